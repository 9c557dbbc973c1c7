"""``lerobot eval`` itself, per control step: against the bare vector environment and robosuite in LeRobot's loop.

Times run from the first step of an episode to LeRobot's figures of it, videos written, without start-up and reset. The
policies act at random at no cost, and differ in how often they read pictures.

`rollouts_total`: two evaluations of one rollout of each task, cut after a few and after more steps, give the cost
of a step and of a rollout before its first step. All processes run at once, so their mutual slowdown is included; add
the time of a real policy.
"""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.baselines.modeling_baselines import MemobenchRandomPolicy
from lerobot_memobench.protocol import EVALUATION_EPISODES, EVALUATION_SEED, HORIZON
from lerobot_memobench.run import run
from lerobot_memobench.run.plan import plan_line
from lerobot_memobench.run.run import run_evaluation
from lerobot_memobench.tasks.catalogue import task_names
from research.speed.sides import TASK, Apart, Line, StockEnv, machine, stock_open
from research.speed.threads import by_the_libraries, by_the_rule


class Cost(NamedTuple):
    """Of one control step, s: by the clock on the wall, and of all processors together."""

    wall: float
    cpu: float


class Stopwatch:
    """Counts the steps of vector environments, and returns the cost of each since the first."""

    def __init__(self) -> None:
        self.steps, self._start, self._end = 0, Cost(0, 0), Cost(0, 0)

    def step(self) -> None:
        """Note that a step begins."""
        if not self.steps:
            self._start = Cost(time.perf_counter(), time.process_time())
        self.steps += 1

    def end(self) -> None:
        """Note that all is done."""
        self._end = Cost(time.perf_counter(), time.process_time())

    @property
    def cost(self) -> Cost:
        """Of one step."""
        spent = (end - start for start, end in zip(self._start, self._end, strict=True))
        return Cost(*(seconds / self.steps for seconds in spent))


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    """Yield a watch that notes the steps of vector environments in this process and the end of an evaluation."""
    from lerobot.scripts import lerobot_eval

    watch, step = Stopwatch(), gym.vector.SyncVectorEnv.step

    def noted_step(self: gym.vector.SyncVectorEnv, actions: Any) -> Any:
        watch.step()
        return step(self, actions)

    def noted(evaluation: Any) -> Any:
        def evaluate(*args: Any, **settings: Any) -> Any:
            found = evaluation(*args, **settings)
            watch.end()
            return found

        return evaluate

    with (
        patch.object(gym.vector.SyncVectorEnv, "step", noted_step),
        patch.object(lerobot_eval, "eval_policy", noted(lerobot_eval.eval_policy)),
        patch.object(run, "evaluate", noted(run.evaluate)),
    ):
        yield watch


NEVER, EACH, FIFTH = 0, 1, 5
"""Steps from one look at the pictures to the next."""
LINES = {
    "eval_loop_each_frame_seen": (EACH, 0),
    "eval_loop_every_5th_seen": (FIFTH, 0),
    "eval_loop_none_seen": (NEVER, 0),
    "eval_loop_filmed": (EACH, 1),
}
"""Line -> steps between looks, and how many episodes are filmed."""


@contextmanager
def observing_every(steps: int) -> Iterator[None]:
    """While this lasts, the random policy looks at every ``steps``-th observation, at none with 0."""
    calls = itertools.count(1)
    with patch.object(
        MemobenchRandomPolicy, "needs_observation", lambda self: bool(steps) and next(calls) % steps == 0
    ):
        yield


def evaluate_once(every: int, films: int, steps: int, task: str = TASK) -> Cost:
    """Return the cost of a step of ``lerobot eval``, in an episode of so many."""
    words = [
        "env=memobench",
        f"tasks={task}",
        "policy=memobench_random",
        "demonstration_prompt=false",
        f"videos={films}",
    ]
    words += ["episodes=1", "batch_size=1", f"horizon={steps}"]
    with tempfile.TemporaryDirectory() as out, observing_every(every), stopwatch() as watch:
        run_evaluation(plan_line([*words, f"output_dir={Path(out) / 'run'}"]), lambda text: None)
    return watch.cost


