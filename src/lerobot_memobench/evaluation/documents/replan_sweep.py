"""One method at several replan intervals: its tables, and which interval is best for what."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.evaluation.documents.evaluation_tables import HOW_TO_READ, rate_row
from lerobot_memobench.evaluation.documents.sentences import inputs_sentence
from lerobot_memobench.evaluation.documents.tables import Section, Table, best_in_columns, figure
from lerobot_memobench.evaluation.documents.wide_tables import all_rates, wide_table
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate, percent
from lerobot_memobench.evaluation.metrics.rollouts import policy_inputs
from lerobot_memobench.evaluation.records.runs import Run


def sweep(method: str, runs: Sequence[Run]) -> Section:
    """Return the tables of one method at several replan intervals, and which interval is best for what."""
    notes = []
    if len({frozenset(run.summary.tasks) for run in runs}) > 1:
        notes.append("the intervals were not evaluated on the same tasks; their averages do not compare")
    return Section(
        f"Replan sweep: {method}",
        (_averages(method, runs), _memory_types(method, runs)),
        (f"Best replan interval by average: {', '.join(_best(runs))}.",),
        tuple(notes),
    )


def _averages(method: str, runs: Sequence[Run]) -> Table:
    rows = tuple((run.replan_steps, *rate_row(None, run.summary.average)[1:]) for run in runs)
    return Table(
        f"replan-{_slug(method)}",
        f"Average by replan interval: {method}",
        ("replan interval", "n", *METRICS),
        rows,
        note=f"{HOW_TO_READ} {_seen(runs)}",
        best=best_in_columns(rows),
    )


def _memory_types(method: str, runs: Sequence[Run]) -> Table:
    rows = tuple((run.replan_steps, *all_rates(run.summary)) for run in runs)
    return wide_table(
        f"replan-types-{_slug(method)}",
        f"Memory types by replan interval: {method}",
        rows,
        leading=("replan interval",),
        note=_seen(runs),
        best=best_in_columns(rows),
    )


def _seen(runs: Sequence[Run]) -> str:
    return inputs_sentence(policy_inputs([record for run in runs for record in run.records]))


def _best(runs: Sequence[Run]) -> list[str]:
    """Return the best average of each metric and where it is reached, each as a phrase."""
    return [
        f"{metric} {figure(rate.value)} at {' and '.join(map(str, steps))}"
        for metric in METRICS
        for steps, rate in [best_interval(runs, metric)]
        if rate is not None
    ]


def best_interval(runs: Sequence[Run], metric: str) -> tuple[list[int], Rate | None]:
    """Return the replan intervals with the highest average of a metric as printed, and that average."""
    found = [(percent(run.summary.average[metric].value), run) for run in runs]
    known = [value for value, _ in found if value is not None]
    if not known:
        return [], None
    best = [run for value, run in found if value == max(known)]
    return [run.replan_steps for run in best if run.replan_steps is not None], best[0].summary.average[metric]


def _slug(name: str) -> str:
    return "-".join("".join(c if c.isalnum() and c.isascii() else " " for c in name).split()) or "policy"
