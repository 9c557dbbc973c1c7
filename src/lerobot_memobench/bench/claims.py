"""What is claimed of the simulator's speed, measured beside stock robosuite 1.4.1 in one run.

A machine that does other things at the same time slows both sides: they take turns, the median of each counts, and
what is claimed is the ratio. Stock robosuite is its own PickPlace with the same arm, controller, cameras and sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lerobot_memobench.bench.line import Line, line_of
from lerobot_memobench.bench.machine import TASK
from lerobot_memobench.bench.sides import Ours, actions, alternate, make_current, stock_open, timed
from lerobot_memobench.bench.workers import workers
from lerobot_memobench.errors import MemobenchError, nearest


def step_with_images(task: str = TASK, quality: str = "default", rounds: int = 8) -> Line:
    """One control step with both 256×256 images."""
    return _step("step_with_images", task, quality, rounds, images=True)


def step_without_images(task: str = TASK, rounds: int = 12) -> Line:
    """One control step, physics and controller alone."""
    return _step("step_without_images", task, "default", rounds, images=False)


def _step(name: str, task: str, quality: str, rounds: int, images: bool) -> Line:
    moves = actions()
    ours = Ours(task, images, quality)
    with stock_open(images) as env:

        def their_turn() -> float:
            make_current(env)
            return timed(lambda: env.step(next(moves)))

        def our_turn() -> float:
            return timed(lambda: ours.step(next(moves)))

        for _ in range(3):  # the first frames compile shaders
            our_turn(), their_turn()
        mine, other = alternate(our_turn, their_turn, rounds, 20, 5)
    detail = {"task": task, "quality": quality} if images else {"task": task}
    return line_of(name, mine, other, detail)


def reset(task: str = TASK, rounds: int = 3) -> Line:
    """Reset to a new seed with both images; ours includes the ten stabilisation steps."""
    seeds = iter(range(10**9))
    ours = Ours(task)
    with stock_open(True) as env:

        def their_turn() -> float:
            make_current(env)
            return timed(env.reset)

        mine, other = alternate(lambda: timed(lambda: ours.reset(next(seeds))), their_turn, rounds, 8, 1)
    return line_of("reset", mine, other, {"task": task})


def eval_loop() -> list[Line]:
    """A control step of ``lerobot eval``; LeRobot is imported for it, which takes longer than the other claims."""
    from lerobot_memobench.bench import evaluation

    return evaluation.eval_loop()


BENCHMARKS: dict[str, Callable[[], Line | list[Line]]] = {
    "step_with_images": step_with_images,
    "step_without_images": step_without_images,
    "reset": reset,
    "workers": workers,
    "eval_loop": eval_loop,
}


def run(names: list[str] | None = None) -> Iterator[Line]:
    """Yield the lines of the named benchmarks, all of them by default, as they are measured."""
    for name in names or list(BENCHMARKS):
        if name not in BENCHMARKS:
            raise MemobenchError(f"there is no benchmark {name!r}; {nearest(name, BENCHMARKS)}")
        result = BENCHMARKS[name]()
        yield from result if isinstance(result, list) else [result]
