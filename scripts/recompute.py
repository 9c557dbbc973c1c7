"""Recompute the published figures from what the repository keeps, and fail where a page says otherwise.

``python scripts/recompute.py`` goes through README and ``docs/benchmark/results.md``. The last cell of a table's row
says where its figures come from: a log below ``docs/research/logs``, whose episodes are counted again; the table of a
shipped policy's card; what `memobench describe` wrote of demonstrations. A row whose figures cannot be recomputed
says *log not kept*. Claims in other places stand in ``docs/research/figures.md``, each with what its
source says: both must be there, word for word.

``python scripts/recompute.py keep FOLDER NAME`` keeps the log and card of an evaluation as ``docs/research/logs/NAME``,
compressed, and prints its row.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from lerobot_memobench.envs.episode_log import MERGED_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.evidence import Evidence
from lerobot_memobench.evaluation.metrics import METRICS, Rate, Row, mean_row, percent
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.evaluation.report import keep_log
from lerobot_memobench.io import packed
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import MEMORY_TYPES

ROOT = Path(__file__).parents[1]
NOTES = ROOT / "docs" / "research"
LOGS = NOTES / "logs"
PAGES = (ROOT / "README.md", ROOT / "docs" / "benchmark" / "results.md")
CLAIMS = NOTES / "figures.md"
NOT_KEPT = "log not kept"
ROLLOUTS = "rollouts"
FOLLOWS, CHANCE, SCENES = "follows", "chance", "scenes"
"""Columns of an evaluation by evidence."""
INTERVAL = re.compile(r"[\d.]+\s\[[\d.]+–[\d.]+\]")

Figures = Mapping[str, str]
"""Heading of a column -> what stands below it."""
Tables = list[tuple[list[str], list[list[str]]]]
"""Headings and rows of each table of a page."""


# --- figures as documents write them ---


def in_words(rate: Rate) -> str:
    """Return a rate as documents write it: ``97.9 [96.9–98.5]``; 0 and 100 without a decimal."""
    if rate.value is None or rate.interval is None:
        return "–"
    return with_interval(rate.value, *rate.interval)


def with_interval(*parts: float) -> str:
    """Return a value and the ends of its interval, of 0 to 1, as documents write them."""
    told = map(percent, parts)
    value, low, high = (f"{part:.0f}" if part in (0, 100) else f"{part:.1f}" for part in told)
    return f"{value} [{low}–{high}]"


def figures_of_tasks(tasks: Mapping[str, Row]) -> Figures:
    """Return the average's metrics, the SR of memory types and the number of rollouts, from rates per task."""
    types = {
        memory_type: mean_row(row for name, row in tasks.items() if get_task(name).memory_type == memory_type)
        for memory_type in MEMORY_TYPES
    }
    there = {memory_type: row for memory_type, row in types.items() if row["SR"].value is not None}
    average = mean_row(there.values())
    return {
        **{metric: in_words(average[metric]) for metric in METRICS},
        **{memory_type: f"{percent(row['SR'].value):.1f}" for memory_type, row in there.items()},
        ROLLOUTS: f"{sum(row['SR'].n for row in tasks.values()):,}",
    }


def of_log(folder: Path) -> Figures:
    """Return the figures of a kept log, by the report's own sums."""
    (run,) = read_runs([folder])
    summary, found = run.summary, run.evidence.average if run.evidence else None
    return {
        **(of_evidence(found) if found else {}),
        **{metric: in_words(summary.average[metric]) for metric in METRICS},
        **{name: f"{percent(row['SR'].value):.1f}" for name, row in summary.memory_types.items()},
        ROLLOUTS: f"{summary.rollouts:,}",
    }


def of_evidence(found: Evidence) -> Figures:
    """Return how often choices followed the evidence, and could have without the past, and in how many scenes."""
    rate = found.rates[FOLLOWS]
    told = with_interval(rate.value, rate.low, rate.high)
    return {FOLLOWS: told, CHANCE: f"{percent(found.chance):.1f}", SCENES: str(found.scenes)}


def of_card(page: Path) -> Figures:
    """Return the figures of the table per task in a shipped policy's card."""
    for head, rows in tables(page):
        if head[1:] == [ROLLOUTS, *METRICS]:
            found = {row[0]: row[1:] for row in rows if row[0] not in (*MEMORY_TYPES, "average")}
            return figures_of_tasks({name: _row(int(cells[0]), cells[1:]) for name, cells in found.items()})
    raise MemobenchError(f"{page} has no table of rollouts and metrics per task")


def _row(rollouts: int, cells: list[str]) -> Row:
    """Return a task's rates from a card's cells, per cent."""
    return {
        metric: Rate(None, 0) if cell == "–" else Rate(float(cell) / 100, rollouts)
        for metric, cell in zip(METRICS, cells, strict=True)
    }


def of_demonstrations(page: Path) -> Figures:
    """Return the expert's SR from the page that `memobench describe` wrote of its demonstrations."""
    text = page.read_text()
    if found := re.search(r"^All (\d+) seeds asked for were solved", text, re.MULTILINE):
        lost, asked = 0, int(found[1])
    elif found := re.search(r"^\*\*(\d+) of (\d+) seeds asked for have no demonstration", text, re.MULTILINE):
        lost, asked = int(found[1]), int(found[2])
    else:
        raise MemobenchError(f"{page} does not say how many seeds were solved")
    return {"SR": in_words(Rate(1 - lost / asked, asked)), ROLLOUTS: f"{asked:,}"}


