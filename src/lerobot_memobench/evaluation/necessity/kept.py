"""Of which types is what a necessity study keeps? Anything else in its files is made again."""

from __future__ import annotations

from typing import TypedDict

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


class Aliased(TypedDict, total=False):
    """Pictures at which more than one answer is right; empty where no demonstration succeeded."""

    at_home: Number
    pixel_exact: Number
    as_it_happens: Number


class InOrder(Aliased, total=False):
    """How far policies without memory come in the demonstrated order."""

    chance: Number
    deterministic: Number
    stochastic: Number


class KeptScene(TypedDict):
    """`Scene.result`."""

    fingerprint: str
    seed: Whole
    solved: Count
    decisions: Count
    aliased: Aliased
    in_order: InOrder
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
