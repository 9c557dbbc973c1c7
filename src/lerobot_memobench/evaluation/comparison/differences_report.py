"""A comparison of two evaluations as tables and as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lerobot_memobench.evaluation.comparison.differences import Comparison, Difference
from lerobot_memobench.evaluation.documents.sentences import inputs_phrase
from lerobot_memobench.evaluation.documents.tables import Cell, Count, Name, Numbers, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import percent
from lerobot_memobench.io import count_of

NOTE = (
    "Difference is the second less the first, in points. p: exact McNemar for SR (pairs of which only one succeeded "
    "are given as first / second), sign-flip permutation for the others; for tasks also adjusted for their number "
    "(Holm). "
    "Detectable: the smallest true difference that so many pairs would show with 80 % power at 5 %."
)


def report(found: Comparison) -> Report:
    """Return a comparison as tables and JSON values."""
    overall = [row for row in found.differences if not row.of_a_task]
    by_task = [row for row in found.differences if row.of_a_task]
    tables = (
        _table("difference", "Average and memory types", found, overall, tasks=False),
        _table("difference-tasks", "Tasks", found, by_task, tasks=True),
    )
    sentence = f"{count_of(found.pairs, 'episode')} in both, paired by task, episode and referent."
    title = f"{found.b} against {found.a}"
    return Report(title, (Section("", tables, (sentence, NOTE), found.notes),), data(found))


def _table(key: str, title: str, found: Comparison, rows: Sequence[Difference], tasks: bool) -> Table:
    header = ["task" if tasks else "scope", "metric", "pairs", found.a, found.b, "difference", "only one", "p"]
    header += ["p (Holm)"] * tasks + ["detectable"]
    starts = [k for k, row in enumerate(rows) if k == 0 or rows[k - 1].scope != row.scope]
    cells = tuple(_row(row, tasks, k in starts) for k, row in enumerate(rows))
    seen = "; ".join(
        f"{name}: {inputs_phrase(words)}" for name, words in zip((found.a, found.b), found.inputs, strict=True)
    )
    return Table(key, title, tuple(header), cells, note=f"{seen}.", rules=frozenset(starts) - {0})


def _row(row: Difference, tasks: bool, first: bool) -> tuple[Cell, ...]:
    """Return the row of one metric; only the first of a scope names it."""
    name: Cell = (Name(row.scope) if tasks else row.scope) if first else ""
    return (
        name,
        row.metric,
        Count(row.n),
        _points(row.a),
        _points(row.b),
        _points(row.value, True),
        Numbers("" if row.only_a is None else f"{row.only_a} / {row.only_b}"),
        _p(row.p),
        *[_p(row.adjusted)] * tasks,
        Numbers("> 100") if row.detectable is None else _points(row.detectable),
    )


def _points(value: float, signed: bool = False) -> Numbers:
    text = f"{percent(value):{'+' if signed else ''}.1f}"
    return Numbers(text.replace("-", "−"))


def _p(value: float | None) -> Numbers:
    if value is None:
        return Numbers("")
    return Numbers("< 0.001" if value < 0.001 else f"{value:.3f}")


def data(found: Comparison) -> dict[str, Any]:
    """Return a comparison as JSON values; rates in per cent, p as they are."""
    return {
        "a": found.a,
        "b": found.b,
        "inputs": {found.a: found.inputs[0], found.b: found.inputs[1]},
        "pairs": found.pairs,
        "differences": [_entry(row) for row in found.differences],
        "notes": list(found.notes),
    }


def _entry(row: Difference) -> dict[str, Any]:
    return {
        "scope": row.scope,
        "metric": row.metric,
        "pairs": row.n,
        "a": round(100 * row.a, 2),
        "b": round(100 * row.b, 2),
        "difference": round(100 * row.value, 2),
        "only_a": row.only_a,
        "only_b": row.only_b,
        "test": "mcnemar_exact" if row.metric == "SR" else "sign_flip",
        "exact": row.exact,
        "p": row.p,
        "p_holm": row.adjusted,
        "detectable": None if row.detectable is None else round(100 * row.detectable, 2),
    }
