"""Of which types is what a necessity study keeps? Anything else in its files is made again."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypedDict

from annotated_types import Len, MaxLen

from lerobot_memobench.files.reading import Count, Number, Whole


class Said(TypedDict):
    """A moment of an aliased pair."""

    variant: Count
    step: Count
    answer: str


class Example(TypedDict):
    """An aliased pair."""

    seed: Whole
    a: Said
    b: Said


Nothing = Annotated[dict[str, Any], MaxLen(0)]
"""Where no demonstration succeeded."""
Aliased = Annotated[dict[Literal["at_home", "pixel_exact", "as_it_happens"], Number], Len(3, 3)]
"""Pictures at which more than one answer is right."""
InOrder = Annotated[
    dict[Literal["chance", "deterministic", "stochastic", "pixel_exact", "as_it_happens"], Number], Len(5, 5)
]
"""How far policies without memory come in the demonstrated order."""


class KeptScene(TypedDict):
    """`Scene.result`."""

    fingerprint: str
    seed: Whole
    solved: Count
    decisions: Count
    aliased: Nothing | Aliased
    in_order: Nothing | InOrder
    examples: list[Example]
    largest_same: Number
    smallest_different: Number


class Rule(TypedDict):
    """What a map does where one of these combinations of atoms is seen."""

    when: list[str]
    do: str


class KeptSearch(TypedDict):
    """`any_order.search`."""

    fingerprint: str
    deterministic: Number
    stochastic: Number
    confirmed: Count
    of: Count
    complete: bool
    policy: list[Rule]
