"""LIBERO's own five suites: 130 tasks without checkpoints, and 50 initial states of each.

``tasks/libero/<suite>.zip`` holds for each task, in LIBERO's order, its BDDL file and a NumPy array of its initial
states, which ``scripts/libero_suites.py`` reads from the wheel hf-libero. The suites of this benchmark stay
`task.SUITES`: a LIBERO task has no checkpoints, prompt or variants.
"""

from __future__ import annotations

import io
import zipfile
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.tasks.bddl import parse_bddl
from lerobot_memobench.tasks.task import LIBERO_SUITES, LiberoSuite, Task
from lerobot_memobench.untrusted import refusing

FOLDER = Path(__file__).parent / "libero"
SCENE_LANGUAGE = "SCENE"
"""Part of the names of LIBERO-100's tasks that ends the name of the scene."""
NUM_STATES = 50
"""Initial states of each task; episode i starts in state i."""
STEP_LIMITS: dict[LiberoSuite, int] = {
    "libero_spatial": 280,
    "libero_object": 280,
    "libero_goal": 300,
    "libero_10": 520,
    "libero_90": 400,
}
"""Control steps of an episode, those of LeRobot's LIBERO environment."""


def libero_tasks(suite: str) -> tuple[str, ...]:
    """Return the names of a suite's tasks in LIBERO's order, a task's id is its index; raises for an unknown suite."""
    check_choice("suite", suite, LIBERO_SUITES)
    return _names(suite)


def libero_id(name: str) -> int | None:
    """Return LIBERO's id of a task, its index in its suite; None for a task that is not LIBERO's."""
    return next((_names(suite).index(name) for suite in LIBERO_SUITES if name in _names(suite)), None)


@cache
def get_libero_task(name: str) -> Task:
    """Return a LIBERO task.

    Its instruction is LIBERO's and LeRobot's, derived from the task's name; the file's ``:language`` may differ.
    """
    suite = _suite_of(name)
    text = _read(suite, f"{name}.bddl").decode()
    problem = parse_bddl(text, f"{_archive(suite)}/{name}.bddl")
    return Task(
        name=name,
        memory_type=suite,
        family=suite,
        language=language(name),
        **problem.scene,
        checkpoints=(),
        prompt=None,
        variants=(),
        demo_summary="",
        folder=_archive(suite) / name,
        bddl_text=text,
        metadata={},
        suite=suite,
    )


@lru_cache(maxsize=8)
def initial_states(name: str) -> NDArray[np.float64]:
    """Return the initial states of a LIBERO task, (50, 1 + nq + nv), read-only: time, positions and velocities.

    Raises:
        MemobenchError: the name is unknown, or the suite's file is damaged.
    """
    suite = _suite_of(name)
    with refusing(lambda reason: _damaged(suite, reason)):
        states = np.load(io.BytesIO(_read(suite, f"{name}.npy")), allow_pickle=False)
        if states.dtype != np.float64 or states.ndim != 2 or len(states) != NUM_STATES or not np.isfinite(states).all():
            raise _damaged(suite, f"the initial states of {name} are {states.dtype} of shape {states.shape}")
    states.flags.writeable = False
    return states


def check_states(suite: str, first: int, episodes: int) -> None:
    """Raise `MemobenchError` unless the tasks of a suite have the initial states of ``episodes`` from ``first`` on."""
    if not 0 <= first <= first + episodes <= NUM_STATES:
        raise MemobenchError(
            f"found the initial states {first} to {first + episodes - 1}, and tasks of {suite} have {NUM_STATES} "
            f"initial states, 0 to {NUM_STATES - 1}: ask for at most {NUM_STATES} episodes, and leave seed_base out"
        )


def language(name: str) -> str:
    """Return the instruction that LIBERO derives from a task's name."""
    words = name.split("_")
    scenes = [index for index, word in enumerate(words) if word.startswith(SCENE_LANGUAGE)]
    return " ".join(words[scenes[0] + 1 :] if name[0].isupper() and scenes else words)


def _suite_of(name: str) -> LiberoSuite:
    for suite in LIBERO_SUITES:  # names are unique over all suites
        if name in _names(suite):
            return suite
    known = [known for suite in LIBERO_SUITES for known in _names(suite)]
    raise MemobenchError(f"found no task named {name!r} in LIBERO's suites, {nearest(name, known)}")


@cache
def _names(suite: str) -> tuple[str, ...]:
    with refusing(lambda reason: _damaged(suite, reason)), zipfile.ZipFile(_archive(suite)) as archive:
        return tuple(entry.removesuffix(".bddl") for entry in archive.namelist() if entry.endswith(".bddl"))


def _read(suite: str, entry: str) -> bytes:
    with refusing(lambda reason: _damaged(suite, reason)), zipfile.ZipFile(_archive(suite)) as archive:
        return archive.read(entry)


def _archive(suite: str) -> Path:
    return FOLDER / f"{suite}.zip"


def _damaged(suite: str, reason: str) -> MemobenchError:
    return MemobenchError(f"{_archive(suite)} is not the file of this package ({reason}); install the package again")
