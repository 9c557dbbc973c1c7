"""The paper's annotation study, recomputed from what it publishes of it.

The labels themselves are not published, but: rows of the confusion matrix hold each template once per rater; its
diagonal is the pooled agreement; its columns are all labels given, which with the number of templates on which raters
differ (each one against two, as the text says) fixes Fleiss' kappa. Which pairs differ follows from the three values of
Cohen's kappa, which must use up those differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lerobot_memobench.evaluation.tables import Numbers, Report, Section, Table
from lerobot_memobench.paper import raw_tables
from lerobot_memobench.tasks.task import OPERATIONS
from research.agreement.study import confusion_kappa, confusion_table, kappa

RATERS = 3
"""Of the paper's study."""

TEMPLATES = {"S": 35, "U": 32, "C": 17}
"""Released label -> templates, as the paper's confusion table says."""


@dataclass(frozen=True)
class AgreementFigures:
    """The paper's annotation study: three raters, 84 templates.

    Attributes:
        confusion: released label -> pooled decisions of the raters for S, U, C.
        exact, majority, pooled: (agreeing, of) templates, templates, decisions.
        per_rater: shares, in the paper's order.
    """

    confusion: Mapping[str, tuple[int, int, int]]
    fleiss_kappa: float
    cohen_kappa: tuple[float, ...]
    exact: tuple[int, int]
    majority: tuple[int, int]
    pooled: tuple[int, int]
    per_rater: tuple[float, ...]


def annotator_agreement() -> AgreementFigures:
    """Return what the paper says of its annotation study."""
    raw = raw_tables()["annotator_agreement"]

    def count(key: str) -> tuple[int, int]:
        """Take ``part/whole`` apart."""
        part, whole = raw[key].split("/")
        return int(part), int(whole)

    return AgreementFigures(
        confusion={label: (row[0], row[1], row[2]) for label, row in raw["confusion"].items()},
        fleiss_kappa=raw["fleiss_kappa"],
        cohen_kappa=tuple(raw["cohen_kappa"]),
        exact=count("exact_agreement"),
        majority=count("majority_vs_released"),
        pooled=count("pooled_vs_released"),
        per_rater=tuple(raw["per_rater_vs_released"]),
    )


@dataclass(frozen=True)
class Recomputed:
    """A published figure and the same from other published ones. ``how`` names these."""

    name: str
    published: str
    recomputed: str
    how: str

    @property
    def agrees(self) -> bool:
        """Whether both are the same, as printed."""
        return self.published == self.recomputed


def from_published(paper: AgreementFigures) -> list[Recomputed]:
    """Recompute the paper's figures from its confusion matrix, its shares and its kappas."""
    return [*_from_matrix(paper), _from_shares(paper), *_from_kappas(paper)]


def _templates(paper: AgreementFigures) -> int:
    return sum(map(sum, paper.confusion.values())) // RATERS


def _split(paper: AgreementFigures) -> int:
    """Return on how many templates raters differ."""
    return _templates(paper) - paper.exact[0]


def _expected(paper: AgreementFigures) -> float:
    """Return the agreement by chance: of all labels given, the columns of the confusion matrix."""
    columns = [sum(column) for column in zip(*paper.confusion.values(), strict=True)]
    return sum((n / sum(columns)) ** 2 for n in columns)


def _fleiss(paper: AgreementFigures) -> float:
    observed = (paper.exact[0] + _split(paper) / RATERS) / _templates(paper)
    found = kappa(observed, _expected(paper))
    assert found is not None
    return found


def _right(paper: AgreementFigures) -> list[int]:
    """Return per rater on how many templates it agrees with the released labels."""
    return [round(share * _templates(paper)) for share in paper.per_rater]


def _from_matrix(paper: AgreementFigures) -> list[Recomputed]:
    diagonal = sum(paper.confusion[label][k] for k, label in enumerate(OPERATIONS))
    total = sum(map(sum, paper.confusion.values()))
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
            "Fleiss' κ",
            f"{paper.fleiss_kappa:.3f}",
            f"{_fleiss(paper):.3f}",
            "columns of the matrix, unanimous templates",
        ),
    ]


def _from_shares(paper: AgreementFigures) -> Recomputed:
    right = _right(paper)
    return Recomputed(
        "decisions that agree, raters summed",
        str(paper.pooled[0]),
        str(sum(right)),
        "per-rater agreement: " + ", ".join(f"{n}/{_templates(paper)}" for n in right),
    )


def _from_kappas(paper: AgreementFigures) -> list[Recomputed]:
    apart = disagreements(paper.cohen_kappa, _templates(paper), _expected(paper))
    alone = odd_ones_out(apart)
    return [
        Recomputed(
            "mean of Cohen's κ",
            f"{sum(paper.cohen_kappa) / len(paper.cohen_kappa):.3f}",
            f"{_fleiss(paper):.3f}",
            "Fleiss' κ, which it equals where raters use labels alike",
        ),
        Recomputed(
            "templates with a split",
            str(_split(paper)),
            str(sum(apart) // 2),
            f"Cohen's κ: the pairs differ on {', '.join(map(str, apart))} templates, each split counted by two pairs",
        ),
        Recomputed(
            "majority against released labels",
            "{}/{}".format(*paper.majority),
            f"{max(_right(paper))}/{_templates(paper)}" if min(alone) == 0 else "not fixed",
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
    counts = {label: dict[str, int](zip(OPERATIONS, row, strict=True)) for label, row in paper.confusion.items()}
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
    section = Section("", (table, confusion_table(counts)), (sentence,))
    return Report("The paper's annotation study", (section,), content)