def step_bare(every: int, steps: int, task: str = TASK) -> Cost:
    """Return the cost of a step of our vector environment alone, its pictures drawn as often as they are read."""
    watched = True
    with tempfile.TemporaryDirectory() as out, stopwatch() as watch:
        config = MemobenchEnvConfig(tasks=task, demonstration_prompt=False, horizon=steps, log_dir=out)
        env: Any  # gymnasium's stub of a vector environment knows no list of seeds, and no `call`
        ((env,),) = (suite.values() for suite in config.create_envs(1).values())
        env.reset(seed=[EVALUATION_SEED])
        for number, action in enumerate(_moves(steps), start=1):
            looks = bool(every) and number % every == 0
            if looks != watched:
                env.call("need_observation", looks)
                watched = looks
            env.step(action)
        watch.end()
        env.close()
    return watch.cost


def _moves(steps: int) -> NDArray[np.float32]:
    """Return the actions of the random policy, (steps, 1, 7)."""
    return np.random.default_rng(0).uniform(-1, 1, (steps, 1, 7)).astype(np.float32)


def evaluate_stock(stock: Any, films: int, steps: int) -> Cost:
    """Return the cost of a step of stock robosuite in LeRobot's own loop, with its films."""
    from lerobot.envs.utils import freeze_after_episode_end
    from lerobot.scripts import lerobot_eval

    from lerobot_memobench.policies.baselines.configuration_baselines import MemobenchRandomConfig
    from lerobot_memobench.policies.baselines.processor_baselines import pass_through

    logging.disable(logging.WARNING)
    env = gym.vector.SyncVectorEnv([freeze_after_episode_end(lambda: StockEnv(stock, steps))])
    before, after = pass_through("cpu")
    with tempfile.TemporaryDirectory() as out, stopwatch() as watch:
        lerobot_eval.eval_policy(
            env=env,
            policy=MemobenchRandomPolicy(MemobenchRandomConfig()),
            env_preprocessor=_same,
            env_postprocessor=_same,
            preprocessor=before,
            postprocessor=after,
            n_episodes=1,
            max_episodes_rendered=films,
            videos_dir=Path(out),
            start_seed=0,
        )
    return watch.cost


def _same(given: Any) -> Any:
    return given


def eval_loop(task: str = TASK, rounds: int = 5, steps: int = 100, their_steps: int = 20) -> list[Line]:
    """A control step of ``lerobot eval``, by how often the policy looks at pictures, and with a film."""
    with stock_open(True) as stock, rollouts_apart(by_the_rule()) as ours:
        sides: dict[tuple[str, int], Callable[[], Cost]] = {}
        for name, (every, films) in LINES.items():
            sides[name, 0] = partial(ours.does, evaluate_apart, every, films, steps, task)
            sides["bare", every] = partial(ours.does, bare_apart, every, steps, task)
            sides["stock", films] = partial(stock.does, evaluate_stock, films, their_steps)
        costs = _turns(sides, rounds)
    return [
        _line(name, costs[name, 0], costs["stock", films], costs["bare", every], {"task": task})
        for name, (every, films) in LINES.items()
    ]


def thread_rule(task: str = TASK, rounds: int = 5, steps: int = 100) -> list[Line]:
    """Gain of the rule of `jobs.threads` where every frame is read: one evaluation, and two at once.

    ``ours`` is by the rule and ``theirs`` with the threads that the libraries take by themselves. Of two at once it is
    the time of a step of either over two: half of it would be twice the work.
    """
    act, alone = partial(_both, evaluate_apart, EACH, 0, steps, task), partial(_both, bare_apart, EACH, steps, task)
    with ExitStack() as opened:
        teams = {
            way: [opened.enter_context(rollouts_apart(environment)) for _ in range(2)]
            for way, environment in (("rule", by_the_rule()), ("libraries", by_the_libraries()))
        }
        sides: dict[tuple[str, str], Callable[[], Cost]] = {}
        for way, team in teams.items():
            sides[way, "one"] = partial(act, team[:1])
            sides[way, "bare"] = partial(alone, team[:1])
            sides[way, "two"] = partial(act, team)
        costs = _turns(sides, rounds)
    lines = []
    for name, kind in (("threads_one_evaluation", "one"), ("threads_two_evaluations", "two")):
        ours, theirs = costs["rule", kind], costs["libraries", kind]
        detail = {
            "task": task,
            "cpu_ours": round(1e3 * ours.cpu, 3),
            "cpu_theirs": round(1e3 * theirs.cpu, 3),
            "cpu_ratio": round(theirs.cpu / ours.cpu, 2),
            "comparison": "the libraries' own threads",
        }
        if kind == "one":
            for way, added in (("rule", "over_bare"), ("libraries", "over_bare_before")):
                looked, bare = costs[way, "one"], costs[way, "bare"]
                detail |= {added: round(looked.wall / bare.wall - 1, 3)}
                detail |= {f"{added}_cpu": round(looked.cpu / bare.cpu - 1, 3)}
        mine, other = round(1e3 * ours.wall, 3), round(1e3 * theirs.wall, 3)
        lines.append(Line(name, mine, other, round(theirs.wall / ours.wall, 2), "ms", machine(), detail))
    return lines


