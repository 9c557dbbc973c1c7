"""Agreement beyond chance: Fleiss' and Cohen's kappa, None where only one label is ever used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np


def kappa(observed: float, expected: float) -> float | None:
    """Return (observed − expected) / (1 − expected)."""
    return None if expected >= 1.0 else (observed - expected) / (1.0 - expected)


def fleiss_kappa(rows: Sequence[Sequence[str]]) -> float | None:
    """Return Fleiss' kappa of (T, R) labels, R ≥ 2 (Fleiss 1971)."""
    from statsmodels.stats.inter_rater import aggregate_raters, fleiss_kappa

    counts, labels = aggregate_raters(np.array([list(row) for row in rows]))
    return None if len(labels) == 1 else float(fleiss_kappa(counts))


def cohen_kappa(a: Sequence[str], b: Sequence[str]) -> float | None:
    """Return Cohen's kappa of two raters' (T,) labels (Cohen 1960)."""
    labels, counts = sorted({*a, *b}), Counter(zip(a, b, strict=True))
    return confusion_kappa([[counts[x, y] for y in labels] for x in labels])


def confusion_kappa(table: Sequence[Sequence[int]]) -> float | None:
    """Return Cohen's kappa of a square table of counts."""
    from statsmodels.stats.inter_rater import cohens_kappa

    counts = np.array(table)
    if counts.diagonal().max() == counts.sum():
        return None
    return float(cohens_kappa(counts, return_results=False))
