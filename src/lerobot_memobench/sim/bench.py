"""How fast the simulator is, beside stock robosuite 1.4.1, both measured in one run.

A machine that does other things at the same time slows both sides: they take turns, the median of each counts, and
what is claimed is the ratio. Stock robosuite is its own PickPlace with the same arm, controller, cameras and sizes.
"""

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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.sim.rendering import RenderSettings, close_renderers, gl_backend
from lerobot_memobench.sim.scene import CONTROL_HZ
from lerobot_memobench.sim.simulation import CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.progress import Progress

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
"""What is measured unless another task is named: its bowls have the most contacts of the catalogue's usual scenes."""
STOCK_CAMERAS = ["agentview", "robot0_eye_in_hand"]
IMAGE_SIZE = 256
WORKERS = (1, 2, 4)

Turn = Callable[[], float]
"""Do the thing once and return how long it took, s."""


@dataclass(frozen=True)
class Line:
    """One claim, measured. ``ratio`` is how many times better ours is."""

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


@cache
def machine() -> str:
    """Return processor, cores, GL device and versions, for a reader to compare with."""
    model = platform.processor() or platform.machine()
    try:
        names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    except OSError:
        pass
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model}, {cores} cores, {_gl_device()}, {platform.system()}, mujoco {mujoco.__version__}"


def _gl_device() -> str:
    sim = Simulation(get_task(TASK))
    sim.reset(0)
    sim.render()  # opens a context and chooses PyOpenGL's platform, which its import fixes
    from OpenGL import GL

    device = GL.glGetString(GL.GL_RENDERER).decode()
    close_renderers()
    return f"{gl_backend()} on {device}"


# --- the two sides ----------------------------------------------------------------------------------------------


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


def _stock_context(env: Any) -> None:
    """Make robosuite's GL context current; it takes for granted that nobody else draws."""
    context = getattr(env.sim, "_render_context_offscreen", None)
    if context is not None:
        context.gl_ctx.make_current()


class Ours:
    """A step as the gym environment takes it: physics, checkpoints, proprioception and, if wanted, both images."""

    def __init__(self, task: str = TASK, images: bool = True, quality: str = "default") -> None:
        self.task = get_task(task)
        self.sim = Simulation(self.task, RenderSettings(IMAGE_SIZE, IMAGE_SIZE, quality))
        self.images = images
        self.reset(0)

    def look(self) -> list[NDArray[np.uint8]]:
        """Return both images, if wanted."""
        return [self.sim.render(camera) for camera in CAMERAS] if self.images else []

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


def _actions() -> Iterator[NDArray[np.float64]]:
    """Small movements around the start: both sides get the same ones."""
    rng = np.random.default_rng(0)
    while True:
        yield rng.uniform(-0.3, 0.3, 7)


def _timed(do: Callable[[], Any]) -> float:
    start = time.perf_counter()
    do()
    return time.perf_counter() - start


def alternate(ours: Turn, theirs: Turn, rounds: int, ours_per_round: int, theirs_per_round: int) -> tuple[float, float]:
    """Return the median seconds of both sides, taken in turns."""
    mine, other = [], []
    for _ in range(rounds):
        mine += [ours() for _ in range(ours_per_round)]
        other += [theirs() for _ in range(theirs_per_round)]
    return statistics.median(mine), statistics.median(other)


def _line(name: str, ours: float, theirs: float, detail: dict[str, Any]) -> Line:
    return Line(name, round(1e3 * ours, 3), round(1e3 * theirs, 3), round(theirs / ours, 2), "ms", machine(), detail)


@contextmanager
def _stock(images: bool) -> Iterator[Any]:
    """Yield stock robosuite, and close both sides' GL contexts afterwards."""
    machine()  # asks GL now, not while both sides have contexts open
    env = stock_robosuite(images)
    try:
        env.reset()
        yield env
    finally:
        # robosuite ends EGL for the whole process at exit; what is still open then could not be freed.
        close_renderers()
        _close_stock(env)


def _close_stock(env: Any) -> None:
    """Free robosuite's GL context while EGL still runs; left to the interpreter's exit it prints tracebacks."""
    _stock_context(env)
    env.close()
    env.sim = None
    gc.collect()


# --- the claims -------------------------------------------------------------------------------------------------


def step_with_images(task: str = TASK, quality: str = "default", rounds: int = 8) -> Line:
    """One control step with both 256×256 images."""
    return _step("step_with_images", task, quality, rounds, images=True)


def step_without_images(task: str = TASK, rounds: int = 12) -> Line:
    """One control step, physics and controller alone."""
    return _step("step_without_images", task, "default", rounds, images=False)


