"""Words and formulas that the families share."""

from __future__ import annotations

from lerobot_memobench.tasks.formula import And, Atom, Exactly, Formula, Round

HOME = Atom("handhome", ())
CABINET = "wooden_cabinet_1"
DRAWERS = ("top", "middle", "bottom")
TIMES = {1: "once", 2: "twice", 3: "three times"}
Texts = tuple[str, str, str]


def region(drawer: str) -> str:
    """Return the region of the cabinet's ``top``, ``middle`` or ``bottom`` drawer."""
    return f"{CABINET}_{drawer}_region"


def ready(*things: str) -> Formula:
    """The scene as it began: the hand home, things in their places. Nothing visible tells what has been done."""
    found = (HOME, *(Atom("inplace", (thing,)) for thing in things))
    return And(found) if len(found) > 1 else HOME


def times(number: int, before: Formula, *event: Formula) -> Formula:
    """The event has happened exactly so often, each time from the scene as it began."""
    return And((Exactly(number, Round((before, *event))), Exactly(number, Round(event))))