SOURCES: dict[str, Callable[[Path], Figures]] = {
    r"(logs/[\w-]+|study/[\w/-]+)(?=/)": of_log,
    r"\w+/README\.md": of_card,
    r"\w+/tables\.md": of_demonstrations,
}
"""Ending of a link's target, as far as it names the source -> what reads it."""


# --- pages ---


def tables(page: Path) -> Tables:
    """Return the tables of a page."""
    found = []
    for block in re.findall(r"(?:^\|.*\n)+", page.read_text(), re.MULTILINE):
        head, _, *rows = ([cell.strip() for cell in line.strip().strip("|").split("|")] for line in block.splitlines())
        found.append((head, rows))
    return found


def source_of(page: Path, cell: str) -> Figures | None:
    """Return the figures of the source that a cell links, None where it links none that can be recomputed."""
    for target in re.findall(r"\]\(([^)#]+)", cell):
        for ending, read in SOURCES.items():
            if found := re.search(f"^.*{ending}", target):
                return read((page.parent / found[0]).resolve())
    return None


def rows_of(page: Path) -> Iterator[tuple[list[str], Figures, str]]:
    """Yield each row of results of a page, its cells under known headings, and the cell that names its source.

    A row of results is one with an interval, or of a table of SR or of memory types.
    """
    for head, rows in tables(page):
        known = [name for name in head if name in (*METRICS, *MEMORY_TYPES, ROLLOUTS, FOLLOWS, CHANCE, SCENES)]
        for row in rows:
            if {"SR", "temporal"} & set(known) or any(map(INTERVAL.search, row)):
                told = {name: row[head.index(name)] for name in known}
                yield row, {name: cell for name, cell in told.items() if cell}, row[-1]


def problems_of_tables(page: Path) -> list[str]:
    """Return what is wrong with the rows of results of a page: a difference, or no word on where they are from."""
    found = []
    for row, told, source in rows_of(page):
        figures = source_of(page, source)
        if figures is None and NOT_KEPT not in source:
            found.append(f"{page.name}: {row[0]} links nothing to recompute it from, and does not say {NOT_KEPT!r}")
        for name, cell in told.items():
            if figures is not None and cell != figures.get(name):
                found.append(f"{page.name}: {row[0]} has {name} {cell}, and {figures.get(name)} by its source")
    return found


def problems_of_prose(page: Path, claims: Path = CLAIMS) -> list[str]:
    """Return the intervals outside a page's tables that the list of claims does not have."""
    prose = _flat(re.sub(r"^\|.*\n", "", page.read_text(), flags=re.MULTILINE))
    listed = " ".join(claim for where, claim, *_ in _claims(claims) if _place(claims, where) == page.resolve())
    return [
        f"{page.name}: {one} stands in no table, and is not in {claims.name}"
        for one in INTERVAL.findall(prose)
        if one not in listed
    ]


def problems_of_claims(claims: Path = CLAIMS) -> list[str]:
    """Return which claims, or what their sources say, do not stand where the list has them."""
    return [
        f"{place.name} does not say {text!r}, as {claims.name} has it"
        for page, claim, source, said, *_ in _claims(claims)
        for place, text in ((_place(claims, page), claim), (_place(claims, source), said))
        if _flat(text) not in _flat(place.read_text())
    ]


def _claims(page: Path) -> list[list[str]]:
    """Return the rows of the list of claims: page, claim, source, what the source says, whether a log is kept."""
    return [row for head, rows in tables(page) if head[:2] == ["page", "it says"] for row in rows]


def _place(page: Path, link: str) -> Path:
    """Return the file that a cell of a page links."""
    found = re.search(r"\]\(([^)#]+)", link)
    if found is None:
        raise MemobenchError(f"{page}: {link!r} links no file")
    return (page.parent / found[1]).resolve()


def _flat(text: str) -> str:
    """Return text on one line, without emphasis: a sentence may be broken anywhere, and stand in a table."""
    return " ".join(text.replace("*", "").replace("|", " ").replace("\n> ", " ").split())


# --- keeping a log ---


def keep(folder: Path, name: str) -> str:
    """Compress the log and the card of an evaluation into the notes; return its row."""
    kept = LOGS / name
    keep_log(folder, kept)
    row = of_log(kept)
    if row != of_log(folder):
        raise MemobenchError(f"the log in {kept} does not tell what the one in {folder} does")
    return f"| {' | '.join(row.values())} | [log](../research/logs/{name}/{packed(Path(MERGED_FILE))}) |"


def main(words: list[str]) -> int:
    """Run the command line; return the exit status."""
    if words[:1] == ["keep"]:
        print(keep(Path(words[1]), words[2]))
        return 0
    checks = (problems_of_tables, problems_of_prose)
    problems = [*(problem for page in PAGES for check in checks for problem in check(page)), *problems_of_claims()]
    for page in PAGES:
        for row, _, source in rows_of(page):
            print(f"{page.name}: {row[0]}: {'recomputed' if source_of(page, source) else NOT_KEPT}")
    print("\n".join(problems) or "no figure differs from its source")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
