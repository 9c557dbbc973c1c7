"""The two sides of a comparison: this simulator, and stock robosuite 1.4.1 with the same arm, cameras and sizes."""

from __future__ import annotations

import gc
import json
import logging
import multiprocessing
import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from unittest.mock import patch

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.observations import METADATA, action_space, observation_space
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.protocol import CAMERAS, CONTROL_HZ
from lerobot_memobench.sim.controller import FULLM_READS_DATA
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.progress import Progress
from research.speed.threads import by_the_libraries

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
"""The task by default: its bowls have the most contacts of the catalogue's usual scenes."""
STOCK_GL = os.environ.get("MUJOCO_GL", "egl")
"""With what stock robosuite draws."""


@cache
def machine() -> str:
    """Return processor, cores, versions and what draws stock's pictures, for a reader to compare with."""
    return (
        f"{_processor()}, {cores()} cores, {platform.system()}, mujoco {mujoco.__version__}, stock drawn by {STOCK_GL}"
    )


def _processor() -> str:
    model = platform.processor() or platform.machine()
    try:
        names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    except OSError:
        return model
    return names[0].split(":", 1)[1].strip() if names else model


# --- the sides ---

STOCK_CAMERAS = ["agentview", "robot0_eye_in_hand"]
IMAGE_SIZE = 256


class Times(NamedTuple):
    """Duration, s: wall time, and CPU time of all threads of the process."""

    wall: float
    cpu: float


Turn = Callable[[], Times]
"""Do the thing once and return how long it took."""


class Ours:
    """A step as the gym environment takes it: physics, checkpoints, proprioception and, if wanted, both images."""

    def __init__(self, task: str = TASK, images: bool = True, quality: str = "default") -> None:
        self.task = get_task(task)
        self.sim = Simulation(self.task, RenderSettings(IMAGE_SIZE, IMAGE_SIZE, quality))
        self.images = images
        self.reset(0)

    def look(self) -> list[NDArray[np.uint8]]:
        """Return both images, if wanted."""
        return [self.sim.render(camera) for camera in MJCF_CAMERAS] if self.images else []

    def reset(self, seed: int) -> None:
        """Start the scene of a seed, stabilisation steps included."""
        self.sim.reset(seed)
        self.progress = Progress(self.task)
        self.look()

    def step(self, action: NDArray[np.float64]) -> None:
        """Take one control step."""
        self.sim.step(action)
        self.progress.step(self.sim.holds)
        self.sim.proprio()
        self.look()


class Vectored:
    """The same through the vector environment that LeRobot steps: one environment, both images."""

    def __init__(self, task: str = TASK) -> None:
        from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig

        self._logs = TemporaryDirectory()
        config = MemobenchEnvConfig(tasks=task, demonstration_prompt=False, log_dir=self._logs.name)
        [suite] = config.create_envs(1).values()
        self.env: Any  # gymnasium's stub of a vector environment knows no list of seeds
        [self.env] = suite.values()
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start the episode of a seed."""
        self.env.reset(seed=[seed])

    def step(self, action: NDArray[np.float64]) -> None:
        """Take one control step."""
        self.env.step(action[None].astype(np.float32))

    def close(self) -> None:
        """End the environment and its log."""
        self.env.close()
        self._logs.cleanup()


# --- stock robosuite ---


def stock_robosuite(images: bool = True) -> Any:
    """Return robosuite's PickPlace as its documentation makes it, without its warnings.

    Raises:
        MemobenchError: its controllers do not run on this MuJoCo.
    """
    if FULLM_READS_DATA:
        raise MemobenchError(f"robosuite's controllers need MuJoCo before 3.10, found {mujoco.__version__}")
    os.environ["MUJOCO_GL"] = STOCK_GL
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import robosuite
        from robosuite.controllers import load_controller_config

        return robosuite.make(
            "PickPlace",
            robots="Panda",
            controller_configs=load_controller_config(default_controller="OSC_POSE"),
            has_renderer=False,
            has_offscreen_renderer=images,
            use_camera_obs=images,
            camera_names=STOCK_CAMERAS,
            camera_heights=IMAGE_SIZE,
            camera_widths=IMAGE_SIZE,
            control_freq=CONTROL_HZ,
            horizon=10**9,
        )


def make_current(env: Any) -> None:
    """Make robosuite's GL context current; it assumes to be the only one that draws."""
    context = getattr(env.sim, "_render_context_offscreen", None)
    if context is not None:
        context.gl_ctx.make_current()


class Apart:
    """A side in a process of its own, which waits between calls so that sides can take turns.

    Args:
        opened: opens what every function that is asked for is given first; both are pickled.
        environment: of the process. It sets the threads of its libraries (`jobs.threads`).
    """

    def __init__(self, opened: Callable[[], AbstractContextManager[Any]], environment: Mapping[str, str]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(opened, theirs), daemon=True)
        with patch.dict(os.environ, environment, clear=True):
            self._process.start()
        theirs.close()
        self.answer()

    def ask(self, do: Callable[..., Any], *args: Any) -> None:
        """Call a function of a module in the process, with the opened object and these arguments."""
        self._pipe.send((do, args))

    def answer(self) -> Any:
        """Return what came of it."""
        found = self._pipe.recv()
        if isinstance(found, BaseException):
            raise found
        return found

    def does(self, do: Callable[..., Any], *args: Any) -> Any:
        """Return the result of a function."""
        self.ask(do, *args)
        return self.answer()

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(30)
        if self._process.is_alive():
            self._process.kill()


def _serve(opened: Callable[[], AbstractContextManager[Any]], pipe: Any) -> None:
    """Serve calls through the pipe until it is closed."""
    with opened() as thing:
        pipe.send(None)
        while True:
            try:
                do, args = pipe.recv()
            except EOFError:
                return
            try:
                pipe.send(do(thing, *args))
            except Exception as error:
                pipe.send(error)


