"""The paper's tables with evaluations on top of each, and in what these depart from the paper's protocol."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.tables import Cell, Count, Section, Table
from lerobot_memobench.evaluation.documents.wide_tables import run_row, wide_table
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.io import count_of
from lerobot_memobench.paper import PublishedRow, failure_taxonomy, published_rows
from lerobot_memobench.tasks.task import MEMORY_TYPES, PUBLISHED

PAPER_PROTOCOL = {"referent": "fixed", "demonstration_prompt": True, "horizon": 1200, "seed_base": 7}
PAPER_SAW = "pixels"
PAPER_TASKS, PAPER_EPISODES = 30, 50

TABLES = (
    ("paper-main", "Beside the paper's main results", ("main",)),
    ("paper-alignment", "Beside the paper's memory alignment results", ("alignment",)),
    ("paper-reference", "Beside the paper's oracle memory and MemER", ("oracle", "memer")),
)
"""Key, title, and which of the paper's tables it holds."""


def check_beside(runs: Sequence[Run], paper: bool) -> None:
    """Refuse to stand the paper's figures (``paper``) beside those of other tasks than it published.

    Raises:
        MemobenchError: naming the first such evaluation.
    """
    other = next((run for run in runs if run.protocol.get("suite", PUBLISHED) != PUBLISHED), None)
    if paper and other is not None:
        raise MemobenchError(
            f"{other.folder} is an evaluation of the {other.protocol['suite']} suite, the paper's figures are of the "
            "published one; leave out --with paper"
        )


def beside_paper(runs: Sequence[Run]) -> Section:
    """Return the paper's tables of rates with these evaluations on top of each, and in what they depart from it."""
    tables = [_beside(runs, *each) for each in TABLES]
    return Section("Beside the paper", (*tables, paper_failures()), notes=tuple(departure_notes(runs)))


def departure_notes(runs: Sequence[Run]) -> list[str]:
    """Return a sentence for each evaluation that was not run as the paper's were."""
    return [f"{run.name} departs from the paper's protocol: {', '.join(d)}" for run in runs if (d := departures(run))]


def beside_name(run: Run) -> str:
    """Return what an evaluation is called beside the paper's rows of 30 tasks and 1,500 rollouts."""
    return with_extent(run.name, [run])


def with_extent(name: str, runs: Sequence[Run]) -> str:
    """Return a name and behind it how much was run, where that is not what the paper ran."""
    told = "; ".join(dict.fromkeys(filter(None, map(extent, runs))))
    return f"{name} ({told})" if told else name


def extent(run: Run) -> str:
    """Return how many tasks and rollouts an evaluation is of, "" where it is as many as the paper's."""
    summary = run.summary
    if len(summary.tasks) == PAPER_TASKS and {row["SR"].n for row in summary.tasks.values()} == {PAPER_EPISODES}:
        return ""
    return f"{len(summary.tasks)} of {PAPER_TASKS} tasks, {count_of(summary.rollouts, 'rollout')}"


def _beside(runs: Sequence[Run], key: str, title: str, sources: Sequence[str]) -> Table:
    published = published_rows(*sources)
    rows = (*((beside_name(run), *run_row(run)[1:]) for run in runs), *(_published_row(row) for row in published))
    steps = [row.replan_steps for row in published]
    changes = {len(runs) + k for k in range(1, len(steps)) if steps[k] != steps[k - 1]}
    return wide_table(key, title, rows, strong=range(len(runs)), rules={len(runs), *changes})


def _published_row(row: PublishedRow) -> tuple[Cell, ...]:
    columns = [*(row.memory_types[name] for name in MEMORY_TYPES), row.average]
    return (
        f"paper: {row.label}",
        PAPER_SAW,
        row.replan_steps,
        *(published_rate(c[m]) for c in columns for m in METRICS),
    )


def published_rate(value: float | None) -> Rate:
    """Return a published percentage as a rate without interval: the paper gives none."""
    return Rate(None if value is None else value / 100, 0)


def paper_failures() -> Table:
    """Return how the paper's rollouts of its temporal task ended."""
    counts = failure_taxonomy()
    total = counts.pop("rollouts")
    rows = tuple((name.replace("_", " "), Count(count), Rate(count / total, total)) for name, count in counts.items())
    return Table(
        "paper-failures",
        f"The paper's outcomes of {total} rollouts of a temporal task with the checkpoints S, U, U",
        ("outcome", "rollouts", "of all"),
        rows,
    )


def departures(run: Run) -> list[str]:
    """Return in what an evaluation was not run as the paper's were, each as a phrase."""
    found = []
    if len(run.summary.tasks) != PAPER_TASKS:
        found.append(f"{len(run.summary.tasks)} of {PAPER_TASKS} tasks")
    counts = {row["SR"].n for row in run.summary.tasks.values()}
    if counts != {PAPER_EPISODES}:
        low, high = min(counts), max(counts)
        found.append(f"{low if low == high else f'{low} to {high}'} episodes of each instead of {PAPER_EPISODES}")
    for key, value in PAPER_PROTOCOL.items():
        if key in run.protocol and run.protocol[key] != value:
            found.append(f"{key.replace('_', ' ')} {run.protocol[key]} instead of {value}")
    return found
