"""The two sides of a comparison: this simulator, and stock robosuite 1.4.1 with the same arm, cameras and sizes."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.bench.machine import TASK, machine
from lerobot_memobench.jobs.threads import by_the_libraries
from lerobot_memobench.protocol import CONTROL_HZ
from lerobot_memobench.sim.rendering import RenderSettings, gl_backend
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.progress import Progress

STOCK_CAMERAS = ["agentview", "robot0_eye_in_hand"]
IMAGE_SIZE = 256


class Times(NamedTuple):
    """What a thing took, s: on the clock on the wall, and of processors, all threads of the process together."""

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
        config = MemobenchEnvConfig(task=task, prompt_video=False, log_dir=self._logs.name)
        [suite] = config.create_envs(1).values()
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
    """Return robosuite's PickPlace as its documentation makes it, without its warnings."""
    os.environ["MUJOCO_GL"] = gl_backend()
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
    """Make robosuite's GL context current; it takes for granted that nobody else draws."""
    context = getattr(env.sim, "_render_context_offscreen", None)
    if context is not None:
        context.gl_ctx.make_current()


class Apart:
    """A side in a process of its own: it does what it is asked, and waits in between, so that sides can take turns.

    Args:
        opened: opens what every function that is asked for is given first; both are pickled.
        environment: of the process. It says how many threads its libraries have (`jobs.threads`).
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
        """Have a function of a module called, with what was opened and these arguments."""
        self._pipe.send((do, args))

    def answer(self) -> Any:
        """Return what came of it."""
        found = self._pipe.recv()
        if isinstance(found, BaseException):
            raise found
        return found

    def does(self, do: Callable[..., Any], *args: Any) -> Any:
        """Return what comes of a function."""
        self.ask(do, *args)
        return self.answer()

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(30)
        if self._process.is_alive():
            self._process.kill()


def _serve(opened: Callable[[], AbstractContextManager[Any]], pipe: Any) -> None:
    """Do what is asked through the pipe until it is closed."""
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
    machine()  # asks GL now, not while something is drawn
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
    """Return what one of its control steps takes."""
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
    """Return what a call takes."""
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