@contextmanager
def stock_open(images: bool) -> Iterator[Apart]:
    """Yield stock robosuite in a process of its own, whose libraries take the threads that they take by themselves."""
    side = Apart(partial(_stock, images), by_the_libraries())
    try:
        yield side
    finally:
        side.close()


@contextmanager
def _stock(images: bool) -> Iterator[Any]:
    """Open stock robosuite in this process."""
    env = stock_robosuite(images)
    try:
        env.reset()
        yield env
    finally:
        close_stock(env)  # robosuite ends EGL for the whole process at exit


def step_stock(env: Any, action: NDArray[np.float64]) -> Times:
    """Return the duration of one of its control steps."""
    return timed(lambda: env.step(action))


def reset_stock(env: Any) -> Times:
    """Return what its reset takes."""
    return timed(env.reset)


def close_stock(env: Any) -> None:
    """Free robosuite's GL context while EGL still runs; left to the interpreter's exit it prints tracebacks."""
    make_current(env)
    env.close()
    env.sim = None
    gc.collect()


# --- taking turns ---


def actions() -> Iterator[NDArray[np.float64]]:
    """Small movements around the start: both sides get the same ones."""
    rng = np.random.default_rng(0)
    while True:
        yield rng.uniform(-0.3, 0.3, 7)


def timed(do: Callable[[], Any]) -> Times:
    """Return the duration of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    do()
    return Times(time.perf_counter() - wall, time.process_time() - cpu)


def alternate(
    ours: Turn, theirs: Turn, rounds: int, ours_per_round: int, theirs_per_round: int
) -> list[tuple[Times, Times]]:
    """Return a pair per round: the medians of both sides, which take turns."""

    def median_of(turn: Turn, times: int) -> Times:
        taken = [turn() for _ in range(times)]
        return Times(statistics.median(t.wall for t in taken), statistics.median(t.cpu for t in taken))

    return [(median_of(ours, ours_per_round), median_of(theirs, theirs_per_round)) for _ in range(rounds)]


# --- stock robosuite as an environment of LeRobot ---


class StockEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """Stock robosuite as LeRobot's loop wants it, with our observation's names."""

    metadata = METADATA
    task = task_description = "pick_place"

    def __init__(self, stock: Any, steps: int) -> None:
        self.render_mode, self._stock, self._max_episode_steps = "rgb_array", stock, steps
        self.observation_space, self.action_space = observation_space(EnvSettings(), steps), action_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start again."""
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
        self._pictures = {key: found[f"{camera}_image"] for key, camera in zip(CAMERAS, STOCK_CAMERAS, strict=True)}
        hand = (found["robot0_eef_pos"], found["robot0_eef_quat"][:3], found["robot0_gripper_qpos"])
        still = np.ones(1, np.float32)
        return {"pixels": self._pictures, "agent_pos": np.concatenate(hand, dtype=np.float32), "phase": still} | {
            "step": still * self._step
        }

    def render(self) -> NDArray[np.uint8]:
        """Return both cameras side by side."""
        return np.hstack(list(self._pictures.values()))


# --- results ---


@dataclass(frozen=True)
class Line:
    """One claim, measured. ``ratio`` is how many times better ours is.

    Durations are wall times. CPU times are in ``detail`` as
    ``cpu_ours``, ``cpu_theirs`` and ``cpu_ratio``: compare them on a shared machine.
    """

    name: str
    ours: float
    theirs: float
    ratio: float
    unit: str
    machine: str
    detail: dict[str, Any]

    def json(self) -> str:
        """Return the line as one JSON object."""
        record = asdict(self)
        detail = record.pop("detail")
        return json.dumps({**record, **detail})


def line_of(name: str, pairs: list[tuple[Times, Times]], detail: dict[str, Any]) -> Line:
    """Return the line of both sides' durations, taken in pairs: each figure is the pairs' median, the ratio too."""

    def medians(clock: str) -> tuple[float, float, float]:
        taken = [(getattr(ours, clock), getattr(theirs, clock)) for ours, theirs in pairs]
        mine, other = (round(1e3 * statistics.median(side), 3) for side in zip(*taken, strict=True))
        return mine, other, round(statistics.median(theirs / ours for ours, theirs in taken), 2)

    cpu = dict(zip(("cpu_ours", "cpu_theirs", "cpu_ratio"), medians("cpu"), strict=True))
    return Line(name, *medians("wall"), "ms", machine(), {**detail, **cpu})


def table(lines: list[Line]) -> str:
    """Return a Markdown table of lines, the machine above it: durations on the wall, then those of processors."""
    rows = [
        "| what | ours | stock robosuite 1.4.1 | ratio | ours, CPU | stock, CPU | ratio, CPU | |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for line in lines:
        notes = ", ".join(
            f"{key.replace('_', ' ')} {line.detail[key]}"
            for key in ("quality", "memory_mb", "their_memory_mb", "over_bare", "over_bare_before", "comparison")
            if key in line.detail
        )
        name = line.name.replace("_", " ")
        cells = [name, *_figures(line.ours, line.theirs, line.ratio, line.unit)]
        if "cpu_ratio" in line.detail:
            cells += _figures(line.detail["cpu_ours"], line.detail["cpu_theirs"], line.detail["cpu_ratio"], line.unit)
        else:
            cells += ["", "", ""]
        rows.append(f"| {' | '.join([*cells, notes])} |")
    return "\n".join([*([lines[0].machine, ""] if lines else []), *rows])


def _figures(ours: float, theirs: float, ratio: float, unit: str) -> list[str]:
    return [f"{ours:g} {unit}", f"{theirs:g} {unit}", f"{ratio:g}×"]
