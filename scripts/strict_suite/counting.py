"""Counting: the instruction gives the number of repetitions; the scene does not show how many are done."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from folders import Setting, StrictTask
from words import AS_BEGUN, CABINET, COUNTS, DRAWERS, HOME, ORDINALS, PLACES, TIMES, Texts, left_ajar, region, times

from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.formula import And, Atom, Exactly, Formula, Hold, Never, Round, When
from lerobot_memobench.tasks.task import REPETITIONS

BACK = Region("microwave_init_region", "kitchen_table", ((-0.01, -0.26, 0.01, -0.24),), (pi, pi))
"""Start of the microwave, as in the other task with a microwave. At the published start it overlaps the plate."""
REST = 41
"""Control steps of rest with which a policy signals the end: the arrival, and 40 after the release."""


@dataclass(frozen=True)
class Counted:
    """An event to be counted.

    Attributes:
        asked: text of the instruction.
        coarse, did, fine: the memory's text about a complete event.
        begun, ended: atoms at the start and the end of the event.
        opened: the memory's texts about its start (coarse, intermediate, fine).
    """

    name: str
    published: str
    asked: str
    coarse: str
    did: str
    fine: str
    begun: Atom
    ended: Atom
    opened: Texts


def _drawer(drawer: str) -> Counted:
    place = region(drawer)
    return Counted(
        f"check_the_{drawer}_drawer_a_given_number_of_times",
        f"check_the_{drawer}_drawer_of_the_cabinet",
        f"check the {drawer} drawer of the cabinet",
        f"{drawer} drawer inspected",
        f"pulled the {drawer} drawer out and pushed it shut",
        f"pulled the cabinet's {drawer} drawer out to look inside and pushed it shut again",
        Atom("open", (place,)),
        Atom("close", (place,)),
        (
            f"{drawer} drawer pulled out",
            f"pulled the {drawer} drawer out",
            f"pulled the cabinet's {drawer} drawer out until it stood open",
        ),
    )


def _stove(suffix: str, where: str) -> Counted:
    return Counted(
        f"turn_the_stove_on_and_off{suffix}_a_given_number_of_times",
        f"turn_on_the_stove_and_turn_it_off{suffix}",
        f"turn the stove{where} on and off",
        "stove lit and off again",
        "switched the stove on and off again",
        "rotated the stove's knob until the burner glowed red and rotated it back until the burner was dark",
        Atom("turnon", ("flat_stove_1",)),
        Atom("turnoff", ("flat_stove_1",)),
        ("stove lit", "switched the stove on", "rotated the stove's knob until the burner glowed red"),
    )


EVENTS = (
    Counted(
        "open_and_close_the_microwave_a_given_number_of_times",
        "open_and_close_the_microwave",
        "open and close the microwave",
        "microwave open and shut again",
        "swung the microwave's door open and shut it again",
        "pulled the microwave's door open and then pushed it back until it was shut",
        Atom("open", ("microwave_1",)),
        Atom("close", ("microwave_1",)),
        (
            "microwave door swung open",
            "swung the microwave's door open",
            "pulled the handle of the microwave until its door stood open",
        ),
    ),
    _drawer("top"),
    _drawer("middle"),
    _stove("", ""),
    _stove("_near_the_shelf", " near the shelf"),
)


def strict_tasks() -> list[StrictTask]:
    """Return the five counting tasks."""
    return [
        StrictTask(
            event.name,
            event.published,
            "counting",
            "SUUC",
            tuple(_setting(event, number) for number in TIMES),
            spoilt_as="miscount",
            regions=PLACES if _at_cabinet(event) else (),
            moved=(BACK,) if event.begun.args == ("microwave_1",) else (),
        )
        for event in EVENTS
    ]


def _at_cabinet(event: Counted) -> bool:
    return event.begun.args[0].startswith(CABINET)


def _setting(event: Counted, number: int) -> Setting:
    asked = f"{event.asked} {TIMES[number]}"
    joints = map(region, DRAWERS) if _at_cabinet(event) else event.begun.args
    counted = And((AS_BEGUN, *times(number, event.begun, event.ended)))
    goal = And((Never(left_ajar(*joints)), When((Hold(REST, And((HOME, event.ended))), counted))))
    steps = [*_checkpoints(event, number), (goal, _rested(event, number))]
    return Setting(
        f"{asked}, leaving everything as it was",
        goal,
        tuple(formula for formula, _ in steps),
        tuple(texts for _, texts in steps),
        f"{asked[0].upper()}{asked[1:]}, coming home after each time, and then rest.",
        difficulty=next(name for name, most in REPETITIONS.items() if number <= most),
    )


def _checkpoints(event: Counted, number: int) -> list[tuple[Formula, Texts]]:
    """Return three checkpoints for each number: all variants of a task share the labels of their checkpoints."""

    def underway(k: int) -> tuple[Formula, Texts]:
        return _begun(event, k), _opened(event, k, number)

    def complete(k: int) -> tuple[Formula, Texts]:
        return _done(event, k), _counted(event, k, number)

    if number == 1:
        return [underway(1), complete(1), (And((_done(event, 1), HOME)), _home(event))]
    return [complete(1), underway(2) if number == 2 else complete((number + 1) // 2), complete(number)]


def _done(event: Counted, number: int) -> Formula:
    return Exactly(number, Round((AS_BEGUN, event.begun, event.ended)))


def _begun(event: Counted, number: int) -> Formula:
    return Exactly(number, Round((AS_BEGUN, event.begun)))


def _counted(event: Counted, done: int, asked: int) -> Texts:
    left = {0: "nothing is left to do", 1: "once more to go"}.get(asked - done, f"{COUNTS[asked - done]} more to go")
    return (
        f"{event.coarse}, {done} of {asked}",
        f"{event.did}, {TIMES[done]} by now",
        f"{event.fine}, {TIMES[done]} by now; {TIMES[asked]} is asked for, so {left}",
    )


def _opened(event: Counted, k: int, asked: int) -> Texts:
    which = f"the {ORDINALS[k]}"
    coarse, intermediate, fine = event.opened
    return (
        f"{coarse}, {k} of {asked}",
        f"{intermediate} for {which} time",
        f"{fine}, for {which} of {asked} time{'s' if asked > 1 else ''}",
    )


def _home(event: Counted) -> Texts:
    return (
        "hand home",
        "brought the hand home after the one time",
        f"{event.fine}, and brought the hand home; once is asked for, so nothing more is to be begun",
    )


def _rested(event: Counted, number: int) -> Texts:
    return (
        f"done {TIMES[number]}, at rest",
        f"{event.did}, {TIMES[number]} in all, and came to rest",
        f"{event.fine}, {TIMES[number]} in all as the instruction asks, then came home and began nothing more",
    )
