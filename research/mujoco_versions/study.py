"""The expert under two versions of MuJoCo: outcomes, final states and first pictures compared.

Each side runs in a process of its own, which finds its MuJoCo first on its path, and writes one file per task. A file
that is there is not made again, so a study that was ended goes on.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of
from lerobot_memobench.protocol import ACTION_DIM, CAMERAS, EVALUATION_SEED, PROMPT
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import SUITES


class Drift(NamedTuple):
    """One episode on both sides.

    Attributes:
        solved: on either side.
        steps: control steps on either side.
        start, end: how far any body of the scene is from itself on the other side, m, at the first and last frame.
        pixels: share of the pixels of the first pictures that differ.
        shade: their mean absolute difference, of 255, over all pixels.
    """

    suite: str
    task: str
    seed: int
    solved: tuple[bool, bool]
    steps: tuple[int, int]
    start: float
    end: float
    pixels: float
    shade: float


def run_side(out: Path, seeds: int, tasks: Sequence[str] | None = None) -> None:
    """Let the expert act under the MuJoCo of this process.

    Args:
        out: folder of one ``.npz`` file per task.
        seeds: episodes per task.
        tasks: names; None for all of both suites.
    """
    import mujoco

    out.mkdir(parents=True, exist_ok=True)
    for name in tasks or task_names(suite=None):
        path = out / f"{name}.npz"
        if path.exists():
            continue
        episode = Episode(get_task(name))
        rows = [_run_episode(episode, EVALUATION_SEED + k) for k in range(seeds)]
        with draft_of(path) as draft:
            columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
            np.savez_compressed(draft, **columns, mujoco=np.array(mujoco.__version__))  # type: ignore[arg-type]  # numpy's stub
        print(f"MuJoCo {mujoco.__version__}: {name}: {sum(row['solved'] for row in rows)}/{seeds}", flush=True)


def _run_episode(episode: Episode, seed: int) -> dict[str, Any]:
    episode.reset(seed)
    row = {"seed": seed, "start": episode.sim.data.xpos.copy()}
    row |= {key: episode.sim.render(camera).copy() for key, camera in CAMERAS.items()}
    while not episode.done:
        in_prompt = episode.phase == PROMPT
        episode.step(np.zeros(ACTION_DIM, np.float32) if in_prompt else episode.expert_action())
    return row | {"solved": episode.success, "steps": episode.step_index, "end": episode.sim.data.xpos.copy()}


def run_both(packages: Path, out: Path, seeds: int, tasks: Sequence[str] | None = None) -> None:
    """Run this environment's side into ``out/here`` and the other into ``out/there``.

    Args:
        packages: folder that holds the other MuJoCo, as ``uv pip install --target`` makes it.
    """
    if not packages.is_dir():
        raise MemobenchError(f"{packages} is not a folder; expected one that holds another MuJoCo")
    for side in ("here", "there"):
        first = [str(packages.resolve())] if side == "there" else []
        path = os.pathsep.join([*first, os.getcwd(), *filter(None, [os.environ.get("PYTHONPATH")])])
        words = [sys.executable, "-m", "research.mujoco_versions", "side", str(out / side), str(seeds), *(tasks or ())]
        done = subprocess.run(words, env=os.environ | {"PYTHONPATH": path}, check=False)
        if done.returncode:
            raise MemobenchError(f"the side {side!r} ended with status {done.returncode}; see its message above")


def compare(out: Path) -> tuple[tuple[str, str], list[Drift]]:
    """Return both versions of MuJoCo and what differs in every episode that both sides ran."""
    versions: set[tuple[str, str]] = set()
    drifts: list[Drift] = []
    for suite in SUITES:
        for name in task_names(suite=suite):
            files = [out / side / f"{name}.npz" for side in ("here", "there")]
            if not all(file.exists() for file in files):
                continue
            with np.load(files[0], allow_pickle=False) as a, np.load(files[1], allow_pickle=False) as b:
                here, there = dict(a), dict(b)
            versions.add((str(here["mujoco"]), str(there["mujoco"])))
            drifts += [_drift(suite, name, here, there, k) for k in range(min(len(here["seed"]), len(there["seed"])))]
    if len(versions) != 1:
        raise MemobenchError(f"{out} holds runs of {len(versions)} pairs of MuJoCo versions; expected one")
    return versions.pop(), drifts


def _drift(suite: str, task: str, here: dict[str, np.ndarray], there: dict[str, np.ndarray], k: int) -> Drift:
    def distance(key: str) -> float:
        return float(np.linalg.norm(here[key][k] - there[key][k], axis=1).max())

    apart = np.stack([np.abs(here[key][k].astype(int) - there[key][k].astype(int)) for key in CAMERAS])
    return Drift(
        suite,
        task,
        int(here["seed"][k]),
        (bool(here["solved"][k]), bool(there["solved"][k])),
        (int(here["steps"][k]), int(there["steps"][k])),
        distance("start"),
        distance("end"),
        float(apart.any(axis=-1).mean()),
        float(apart.mean()),
    )


def table(versions: tuple[str, str], drifts: Sequence[Drift]) -> str:
    """Return a Markdown table, a row per suite, and a line for each episode that ends otherwise."""
    here, there = versions
    lines = [
        f"| suite | episodes | solved, {here} | solved, {there} | as many steps | start apart, mm | end apart, mm "
        "| pixels that differ | shade, of 255 |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for suite in SUITES:
        rows = [drift for drift in drifts if drift.suite == suite]
        if rows:
            cells = [
                suite,
                len(rows),
                sum(row.solved[0] for row in rows),
                sum(row.solved[1] for row in rows),
                sum(row.steps[0] == row.steps[1] for row in rows),
                _spread(1e3 * row.start for row in rows),
                _spread(1e3 * row.end for row in rows),
                _spread((100 * row.pixels for row in rows), " %"),
                _spread(row.shade for row in rows),
            ]
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    otherwise = [
        f"- {row.task}, seed {row.seed}: solved under {here if row.solved[0] else there} alone"
        for row in drifts
        if row.solved[0] != row.solved[1]
    ]
    lines += ["", "Apart, pixels and shade: median, 90th percentile, largest."]
    return "\n".join([*lines, *(["", *otherwise] if otherwise else [])])


def _spread(values: Iterable[float], unit: str = "") -> str:
    cuts = np.quantile(np.array(list(values)), [0.5, 0.9, 1.0])
    return ", ".join(f"{cut:.3g}" for cut in cuts) + unit
