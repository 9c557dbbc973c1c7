"""Policies that exceed the ceilings of the temporal strict tasks by a documented limit of the suite.

    python -m research.necessity.limits --scenes 4 --out outputs/limits

The ceilings hold for policies without a memory and without a clock that declare their plans correctly. Each strategy
here breaks one of these conditions (docs/benchmark/suites.md, limits): it knows the elapsed steps, begins plans early,
or carries out more actions than it declares. Rollouts are kept as those of `research.necessity.adversaries`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from lerobot_memobench.constants import LONGEST_HOLD, VALIDATION_SEED
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import STRICT, Task
from research.command import run
from research.necessity.adversaries import (
    HAND_POSE,
    NEAR,
    Motion,
    Seat,
    Strategy,
    bring,
    ceiling,
    come_from,
    directions,
    finish,
    gather,
    line,
    play,
)
from research.necessity.clock import EVENT_STEPS

PLAN, CUT = 10, {1: 5, 2: 3}
"""Declared actions of a plan; past events -> actions of a plan that is cut short near home."""
EVENTS_BY_INDEX = {0: 0, PLAN - 5: 1, PLAN - 8: 2}
"""Index of the first action with an effect in its plan -> past events: holds end at multiples of `PLAN`."""
UNDECLARED = 400
"""Actions of a plan that is declared as a single action."""


def by_elapsed_steps(releases: Callable[[Seat, int], NDArray[np.floating]], seat: Seat) -> Motion:
    """Count past events by the elapsed steps at a release; ``releases`` expects them after 0 to n events."""
    expected = releases(seat, len(seat.events()))
    while (done := int(np.argmin(np.abs(expected - seat.elapsed)))) < len(seat.events()):
        yield from bring(seat, *seat.events()[done])
        yield from seat.do()
    yield from finish(seat)


def after_longest_holds(seat: Seat, events: int) -> NDArray[np.floating]:
    """Return the releases if a declared window makes all holds as long as the longest one."""
    return LONGEST_HOLD + np.arange(events + 1) * (LONGEST_HOLD + EVENT_STEPS)


def after_public_holds(seat: Seat, events: int) -> NDArray[np.floating]:
    """Return the releases by the holds that the public seed of a recognised scene draws."""
    drawn = [next(holds) for holds in [seat.episode.draw_holds()] for _ in range(events + 1)]
    return np.cumsum(drawn) + np.arange(events + 1) * EVENT_STEPS


def by_phase_of_plans(seat: Seat) -> Motion:
    """Begin plans early near home; the phase of later plans counts the events."""
    events = seat.events()
    while (done := EVENTS_BY_INDEX.get(seat.elapsed - _present_plan(seat)[0], 0)) < len(events):
        yield from bring(seat, *events[done])
        yield from come_from(
            seat, done + 1, lambda: _present_plan(seat) in [(seat.elapsed, cut) for cut in CUT.values()]
        )
    yield from finish(seat)


def _present_plan(seat: Seat) -> tuple[int, int]:
    """Return first step and number of actions of the present plan, a function of the observations alone."""
    first = 0
    while True:
        frame = seat.frames[first]
        close = abs(float(np.linalg.norm(frame)) - NEAR) < 0.005
        length = CUT.get(1 + int(np.argmax(directions() @ frame)), PLAN) if close else PLAN
        if first + length > seat.elapsed:
            return first, length
        first += length


def by_undeclared_plan(seat: Seat) -> Motion:
    """Come home within a plan that began near home; if the plan goes on after the hold, the event is done."""
    first, *others = seat.events()
    while np.linalg.norm(seat.frames[seat.elapsed - seat.elapsed % UNDECLARED]) <= HAND_POSE:
        yield from bring(seat, *first)
        yield from come_from(seat, 1, lambda: seat.elapsed % UNDECLARED == 0)
    for event in others:
        yield from bring(seat, *event)
    yield from finish(seat)


LIMITS: dict[str, tuple[Strategy, dict[str, Any]]] = {
    "a clock, window of 6,000 steps": (partial(by_elapsed_steps, after_longest_holds), {"window_steps": LONGEST_HOLD}),
    "a clock, public holds": (partial(by_elapsed_steps, after_public_holds), {}),
    "phase of plans": (by_phase_of_plans, {"replan_steps": PLAN}),
    "400 actions, declared as one": (by_undeclared_plan, {}),
}
"""Name -> strategy, and settings that its policy declares."""


def applies(strategy: str, task: Task) -> bool:
    """Return whether a strategy is written for a temporal task."""
    orders_two = task.family == "ordering" and "three" not in task.name
    return "clock" in strategy or orders_two or (strategy == "phase of plans" and task.family == "ordering")


def rollout(name: str, strategy: str, seed: int) -> dict[str, object]:
    """Return one rollout of a strategy, as `research.necessity.adversaries.rollout`."""
    act, declared = LIMITS[strategy]
    return play(Episode(get_task(name), EnvSettings(suite=STRICT, **declared)), act, strategy, seed)


def limits(
    out: Annotated[Path, typer.Option(help="Folder of the rollouts; the same command goes on.")],
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each task and strategy.")] = 4,
) -> None:
    """Roll out the strategies; print solved rollouts by strategy and ceiling."""
    wanted = [
        (name, strategy, VALIDATION_SEED + k)
        for k in range(scenes)
        for strategy in LIMITS
        for name in task_names("temporal", suite="strict")
        if applies(strategy, get_task(name))
    ]
    found: dict[tuple[str, str], list[bool]] = {}
    for one in gather(rollout, wanted, out, workers=1):
        task = get_task(str(one["task"]))
        kind = f"{task.family} | {100 * ceiling(task):.1f}"
        found.setdefault((str(one["strategy"]), kind), []).append(bool(one["success"]))
    print("| strategy | family | ceiling | solved | rollouts | interval |\n|---|---|---:|---:|---:|---|")
    print("\n".join(line(f"{strategy} | {kind}", results) for (strategy, kind), results in sorted(found.items())))


if __name__ == "__main__":
    sys.exit(run("necessity.limits", limits))
