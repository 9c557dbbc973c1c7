"""Do annotators agree on which operation a checkpoint is? Statistics of a relabelling study (paper, appendix).

Labels are "S", "U", "C". A template is one checkpoint; every rater labels every template.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.tables import Cell, Count, Numbers, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import Rate
from lerobot_memobench.paper import AgreementFigures
from lerobot_memobench.tasks.task import OPERATIONS

OPERATION_NAMES = {"S": "Storage", "U": "Update", "C": "Compression"}


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


# --- statistics ---


def kappa(observed: float, expected: float) -> float | None:
    """Return (observed − expected) / (1 − expected), None where only one label is ever used."""
    return None if expected >= 1.0 else (observed - expected) / (1.0 - expected)


def fleiss_kappa(rows: Sequence[Sequence[str]]) -> float | None:
    """Return Fleiss' kappa of (T, R) labels, R ≥ 2 (Fleiss 1971)."""
    raters = len(rows[0])
    counts = [Counter(row) for row in rows]
    observed = sum(sum(n * (n - 1) for n in count.values()) for count in counts) / (len(rows) * raters * (raters - 1))
    total = sum(counts, Counter[str]())
    expected = sum((n / (len(rows) * raters)) ** 2 for n in total.values())
    return kappa(observed, expected)


def cohen_kappa(a: Sequence[str], b: Sequence[str]) -> float | None:
    """Return Cohen's kappa of two raters' (T,) labels (Cohen 1960)."""
    return confusion_kappa(
        [[sum(x == i and y == j for x, y in zip(a, b, strict=True)) for j in _all(a, b)] for i in _all(a, b)]
    )


def _all(a: Sequence[str], b: Sequence[str]) -> list[str]:
    return sorted({*a, *b})


def confusion_kappa(table: Sequence[Sequence[int]]) -> float | None:
    """Return Cohen's kappa of a square table of counts."""
    total = sum(map(sum, table))
    observed = sum(table[k][k] for k in range(len(table))) / total
    columns = [sum(column) for column in zip(*table, strict=True)]
    return kappa(observed, sum(sum(row) * column for row, column in zip(table, columns, strict=True)) / total**2)


def majority(row: Sequence[str]) -> str | None:
    """Return the label that more than half of the raters gave, None where none has."""
    label, count = Counter(row).most_common(1)[0]
    return label if 2 * count > len(row) else None


def confusion(labels: Labels) -> dict[str, dict[str, int]]:
    """Return released label -> label given -> decisions of all raters together."""
    found = {label: dict.fromkeys(OPERATIONS, 0) for label in OPERATIONS}
    for released, row in zip(labels.released or (), labels.rows, strict=True):
        for given in row:
            found[released][given] += 1  # type: ignore[index]
    return {str(label): {str(given): n for given, n in row.items()} for label, row in found.items()}


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
    splits = Counter("/".join(sorted(set(row), key="SUC".index)) for row in rows if len(set(row)) > 1)
    found: dict[str, Any] = {"majority": None, "pooled": None, "per_rater": None, "pooled_kappa": None}
    table = None
    if labels.released is not None:
        released = labels.released
        right = {
            name: sum(x == y for x, y in zip(given, released, strict=True)) for name, given in labels.raters.items()
        }
        table = confusion(labels)
        found = {
            "majority": (sum(majority(row) == label for row, label in zip(rows, released, strict=True)), count),
            "pooled": (sum(right.values()), count * len(labels.raters)),
            "per_rater": {name: (n, count) for name, n in right.items()},
            "pooled_kappa": confusion_kappa([list(row.values()) for row in table.values()]),
        }
    return Agreement(
        templates=count,
        raters=tuple(labels.raters),
        fleiss=fleiss_kappa(rows),
        cohen={(a, b): cohen_kappa(labels.raters[a], labels.raters[b]) for a, b in combinations(labels.raters, 2)},
        exact=(sum(len(set(row)) == 1 for row in rows), count),
        splits=dict(splits),
        confusion=table,
        **found,
    )


# --- what is written ---


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
    return Numbers("–" if value is None else f"{value:.3f}".replace("-", "−"))


def data(found: Agreement) -> dict[str, Any]:
    """Return a study's figures as JSON values."""

    def share(value: tuple[int, int] | None) -> dict[str, Any] | None:
        if value is None:
            return None
        return {"agree": value[0], "of": value[1], "percent": round(100 * value[0] / value[1], 1)}

    return {
        "templates": found.templates,
        "raters": list(found.raters),
        "fleiss_kappa": found.fleiss,
        "cohen_kappa": [{"raters": [a, b], "kappa": value} for (a, b), value in found.cohen.items()],
        "exact_agreement": share(found.exact),
        "splits": dict(found.splits),
        "majority_vs_released": share(found.majority),
        "pooled_vs_released": share(found.pooled),
        "per_rater_vs_released": (
            None if found.per_rater is None else {name: share(value) for name, value in found.per_rater.items()}
        ),
        "pooled_kappa_vs_released": found.pooled_kappa,
        "confusion": None if found.confusion is None else {label: dict(row) for label, row in found.confusion.items()},
    }


