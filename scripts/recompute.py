"""Recompute the published figures from the kept rollouts; fail where a page differs.

``python scripts/recompute.py`` checks README, ``docs/benchmark/results.md`` and ``results/demonstrations.md``. The
last cell of a table's row names the source of its values: an evaluation in ``results/*/rollouts.parquet``, the log of
a row of the board, a run in ``results/demonstrations.parquet``, or the table of a shipped policy's card. A row that
cannot be recomputed has *log not kept*. Rows of ``results/study.md`` are rows of the tables that
``research.memory_study`` makes of the kept cells.
Claims in other places are listed in ``results/figures.md``, each with the words of its source: both must be there.

``python scripts/recompute.py keep FOLDER NAME`` adds an evaluation to ``results/evaluations`` and prints its row.
``python scripts/recompute.py restore TABLES NAME FOLDER`` writes a kept evaluation as a folder that commands read.
"""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pyarrow.parquet as pq

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # `research` is not installed

from lerobot_memobench.board.submission import LOG  # noqa: E402
from lerobot_memobench.errors import MemobenchError, nearest  # noqa: E402
from lerobot_memobench.evaluation.evidence import Evidence  # noqa: E402
from lerobot_memobench.evaluation.metrics import PAPER_METRICS, Rate, Row, mean_row, percent  # noqa: E402
from lerobot_memobench.evaluation.records import Run, read_runs  # noqa: E402
from lerobot_memobench.evaluation.report import write_report  # noqa: E402
from lerobot_memobench.tasks.catalogue import get_task, task_number  # noqa: E402
from lerobot_memobench.tasks.task import MEMORY_TYPES  # noqa: E402
from research.kept import ROLLOUTS as ROLLOUT_TABLE  # noqa: E402
from research.kept import keep, restore  # noqa: E402
from research.memory_study.grid import GRID_FILE, read_grid  # noqa: E402
from research.memory_study.tables import tables as study_tables  # noqa: E402
from tools.board.submission import read_submission  # noqa: E402

RESULTS = ROOT / "results"
EVALUATIONS = RESULTS / "evaluations"
PAGES = (ROOT / "README.md", ROOT / "docs" / "benchmark" / "results.md", RESULTS / "demonstrations.md")
CLAIMS = RESULTS / "figures.md"
STUDY = RESULTS / "study.md"
NOT_KEPT = "log not kept"
ROLLOUTS = "rollouts"
FOLLOWS, CHANCE, SCENES = "follows", "chance", "scenes"
"""Columns of an evaluation by evidence."""
NUMBERS = tuple(map(str, range(1, 31)))
"""Columns of SR by the number of a task."""
INTERVAL = re.compile(r"[\d.]+\s\[[\d.]+–[\d.]+\]")

Values = Mapping[str, str]
"""Heading of a column -> the rate in it."""
Tables = list[tuple[list[str], list[list[str]]]]
"""Headings and rows of each table of a page."""


# --- figures as documents write them ---


def in_words(rate: Rate) -> str:
    """Return a rate as documents write it: ``97.9 [96.9–98.5]``; 0 and 100 without a decimal."""
    if rate.value is None or rate.interval is None:
        return "–"
    return with_interval(rate.value, *rate.interval)


def with_interval(*parts: float) -> str:
    """Return a value and the ends of its interval, from 0 to 1, as documents write them."""
    value, low, high = (
        f"{part:.0f}" if part in (0, 100) else f"{part:.1f}" for part in map(percent, parts) if part is not None
    )
    return f"{value} [{low}–{high}]"


def of_tasks(tasks: Mapping[str, Row]) -> Values:
    """Return the average's metrics, the SR of memory types and the number of rollouts, from rates per task."""
    types = {
        memory_type: mean_row(row for name, row in tasks.items() if get_task(name).memory_type == memory_type)
        for memory_type in MEMORY_TYPES
    }
    present = {memory_type: row for memory_type, row in types.items() if row["SR"].value is not None}
    average = mean_row(present.values())
    return {
        **{metric: in_words(average[metric]) for metric in PAPER_METRICS},
        **{memory_type: f"{percent(row['SR'].value):.1f}" for memory_type, row in present.items()},
        ROLLOUTS: f"{sum(row['SR'].n for row in tasks.values()):,}",
    }


def of_evaluation(folder: Path) -> Values:
    """Return the figures of an evaluation, counted as the report counts them."""
    (run,) = read_runs([folder])
    return of_run(run)


@cache
def of_board(row: Path) -> Values:
    """Return the figures of a row of the board."""
    return of_run(read_submission(row).evaluation)


