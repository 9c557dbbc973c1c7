"""Net ``executions``: the expert's executions of the first demonstration seed of all 60 tasks.

`memobench generate --no-images` and `memobench describe` on each memory type of both suites. The facts are the hash of
each column of an episode's frames, its length, and whether its hash is the committed one. About 6 CPU minutes.
"""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from scripts.nets.access import succeed
from scripts.nets.store import ROOT, Facts, Parts, digest

SEED = 10_000
RUN = "any processor"
"""Run of ``results/demonstrations.parquet`` with the kernels that `__main__` sets."""
TYPES = ("temporal", "spatial", "object", "procedural")


def parts() -> Parts:
    """Return one part per suite and memory type."""
    return {f"{suite} {kind}": partial(execute, suite, kind) for suite in ("published", "strict") for kind in TYPES}


def execute(suite: str, kind: str, folder: Path) -> Facts:
    """Generate one demonstration of each task; return the facts of its frames."""
    dataset, described = folder / f"{suite}_{kind}", folder / f"{suite}_{kind}_described"
    if not (dataset / "meta" / "info.json").exists():
        words = ("--suite", suite, "--tasks", kind, "--episodes", 1, "--no-images", "--out", dataset)
        succeed("memobench", "generate", *words)
    succeed("memobench", "describe", dataset, "--out", described)
    hashes = {
        task: seeds[str(SEED)]
        for file in described.rglob("*.json")
        for task, seeds in json.loads(file.read_text()).items()
        if isinstance(seeds, dict) and str(SEED) in seeds
    }
    table = pd.read_parquet(ROOT / "results" / "demonstrations.parquet")
    committed = table[(table["run"] == RUN) & (table["seed"] == SEED)].set_index("task")["sha256"]
    every = pd.concat(pd.read_parquet(file) for file in sorted(dataset.glob("data/*/*.parquet")))
    about = pd.concat(pd.read_parquet(file) for file in sorted(dataset.glob("meta/episodes/*/*.parquet")))
    found: Facts = {}
    for task, index in zip(about["task_name"], about["episode_index"], strict=True):
        frames = every[every["episode_index"] == index]
        numeric = [name for name in frames.columns if not isinstance(frames[name].iloc[0], str | dict)]
        columns = {name: digest(np.stack(frames[name].to_list())) for name in numeric}
        hashed = hashes[task] == committed[task]
        found[f"{suite} {task}"] = {"frames": len(frames), "hash is the committed one": hashed, **columns}
    return found
