"""``lerobot eval`` itself, per control step: beside the bare vector environment, and stock robosuite in LeRobot's loop.

What is timed lasts from the first step of an episode to LeRobot's figures of it, films written: start-up and reset are
apart. The policies act at random and cost nothing; how often they look at pictures is what differs.
"""

from __future__ import annotations

import itertools
import logging
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.bench.line import Line
from lerobot_memobench.bench.machine import TASK, machine
from lerobot_memobench.bench.sides import STOCK_CAMERAS, make_current, stock_open
from lerobot_memobench.engine.defaults import FIRST_SEED
from lerobot_memobench.engine.planning import plan_line
from lerobot_memobench.engine.run import run_evaluation
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.observations import IMAGE_KEYS, METADATA, action_space, observation_space
from lerobot_memobench.policies.memobench_random.modeling_memobench_random import MemobenchRandomPolicy

NEVER, EACH, FIFTH = 0, 1, 5
"""Steps from one look at the pictures to the next."""
LINES = {
    "eval_loop_each_frame_seen": (EACH, 0),
    "eval_loop_every_5th_seen": (FIFTH, 0),
    "eval_loop_none_seen": (NEVER, 0),
    "eval_loop_filmed": (EACH, 1),
}
"""Line -> steps between looks, and how many episodes are filmed."""


class Cost(NamedTuple):
    """Of one control step, s: by the clock on the wall, and of all processors together."""

    wall: float
    cpu: float


class Stopwatch:
    """Counts the steps of vector environments, and tells what each has cost since the first."""

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
    """Yield a watch that notes the steps of vector environments in this process and the end of LeRobot's evaluation."""
    from lerobot.scripts import lerobot_eval

    watch, step, evaluate = Stopwatch(), gym.vector.SyncVectorEnv.step, lerobot_eval.eval_policy

    def noted_step(self: gym.vector.SyncVectorEnv, actions: Any) -> Any:
        watch.step()
        return step(self, actions)

    def noted_evaluation(*args: Any, **settings: Any) -> Any:
        found = evaluate(*args, **settings)
        watch.end()
        return found

    with (
        patch.object(gym.vector.SyncVectorEnv, "step", noted_step),
        patch.object(lerobot_eval, "eval_policy", noted_evaluation),
    ):
        yield watch


@contextmanager
def looking_every(steps: int) -> Iterator[None]:
    """While this lasts, the random policy looks at every ``steps``-th observation, at none with 0."""
    calls = itertools.count(1)
    with patch.object(MemobenchRandomPolicy, "looks_next", lambda self: bool(steps) and next(calls) % steps == 0):
        yield


def evaluate_once(every: int, films: int, steps: int, task: str = TASK) -> Cost:
    """Return what a step of ``lerobot eval`` costs, in an episode of so many."""
    words = ["env=memobench", f"tasks={task}", "policy=memobench_random", "prompt_video=false", f"films={films}"]
    words += ["episodes=1", "batch_size=1", f"horizon={steps}"]
    with tempfile.TemporaryDirectory() as out, looking_every(every), stopwatch() as watch:
        run_evaluation(plan_line([*words, f"output_dir={Path(out) / 'run'}"]), lambda text: None)
    return watch.cost


def step_bare(every: int, steps: int, task: str = TASK) -> Cost:
    """Return what a step of our vector environment costs by itself, its pictures drawn as often as they are seen."""
    watched = True
    with tempfile.TemporaryDirectory() as out, stopwatch() as watch:
        config = MemobenchEnvConfig(tasks=task, prompt_video=False, horizon=steps, log_dir=out)
        ((env,),) = (suite.values() for suite in config.create_envs(1).values())
        env.reset(seed=[FIRST_SEED])
        for number, action in enumerate(_moves(steps), start=1):
            looks = bool(every) and number % every == 0
            if looks != watched:
                env.call("watch", looks)
                watched = looks
            env.step(action)
        watch.end()
        env.close()
    return watch.cost


def _moves(steps: int) -> NDArray[np.float32]:
    """Return what the random policy does, (steps, 1, 7)."""
    return np.random.default_rng(0).uniform(-1, 1, (steps, 1, 7)).astype(np.float32)


# --- stock robosuite ---


class StockEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """Stock robosuite as LeRobot's loop wants it, with our observation's names."""

    metadata = METADATA
    task = task_description = "pick_place"

    def __init__(self, stock: Any, steps: int) -> None:
        self.render_mode, self._stock, self._max_episode_steps = "rgb_array", stock, steps
        self.observation_space, self.action_space = observation_space(False), action_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start anew."""
        super().reset(seed=seed)
        make_current(self._stock)
        self._step = 0
        return self._observed(self._stock.reset()), {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Take one control step."""
        make_current(self._stock)
        self._step += 1
        found, reward, _, _ = self._stock.step(action)
        return self._observed(found), float(reward), False, self._step >= self._max_episode_steps, {"is_success": False}

    def _observed(self, found: dict[str, Any]) -> dict[str, Any]:
        self._pictures = {key: found[f"{camera}_image"] for key, camera in zip(IMAGE_KEYS, STOCK_CAMERAS, strict=True)}
        hand = (found["robot0_eef_pos"], found["robot0_eef_quat"][:3], found["robot0_gripper_qpos"])
        still = np.ones(1, np.float32)
        return {"pixels": self._pictures, "agent_pos": np.concatenate(hand, dtype=np.float32), "phase": still} | {
            "step": still * self._step
        }

    def render(self) -> NDArray[np.uint8]:
        """Return both cameras side by side."""
        return np.hstack(list(self._pictures.values()))


def evaluate_stock(stock: Any, films: int, steps: int) -> Cost:
    """Return what a step of stock robosuite costs in LeRobot's own loop, with its films."""
    from lerobot.envs.utils import freeze_after_episode_end
    from lerobot.scripts import lerobot_eval

    from lerobot_memobench.policies.memobench_random.configuration_memobench_random import MemobenchRandomConfig
    from lerobot_memobench.policies.pass_through import pass_through

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


# --- taking turns ---


def eval_loop(task: str = TASK, rounds: int = 5, steps: int = 100, their_steps: int = 20) -> list[Line]:
    """A control step of ``lerobot eval``, by how often the policy looks at pictures, and with a film."""
    import lerobot_memobench.registration  # noqa: F401 - makes the policy known

    logging.disable(logging.WARNING)
    try:
        with stock_open(True) as stock:
            sides: dict[tuple[str, int], Callable[[], Cost]] = {}
            for name, (every, films) in LINES.items():
                sides[name, 0] = lambda every=every, films=films: evaluate_once(every, films, steps, task)  # type: ignore[misc]
                sides["bare", every] = lambda every=every: step_bare(every, steps, task)  # type: ignore[misc]
                sides["stock", films] = lambda films=films: evaluate_stock(stock, films, their_steps)  # type: ignore[misc]
            costs = _turns(sides, rounds)
    finally:
        logging.disable(logging.NOTSET)
    return [
        _line(name, costs[name, 0], costs["stock", films], costs["bare", every], {"task": task})
        for name, (every, films) in LINES.items()
    ]


def _turns[Side](sides: dict[Side, Callable[[], Cost]], rounds: int) -> dict[Side, Cost]:
    """Return the medians of all sides, which take turns; the first round, which compiles and loads, does not count."""
    found: dict[Side, list[Cost]] = {side: [] for side in sides}
    for _ in range(rounds + 1):
        for side, measure in sides.items():
            found[side].append(measure())
    return {side: Cost(*map(statistics.median, zip(*costs[1:], strict=True))) for side, costs in found.items()}


def _line(name: str, ours: Cost, theirs: Cost, bare: Cost, detail: dict[str, Any]) -> Line:
    beside = {
        "bare": round(1e3 * bare.wall, 3),
        "over_bare": round(ours.wall / bare.wall - 1, 3),
        "cpu": round(1e3 * ours.cpu, 3),
        "bare_cpu": round(1e3 * bare.cpu, 3),
        "over_bare_cpu": round(ours.cpu / bare.cpu - 1, 3),
    }
    mine, other = round(1e3 * ours.wall, 3), round(1e3 * theirs.wall, 3)
    return Line(name, mine, other, round(theirs.wall / ours.wall, 2), "ms", machine(), {**detail, **beside})
