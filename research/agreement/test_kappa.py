"""Kappas against textbook values."""

from __future__ import annotations

import pytest

from research.agreement.study import cohen_kappa, confusion_kappa, fleiss_kappa


def test_fleiss_of_the_textbook() -> None:
    """Fleiss (1971) as reproduced everywhere: 10 subjects, 14 raters, 5 categories, kappa 0.210."""
    table = [
        (0, 0, 0, 0, 14), (0, 2, 6, 4, 2), (0, 0, 3, 5, 6), (0, 3, 9, 2, 0), (2, 2, 8, 1, 1),
        (7, 7, 0, 0, 0), (3, 2, 6, 3, 0), (2, 5, 3, 2, 2), (6, 5, 2, 1, 0), (0, 2, 2, 3, 7),
    ]  # fmt: skip
    rows = [[str(k) for k, count in enumerate(row) for _ in range(count)] for row in table]
    assert fleiss_kappa(rows) == pytest.approx(0.210, abs=5e-4)


def test_cohen_of_the_textbook() -> None:
    """20 yes/yes, 5 yes/no, 10 no/yes, 15 no/no: observed 0.7, expected 0.5, kappa 0.4."""
    assert confusion_kappa([[20, 5], [10, 15]]) == pytest.approx(0.4)
    a = "S" * 25 + "U" * 25
    b = "S" * 20 + "U" * 5 + "S" * 10 + "U" * 15
    assert cohen_kappa(a, b) == pytest.approx(0.4)


def test_one_label_only_has_no_kappa() -> None:
    assert cohen_kappa("SSS", "SSS") is None
    assert fleiss_kappa(["SS", "SS"]) is None
