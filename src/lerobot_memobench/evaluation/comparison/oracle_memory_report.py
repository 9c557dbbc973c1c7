"""The oracle memory control as a report."""

from __future__ import annotations

from collections.abc import Mapping

from lerobot_memobench.evaluation.comparison.estimates import as_percent, estimate, number
from lerobot_memobench.evaluation.comparison.oracle_memory import AVERAGE, Contrast, Contrasts
from lerobot_memobench.evaluation.comparison.prefix_rows import PAPER, replan_title
from lerobot_memobench.evaluation.documents.tables import NOT_APPLICABLE, Cell, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import METRICS

SENTENCE = (
    "Cells are standard/oracle in per cent. Gap closed is (oracle − standard)/(100 − standard), with "
    "the 95 % interval of a bootstrap over paired episodes; – where an operation does not occur, or "
    "the gap is under one point."
)


def oracle_report(found: Mapping[int | None, Contrasts], paper: tuple[int, Contrasts] | None = None) -> Report:
    """Return the decomposition, one table per replan interval.

    Args:
        paper: the published contrasts and their replan interval; in rows of their own under ours of that interval, or
            in a table of their own.
    """
    tables, data = [], {}
    for replan, contrasts in found.items():
        beside = paper[1] if paper is not None and replan == paper[0] else None
        tables.append(_table(replan, contrasts, beside))
        data[str(replan)] = as_percent(contrasts)
    if paper is not None:
        data[PAPER] = as_percent(paper[1])
        if paper[0] not in found:
            tables.append(_table(paper[0], paper[1], None, f", {PAPER}"))
    return Report("Oracle memory decomposition", (Section("", tuple(tables), sentences=(SENTENCE,)),), data)


def _table(replan: int | None, found: Contrasts, beside: Contrasts | None, suffix: str = "") -> Table:
    rows: list[tuple[Cell, ...]] = []
    strong = set()
    for name, metrics in found.items():
        if name == AVERAGE:
            strong.add(len(rows))
        rows.append((name, *_cells(metrics)))
        if beside is not None and name in beside:
            rows.append((f"{name}, {PAPER}", *_cells(beside[name])))
    header = ("memory type", *METRICS, *(f"{metric} gap closed" for metric in METRICS))
    return Table(f"oracle_{replan}", replan_title(replan) + suffix, header, tuple(rows), strong=frozenset(strong))


def _cells(metrics: Mapping[str, Contrast]) -> list[Cell]:
    pairs = [
        NOT_APPLICABLE if metrics[m].standard is None else f"{number(metrics[m].standard)}/{number(metrics[m].other)}"
        for m in METRICS
    ]
    return [*pairs, *(estimate(metrics[m].closed) for m in METRICS)]
