"""Failures of strict tasks are named for what happened, by driven predicates without a simulator."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from lerobot_memobench.tasks.assessment import classify_failure
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.progress import Progress

DRAWERS = "check_all_three_drawers_once_each_in_the_given_order"
COUNTING = "check_the_top_drawer_a_given_number_of_times"
FINDING = "find_the_artichoke_hidden_in_one_of_the_drawers"
BOWL = "open_and_close_the_microwave_once_then_put_the_white_bowl_on_the_plate"


def failure(name: str, states: Iterable[str], cut_off: bool = False) -> str | None:
    """Return the class of a rollout; a state names what is open, ``home``, ``ajar`` or ``moved``, for 60 steps each."""
    task = get_task(name).variant(0)
    progress = Progress(task)
    for state in states:
        words = set(state.split())

        def holds(atom: Atom, words: set[str] = words) -> bool:
            places = [place for place in ("top", "middle", "bottom", "microwave") if place in " ".join(atom.args)]
            open_ = bool(places) and places[0] in words
            return {
                "open": open_,
                "close": not open_,
                "ajar": open_ or ("ajar" in words and places == ["top"]),
                "handhome": "home" in words,
                "asbegun": "home" in words and words == {"home"},
                "inplace": "moved" not in words,
            }.get(atom.predicate, False)

        for _ in range(60):
            if not progress.lost and not progress.success:
                progress.step(holds)
    lost = progress.broken if progress.lost else None
    return classify_failure(
        task, progress.first_step, progress.success, lost=lost, cut_off=cut_off, ordered=progress.ordered
    )


def check(drawer: str) -> list[str]:
    return ["home", drawer, "away"]


@pytest.mark.parametrize(
    ("name", "states", "expected"),
    [
        (DRAWERS, ["home", "middle"], "wrong_order"),
        (DRAWERS, [*check("top"), *check("bottom")], "wrong_order"),
        (DRAWERS, [*check("top"), *check("top")], "miscount"),
        (DRAWERS, [*check("top"), *check("middle"), *check("top")], "miscount"),
        (DRAWERS, [*check("top"), "middle"], "hand"),
        (DRAWERS, ["home", "top", "home ajar"], "hand"),
        (DRAWERS, ["home", "away"], "hand"),
        (DRAWERS, [*check("top"), "home"], "stale_memory"),
        (DRAWERS, [*check("top"), *check("middle"), "home"], "compression_collapse"),
        (DRAWERS, [*check("top"), *check("middle"), "home", "bottom"], "hand"),
        (COUNTING, ["home"], "miscount"),
        (COUNTING, ["top", "home ajar"], "hand"),
        (FINDING, ["home", "bottom"], "wrong_place"),
        (FINDING, ["home", "top"], "hand"),
        (FINDING, ["home", "away"], "storage_failure"),
        (BOWL, ["home", "moved"], "wrong_order"),
        (BOWL, ["home", "microwave", "away", "moved"], "hand"),
        (BOWL, ["home", "microwave", "away", "home", "moved"], "hand"),
        (BOWL, ["home", "microwave", "away", "home"], "compression_collapse"),
    ],
)
def test_strict_failures_are_named_for_what_happened(name: str, states: list[str], expected: str) -> None:
    assert failure(name, states) == expected


def test_a_cut_off_rollout_stays_one() -> None:
    assert failure(FINDING, ["home", "top"], cut_off=True) == "cut_off"