# --- from what the paper publishes ---


@dataclass(frozen=True)
class Recomputed:
    """A published figure and the same from other published ones. ``how`` names these."""

    name: str
    published: str
    recomputed: str
    how: str

    @property
    def agrees(self) -> bool:
        return self.published == self.recomputed


RATERS = 3
"""Of the paper's study."""

TEMPLATES = {"S": 35, "U": 32, "C": 17}
"""Released label -> templates, as the paper's confusion table says."""


def from_published(paper: AgreementFigures) -> list[Recomputed]:
    """Recompute the paper's figures from its confusion matrix and its count of unanimous templates.

    The labels themselves are not published, but: rows of the matrix hold each template once per rater; its diagonal is
    the pooled agreement; its columns are all labels given, which with the number of templates on which raters differ
    (each one against two, as the text says) fixes Fleiss' kappa. Which pairs differ follows from the three values of
    Cohen's kappa, which must use up those differences.
    """
    columns = [sum(column) for column in zip(*paper.confusion.values(), strict=True)]
    total = sum(columns)
    templates = total // RATERS
    diagonal = sum(paper.confusion[label][k] for k, label in enumerate(OPERATIONS))
    split = templates - paper.exact[0]
    observed = (paper.exact[0] + split / RATERS) / templates
    expected = sum((n / total) ** 2 for n in columns)
    fleiss = kappa(observed, expected)
    assert fleiss is not None
    right = [round(share * templates) for share in paper.per_rater]
    apart = disagreements(paper.cohen_kappa, templates, expected)
    alone = odd_ones_out(apart)
    return [
        Recomputed(
            "templates by released label",
            ", ".join(f"{count} {label}" for label, count in TEMPLATES.items()),
            ", ".join(f"{sum(row) // RATERS} {label}" for label, row in paper.confusion.items()),
            "rows of the confusion matrix over three raters",
        ),
        Recomputed(
            "pooled agreement with released labels",
            "{}/{}".format(*paper.pooled),
            f"{diagonal}/{total}",
            "diagonal of the confusion matrix",
        ),
        Recomputed(
            "Fleiss' κ", f"{paper.fleiss_kappa:.3f}", f"{fleiss:.3f}", "columns of the matrix, unanimous templates"
        ),
        Recomputed(
            "decisions that agree, raters summed",
            str(paper.pooled[0]),
            str(sum(right)),
            "per-rater agreement: " + ", ".join(f"{n}/{templates}" for n in right),
        ),
        Recomputed(
            "mean of Cohen's κ",
            f"{sum(paper.cohen_kappa) / len(paper.cohen_kappa):.3f}",
            f"{fleiss:.3f}",
            "Fleiss' κ, which it equals where raters use labels alike",
        ),
        Recomputed(
            "templates with a split",
            str(split),
            str(sum(apart) // 2),
            f"Cohen's κ: the pairs differ on {', '.join(map(str, apart))} templates, each split counted by two pairs",
        ),
        Recomputed(
            "majority against released labels",
            "{}/{}".format(*paper.majority),
            f"{max(right)}/{templates}" if min(alone) == 0 else "not fixed",
            "the raters were alone on " + ", ".join(map(str, alone)) + " templates: one is the majority everywhere",
        ),
    ]


def disagreements(kappas: Sequence[float], templates: int, expected: float) -> list[int]:
    """Return on how many templates each pair of raters differs, from its kappa and the chance agreement.

    Each pair's own chance agreement is not published; that of all labels together stands for it.
    """
    return [round((1 - value) * (1 - expected) * templates) for value in kappas]


def odd_ones_out(apart: Sequence[int]) -> list[int]:
    """Return on how many templates each of three raters is alone, from how often the pairs 12, 13 and 23 differ."""
    total = sum(apart) // 2
    return [total - apart[2], total - apart[1], total - apart[0]]


def published_report(paper: AgreementFigures) -> Report:
    """Return the paper's figures beside those recomputed, and its confusion matrix."""
    found = from_published(paper)
    rows = tuple(
        (each.name, Numbers(each.published), Numbers(each.recomputed), "equal" if each.agrees else "differs", each.how)
        for each in found
    )
    counts = {label: dict(zip(OPERATIONS, row, strict=True)) for label, row in paper.confusion.items()}
    plain = {label: {str(k): n for k, n in row.items()} for label, row in counts.items()}
    pooled = confusion_kappa([list(row) for row in paper.confusion.values()])
    sentence = f"Not published, from the confusion matrix: Cohen's κ of decisions and released labels {pooled:.3f}."
    table = Table(
        "published-agreement",
        "The paper's annotation study, recomputed",
        ("figure", "published", "recomputed", "", "from"),
        rows,
    )
    content = {
        "figures": [
            {"name": e.name, "published": e.published, "recomputed": e.recomputed, "agrees": e.agrees, "from": e.how}
            for e in found
        ],
        "pooled_kappa_vs_released": pooled,
    }
    return Report("The paper's annotation study", (Section("", (table, confusion_table(plain)), (sentence,)),), content)
