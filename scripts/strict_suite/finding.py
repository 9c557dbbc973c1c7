"""Finding: the video shows the drawer in which an object is hidden; all drawers are closed during execution.

A hidden object is outside the scene until its drawer is ajar. A wrong drawer that is ajar fails the episode.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

from folders import Setting, StrictTask
from words import DRAWERS, PLACES, Texts, region

from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.formula import And, Atom, Formula, Never, Not, Or
from lerobot_memobench.tasks.task import Prompt

TABLE = "kitchen_table"
SPOT = Region("table_region", TABLE, ((-0.09, 0.10, 0.05, 0.24), (-0.40, -0.60, 0.40, 0.60)))
"""Goal region of the found object: the whole table top. The first range is the free area that experts use."""


@dataclass(frozen=True)
class Thing:
    """A hidden object: its instance and its name in texts."""

    instance: str
    words: str


SINGLES = (
    Thing("artichoke_1", "artichoke"),
    Thing("broccoli_1", "broccoli"),
    Thing("brussels_sprouts__2_1", "brussels sprouts"),
    Thing("charger_1", "charger"),
    Thing("beefsteak_tomato__1_1", "tomato"),
)
SECONDS = (
    Thing("chestnut__2_1", "chestnut"),
    Thing("bean_curd_1", "bean curd"),
    Thing("cork__3_1", "cork"),
    Thing("cap__2_1", "cap"),
    Thing("biscuit_1", "biscuit"),
)


def strict_tasks() -> list[StrictTask]:
    """Return the ten finding tasks: five with one thing, five with two."""
    pairs = list(zip(SINGLES, SECONDS, strict=True))
    return [*(_single(first) for first in SINGLES), *(_pair(first, second) for first, second in pairs)]


def _underscored(words: str) -> str:
    return words.replace(" ", "_")


def _single(thing: Thing) -> StrictTask:
    name = _underscored(thing.words)
    settings = tuple(_setting(thing, drawer, ((thing, drawer),)) for drawer in DRAWERS)
    return _strict_task(
        f"find_the_{name}_hidden_in_one_of_the_drawers",
        f"put_the_{name}_into_the_top_drawer_of_the_cabinet",
        "hidden_thing",
        settings,
    )


def _pair(first: Thing, second: Thing) -> StrictTask:
    names = _underscored(first.words), _underscored(second.words)
    settings = tuple(
        _setting(asked, where, ((first, one), (second, other)))
        for one, other in permutations(DRAWERS, 2)
        for asked, where in ((first, one), (second, other))
    )
    return _strict_task(
        f"find_the_{names[0]}_or_the_{names[1]}_hidden_in_two_of_the_drawers",
        f"put_the_{names[0]}_into_the_top_drawer_and_the_{names[1]}_into_the_middle_drawer",
        "two_hidden_things",
        settings,
    )


def _strict_task(name: str, published: str, family: str, settings: tuple[Setting, ...]) -> StrictTask:
    return StrictTask(name, published, family, "SUC", settings, spoilt_as="wrong_place", regions=(*PLACES, SPOT))


def _setting(asked: Thing, drawer: str, hidden: tuple[tuple[Thing, str], ...]) -> Setting:
    place = region(drawer)
    wrong = tuple(Atom("ajar", (region(other),)) for other in DRAWERS if other != drawer)
    on_table = Atom("on", (asked.instance, SPOT.full_name))
    goal: Formula = And((Never(Or(wrong)), Atom("wasopen", (place,)), on_table))
    taken = And((Atom("wasopen", (place,)), Not(Atom("in", (asked.instance, place)))))  # a hidden object is nowhere
    checkpoints = (Atom("open", (place,)), taken, goal)
    return Setting(
        f"find the {asked.words} in the cabinet without moving a wrong drawer and put it on the table",
        goal,
        checkpoints,
        (_opened(asked, drawer), _taken(asked, drawer), _found(asked, drawer, hidden)),
        f"Open the {drawer} drawer, in which the {asked.words} was hidden, and put it on the table.",
        Prompt("hide", None, tuple((thing.instance, region(where)) for thing, where in hidden)),
    )


def _opened(asked: Thing, drawer: str) -> Texts:
    return (
        f"{drawer} drawer pulled out",
        f"pulled out the {drawer} drawer, where the {asked.words} was hidden",
        f"pulled the cabinet's {drawer} drawer out, into which the video showed the {asked.words} being put",
    )


def _taken(asked: Thing, drawer: str) -> Texts:
    return (
        f"{asked.words} taken out",
        f"took the {asked.words} out of the {drawer} drawer",
        f"took the {asked.words} from where it was hidden; it is no longer in the {drawer} drawer",
    )


def _found(asked: Thing, drawer: str, hidden: tuple[tuple[Thing, str], ...]) -> Texts:
    rest = [f"the {thing.words} is still in the {where} drawer" for thing, where in hidden if thing != asked]
    left = rest[0] if rest else f"the {drawer} drawer is empty and the others were left shut"
    return (
        f"{asked.words} on the table",
        f"put the {asked.words} from the {drawer} drawer on the table",
        f"found the {asked.words} in the {drawer} drawer and put it on the table; {left}",
    )
