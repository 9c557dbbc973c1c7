"""Texts and formulas shared by the families."""

from __future__ import annotations

from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.formula import And, Atom, Exactly, Formula, Or, Round

HOME = Atom("handhome", ())
AS_BEGUN = Atom("asbegun", ())
"""The scene equals its start bit for bit, so it cannot serve as a note."""
CABINET = "wooden_cabinet_1"
DRAWERS = ("top", "middle", "bottom")
PLACES = tuple(Region(f"{drawer}_region", CABINET) for drawer in DRAWERS)
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")
ORDINALS = ("", "first", "second", "third")
TIMES = {1: "once", 2: "twice"} | {k: f"{COUNTS[k]} times" for k in range(3, len(COUNTS))}
Texts = tuple[str, str, str]


def region(drawer: str) -> str:
    """Return the region of the cabinet's ``top``, ``middle`` or ``bottom`` drawer."""
    return f"{CABINET}_{drawer}_region"


def left_ajar(*joints: str) -> Formula:
    """The hand is home and a door, drawer or knob is partly open, which could serve as a note."""
    ajar = tuple(Atom("ajar", (joint,)) for joint in joints)
    return And((HOME, Or(ajar) if len(ajar) > 1 else ajar[0]))


def times(number: int, *event: Formula) -> tuple[Formula, Formula]:
    """The event has happened exactly ``number`` times, each time from the restored scene."""
    return Exactly(number, Round((AS_BEGUN, *event))), Exactly(number, Round(event))
