"""An annotation study as tables and as JSON values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lerobot_memobench.evaluation.agreement.study import Agreement
from lerobot_memobench.evaluation.documents.tables import (
    NOT_APPLICABLE,
    OPERATION_NAMES,
    Cell,
    Count,
    Numbers,
    Report,
    Section,
    Table,
)
from lerobot_memobench.evaluation.metrics.rates import Rate


def report(found: Agreement) -> Report:
    """Return a study's figures as tables and JSON values."""
    rows: list[tuple[Cell, ...]] = [
        (f"Fleiss' κ, {len(found.raters)} raters", _kappa_text(found.fleiss), ""),
        *((f"Cohen's κ, {a} and {b}", _kappa_text(value), "") for (a, b), value in found.cohen.items()),
        _share("all raters agree", found.exact),
        *((f"raters split between {name}", Numbers(f"{n}"), "") for name, n in sorted(found.splits.items())),
    ]
    tables = []
    if found.majority and found.pooled and found.per_rater is not None:
        rows.append(_share("majority and released labels agree", found.majority))
        rows.append(_share("raters' decisions and released labels agree", found.pooled))
        rows += [_share(f"{name} and released labels agree", share) for name, share in found.per_rater.items()]
        rows.append(("Cohen's κ, decisions and released labels", _kappa_text(found.pooled_kappa), ""))
    if found.confusion is not None:
        tables.append(confusion_table(found.confusion))
    statistics = Table(
        "agreement", f"Agreement on {found.templates} templates", ("figure", "", "per cent"), tuple(rows)
    )
    return Report("Annotation study", (Section("", (statistics, *tables)),), data(found))


def confusion_table(counts: Mapping[str, Mapping[str, int]]) -> Table:
    """Return the table of decisions by released label."""
    rows: list[tuple[Cell, ...]] = [
        (OPERATION_NAMES[label], *(Count(n) for n in row.values()), _rate(row[label], sum(row.values())))
        for label, row in counts.items()
    ]
    header = ("released label", *(f"given {name}" for name in OPERATION_NAMES), "agree")
    return Table("confusion", "Decisions of all raters by released label", header, tuple(rows))


def _rate(part: int, whole: int) -> Rate:
    return Rate(part / whole, whole) if whole else Rate(None, 0)


def _share(name: str, share: tuple[int, int]) -> tuple[Cell, ...]:
    part, whole = share
    return (name, Numbers(f"{part}/{whole}"), Numbers(f"{100 * part / whole:.1f}"))


def _kappa_text(value: float | None) -> Numbers:
    return Numbers(NOT_APPLICABLE if value is None else f"{value:.3f}".replace("-", "−"))


def data(found: Agreement) -> dict[str, Any]:
    """Return a study's figures as JSON values."""
    return {
        "templates": found.templates,
        "raters": list(found.raters),
        "fleiss_kappa": found.fleiss,
        "cohen_kappa": [{"raters": [a, b], "kappa": value} for (a, b), value in found.cohen.items()],
        "exact_agreement": _counts(found.exact),
        "splits": dict(found.splits),
        "majority_vs_released": _counts(found.majority),
        "pooled_vs_released": _counts(found.pooled),
        "per_rater_vs_released": (
            None if found.per_rater is None else {name: _counts(value) for name, value in found.per_rater.items()}
        ),
        "pooled_kappa_vs_released": found.pooled_kappa,
        "confusion": None if found.confusion is None else {label: dict(row) for label, row in found.confusion.items()},
    }


def _counts(share: tuple[int, int] | None) -> dict[str, Any] | None:
    if share is None:
        return None
    return {"agree": share[0], "of": share[1], "percent": round(100 * share[0] / share[1], 1)}
