"""Order: each event exactly once and in the order of the instruction; a wrong order cannot be corrected."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

from folders import Setting, StrictTask
from words import AS_BEGUN, DRAWERS, PLACES, Texts, left_ajar, region

from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.formula import And, Atom, Exactly, Formula, Never, Not, Or, Round, When

BOWL, PAN, WHITE = "akita_black_bowl_1", "chefmate_8_frypan_1", "white_bowl_1"
STOVE, MICROWAVE = "flat_stove_1", "microwave_1"
ASIDE = Region("akita_black_bowl_init_region", "kitchen_table", ((0.175, 0.125, 0.225, 0.175),))
"""Place of the bowl while all drawers are checked. At the published place the hand at the lowest handle pushes it, and
a moved bowl would reveal which drawer was open."""

Event = tuple[Atom, Atom]
"""Atoms between which the event is in progress."""


def strict_tasks() -> list[StrictTask]:
    """Return the five ordering tasks."""
    return [_three_drawers(), _bowl_in_drawer(), _bowl_on_plate(), *_pans()]


def _drawer(name: str) -> Event:
    return Atom("open", (region(name),)), Atom("close", (region(name),))


def _once(event: Event) -> Formula:
    """It has happened exactly once, and is over."""
    return And((Exactly(1, Round(event)), event[1]))


def _before(event: Event, later: Formula) -> Formula:
    """When the later thing begins, the event has happened exactly once, from and back to the scene as it began."""
    return When((later, Exactly(1, Round((AS_BEGUN, *event, AS_BEGUN)))))


def _done(event: Event) -> Formula:
    return Exactly(1, Round((AS_BEGUN, *event)))


# --- drawers ---


def _three_drawers() -> StrictTask:
    return StrictTask(
        "check_all_three_drawers_once_each_in_the_given_order",
        "check_all_three_drawers_of_the_cabinet",
        "ordering",
        "SUC",
        tuple(_checks(order) for order in permutations(DRAWERS)),
        regions=PLACES,
        moved=(ASIDE,),
    )


def _checks(order: Sequence[str]) -> Setting:
    first, second, third = events = [_drawer(name) for name in order]
    goal = And(
        (
            Never(left_ajar(*map(region, DRAWERS))),
            _before(first, second[0]),
            _before(second, third[0]),
            *(_once(event) for event in events),
        )
    )
    return Setting(
        f"check the {order[0]} drawer, then the {order[1]} drawer and then the {order[2]} drawer, each exactly once, "
        "leaving everything as it was",
        goal,
        (_done(first), _done(second), goal),
        _checked(order),
        f"Look into the {order[0]}, the {order[1]} and the {order[2]} drawer in turn, coming home after each.",
    )


def _checked(order: Sequence[str]) -> tuple[Texts, Texts, Texts]:
    a, b, c = order
    return (
        (
            f"{a} drawer inspected, one of three",
            f"pulled out and shut the {a} drawer",
            f"looked into the cabinet's {a} drawer and pushed it shut; the {b} and the {c} drawer are to go",
        ),
        (
            f"{b} drawer inspected, two of three",
            f"pulled out and shut the {b} drawer after the {a} one",
            f"looked into the cabinet's {b} drawer and pushed it shut; {a} and {b} inspected, the {c} drawer is to go",
        ),
        (
            "every drawer inspected once",
            f"pulled out and shut the {a}, the {b} and the {c} drawer, each once",
            f"looked into the cabinet's {c} drawer and pushed it shut; {a}, {b} and {c} were inspected in this order",
        ),
    )


def _bowl_in_drawer() -> StrictTask:
    middle, top = _drawer("middle"), _drawer("top")
    begun = Or((top[0], Not(Atom("inplace", (BOWL,)))))
    stowed = Atom("in", (BOWL, region("top")))
    unmarked = Never(left_ajar(*map(region, DRAWERS)))
    goal = And((unmarked, _before(middle, begun), _once(middle), _once(top), stowed))
    setting = Setting(
        "check the middle drawer exactly once, leaving everything as it was, then put the black bowl in the top drawer "
        "and close it",
        goal,
        (_done(middle), top[0], goal),
        (
            (
                "middle drawer inspected",
                "pulled the middle drawer out and pushed it shut",
                "pulled the cabinet's middle drawer out to look inside and pushed it shut again, once, as asked",
            ),
            (
                "top drawer pulled out",
                "pulled the top drawer out",
                "with the middle drawer already inspected, pulled the cabinet's top drawer out to take the black bowl",
            ),
            (
                "bowl stowed and drawer shut",
                "stowed the black bowl in the top drawer and shut it",
                "with the middle drawer inspected once, laid the black bowl into the cabinet's top drawer and shut it",
            ),
        ),
        "Look into the middle drawer, come home, then stow the black bowl in the top drawer and shut it.",
    )
    return StrictTask(
        "check_the_middle_drawer_once_then_put_the_black_bowl_in_the_top_drawer",
        "check_the_middle_drawer_and_put_the_black_bowl_in_the_top_drawer_and_close_it",
        "ordering",
        "SUC",
        (setting,),
        regions=PLACES,
    )


# --- appliances ---


def _carried(asked: str, summary: str, event: Event, placed: Atom, texts: Sequence[Texts]) -> Setting:
    """An appliance is used once, then a thing is carried: when it leaves its place, that must have been."""
    unmarked, moved = Never(left_ajar(*event[0].args)), Not(Atom("inplace", (placed.args[0],)))
    goal = And((unmarked, _before(event, moved), _once(event), placed))
    begun = Exactly(1, Round((AS_BEGUN, event[0])))
    return Setting(asked, goal, (begun, _done(event), goal), tuple(texts), summary)


def _bowl_on_plate() -> StrictTask:
    setting = _carried(
        "open and close the microwave exactly once, leaving everything as it was, then put the white bowl on the plate",
        "Swing the microwave's door open and shut, come home, then move the white bowl from its top onto the plate.",
        (Atom("open", (MICROWAVE,)), Atom("close", (MICROWAVE,))),
        Atom("on", (WHITE, "plate_1")),
        (
            (
                "microwave door swung open",
                "swung the microwave's door open",
                "pulled the handle of the microwave until its door stood open",
            ),
            (
                "microwave door open and shut again",
                "swung the microwave's door open and shut it again",
                "pulled the microwave's door open and then pushed it back until it was shut, once, as asked",
            ),
            (
                "bowl moved to plate",
                "moved the white bowl onto the plate",
                "with the microwave opened and shut once, set the white bowl from its top down on the plate",
            ),
        ),
    )
    return StrictTask(
        "open_and_close_the_microwave_once_then_put_the_white_bowl_on_the_plate",
        "open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate",
        "ordering",
        "SUC",
        (setting,),
    )


def _pans() -> list[StrictTask]:
    return [
        _pan("on_it", "on it", "stove", f"{STOVE}_cook_region", "onto the stove's cooking plate"),
        _pan(
            "on_the_shelf",
            "on the shelf",
            "shelf",
            "wooden_two_layer_shelf_1_top_side",
            "onto the top board of the wooden shelf",
        ),
    ]


def _pan(suffix: str, where: str, support: str, place: str, onto: str) -> StrictTask:
    setting = _carried(
        f"turn the stove on and off exactly once, leaving everything as it was, then put the frying pan {where}",
        f"Switch the stove on and off, come home, then set the frying pan on the {support}.",
        (Atom("turnon", (STOVE,)), Atom("turnoff", (STOVE,))),
        Atom("on", (PAN, place)),
        (
            ("stove lit", "switched the stove on", "rotated the stove's knob until the burner glowed red"),
            (
                "stove lit and off again",
                "switched the stove on and then off again",
                "rotated the knob to light the burner and later rotated it back, once, so the burner is dark again",
            ),
            (
                f"pan set on {support}",
                f"set the frying pan down on the {support}",
                f"with the burner lit once and dark again, carried the frying pan {onto}",
            ),
        ),
    )
    return StrictTask(
        f"turn_the_stove_on_and_off_once_then_put_the_frying_pan_{suffix}",
        f"turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_{suffix}",
        "ordering",
        "SUC",
        (setting,),
    )
