"""Net ``executions``: the expert's executions of the first demonstration seed of all 60 tasks.

`memobench generate --no-images` of each task of both suites. The facts are the hash of each column of an episode's
frames, the fields of its row in ``meta/episodes``, and whether its hash is the committed one. About 6 CPU minutes.
"""

from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from scripts.nets.access import succeed
from scripts.nets.store import ROOT, Facts, Parts, digest

SEED = 10_000
RUN = "any processor"
"""Run of ``results/demonstrations.parquet`` with the kernels that `__main__` sets."""
SUITES, TASKS = ("published", "strict"), 30


def parts() -> Parts:
    """Return one part per task, by its number."""
    return {f"{suite} {task}": partial(execute, suite, task) for suite in SUITES for task in range(1, TASKS + 1)}


def execute(suite: str, number: int, folder: Path) -> Facts:
    """Generate one demonstration of a task; return the facts of its frames."""
    dataset = folder / f"{suite}_{number}"
    words = ("--suite", suite, "--tasks", number, "--episodes", 1, "--no-images", "--out", dataset)
    if not (dataset / "meta" / "info.json").exists():
        succeed("memobench", "generate", *words)
    frames = pd.concat(pd.read_parquet(file) for file in sorted(dataset.glob("data/*/*.parquet")))
    (episode,) = pd.read_parquet(next(dataset.glob("meta/episodes/*/*.parquet"))).to_dict("records")
    table = pd.read_parquet(ROOT / "results" / "demonstrations.parquet")
    row = (table["run"] == RUN) & (table["seed"] == SEED) & (table["task"] == episode["task_name"])
    hashed = table.loc[row, "sha256"].tolist() == [episode["digest"]]
    columns = {f"frame {name}": hash_of(frames[name]) for name in frames.columns}
    fields = {f"episode {name}": str(value) for name, value in episode.items() if "/" not in name}
    return {f"{suite} {episode['task_name']}": {"hash is the committed one": hashed, **fields, **columns}}


def hash_of(column: "pd.Series[object]") -> str:
    """Return the hash of a column of numbers, of arrays of numbers, or of anything else."""
    values = np.stack(column.to_list()) if not isinstance(column.iloc[0], str | dict | list) else None
    return digest(column.to_json() if values is None or values.dtype == object else values)