def _both(do: Callable[..., Cost], *args: Any) -> Cost:
    """Return the cost of a step in processes that run at once: their mean wall time over their number."""
    *what, team = args
    for side in team:
        side.ask(do, *what)
    costs: list[Cost] = [side.answer() for side in team]
    return Cost(statistics.fmean(c.wall for c in costs) / len(team), statistics.fmean(c.cpu for c in costs))


@contextmanager
def rollouts_apart(environment: Mapping[str, str]) -> Iterator[Apart]:
    """Yield a process in which rollouts are measured, with the threads of its environment."""
    side = Apart(_ready, environment)
    try:
        yield side
    finally:
        side.close()


@contextmanager
def _ready() -> Iterator[None]:
    """Make a process ready for rollouts, as `lerobot eval` does."""
    from lerobot_memobench.jobs.threads import ACTING, use_threads

    use_threads(ACTING)
    import lerobot_memobench.registration  # noqa: F401 - makes the policy known

    logging.disable(logging.WARNING)
    yield


def evaluate_apart(_: None, every: int, films: int, steps: int, task: str) -> Cost:
    """Return what `evaluate_once` does."""
    return evaluate_once(every, films, steps, task)


def bare_apart(_: None, every: int, steps: int, task: str) -> Cost:
    """Return what `step_bare` does."""
    return step_bare(every, steps, task)


def _turns[Side](sides: dict[Side, Callable[[], Cost]], rounds: int) -> dict[Side, Cost]:
    """Return the medians of all sides, which take turns; the first round, which compiles and loads, does not count."""
    found: dict[Side, list[Cost]] = {side: [] for side in sides}
    for _ in range(rounds + 1):
        for side, measure in sides.items():
            found[side].append(measure())
    return {side: Cost(*map(statistics.median, zip(*costs[1:], strict=True))) for side, costs in found.items()}


def _line(name: str, ours: Cost, theirs: Cost, bare: Cost, detail: dict[str, Any]) -> Line:
    over_bare = {
        "bare": round(1e3 * bare.wall, 3),
        "over_bare": round(ours.wall / bare.wall - 1, 3),
        "cpu": round(1e3 * ours.cpu, 3),
        "bare_cpu": round(1e3 * bare.cpu, 3),
        "over_bare_cpu": round(ours.cpu / bare.cpu - 1, 3),
    }
    mine, other = round(1e3 * ours.wall, 3), round(1e3 * theirs.wall, 3)
    return Line(name, mine, other, round(theirs.wall / ours.wall, 2), "ms", machine(), {**detail, **over_bare})


SHORT, LONG = 10, 60
"""Execution steps of the two evaluations."""


def _evaluate(tasks: str, steps: int, shard: str, every: int, out: str) -> None:
    """Evaluate a part of the tasks, one rollout each, in a process of its own."""
    import lerobot_memobench.registration  # noqa: F401 - makes the policy known

    words = ["env=memobench", f"tasks={tasks}", "policy=memobench_random", "episodes=1", "videos=0", f"horizon={steps}"]
    with observing_every(every):
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
    """Return the hours that all rollouts of the benchmark take here, and their parts.

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
