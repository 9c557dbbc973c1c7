"""The paper's tables with your evaluations in the first rows, and the tables of its controls.

    python examples/paper/tables.py outputs/eval/k5 outputs/eval/k20

The notes name settings in which an evaluation departs from the paper's.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from published import RAW, PublishedRow, published_rows

from lerobot_memobench.constants import BY_PAPER, EVALUATION_SEED, HORIZON
from lerobot_memobench.envs.settings import IMAGE_SETTINGS
from lerobot_memobench.evaluation.comparison import NOTE
from lerobot_memobench.evaluation.metrics import PAPER_METRICS, Rate
from lerobot_memobench.evaluation.records import Run, headline, read_runs
from lerobot_memobench.evaluation.report import LEADING, PAPER_COLUMNS, run_row, wide_columns
from lerobot_memobench.evaluation.statistics import oracle_share
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE, WRITERS, Cell, Report, Section, Table, percent_text
from lerobot_memobench.tasks.task import MEMORY_TYPES, PUBLISHED

SETTINGS = {
    **{"suite": PUBLISHED, "rules": BY_PAPER, "referent": "fixed", "demonstration_prompt": True},
    **{"horizon": HORIZON, "seed_base": EVALUATION_SEED, **IMAGE_SETTINGS},
}
"""Settings of the paper's evaluations."""
TASKS, EPISODES = 30, 50
RATES = (
    ("paper-main", "With the paper's main results", ("main",)),
    ("paper-alignment", "With the paper's memory alignment results", ("alignment",)),
    ("paper-reference", "With the paper's oracle memory and MemER", ("oracle", "memer")),
)
"""Key, title, and contained tables of the paper."""


def departures(run: Run) -> list[str]:
    """Return a phrase for each departure of an evaluation from the paper's protocol."""
    tasks, counts = run.summary.tasks, {task.rates["SR"].n for task in run.summary.tasks.values()}
    found = [] if len(tasks) == TASKS else [f"{len(tasks)} of {TASKS} tasks"]
    if counts != {EPISODES}:
        found.append(f"{' to '.join(map(str, sorted({min(counts), max(counts)})))} episodes of each, not {EPISODES}")
    known = SETTINGS | run.protocol
    found += [f"{key} {known[key]}, not {value}" for key, value in SETTINGS.items() if known[key] != value]
    return found


def rates_table(runs: Sequence[Run], key: str, title: str, tables: Sequence[str]) -> Table:
    """Return a table of the paper with the evaluations in the first rows."""
    published = published_rows(*tables)
    rows = (*(run_row(run) for run in runs), *map(published_cells, published))
    steps = [row.replan_steps for row in published]
    changes = {len(runs) + k for k in range(1, len(steps)) if steps[k] != steps[k - 1]}
    wide = wide_columns(LEADING, PAPER_COLUMNS, PAPER_METRICS)
    return Table(key, title, rows=rows, note=NOTE, strong=range(len(runs)), rules={len(runs), *changes}, **wide)


def published_cells(row: PublishedRow) -> tuple[Cell, ...]:
    """Return a row of the paper; it has no intervals."""
    columns = [*(row.memory_types[name] for name in MEMORY_TYPES), row.average]
    rates = [fraction(figures[metric]) for figures in columns for metric in PAPER_METRICS]
    return (f"paper: {row.label}", "pixels", row.replan_steps, *(Rate(rate, 0) for rate in rates))


def fraction(value: float | None) -> float | None:
    """Return a percentage as a fraction."""
    return None if value is None else value / 100


def failures_table() -> Table:
    """Return the outcomes of the paper's rollouts of one temporal task."""
    counts = dict(RAW["failure_taxonomy"])
    total = counts.pop("rollouts")
    rows = [(name.replace("_", " "), count, Rate(count / total, total)) for name, count in counts.items()]
    title = f"The paper's outcomes of {total} rollouts of a temporal task with the checkpoints S, U, U"
    return Table("paper-failures", title, ("outcome", "rollouts", "of all"), rows)


def oracle_table() -> Table:
    """Return standard and oracle memory, and the share of the gap to 100 % that the oracle closes."""
    standard, oracle = published_rows("oracle")
    rows: list[tuple[Cell, ...]] = []
    for name in (*MEMORY_TYPES, "average"):
        found = [{**row.memory_types, "average": row.average}[name] for row in (standard, oracle)]
        pairs = [(fraction(found[0][metric]), fraction(found[1][metric])) for metric in PAPER_METRICS]
        cells = [NOT_APPLICABLE if a is None else f"{percent_text(a)}/{percent_text(b)}" for a, b in pairs]
        rows.append((name, *cells, *(percent_text(oracle_share(a, b)) for a, b in pairs)))
    header = ("memory type", *PAPER_METRICS, *(f"{metric} gap closed" for metric in PAPER_METRICS))
    title = f"The paper's standard/oracle memory, replan interval {standard.replan_steps}"
    return Table("paper-oracle", title, header, rows, strong={len(rows) - 1})


def shuffled_table() -> Table:
    """Return prefix completion with normal and with shuffled subgoals."""
    normal, shuffled = (RAW["shuffled_control"][f"{name}_prefix"] for name in ("normal", "shuffled"))
    change = [f"{b - a:+.1f}" for a, b in zip(normal, shuffled, strict=True)]
    rows = (("normal", *map("{:.1f}".format, normal)), ("shuffled", *map("{:.1f}".format, shuffled)))
    title = "The paper's prefix completion of a temporal task of three checkpoints"
    return Table("paper-shuffled", title, ("subgoals", "c1", "c2", "c3"), (*rows, ("difference", *change)))


def paper_report(runs: Sequence[Run]) -> Report:
    """Return the paper's tables with these evaluations."""
    tables = (*(rates_table(runs, *each) for each in RATES), failures_table(), oracle_table(), shuffled_table())
    notes = [f"{run.name} departs from the paper: {', '.join(found)}" for run in runs if (found := departures(run))]
    return Report(headline(runs), [Section("With the paper's results", tables, notes=notes)])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("evaluations", nargs="+", help="folders, or NAME=FOLDER, as `memobench report` takes them")
    parser.add_argument("--format", choices=["table", "markdown", "latex"], default="table")
    chosen = parser.parse_args()
    print(WRITERS[chosen.format](paper_report(read_runs(chosen.evaluations))), end="")


if __name__ == "__main__":
    main()