def of_run(run: Run) -> Values:
    """Return the figures of an evaluation that was read."""
    summary, evidence = run.summary, run.evidence.average if run.evidence else None
    return {
        **(of_evidence(evidence) if evidence else {}),
        **{metric: in_words(summary.average[metric]) for metric in PAPER_METRICS},
        **{name: f"{percent(row['SR'].value):.1f}" for name, row in summary.memory_types.items()},
        **{str(task_number(name)): f"{percent(task.rates['SR'].value):.1f}" for name, task in summary.tasks.items()},
        ROLLOUTS: f"{summary.rollouts:,}",
    }


def of_evidence(evidence: Evidence) -> Values:
    """Return how often choices followed the evidence, the chance without the past, and the number of scenes."""
    rate = evidence.rates[FOLLOWS]
    assert None not in (rate.value, rate.low, rate.high)
    return {
        FOLLOWS: with_interval(*(rate.value or 0.0, rate.low or 0.0, rate.high or 0.0)),
        CHANCE: f"{percent(evidence.chance):.1f}",
        SCENES: str(evidence.scenes),
    }


def of_card(page: Path) -> Values:
    """Return the figures of the table per task in a shipped policy's card."""
    for head, rows in tables(page):
        if head[1:] == [ROLLOUTS, *PAPER_METRICS]:
            cells = {row[0]: row[1:] for row in rows if row[0] not in (*MEMORY_TYPES, "average")}
            return of_tasks({name: _row(int(count), rates) for name, (count, *rates) in cells.items()})
    raise MemobenchError(f"{page} has no table of rollouts and metrics per task")


def _row(rollouts: int, cells: list[str]) -> Row:
    return {
        metric: Rate(None, 0) if cell == "–" else Rate(float(cell) / 100, rollouts)
        for metric, cell in zip(PAPER_METRICS, cells, strict=True)
    }


def of_demonstrations(file: Path, run: str) -> Values:
    """Return the expert's SR on the seeds of a run."""
    table = pq.read_table(file, columns=["run", "solved"]).to_pydict()
    solved = [done for name, done in zip(table["run"], table["solved"], strict=True) if name == run]
    if not solved:
        raise MemobenchError(f"{file} has no run {run!r}; {nearest(run, set(table['run']))}")
    return {"SR": in_words(Rate(sum(solved) / len(solved), len(solved))), ROLLOUTS: f"{len(solved):,}"}


@cache
def of_kept(kept: Path, name: str) -> Values:
    """Return the figures of a kept evaluation."""
    with tempfile.TemporaryDirectory() as folder:
        restore(kept, Path(folder), [name])
        return of_evaluation(Path(folder) / name)


# --- pages ---


def tables(page: Path) -> Tables:
    """Return the tables of a page."""
    return tables_in(page.read_text())


def tables_in(text: str) -> Tables:
    """Return the tables of a text in Markdown."""
    found = []
    for block in re.findall(r"(?:^\|.*\n)+", f"{text}\n", re.MULTILINE):
        head, _, *rows = ([cell.strip() for cell in line.strip().strip("|").split("|")] for line in block.splitlines())
        found.append((head, rows))
    return found


def source_of(page: Path, cell: str) -> Values | None:
    """Return the figures of the source that a cell links, None where it links none that can be recomputed."""
    for name, target in re.findall(r"\[`?([^\]`]+)`?\]\(([^)#]+)\)", cell):
        file = (page.parent / target).resolve()
        if file.name == ROLLOUT_TABLE:
            return of_kept(file.parent, name)
        if file.name == LOG:
            return of_board(file.parent)
        if file.name == "demonstrations.parquet":
            return of_demonstrations(file, name)
        if file.name == "README.md" and file.parent.name.startswith("memobench_"):
            return of_card(file)
    return None


def rows_of(page: Path) -> Iterator[tuple[list[str], Values, str]]:
    """Yield each row of results of a page, its cells under known headings, and the cell that names its source.

    A row of results is one with an interval, or of a table of SR, of memory types or of numbers of tasks.
    """
    for head, rows in tables(page):
        columns = (*PAPER_METRICS, *MEMORY_TYPES, *NUMBERS, ROLLOUTS, FOLLOWS, CHANCE, SCENES)
        known = [name for name in head if name in columns]
        for row in rows:
            if {"SR", *MEMORY_TYPES, *NUMBERS} & set(known) or any(map(INTERVAL.search, row)):
                cells = {name: row[head.index(name)] for name in known}
                yield row, {name: cell for name, cell in cells.items() if cell}, row[-1]


def problems_of_tables(page: Path) -> list[str]:
    """Return the errors in a page's rows of results: figures that differ from the source, or no source."""
    found = []
    for row, cells, source in rows_of(page):
        values = source_of(page, source)
        if values is None and NOT_KEPT not in source:
            found.append(f"{page.name}: {row[0]} links no source and lacks {NOT_KEPT!r}")
        for name, cell in cells.items():
            if values is not None and cell != values.get(name):
                found.append(f"{page.name}: {row[0]} has {name} {cell}, and {values.get(name)} by its source")
    return found


