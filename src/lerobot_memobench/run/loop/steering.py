"""What LeRobot's evaluation loop is made to do beside its own: run parts of a task, seed each batch, draw what is seen.

Written against the loop of one version: what it relies on is listed in tests/engine/test_lerobot_loop.py, whose
failures say what to look at when LeRobot moves on. How it gets there, and out again: `lerobot_hooks`.

LeRobot seeds Python, NumPy and torch once per run, so what a sampling policy draws in an episode depends on all that
ran before it. Here each batch is seeded from the run's seed, the task and the batch's first episode: an evaluation
that is resumed or shared among machines draws what an undisturbed one draws.

Frames are drawn for those who look at them (``rollout``), and the environment films (``env.films``): LeRobot would
render ten episodes of each task a second time.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

from lerobot_memobench.lerobot_hooks import INSIDE_SLURM, ROLLOUT, RUN_ONE, check_version, hooked
from lerobot_memobench.run.grid import Range

KEEPS_ITS_NOISE = ("memobench_mem",)
"""Policies that seed each episode's noise themselves, from torch's initial seed: it must stay the run's."""


@contextmanager
def calm_output() -> Iterator[None]:
    """Keep progress bars out of log files, and a library's farewell out of the end of a run."""
    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    with ExitStack() as stack:
        if not sys.stderr.isatty():
            # The bar is redrawn at every step. LeRobot leaves it out where it takes itself to be in a batch job.
            stack.enter_context(hooked(INSIDE_SLURM, lambda _: lambda: True))
        yield


@contextmanager
def steered(seed: int | None, ranges: Mapping[tuple[str, int], list[Range]] | None = None) -> Iterator[None]:
    """While this lasts, LeRobot's loop seeds batches, draws what is looked at, films nothing and runs only ``ranges``.

    Args:
        seed: of the run; batches are not seeded when None.
        ranges: by LeRobot's name of a task the runs of it; everything when None.

    Raises:
        MemobenchError: the installed LeRobot is another than the one whose loop is known here.
    """
    check_version()
    from lerobot.scripts import lerobot_eval

    from lerobot_memobench.run.loop.rollout import sparing

    def one(run_one: Callable[..., Any]) -> Callable[..., Any]:
        return _unfilmed(run_one) if ranges is None else _only(_unfilmed(run_one), ranges)

    def rolled(rollout: Callable[..., Any]) -> Callable[..., Any]:
        spared = sparing(rollout, lambda: lerobot_eval.inside_slurm())
        return spared if seed is None else _seeded(spared, seed)

    with hooked(RUN_ONE, one), hooked(ROLLOUT, rolled):
        yield


def _unfilmed(run_one: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap LeRobot's evaluation of one task: it renders no episode, and makes no folder for films."""

    @functools.wraps(run_one)
    def run(task_group: str, task_id: int, env: Any, **settings: Any) -> tuple[str, int, dict[str, Any]]:
        imagines = getattr(getattr(settings.get("policy"), "config", None), "save_predicted_video", False)
        folder = settings["videos_dir"] if imagines else None  # a world model's own videos stay
        return run_one(task_group, task_id, env, **{**settings, "max_episodes_rendered": 0, "videos_dir": folder})

    return run


def _only(run_one: Callable[..., Any], ranges: Mapping[tuple[str, int], list[Range]]) -> Callable[..., Any]:
    """Wrap LeRobot's evaluation of one task: it is called once per range, the results are joined."""

    @functools.wraps(run_one)
    def run(task_group: str, task_id: int, env: Any, **settings: Any) -> tuple[str, int, dict[str, Any]]:
        joined: dict[str, Any] = {}
        mine = ranges.get((task_group, task_id), [])
        for first, count in mine:
            changed = {**settings, "start_seed": settings["start_seed"] + first, "n_episodes": count}
            for folder in ("videos_dir", "recording_dir"):
                if len(mine) > 1 and settings.get(folder) is not None:  # LeRobot numbers its films from 0
                    changed[folder] = settings[folder] / f"from_{first}"
            _, _, metrics = run_one(task_group, task_id, env, **changed)
            for key, values in metrics.items():
                joined[key] = [*joined.get(key, []), *values]
        return task_group, task_id, joined

    return run


def _seeded(rollout: Callable[..., Any], seed: int) -> Callable[..., Any]:
    """Wrap LeRobot's rollout of one batch: what the policy draws depends on the batch alone."""
    first_seeds: dict[str, int] = {}  # of the policy's own generators: a setting of the policy's may have chosen them

    @functools.wraps(rollout)
    def run(env: Any, policy: Any, *args: Any, **settings: Any) -> Any:
        seeds = settings.get("seeds")
        if seeds and getattr(policy, "name", None) not in KEEPS_ITS_NOISE:
            _seed_batch(policy, first_seeds, seed, env.call("task")[0], seeds[0])
        return rollout(env, policy, *args, **settings)

    return run


def _seed_batch(policy: Any, first_seeds: dict[str, int], seed: int, task: str, first: int) -> None:
    """Seed what LeRobot seeds, and the policy's own generators, whose first seeds are remembered and still count."""
    from lerobot.utils.random_utils import set_seed
    from torch import Generator

    set_seed(batch_seed(seed, task, first))
    for name, generator in vars(policy).items():
        if isinstance(generator, Generator):
            own = first_seeds.setdefault(name, generator.initial_seed())
            generator.manual_seed(batch_seed(seed, task, first, own))


def batch_seed(seed: int, task: str, first: int, *more: int) -> int:
    """Return the seed (32 bits) of the batch that begins with the episode of the seed ``first``."""
    text = " ".join(str(part) for part in (seed, task, first, *more))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "big")
