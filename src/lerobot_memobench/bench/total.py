"""How long a whole evaluation takes: 1,500 rollouts with images, measured on a sample of all tasks.

Two evaluations of one rollout of each task, cut after a few and after more steps, tell what a step costs and what a
rollout costs before its first step (reset, prompt video); all processes run at once, so what they take from one another
is in it. The policy costs nothing: what a real one computes is to be added.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from pathlib import Path
from typing import Any

from lerobot_memobench.bench.evaluation import FIFTH, looking_every
from lerobot_memobench.bench.machine import machine
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.protocol import EVALUATION_EPISODES, HORIZON
from lerobot_memobench.run.plan import plan_line
from lerobot_memobench.run.run import run_evaluation
from lerobot_memobench.tasks.catalogue import task_names

SHORT, LONG = 10, 60
"""Execution steps of the two evaluations."""


def _evaluate(tasks: str, steps: int, shard: str, every: int, out: str) -> None:
    """Evaluate a part of the tasks, one rollout each, in a process of its own."""
    import lerobot_memobench.registration  # noqa: F401 - makes the policy known

    words = ["env=memobench", f"tasks={tasks}", "policy=memobench_random", "episodes=1", "films=0", f"horizon={steps}"]
    with looking_every(every):
        run_evaluation(plan_line([*words, f"shard={shard}", f"output_dir={out}"]), lambda text: None)


def seconds(tasks: str, steps: int, processes: int, every: int) -> tuple[dict[str, float], float]:
    """Return task -> seconds that its rollout of so many execution steps takes, and CPU seconds of all processes."""
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as out:
        team = [
            context.Process(target=_evaluate, args=(tasks, steps, f"{number + 1}/{processes}", every, out))
            for number in range(processes)
        ]
        before = _cpu_of_children()
        for process in team:
            process.start()
        for process in team:
            process.join()
        found = [record for folder in Path(out).iterdir() for record in read_episodes(folder)]
    return {record["task"]: record["wall_s"] for record in found}, _cpu_of_children() - before


def _cpu_of_children() -> float:
    """Return the CPU seconds of this process's children that have ended."""
    used = os.times()
    return used.children_user + used.children_system


def rollouts_total(tasks: str = "all", processes: int | None = None, every: int = FIFTH) -> dict[str, Any]:
    """Return the hours that all rollouts of the benchmark take here, and what they consist of.

    Each rollout is counted with its whole horizon: the most that there can be, for a success ends one earlier.

    Args:
        tasks: those in the sample; their mean counts for all others.
        processes: as many as there are cores when None.
        every: steps from one look at the pictures to the next.
    """
    team = processes or cores()
    (short, short_cpu), (long, long_cpu) = (seconds(tasks, steps, team, every) for steps in (SHORT, LONG))
    more = len(short) * (LONG - SHORT)
    step = sum(long[task] - short[task] for task in short) / more
    before = sum(short.values()) / len(short) - SHORT * step
    rollouts = len(task_names()) * EVALUATION_EPISODES
    return {
        "name": "rollouts_total",
        "rollouts": rollouts,
        "hours": round(rollouts * (before + HORIZON * step) / team / 3600, 2),
        "ms_per_step": round(1e3 * step, 3),
        "cpu_ms_per_step": round(1e3 * (long_cpu - short_cpu) / more, 3),
        "s_before_the_first_step": round(before, 3),
        "tasks": len(short),
        "processes": team,
        "steps_per_look": every,
        "machine": machine(),
    }
