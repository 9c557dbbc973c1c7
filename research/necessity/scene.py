"""The demonstrations of all variants from one start: which of their frames look the same, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.protocol import LONGEST_HOLD
from lerobot_memobench.tasks.task import STRICT, Task
from research.necessity.demonstrations import (
    Demonstration,
    Frame,
    difference,
    largest_pixel_difference,
    pairwise_table,
)
from research.necessity.memoryless import (
    Decision,
    History,
    aliased,
    chance,
    classes,
    deterministic_ceiling,
    stochastic_ceiling,
)

PIXEL_EXACT = 8
"""Largest channel difference of pictures that count as exactly the same, of 255. While things settle by micrometres, a
pixel at an edge goes from one face to its neighbour: by up to 6 levels as drawn on the CPU, by 2 as GL drew it."""
SAME_HAND = 0.01
"""Difference of the proprioception (m, rad) up to which the arm is where it was, as things happen."""
EXAMPLES = 3


class Scene:
    """Frames of successful demonstrations: failed ones have no answers to learn.

    Args:
        variants, shown: goals that may lie behind the start, and how each was demonstrated.
        tolerance: difference up to which pictures look the same.
    """

    def __init__(self, variants: Sequence[Task], shown: Sequence[Demonstration], tolerance: float) -> None:
        self._owners: list[int] = []
        self._frames: list[Frame] = []
        self._asked: list[str] = []
        for variant, demonstration in zip(variants, shown, strict=True):
            if demonstration.success:
                self._frames += demonstration.frames
                self._owners += [variant.variant_index] * len(demonstration.frames)
                self._asked += [variant.language] * len(demonstration.frames)
        self._tolerance = tolerance
        self._hold = LONGEST_HOLD if variants[0].suite == STRICT else 0
        self._differences = pairwise_table([frame.at_home for frame in self._frames], difference)
        self._pictures = classes(self._differences, tolerance)

    def result(self, seed: int) -> dict[str, Any]:
        """Return the result of a scene; ``aliased`` and ``in_order`` are empty without a successful demonstration."""
        histories = self._histories(self._pictures)
        as_exact = self._histories(classes(pairwise_table(self._frames, _exactly), PIXEL_EXACT))
        seen = pairwise_table(self._frames, _as_it_happens)
        as_it_happens = self._histories(classes(seen, self._tolerance))
        with_step = self._histories(classes(np.where(self._told_by_the_step(), 1.0, seen), self._tolerance))
        in_order = (
            {
                "chance": chance(histories),
                "deterministic": deterministic_ceiling(histories),
                "stochastic": stochastic_ceiling(histories),
                "pixel_exact": deterministic_ceiling(as_exact),
                "as_it_happens": deterministic_ceiling(as_it_happens),
                "with_step": deterministic_ceiling(with_step),
            }
            if histories
            else {}
        )
        apart = ~np.equal.outer(self._pictures, self._pictures)
        counts = {
            "at_home": histories,
            "pixel_exact": as_exact,
            "as_it_happens": as_it_happens,
            "with_step": with_step,
        }
        return {
            "seed": seed,
            "solved": len(histories),
            "decisions": sum(len(history) for history in histories),
            "aliased": {key: len(aliased(found)) for key, found in counts.items()} if histories else {},
            "in_order": in_order,
            "examples": [self._example(seed, i, j) for i, j in self._pairs[:EXAMPLES]],
            "largest_same": float(self._differences[~apart].max(initial=0.0)),
            "smallest_different": float(self._differences[apart].min(initial=1.0)),
        }

    def strip(self) -> NDArray[np.uint8] | None:
        """Return the first pair side by side, (height, 4 × width, 3): cameras of a, of b; None without a pair."""
        if not self._pairs:
            return None
        i, j = self._pairs[0]
        return np.concatenate([*self._frames[i].at_home, *self._frames[j].at_home], axis=1)

    def _told_by_the_step(self) -> NDArray[np.bool_]:
        """Return the pairs of frames that the step counter separates, (n, n): further apart than the longest hold.

        Without holds every step does, which is generous: in other scenes the same decision comes at another step.
        """
        steps = np.array([frame.step for frame in self._frames])
        return np.abs(np.subtract.outer(steps, steps)) > self._hold

    def _histories(self, pictures: Sequence[int]) -> list[History]:
        """Return a history per demonstration; pictures under different instructions are distinct."""
        rows: dict[int, list[Decision]] = {}
        instructions = list(dict.fromkeys(self._asked))
        for owner, asked, frame, picture in zip(self._owners, self._asked, self._frames, pictures, strict=True):
            seen = picture + instructions.index(asked) * len(self._frames)
            rows.setdefault(owner, []).append(Decision(seen, frame.answer))
        return [tuple(row) for row in rows.values()]

    @cached_property
    def _pairs(self) -> list[tuple[int, int]]:
        """Frames that look the same and ask for different answers."""
        return [
            (i, j)
            for i, j in combinations(range(len(self._frames)), 2)
            if self._pictures[i] == self._pictures[j]
            and self._asked[i] == self._asked[j]
            and self._frames[i].answer != self._frames[j].answer
        ]

    def _example(self, seed: int, i: int, j: int) -> dict[str, Any]:
        a, b = self._frames[i], self._frames[j]
        return {
            "seed": seed,
            "a": self._said(i),
            "b": self._said(j),
            "difference": float(self._differences[i, j]),
            "largest_pixel_difference": largest_pixel_difference(a.at_home, b.at_home),
            "hand_apart_m": float(np.linalg.norm(a.proprio[:3] - b.proprio[:3])),
        }

    def _said(self, index: int) -> dict[str, Any]:
        frame = self._frames[index]
        return {"variant": self._owners[index], "step": frame.step, "answer": frame.answer}


def _exactly(a: Frame, b: Frame) -> float:
    """Return how much two frames differ with the arm at home if every pixel could be used."""
    return largest_pixel_difference(a.at_home, b.at_home)


def _as_it_happens(a: Frame, b: Frame) -> float:
    """Return how much two frames differ with the arm where it was; 1 where the hand was elsewhere."""
    return difference(a.observations, b.observations) if np.abs(a.proprio - b.proprio).max() <= SAME_HAND else 1.0
