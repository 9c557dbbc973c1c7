"""Play a demonstration prompt: simulate it, or restore it bit for bit from the user's cache folder.

A prompt depends on task, variant and seed, not on the policy. Its file contains the snapshot after each control step.
``MEMOBENCH_PROMPT_CACHE=off`` turns the cache off.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import logging
import os
import sys
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import ACTION_DIM
from lerobot_memobench.experts.expert import PromptDemonstrator
from lerobot_memobench.io import cache_folder, draft_of, files_below
from lerobot_memobench.sim.simulation import Simulation, Snapshot
from lerobot_memobench.tasks.task import Task
from mujoco_raster.highlights import Highlight

logger = logging.getLogger(__name__)

VARIABLE = "MEMOBENCH_PROMPT_CACHE"
LARGEST = 2 << 30
"""Maximum bytes of all files: several thousand prompts of 0.2 to 0.7 MB. The least recently used ones are removed."""
PACKAGES = ("mujoco", "numpy", "scipy")
SOURCES = ("tasks", "sim", "experts", "envs")


class PromptPlayer:
    """Simulate a prompt of at most ``longest`` control steps from the initial state; store it in ``file``."""

    over = False
    succeeded = False
    observed = True  # whether frames before the end are read; if not, a restored prompt skips them

    def __init__(self, demonstrator: PromptDemonstrator, sim: Simulation, longest: int, file: Path | None) -> None:
        self._demonstrator, self._sim, self._longest, self._file = demonstrator, sim, longest, file
        self._actions = demonstrator.actions()
        self._next = next(self._actions, None)
        self._steps = 0
        self._rows: list[NDArray[np.float64]] = []

    def step(self) -> NDArray[np.float32]:
        """Advance by one control step and return the executed action (7,)."""
        file, self._file = self._file, None  # do not store a prompt that raised an error
        action: NDArray[np.float32] = np.zeros(ACTION_DIM, np.float32)
        if self._next is not None:
            action = np.array(self._next, dtype=np.float32)
            self._sim.step(action)
        self._steps += 1
        self._next = next(self._actions, None)
        self.over = self._next is None or self._steps >= self._longest
        self.succeeded = self._demonstrator.succeeded
        self._file = file
        if file is not None:
            self._rows.append(_row(action, self._sim))
            if self.over:
                _write(file, np.array(self._rows), self.succeeded)
        return action


class RestoredPrompt(PromptPlayer):
    """Restore a stored prompt step by step."""

    def __init__(self, sim: Simulation, rows: NDArray[np.float64], succeeded: bool) -> None:
        self._sim, self._kept, self._steps, self.succeeded = sim, rows, 0, succeeded

    def step(self) -> NDArray[np.float32]:
        """Advance by one control step and return the executed action (7,)."""
        parts = np.split(self._kept[self._steps], np.cumsum(_PARTS))
        action, position, rotation, gripper, goes_on, highlight, physics = parts
        self._steps += 1
        self.over = self._steps == len(self._kept)
        if self.observed or self.over:
            snapshot = Snapshot(physics, position, rotation.reshape(3, 3), gripper, bool(goes_on[0]))
            self._sim.restore(snapshot, replayed=True)
            x, y, z, radius = map(float, highlight)
            self._sim.highlights = () if np.isnan(radius) else (Highlight((x, y, z), radius),)
        return action.astype(np.float32)


_PARTS = (ACTION_DIM, 3, 9, 2, 1, 4)
"""Numbers in a row: action, the snapshot's goal position and rotation, gripper and ``goes_on``, position and radius of
the highlight (NaN without one). The physics of the snapshot follow."""


def _row(action: NDArray[np.float32], sim: Simulation) -> NDArray[np.float64]:
    at, lit = sim.snapshot(), sim.highlights
    highlight = (*lit[0].position, lit[0].radius) if lit else (np.nan,) * 4
    parts = action, at.goal_position, at.goal_rotation.ravel(), at.gripper, [at.goes_on], highlight, at.physics
    return np.concatenate(parts, dtype=np.float64)


def prompt_player(demonstrator: PromptDemonstrator, sim: Simulation, longest: int, file: Path | None) -> PromptPlayer:
    """Return a prompt that is restored if ``file`` contains it, else simulated."""
    stored = None if file is None else _read(file, sum(_PARTS) + sim.physics_dim)
    return PromptPlayer(demonstrator, sim, longest, file) if stored is None else RestoredPrompt(sim, *stored)


def prompt_file(task: Task, seed: int, scene_hash: str) -> Path | None:
    """Return the cache file of a prompt, named by a hash of everything that affects it; None if the cache is off."""
    if os.environ.get(VARIABLE, "").lower() in ("off", "0", "false", "no"):
        return None
    # The initial scene is the result of 250 physics steps: its hash separates machines with different arithmetic.
    content = dataclasses.replace(task, folder=Path()), task.bddl_text, seed, scene_hash, _code()
    return cache_folder() / "prompts" / f"{hashlib.sha256(repr(content).encode()).hexdigest()[:32]}.npz"


@cache
def _code() -> tuple[str, ...]:
    package = Path(__file__).parents[1]
    digest = hashlib.sha256((package / "constants.py").read_bytes())
    for source in sorted(file for part in SOURCES for file in files_below(package / part, ".py")):
        digest.update(source.relative_to(package).as_posix().encode() + source.read_bytes())
    return digest.hexdigest(), *(metadata.version(name) for name in PACKAGES), sys.version


def _read(file: Path, width: int) -> tuple[NDArray[np.float64], bool] | None:
    try:
        with np.load(file, allow_pickle=False) as stored:
            name, rows, succeeded = str(stored["name"]), stored["rows"], bool(stored["succeeded"])
    except Exception:  # damaged files raise errors of zipfile, zlib, NumPy and the system
        return None
    if name != file.name or rows.dtype != np.float64 or rows.shape != (len(rows) or 1, width):
        return None
    with contextlib.suppress(OSError):  # read-only folder
        os.utime(file)
    return rows, succeeded


def _write(file: Path, rows: NDArray[np.float64], succeeded: bool) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(file) as draft:
            np.savez_compressed(draft, name=np.array(file.name), rows=rows, succeeded=np.array(succeeded))
        _make_room(file.parent)
    except OSError as error:
        _warn_once(f"prompts cannot be cached in {file.parent} ({error.strerror or error}); set {VARIABLE}=off")


def _make_room(folder: Path) -> None:
    entries = []
    for file in folder.glob("*.npz"):  # includes drafts of killed processes
        with contextlib.suppress(FileNotFoundError):  # removed by another process
            entries.append((file.stat().st_mtime_ns, file.stat().st_size, file))
    excess = sum(size for _, size, _ in entries) - LARGEST
    for _, size, file in sorted(entries):
        if excess <= 0:
            return
        file.unlink(missing_ok=True)
        excess -= size


@cache
def _warn_once(text: str) -> None:
    logger.warning(text)