def _step(name: str, task: str, quality: str, rounds: int, images: bool) -> Line:
    actions = _actions()
    ours = Ours(task, images, quality)
    with _stock(images) as env:

        def their_turn() -> float:
            _stock_context(env)
            return _timed(lambda: env.step(next(actions)))

        def our_turn() -> float:
            return _timed(lambda: ours.step(next(actions)))

        for _ in range(3):  # the first frames compile shaders
            our_turn(), their_turn()
        mine, other = alternate(our_turn, their_turn, rounds, 20, 5)
    detail = {"task": task, "quality": quality} if images else {"task": task}
    return _line(name, mine, other, detail)


def reset(task: str = TASK, rounds: int = 3) -> Line:
    """Reset to a new seed with both images; ours includes the ten stabilisation steps."""
    seeds = iter(range(10**9))
    ours = Ours(task)
    with _stock(True) as env:

        def their_turn() -> float:
            _stock_context(env)
            return _timed(env.reset)

        mine, other = alternate(lambda: _timed(lambda: ours.reset(next(seeds))), their_turn, rounds, 8, 1)
    return _line("reset", mine, other, {"task": task})


def _resident_mb() -> float:
    """Return the memory of this process that no other shares, plus its part of what is shared, MB."""
    try:
        text = Path("/proc/self/smaps_rollup").read_text()
        pss = next(line for line in text.splitlines() if line.startswith("Pss:"))
        return int(pss.split()[1]) / 1024
    except (OSError, StopIteration):
        return float("nan")


def _worker(stock: bool, task: str, seconds: float, ready: Any, go: Any, results: Any) -> None:
    """Step with both images for some seconds and report the number of steps and the memory."""
    actions = _actions()
    if stock:
        env = stock_robosuite()
        env.reset()
        step: Callable[[NDArray[np.float64]], Any] = env.step
    else:
        step = Ours(task).step
    step(next(actions))
    ready.release()
    go.wait()
    count, end = 0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        step(next(actions))
        count += 1
    results.put((count / seconds, _resident_mb()))
    if stock:
        _close_stock(env)


def _team(stock: bool, count: int, task: str, seconds: float) -> tuple[float, float]:
    """Return steps per second of all workers together, and the mean memory of one, MB."""
    context = multiprocessing.get_context("spawn")
    ready, go, results = context.Semaphore(0), context.Event(), context.Queue()
    team = [
        context.Process(target=_worker, args=(stock, task, seconds, ready, go, results), daemon=True)
        for _ in range(count)
    ]
    for process in team:
        process.start()
    try:
        for _ in team:
            if not ready.acquire(timeout=300):
                raise MemobenchError(f"one of {count} worker processes did not get ready within five minutes")
        go.set()
        reports = [results.get(timeout=seconds + 60) for _ in team]
    finally:
        for process in team:
            process.join(timeout=10)
            if process.is_alive():
                process.terminate()
    return sum(rate for rate, _ in reports), statistics.fmean(memory for _, memory in reports)


def workers(task: str = TASK, counts: tuple[int, ...] = WORKERS, seconds: float = 5.0) -> list[Line]:
    """Steps with images per second of several processes together, and the memory of each."""
    lines = []
    for count in counts:
        ours, memory = _team(False, count, task, seconds)
        theirs, their_memory = _team(True, count, task, seconds)
        detail = {
            "task": task,
            "workers": count,
            "memory_mb": round(memory),
            "their_memory_mb": round(their_memory),
        }
        ratio = round(ours / theirs, 2)
        lines.append(Line(f"workers_{count}", round(ours, 1), round(theirs, 1), ratio, "steps/s", machine(), detail))
    return lines


BENCHMARKS: dict[str, Callable[[], Line | list[Line]]] = {
    "step_with_images": step_with_images,
    "step_without_images": step_without_images,
    "reset": reset,
    "workers": workers,
}


def run(names: list[str] | None = None) -> Iterator[Line]:
    """Yield the lines of the named benchmarks, all of them by default, as they are measured."""
    for name in names or list(BENCHMARKS):
        if name not in BENCHMARKS:
            raise MemobenchError(f"there is no benchmark {name!r}; {nearest(name, BENCHMARKS)}")
        result = BENCHMARKS[name]()
        yield from result if isinstance(result, list) else [result]


def table(lines: list[Line]) -> str:
    """Return a Markdown table of lines, the machine above it."""
    rows = ["| what | ours | stock robosuite 1.4.1 | ratio | |", "| --- | ---: | ---: | ---: | --- |"]
    for line in lines:
        notes = ", ".join(
            f"{key.replace('_', ' ')} {line.detail[key]}"
            for key in ("quality", "memory_mb", "their_memory_mb")
            if key in line.detail
        )
        name = line.name.replace("_", " ")
        rows.append(f"| {name} | {line.ours:g} {line.unit} | {line.theirs:g} {line.unit} | {line.ratio:g}× | {notes} |")
    return "\n".join([*([lines[0].machine, ""] if lines else []), *rows])
