"""Measure scenes, memory and episodes of this checkout, of former commits and of stock LIBERO, in turns.

    python benchmarks/speed.py [--stock PYTHON] [--former CHECKOUT] [--tables scenes] [--tasks NAME ...] [--turns 3]

`scripts/stock_libero` builds PYTHON. `git worktree add ../former COMMIT` makes a CHECKOUT; several may be given. Each
side is a process that runs one operation at a time on request, so that other load affects all sides alike. Prints
Markdown tables; a cell holds two values, and ratios are to this checkout, ``here``.

- scenes: CPU of all threads / elapsed, medians. Each reset and step draws both cameras at 256 x 256. A reset includes
  ten steps, which stock LIBERO draws. Imports are left out; the first scene of a process loads compiled functions.
- memory: resident / peak, after all 60 tasks of both suites, after all again, and after 100 resets.
- episodes: CPU of all threads / elapsed, means of every fifth strict task, and of all 30 x 50 in two processes.
"""

from __future__ import annotations

import argparse
import atexit
import itertools
import os
import re
import shutil
import statistics
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from turns import Rows, Worker, all_sides, answer_calls, print_table

SOURCE = Path(__file__).parents[1] / "src"
TABLES = ["scenes", "memory", "episodes"]
TASKS = [
    "check_all_three_drawers_of_the_cabinet",
    "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_the_shelf",
    "put_the_milk_picked_up_in_the_prompt_video_on_the_plate",  # nine cartons
    "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate",  # of libero_spatial
]
ACTION, NO_OP = [0.1, 0.1, 0.0, 0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]
SEEDS = itertools.count(10_000)  # of demonstrations

Sides = dict[str, Callable[[], Worker]]


# --- operations of a side ---


class Package:
    """Operations of this package in the version that PYTHONPATH names."""

    def __init__(self) -> None:
        from lerobot_memobench.envs.episode import Episode
        from lerobot_memobench.sim.simulation import Simulation
        from lerobot_memobench.tasks.catalogue import get_task

        self.make_episode, self.make_simulation, self.get_task = Episode, Simulation, get_task

    def use_empty_cache(self) -> None:
        self.cache = tempfile.TemporaryDirectory()  # removed at the end of the process
        os.environ["XDG_CACHE_HOME"] = self.cache.name

    def first_scene(self, name: str, _: str, state: list[float] | None) -> None:
        self.sim, self.state = self.make_simulation(self.get_task(name)), state
        self.reset()

    def reset(self) -> None:
        self.sim.reset(next(SEEDS), state=self.state)
        self.draw()

    def step(self) -> None:
        self.sim.step(ACTION)
        self.draw()

    def step_without_images(self) -> None:
        self.sim.step(ACTION)

    def draw(self) -> None:
        if hasattr(self.sim, "render_cameras"):
            self.sim.render_cameras(["agentview", "wrist"])
        else:  # a former commit
            for camera in ("agentview", "wrist"):
                self.sim.render(camera)

    def memory(self) -> list[float]:
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        return [int(status[key].split()[0]) / 1024 for key in ("VmRSS", "VmHWM")]

    def rollout(self, name: str) -> None:
        task = self.get_task(name)
        episode = self.make_episode(task, suite=task.suite)
        episode.reset(next(SEEDS))
        while not episode.done:
            episode.step(episode.expert_action())

    def demonstration(self, name: str) -> None:
        from lerobot_memobench.datasets.generate import generate

        with tempfile.TemporaryDirectory() as folder:
            generate([self.get_task(name)], 1, Path(folder) / "dataset", seed_base=next(SEEDS))


class Stock:
    """Operations of stock LIBERO, as LeRobot's environment runs it."""

    def __init__(self) -> None:
        from libero.libero.envs import OffScreenRenderEnv

        self.make_env = partial(OffScreenRenderEnv, camera_heights=256, camera_widths=256)

    def first_scene(self, _: str, bddl: str, state: list[float] | None) -> None:
        self.folder = tempfile.TemporaryDirectory()
        path = Path(self.folder.name) / "task.bddl"
        path.write_text(bddl)
        self.env, self.state = self.make_env(bddl_file_name=str(path)), state
        atexit.unregister(self.close)
        atexit.register(self.close)  # before that of EGL
        self.reset()

    def reset(self) -> None:
        self.draw(True)
        self.env.seed(next(SEEDS))
        self.env.reset()
        if self.state is not None:
            self.env.set_init_state(self.state)
        for _ in range(10):
            self.env.step(NO_OP)

    def step(self) -> None:
        self.draw(True)
        self.env.step(ACTION)

    def step_without_images(self) -> None:
        self.draw(False)
        self.env.step(ACTION)

    def draw(self, images: bool) -> None:
        for camera in ("agentview", "robot0_eye_in_hand"):
            self.env.env.modify_observable(f"{camera}_image", "enabled", images)

    def close(self) -> None:
        self.env.close()


