"""The figures of evaluations as rows of CSV, one figure a row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from lerobot_memobench.evaluation.documents.beside_paper import PAPER_SAW
from lerobot_memobench.evaluation.documents.report_json import interval_of
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate, Row, percent
from lerobot_memobench.evaluation.metrics.summary import Summary
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.paper import PublishedRow, published_rows

HEADER = ("evaluation", "replan_steps", "table", "name", "figure", "percent", "low", "high", "n", "inputs")
"""``table`` is tasks, memory_types, average, pooled, prefix, ordered_prefix, failures, or extent beside the paper's."""

CsvRow = tuple[object, ...]


def csv_rows(runs: Sequence[Run], paper: bool) -> list[CsvRow]:
    """Return every figure of evaluations, and the published ones where asked for."""
    rows = [row for run in runs for row in _run_rows(run)]
    if paper:
        rows += [row for run in runs for row in _extent(run)]
        rows += [row for published in published_rows() for row in _published_rows(published)]
    return rows


def _run_rows(run: Run) -> Iterator[CsvRow]:
    for place, name, figure, rate in _figures(run.summary):
        # Records of one rollout are not independent: an interval over them would be too narrow.
        interval = None if place == "pooled" and figure != "SR" else interval_of(rate)
        low, high = interval or (None, None)
        yield (
            run.name,
            run.replan_steps,
            place,
            name,
            figure,
            percent(rate.value),
            low,
            high,
            rate.n or None,
            run.summary.inputs,
        )


def _extent(run: Run) -> Iterator[CsvRow]:
    """Yield how much was run: beside rows of 30 tasks and 1,500 rollouts."""
    for figure, count in (("tasks", len(run.summary.tasks)), ("rollouts", run.summary.rollouts)):
        yield (run.name, run.replan_steps, "extent", "", figure, None, None, None, count, run.summary.inputs)


def _published_rows(published: PublishedRow) -> Iterator[CsvRow]:
    method = f"paper, {published.table}: {published.model}"
    groups: list[tuple[str, str, Mapping[str, float | None]]] = [
        *(("memory_types", name, figures) for name, figures in published.memory_types.items()),
        ("average", "", published.average),
    ]
    for place, name, figures in groups:
        for metric in METRICS:
            yield (method, published.replan_steps, place, name, metric, figures[metric], None, None, None, PAPER_SAW)


def _figures(summary: Summary) -> Iterator[tuple[str, str, str, Rate]]:
    """Yield (table, name, figure, rate) of everything in a summary."""
    rows: list[tuple[str, str, Row]] = [
        *(("tasks", name, row) for name, row in summary.tasks.items()),
        *(("memory_types", name, row) for name, row in summary.memory_types.items()),
        ("average", "", summary.average),
        ("pooled", "", summary.pooled),
    ]
    for place, name, row in rows:
        for metric in METRICS:
            yield place, name, metric, row[metric]
    yield "pooled", "", "checkpoints", summary.pooled_checkpoints
    for place, prefixes in (("prefix", summary.prefix), ("ordered_prefix", summary.ordered_prefix)):
        for name, rates in prefixes.items():
            for k, rate in enumerate(rates):
                yield place, name, f"c{k + 1}", rate
    total = summary.rollouts
    for failure, count in summary.failures.items():
        yield "failures", "", failure, Rate(count / total, total)
