"""Difficulties of strict tasks: how often an event is repeated."""

from __future__ import annotations

from typing import Literal, NamedTuple, cast, get_args

from lerobot_memobench.errors import check_choice
from lerobot_memobench.protocol import HORIZON

Difficulty = Literal["easy", "standard", "hard", "extreme"]
DIFFICULTIES: tuple[Difficulty, ...] = get_args(Difficulty)
"""From easy to hard. Each draws from the variants of the easier ones and its own (`Variant.difficulty`)."""
EASY, STANDARD = DIFFICULTIES[:2]


class Degree(NamedTuple):
    """A difficulty.

    Attributes:
        most: largest number of repetitions that a counting task asks for.
    """

    most: int

    @property
    def horizon(self) -> int:
        """Execution steps per episode: as many per repetition as in the standard suite, and not less in all."""
        return max(HORIZON, HORIZON * self.most // DEGREES[STANDARD].most)


DEGREES: dict[Difficulty, Degree] = {
    "easy": Degree(2),
    "standard": Degree(3),
    "hard": Degree(5),
    "extreme": Degree(8),
}


def degree_of(difficulty: str) -> Degree:
    """Return the repetitions of a difficulty; raise `MemobenchError` if it is unknown."""
    check_choice("difficulty", difficulty, DIFFICULTIES)
    return DEGREES[cast("Difficulty", difficulty)]


def difficulty_of_count(number: int) -> Difficulty:
    """Return the lowest difficulty that asks for so many repetitions."""
    return next(name for name, degree in DEGREES.items() if number <= degree.most)


def draws(difficulty: Difficulty, lowest: Difficulty) -> bool:
    """Return whether a difficulty draws a variant whose lowest difficulty is ``lowest``."""
    return DIFFICULTIES.index(lowest) <= DIFFICULTIES.index(difficulty)