# --- tables ---


def scenes(packages: Sides, stock: Sides, names: list[str], turns: int) -> None:
    """Print a table for each task."""
    with all_sides(packages, 0, {}) as call:
        for name in names:
            call(None, "first_scene", *scene_of(name))  # compiles functions and fills the cache
    for name in names:
        rows: Rows = {}
        scene, other = scene_of(name), scene_of(next(task for task in TASKS if task != name))
        for turn in range(turns):
            with all_sides(packages | stock, turn, rows) as call:
                call("first scene of a process", "first_scene", *scene)
            with all_sides(packages | stock, turn, rows) as call:
                call(None, "first_scene", *other)
                call("first scene of a task", "first_scene", *scene)
                for _ in range(3):
                    call("reset", "reset")
                    call("step with two images", "step", repetitions=10)
                    call("step without images", "step_without_images", repetitions=30)
            with all_sides(packages, turn, rows) as call:
                call(None, "use_empty_cache")
                call("first scene on a machine", "first_scene", *scene)
        print_table(f"{name}, ms of CPU / elapsed", rows, statistics.median, 1e3)


def scene_of(name: str) -> tuple[str, str, list[float] | None]:
    """Return a task's name, its BDDL text for stock LIBERO and, of a task of LIBERO, an initial state."""
    from lerobot_memobench.tasks.catalogue import get_task, initial_states
    from lerobot_memobench.tasks.task import LIBERO_SUITES

    task = get_task(name)
    if task.suite in LIBERO_SUITES:
        return name, task.bddl_text, initial_states(name)[0].tolist()
    scene = task.bddl_text[: task.bddl_text.index("(:goal")]
    placed = re.findall(r"\(On [^()]+\)", scene)[0]  # stock LIBERO does not know the predicates of memory tasks' goals
    return name, f"{scene}(:goal (And {placed})))", None


def memory(packages: Sides, names: list[str]) -> None:
    """Print the memory of a process that visits many tasks."""
    rows: Rows = {}
    with all_sides(packages, 0, rows) as call:
        for visit in ("visited", "visited again"):
            for name in names:
                call(None, "first_scene", *scene_of(name))
            call(f"{len(names)} tasks {visit}", "memory")
        call(None, "reset", repetitions=100)
        call("100 resets later", "memory")
    print_table("memory, MiB resident / peak", rows, statistics.median)


def episodes(packages: Sides, names: list[str], turns: int) -> None:
    """Print the mean time of the expert's episodes, and that of all in two processes."""
    rows: Rows = {}
    with all_sides(packages, 0, rows) as call:
        call(None, "demonstration", names[0])  # imports LeRobot
        for name in names * turns:
            call("expert's rollout without images", "rollout", name)
            call("demonstration with images", "demonstration", name)
    print_table("episode, s of CPU / elapsed", rows, statistics.mean)
    print_table("30 x 50 episodes in two processes, h of CPU / elapsed", rows, statistics.mean, 30 * 50 / 2 / 3600)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stock", metavar="PYTHON")
    parser.add_argument("--former", metavar="CHECKOUT", type=Path, action="append", default=[])
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES)
    parser.add_argument("--tasks", nargs="+", metavar="NAME", default=[], help="the same for all tables")
    parser.add_argument("--turns", type=int, default=3)
    args = parser.parse_args()
    from lerobot_memobench.errors import MemobenchError
    from lerobot_memobench.tasks.catalogue import task_names

    packages: Sides = {"here": partial(Worker, __file__, SOURCE, "package")}
    stock: Sides = {}
    try:
        if args.turns < 1:
            raise MemobenchError(f"--turns is {args.turns}, expected at least 1")
        for folder in args.former:
            if not (folder / "src/lerobot_memobench").is_dir():
                raise MemobenchError(f"{folder} holds no src/lerobot_memobench; expected a checkout of this repository")
            packages[str(folder)] = partial(Worker, __file__, folder.resolve() / "src", "package")
        if args.stock:
            if shutil.which(args.stock) is None:
                raise MemobenchError(f"{args.stock} is no program; expected the Python of stock LIBERO's environment")
            stock["stock LIBERO"] = partial(Worker, __file__, SOURCE, "stock", python=args.stock)
        for name in args.tasks:
            scene_of(name)
    except MemobenchError as error:
        sys.exit(f"speed: {error}")
    if "scenes" in args.tables:
        scenes(packages, stock, args.tasks or TASKS, args.turns)
    if "memory" in args.tables:
        memory(packages, args.tasks or task_names(suite=None))
    if "episodes" in args.tables:
        episodes(packages, args.tasks or task_names(suite="strict")[::5], args.turns)


if __name__ == "__main__":
    answer_calls({"package": Package, "stock": Stock}[sys.argv[2]]()) if sys.argv[1:2] == ["--serve"] else main()
