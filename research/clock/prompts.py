"""What the length of a prompt tells: how often the variant that it shows is right, guessed from nothing else."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sklearn.model_selection import RepeatedStratifiedKFold
from sklearn.tree import DecisionTreeClassifier

from lerobot_memobench.datasets.lerobot_format.reading import list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task
from research.clock.study import FOLDS, check_enough
from research.learning.results import markdown

SHUFFLES = 10
"""As often everything is guessed, each time by other folds: one shuffle of 49 prompts says 61 to 73 %."""


@dataclass(frozen=True)
class PromptLengths:
    """The prompts of one task.

    Attributes:
        demonstrations, variants: how many. shortest, longest: control steps. right: share of guesses.
    """

    task: str
    demonstrations: int
    variants: int
    shortest: int
    longest: int
    right: float

    @property
    def chance(self) -> float:
        """Share of right guesses of one who is told nothing."""
        return 1 / self.variants


def prompt_lengths(folder: Path, seed: int = 0) -> Iterator[PromptLengths]:
    """Yield what was measured of each task of a dataset whose prompt shows one of several variants.

    A guess is a tree's, of as many leaves as there are variants, on episodes that were not learned from. Folds have the
    variants alike, so that a length which tells nothing is right as often as chance.

    Args:
        seed: of the folds and the trees.

    Raises:
        MemobenchError: no dataset, no such task in it, or fewer demonstrations of one than folds.
    """
    shown: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for place in list_episodes(folder):
        told = place.record
        if told is not None and told.referent != "fixed" and told.exec_start_index > 0:
            shown[told.task_name].append((told.exec_start_index, told.variant))
    if not shown:
        raise MemobenchError(
            f"{folder} holds no prompts that show one of several variants; generate some: --tasks object,procedural "
            "--referent random"
        )
    for name, found in sorted(shown.items()):
        check_enough(folder, name, len(found))
        lengths, variants = np.array(found).T
        right, kinds = 0, len(get_task(name).random_variants)
        folds = RepeatedStratifiedKFold(n_splits=FOLDS, n_repeats=SHUFFLES, random_state=seed)
        for train, test in folds.split(lengths, variants):
            tree = DecisionTreeClassifier(max_leaf_nodes=max(kinds, 2), random_state=seed)
            guesses = tree.fit(lengths[train, None], variants[train]).predict(lengths[test, None])
            right += int((guesses == variants[test]).sum())
        share = right / (SHUFFLES * len(found))
        yield PromptLengths(name, len(found), kinds, int(lengths.min()), int(lengths.max()), share)


def prompts_table(results: Sequence[PromptLengths]) -> str:
    """Return them as a Markdown table, shares in per cent."""
    rows = [
        [
            f"`{one.task}`",
            f"{one.demonstrations}",
            f"{one.variants}",
            f"{one.shortest}–{one.longest}",
            f"{100 * one.chance:.0f}",
            f"{100 * one.right:.0f}",
        ]
        for one in results
    ]
    return markdown(["task", "demonstrations", "variants", "prompt, steps", "chance", "by length"], rows)
