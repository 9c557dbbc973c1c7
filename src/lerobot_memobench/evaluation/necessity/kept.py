"""What a necessity study keeps, and of which types it is. Anything else in its files is made again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

from annotated_types import Len, MaxLen

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Number, Whole, read_json, write_file


@dataclass(frozen=True)
class Kept:
    """A result on disk, or still to be made.

    Attributes:
        path: its file.
        schema: of what types it is. fingerprint: of the question that it answers.
        make: makes it.
    """

    path: Path
    schema: Any
    fingerprint: str
    make: Callable[[], dict[str, Any]]

    def found(self) -> dict[str, Any] | None:
        """Return what the file holds if it answers this question; None if not, whatever else it holds."""
        try:
            found: dict[str, Any] = read_json(self.path, self.schema, "it is made again")
        except (FileNotFoundError, MemobenchError):
            return None
        return found if found["fingerprint"] == self.fingerprint else None

    def get(self) -> dict[str, Any]:
        """Return the result, made and written where there is none.

        Raises:
            MemobenchError: a folder stands in its place.
        """
        found = self.found()
        if found is None:
            if self.path.is_dir():
                raise MemobenchError(f"{self.path} is a folder, expected a result; remove it, or name another --out")
            found = {"fingerprint": self.fingerprint, **self.make()}
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_file(self.path, json.dumps(found, indent=1) + "\n")
        return found


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
    exhausted: bool
    policy: list[Rule]


class Found(TypedDict):
    """What the searches of a task found."""

    deterministic: Number
    confirmed: Count
    of: Count


class KeptResult(TypedDict):
    """What of `study.Result` stands beside a twin's."""

    task: str
    referent: str
    in_order: InOrder | None
    any_order: Found | None