def problems_of_study(page: Path = STUDY, kept: Path = EVALUATIONS) -> list[str]:
    """Return the rows of the study's tables that no table of its program has with the same cells."""
    made: Tables = []
    with tempfile.TemporaryDirectory() as folder:
        restore(kept, Path(folder))
        for grid in map(read_grid, GRID_FILE.parent.glob("*.yaml")):
            made += [table for suite in grid.suites for table in tables_in(study_tables(grid, Path(folder), suite))]
    known = [dict(zip(head, row, strict=True)) for head, rows in made for row in rows]
    return [
        f"{page.name}: {' | '.join(row)} is in no table of research.memory_study"
        for head, rows in tables(page)
        for row in rows
        if not head[0]  # as the program's
        if not any(dict(zip(head, row, strict=True)).items() <= each.items() for each in known)
    ]


def problems_of_prose(page: Path, claims: Path = CLAIMS) -> list[str]:
    """Return the intervals outside a page's tables that the list of claims lacks."""
    prose = _flat(re.sub(r"^\|.*\n", "", page.read_text(), flags=re.MULTILINE))
    listed = " ".join(claim for where, claim, *_ in _claims(claims) if _place(claims, where) == page.resolve())
    return [
        f"{page.name}: {interval} is in no table, and not in {claims.name}"
        for interval in INTERVAL.findall(prose)
        if interval not in listed
    ]


def problems_of_claims(claims: Path = CLAIMS) -> list[str]:
    """Return the claims, and the words of their sources, that the named pages lack."""
    return [
        f"{place.name} does not contain {text!r}, which {claims.name} lists"
        for page, claim, source, words, *_ in _claims(claims)
        for place, text in ((_place(claims, page), claim), (_place(claims, source), words))
        if _flat(text) not in _flat(place.read_text())
    ]


def _claims(page: Path) -> list[list[str]]:
    """Return the rows of the list of claims: page, claim, source, words of the source, whether rollouts are kept."""
    return [row for head, rows in tables(page) if head[:2] == ["page", "claim"] for row in rows]


def _place(page: Path, link: str) -> Path:
    found = re.search(r"\]\(([^)#]+)", link)
    if found is None:
        raise MemobenchError(f"{page}: {link!r} links no file")
    return (page.parent / found[1]).resolve()


def _flat(text: str) -> str:
    """Return text on one line, without emphasis: a sentence may be broken anywhere, and be in a table."""
    return " ".join(text.replace("*", "").replace("|", " ").replace("\n> ", " ").split())


# --- keeping ---


def keep_evaluation(folder: Path, name: str) -> str:
    """Add an evaluation to the results under a name; return its row for a table of results."""
    if (missing := write_report(folder).missing) is not None:  # the report merges the workers' files
        raise MemobenchError(f"{folder} is not a whole evaluation, {missing}")
    with tempfile.TemporaryDirectory() as root:
        (Path(root) / name).symlink_to(folder.resolve())
        keep(Path(root), [name], EVALUATIONS)
    row = of_kept(EVALUATIONS, name)
    if row != of_evaluation(folder):
        raise MemobenchError(f"{EVALUATIONS} gives other figures for {name!r} than {folder}; this is a bug")
    cells = " | ".join(cell for column, cell in row.items() if column not in NUMBERS)
    return f"| {cells} | [`{name}`](../../results/evaluations/{ROLLOUT_TABLE}) |"


def restore_evaluation(kept: Path, name: str, folder: Path) -> None:
    """Write a kept evaluation as a new folder."""
    if folder.exists():
        raise MemobenchError(f"{folder} exists already; name a new folder")
    with tempfile.TemporaryDirectory() as root:
        restore(kept, Path(root), [name])
        if not (restored := Path(root) / name).is_dir():
            raise MemobenchError(f"{kept} has the command of {name!r} alone, no rollouts; name an evaluation")
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(restored, folder)


def main(words: list[str]) -> int:
    """Run the command line; return the exit status."""
    match words:
        case ["keep", folder, name]:
            print(keep_evaluation(Path(folder), name))
            return 0
        case ["restore", kept, name, folder]:
            restore_evaluation(Path(kept), name, Path(folder))
            return 0
        case []:
            pass
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    checks = (problems_of_tables, problems_of_prose)
    problems = [problem for page in PAGES for check in checks for problem in check(page)]
    problems += [*problems_of_study(), *problems_of_claims()]
    for page in PAGES:
        for row, _, source in rows_of(page):
            print(f"{page.name}: {row[0]}: {'recomputed' if source_of(page, source) else NOT_KEPT}")
    print("\n".join(problems) or "no figure differs from its source")
    return int(bool(problems))


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except MemobenchError as error:
        sys.exit(f"recompute: {error}")
