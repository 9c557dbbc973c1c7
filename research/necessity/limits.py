"""Policies that exceed the ceilings of the temporal strict tasks by a documented limit of the suite.

    python -m research.necessity.limits --scenes 4 --out outputs/limits

The ceilings hold for policies without a memory and without a clock that declare their plans correctly. Each strategy
here breaks one of these conditions (docs/benchmark/suites.md, limits): it knows the elapsed steps, begins plans early,
or carries out more actions than it declares. Rollouts are kept as those of `research.necessity.adversaries`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.experts.hand import OPEN
from lerobot_memobench.experts.travel import rise
from lerobot_memobench.protocol import LONGEST_HOLD, VALIDATION_SEED
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import STRICT, Task
from research.command import run
from research.necessity.adversaries import (
    BESIDE,
    HAND_POSE,
    NEAR,
    Motion,
    Seat,
    Strategy,
    bring,
    ceiling,
    directions,
    finish,
    gather,
    line,
    play,
)
from research.necessity.clock import EVENT_STEPS

PLAN, CUT = 10, {1: 5, 2: 3}
"""Declared actions of a plan; past events -> actions of a plan that is cut short beside home."""
EVENTS_BY_INDEX = {0: 0, PLAN - 5: 1, PLAN - 8: 2}
"""Index of the first action with an effect in its plan -> past events: holds end at multiples of `PLAN`."""
UNDECLARED = 400
"""Actions of a plan that is declared as a single action."""


def by_elapsed_steps(releases: Callable[[Seat, int], NDArray[np.float64]], seat: Seat) -> Motion:
    """Count past events by the elapsed steps at a release; ``releases`` expects them after 0 to n events."""
    expected = releases(seat, len(seat.events()))
    while (done := int(np.argmin(np.abs(expected - seat.elapsed)))) < len(seat.events()):
        yield from bring(seat, *seat.events()[done])
        yield from seat.do()
    yield from finish(seat)


def after_longest_holds(seat: Seat, events: int) -> NDArray[np.float64]:
    """Return the releases if a declared window makes all holds as long as the longest one."""
    return LONGEST_HOLD + np.arange(events + 1) * (LONGEST_HOLD + EVENT_STEPS)


def after_public_holds(seat: Seat, events: int) -> NDArray[np.float64]:
    """Return the releases by the holds that the public seed of a recognised scene draws."""
    drawn = [next(holds) for holds in [seat.episode.draw_holds()] for _ in range(events + 1)]
    return np.cumsum(drawn) + np.arange(events + 1) * EVENT_STEPS


def by_phase_of_plans(seat: Seat) -> Motion:
    """Begin plans early beside home; the phase of later plans counts the events."""
    hand, (home, turn) = seat.expert.hand, seat.sim.home
    events, placed = seat.events(), seat.placed()
    while (done := EVENTS_BY_INDEX.get(seat.elapsed - _present_plan(seat)[0], 0)) < len(events):
        yield from bring(seat, *events[done])
        side = directions()[done]
        yield from rise(hand, OPEN, 0.2)
        yield from hand.move(home + BESIDE * side, turn, OPEN, tolerance=0.012, turn_tolerance=0.04, timeout=120)
        yield from hand.move(home + NEAR * side, turn, OPEN, tolerance=0.003, turn_tolerance=0.04, timeout=60)
        while not (seat.elapsed == _present_plan(seat)[0] and _present_plan(seat)[1] < PLAN):
            yield hand.toward(home + NEAR * side, turn, OPEN)
        while seat.episode.action_has_effect and not seat.sim.holds(Atom("asbegun", ())):
            yield hand.toward(home, turn, OPEN, speed=0.6)
    yield from seat.do(*placed)


def _present_plan(seat: Seat) -> tuple[int, int]:
    """Return first step and number of actions of the present plan, a function of the observations alone."""
    first = 0
    while True:
        frame = seat.frames[first]
        beside = abs(float(np.linalg.norm(frame)) - NEAR) < 0.005
        length = CUT.get(1 + int(np.argmax(directions() @ frame)), PLAN) if beside else PLAN
        if first + length > seat.elapsed:
            return first, length
        first += length


def by_undeclared_plan(seat: Seat) -> Motion:
    """Time the event so that a plan begins within it; if the plan goes on after the hold, the event is done."""
    first, *others = seat.events()
    while not np.linalg.norm(seat.frames[seat.elapsed - seat.elapsed % UNDECLARED]) > HAND_POSE:
        while UNDECLARED - seat.elapsed % UNDECLARED > EVENT_STEPS:
            yield seat.expert.hand.toward(*seat.sim.home, OPEN)
        yield from bring(seat, *first)
        yield from seat.do()
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
    """Return whether a strategy is written for a task."""
    if "clock" in strategy:
        return task.family in ("counting", "ordering")
    return task.family == "ordering" and (strategy == "phase of plans" or "three" not in task.name)


@cache
def _episode(name: str, strategy: str) -> Episode:
    return Episode(get_task(name), EnvSettings(suite=STRICT, **LIMITS[strategy][1]))


def rollout(name: str, strategy: str, seed: int) -> dict[str, object]:
    """Return one rollout of a strategy, as `research.necessity.adversaries.rollout`."""
    return play(_episode(name, strategy), LIMITS[strategy][0], strategy, seed)


def limits(
    out: Annotated[Path, typer.Option(help="Folder of the rollouts; the same command goes on.")],
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each task and strategy.")] = 4,
    seed: Annotated[int, typer.Option(help="Seed of the first scene.")] = VALIDATION_SEED,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """Roll out the strategies; print solved rollouts by strategy and ceiling."""
    names = [name for name in task_names(suite="strict") if get_task(name).memory_type == "temporal"]
    wanted = [
        (name, strategy, seed + k)
        for k in range(scenes)
        for strategy in LIMITS
        for name in names
        if applies(strategy, get_task(name))
    ]
    found: dict[tuple[str, str], list[bool]] = {}
    for one in gather(rollout, wanted, out, workers):
        task = get_task(str(one["task"]))
        kind = f"{task.family} | {100 * ceiling(task):.1f}"
        found.setdefault((str(one["strategy"]), kind), []).append(bool(one["success"]))
    print("| strategy | family | ceiling | solved | rollouts | interval |\n|---|---|---:|---:|---:|---|")
    print("\n".join(line(f"{strategy} | {kind}", results) for (strategy, kind), results in sorted(found.items())))


if __name__ == "__main__":
    sys.exit(run("necessity.limits", limits))
