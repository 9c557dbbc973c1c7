"""What is claimed of the simulator's speed, measured beside stock robosuite 1.4.1 in one run.

Both sides take turns, and each turn of ours makes a pair with the turn of theirs that follows. What is claimed is the
median of the pairs' ratios on the wall's clock, on a machine that does nothing else; the processors' clock stands
beside it, and moves less where others compute too. Stock robosuite is its own PickPlace with the same arm, controller,
cameras and sizes, in a process of its own: there its libraries take the threads that they take by themselves, while
ours has those of the rule (`jobs.threads`), as in every command.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lerobot_memobench.bench.line import Line, line_of
from lerobot_memobench.bench.machine import TASK
from lerobot_memobench.bench.sides import (
    Apart,
    Ours,
    Times,
    Vectored,
    actions,
    alternate,
    reset_stock,
    step_stock,
    stock_open,
    timed,
)
from lerobot_memobench.bench.workers import workers
from lerobot_memobench.errors import MemobenchError, nearest


def step_with_images(task: str = TASK, quality: str = "default", rounds: int = 8) -> Line:
    """One control step with both 256×256 images."""
    return _step("step_with_images", task, quality, rounds, images=True)


def step_without_images(task: str = TASK, rounds: int = 12) -> Line:
    """One control step, physics and controller alone."""
    return _step("step_without_images", task, "default", rounds, images=False)


def _step(name: str, task: str, quality: str, rounds: int, images: bool) -> Line:
    ours = Ours(task, images, quality)
    with stock_open(images) as stock:
        pairs = _step_pairs(ours, stock, rounds)
    detail = {"task": task, "quality": quality} if images else {"task": task}
    return line_of(name, pairs, detail)


def _step_pairs(ours: Ours | Vectored, stock: Apart, rounds: int) -> list[tuple[Times, Times]]:
    moves = actions()

    def their_turn() -> Times:
        taken: Times = stock.does(step_stock, next(moves))
        return taken

    def our_turn() -> Times:
        return timed(lambda: ours.step(next(moves)))

    for _ in range(3):  # the first frames compile shaders
        our_turn(), their_turn()
    return alternate(our_turn, their_turn, rounds, 20, 5)


def reset(task: str = TASK, rounds: int = 3) -> Line:
    """Reset to a new seed with both images; ours includes the ten stabilisation steps."""
    ours = Ours(task)
    with stock_open(True) as stock:
        pairs = _reset_pairs(ours, stock, rounds)
    return line_of("reset", pairs, {"task": task})


def _reset_pairs(ours: Ours | Vectored, stock: Apart, rounds: int) -> list[tuple[Times, Times]]:
    seeds = iter(range(1, 10**9))

    def their_turn() -> Times:
        taken: Times = stock.does(reset_stock)
        return taken

    return alternate(lambda: timed(lambda: ours.reset(next(seeds))), their_turn, rounds, 8, 1)


def vector_env(task: str = TASK, rounds: int = 8) -> list[Line]:
    """Steps and resets through the vector environment that LeRobot uses, both images, beside bare stock robosuite."""
    ours = Vectored(task)
    with stock_open(True) as stock:
        steps, resets = _step_pairs(ours, stock, rounds), _reset_pairs(ours, stock, max(1, rounds // 2))
        ours.close()
    return [line_of("vector_env_step", steps, {"task": task}), line_of("vector_env_reset", resets, {"task": task})]


def thread_rule() -> list[Line]:
    """`lerobot eval` with the threads of the rule beside the same with those that the libraries take."""
    from lerobot_memobench.bench import evaluation

    return evaluation.thread_rule()


def eval_loop() -> list[Line]:
    """A control step of ``lerobot eval``; LeRobot is imported for it, which takes longer than the other claims."""
    from lerobot_memobench.bench import evaluation

    return evaluation.eval_loop()


BENCHMARKS: dict[str, Callable[[], Line | list[Line]]] = {
    "step_with_images": step_with_images,
    "step_without_images": step_without_images,
    "reset": reset,
    "vector_env": vector_env,
    "workers": workers,
    "eval_loop": eval_loop,
    "thread_rule": thread_rule,
}


def run(names: list[str] | None = None) -> Iterator[Line]:
    """Yield the lines of the named benchmarks, all of them by default, as they are measured."""
    for name in names or list(BENCHMARKS):
        if name not in BENCHMARKS:
            raise MemobenchError(f"there is no benchmark {name!r}; {nearest(name, BENCHMARKS)}")
        result = BENCHMARKS[name]()
        yield from result if isinstance(result, list) else [result]
