"""Do annotators agree on which operation a checkpoint is? Figures of a relabelling study (paper, appendix).

Labels are "S", "U", "C". A template is one checkpoint; every rater labels every template.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement.kappa import cohen_kappa, confusion_kappa, fleiss_kappa
from lerobot_memobench.tasks.task import OPERATIONS


@dataclass(frozen=True)
class Labels:
    """A relabelling study.

    Attributes:
        templates: names. raters: rater -> (T,) labels. released: (T,) labels to compare with, None where unknown.
    """

    templates: tuple[str, ...]
    raters: Mapping[str, tuple[str, ...]]
    released: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.raters) < 2 or not self.templates:
            raise MemobenchError(
                f"found {len(self.raters)} raters and {len(self.templates)} templates; agreement needs two raters and "
                "a template at least"
            )

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Per template the labels of all raters."""
        return list(zip(*self.raters.values(), strict=True))


def majority(row: Sequence[str]) -> str | None:
    """Return the label that more than half of the raters gave, None where none has."""
    label, count = Counter(row).most_common(1)[0]
    return label if 2 * count > len(row) else None


def confusion(labels: Labels, released: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return released label -> label given -> decisions of all raters together."""
    counts = Counter((right, given) for right, row in zip(released, labels.rows, strict=True) for given in row)
    return {right: {given: counts[right, given] for given in OPERATIONS} for right in OPERATIONS}


@dataclass(frozen=True)
class Agreement:
    """The figures of a study; counts are (agreeing, of). Those against released labels are None without them."""

    templates: int
    raters: tuple[str, ...]
    fleiss: float | None
    cohen: Mapping[tuple[str, str], float | None]
    exact: tuple[int, int]
    splits: Mapping[str, int]
    majority: tuple[int, int] | None
    pooled: tuple[int, int] | None
    per_rater: Mapping[str, tuple[int, int]] | None
    pooled_kappa: float | None
    confusion: Mapping[str, Mapping[str, int]] | None


def study(labels: Labels) -> Agreement:
    """Compute all figures of a study."""
    rows, count = labels.rows, len(labels.templates)
    splits = Counter("/".join(sorted(set(row), key=OPERATIONS.index)) for row in rows if len(set(row)) > 1)
    return Agreement(
        templates=count,
        raters=tuple(labels.raters),
        fleiss=fleiss_kappa(rows),
        cohen={(a, b): cohen_kappa(labels.raters[a], labels.raters[b]) for a, b in combinations(labels.raters, 2)},
        exact=(sum(len(set(row)) == 1 for row in rows), count),
        splits=dict(splits),
        **_against_released(labels),
    )


def _against_released(labels: Labels) -> dict[str, Any]:
    """Return the figures of `Agreement` that compare with released labels."""
    if labels.released is None:
        return dict.fromkeys(("majority", "pooled", "per_rater", "pooled_kappa", "confusion"))
    released, count = labels.released, len(labels.templates)
    right = {name: sum(x == y for x, y in zip(given, released, strict=True)) for name, given in labels.raters.items()}
    table = confusion(labels, released)
    return {
        "majority": (sum(majority(row) == label for row, label in zip(labels.rows, released, strict=True)), count),
        "pooled": (sum(right.values()), count * len(labels.raters)),
        "per_rater": {name: (n, count) for name, n in right.items()},
        "pooled_kappa": confusion_kappa([list(row.values()) for row in table.values()]),
        "confusion": table,
    }
