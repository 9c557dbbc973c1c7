"""The figures of evaluations as JSON values: the keys of ``report.json``, and more beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lerobot_memobench.evaluation.documents.beside_paper import departures
from lerobot_memobench.evaluation.documents.replan_sweep import best_interval
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate, Row, percent
from lerobot_memobench.evaluation.metrics.summary import report
from lerobot_memobench.evaluation.records.protocol import POLICY
from lerobot_memobench.evaluation.records.runs import Run, sweeps, unlike
from lerobot_memobench.paper import PublishedRow, published_rows


def report_data(runs: Sequence[Run], paper: bool) -> dict[str, Any]:
    """Return the figures of one or several evaluations, and the published ones where asked for."""
    found: dict[str, Any]
    if len(runs) == 1:
        found = run_data(runs[0])
    else:
        found = {
            "evaluations": {run.name: run_data(run) for run in runs},
            "notes": unlike({run.name: run.protocol for run in runs}),
        }
    if swept := sweeps(runs):
        found["replan_sweep"] = {method: _sweep_data(group) for method, group in swept.items()}
    if paper:
        found["departs_from_paper"] = {run.name: departures(run) for run in runs}
        found["paper"] = [_published_data(row) for row in published_rows()]
    return found


def run_data(run: Run) -> dict[str, Any]:
    """Return the figures of one evaluation: the keys of ``report.json``, and more beside them."""
    summary = run.summary
    policy = run.protocol.get(POLICY) or {}
    return {
        **report(summary),
        "name": run.name,
        "method": run.method,
        "replan_steps": run.replan_steps,
        "protocol": {key: value for key, value in run.protocol.items() if key != POLICY},
        "policy": {key: policy.get(key) for key in ("type", "sha256", "seed")},
        "intervals": {
            "tasks": {name: _intervals(row) for name, row in summary.tasks.items()},
            "memory_types": {name: _intervals(row) for name, row in summary.memory_types.items()},
            "average": _intervals(summary.average),
        },
        "ordered_prefix": {
            name: [percent(rate.value) for rate in rates] for name, rates in summary.ordered_prefix.items()
        },
        "pooled": {
            "checkpoints": _pooled(summary.pooled_checkpoints),
            **{metric: _pooled(rate) for metric, rate in summary.pooled.items()},
        },
        "failures_by_task": {name: dict(counts) for name, counts in summary.failures_of.items()},
        "notes": list(run.notes),
    }


def _intervals(row: Row) -> dict[str, list[float | None] | None]:
    return {metric: interval_of(row[metric]) for metric in METRICS}


def interval_of(rate: Rate) -> list[float | None] | None:
    """Return the interval of a rate in per cent, None where it has none."""
    interval = rate.interval if rate.trials else None
    return None if interval is None else [percent(bound) for bound in interval]


def _pooled(rate: Rate) -> dict[str, Any]:
    return {"percent": percent(rate.value), "n": rate.n}


def _sweep_data(runs: Sequence[Run]) -> dict[str, Any]:
    return {
        "best": {metric: best_interval(runs, metric)[0] for metric in METRICS},
        "average": {
            str(run.replan_steps): {metric: percent(run.summary.average[metric].value) for metric in METRICS}
            for run in runs
        },
    }


def _published_data(row: PublishedRow) -> dict[str, Any]:
    return {
        "table": row.table,
        "model": row.model,
        "replan_steps": row.replan_steps,
        "memory_types": {name: dict(figures) for name, figures in row.memory_types.items()},
        "average": dict(row.average),
    }
