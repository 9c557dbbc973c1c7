"""Memory necessity: a table for the terminal, Markdown for people, JSON for programs, a figure of aliased pairs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.tables import NOT_APPLICABLE, figure
from lerobot_memobench.evaluation.necessity.aliased_pairs import figure as pairs_figure
from lerobot_memobench.evaluation.necessity.kept import KeptResult
from lerobot_memobench.evaluation.necessity.study import Result
from lerobot_memobench.evaluation.necessity.twins import bounds, side_by_side
from lerobot_memobench.evaluation.necessity.verdicts import VERDICTS, verdict
from lerobot_memobench.io import read_json, write_file

JSON_FILE, MARKDOWN_FILE, FIGURE_FILE = "necessity.json", "necessity.md", "aliased_pairs.png"


@dataclass(frozen=True)
class Column:
    """A column: its heading, and what it says under the table."""

    name: str
    meaning: str


COLUMNS = (
    Column("referent", "what the goal is; *both*: the task has one goal, so the settings are the same"),
    Column("goals", "goals that may lie behind the same start"),
    Column("decisions", "times per episode at which the expert turns to something new"),
    Column("aliased", "pictures at which more than one answer is right: arm at home / as it happens"),
    Column("chance", "knows the routine, guesses evenly where the picture does not decide; one try each"),
    Column("fixed map", "best map from pictures to answers, in the demonstrated order"),
    Column("probabilities", "best probabilities of answers given the picture, same order, one try each"),
    Column("exact", "fixed map if every pixel could be used (differences above 2 of 255)"),
    Column("any order", "best map if any order will do that the goal accepts: found, and confirmed in the simulator"),
    Column(
        "any order, prob.", "best probabilities found, wrong answers mended as the scene allows, within the horizon"
    ),
    Column("expert", "the expert's episodes that reached the goal"),
    Column("memory needed", "see below"),
)


def cells(result: Result, referent: str) -> list[str]:
    """Return a row of the table, without the task."""
    in_order, any_order, counts = result["in_order"], result["any_order"], result["aliased"]
    found = NOT_APPLICABLE
    if any_order is not None:
        found = f"{figure(any_order['deterministic'])} ({any_order['confirmed']}/{any_order['of']})"
        found += "" if any_order["complete"] else " ≥"
    expert = result["expert"]
    return [
        referent,
        str(result["variants"]),
        f"{result['decisions']:.1f}",
        NOT_APPLICABLE if counts is None else f"{counts['at_home']:.1f} / {counts['as_it_happens']:.1f}",
        *(
            NOT_APPLICABLE if in_order is None else figure(in_order[key])
            for key in ("chance", "deterministic", "stochastic", "pixel_exact")
        ),
        found,
        NOT_APPLICABLE if any_order is None else figure(any_order["stochastic"]),
        f"{expert['success']}/{expert['n']}",
        verdict(result),
    ]


def rows(results: Sequence[Result]) -> list[tuple[str, str, list[str]]]:
    """Return memory type, task and cells per row; a task with one goal has one row for both settings."""
    table = []
    for result in results:
        alone = result["referent"] == "fixed" and not result.get("has_variants", True)
        table.append((result["memory_type"], result["task"], cells(result, "both" if alone else result["referent"])))
    return table


def terminal_table(results: Sequence[Result]) -> Any:
    """Return the table for the terminal."""
    from rich.table import Table

    from lerobot_memobench.evaluation.documents.terminal import Unbroken

    table = Table(header_style="bold", pad_edge=False)
    table.add_column("task")
    for column in COLUMNS:
        table.add_column(column.name, justify="left" if column.name in ("referent", "memory needed") else "right")
    before = None
    for memory_type, task, row in rows(results):
        if before not in (None, memory_type):
            table.add_section()
        before = memory_type
        table.add_row(task, *row)
    return Unbroken(table)


def markdown(results: Sequence[Result]) -> str:
    """Return the table, what its columns mean, what follows, and the best maps that were found."""
    lines = ["| task | " + " | ".join(column.name for column in COLUMNS) + " |"]
    lines.append("|---|" + "---|" * len(COLUMNS))
    lines += [f"| {memory_type}: `{task}` | " + " | ".join(row) + " |" for memory_type, task, row in rows(results)]
    lines += ["", "Per cent, means over scenes. Columns:", ""]
    lines += [f"- **{column.name}**: {column.meaning}." for column in COLUMNS[:-1]]
    lines += ["- **memory needed**: " + "; ".join(f"*{word}*: {meaning}" for word, meaning in VERDICTS.items()) + "."]
    same = max((result["largest_same"] for result in results), default=0.0)
    other = min((result["smallest_different"] for result in results), default=1.0)
    lines += [
        "",
        f"Moments that count as looking the same differ in at most {100 * same:.2f} % of the pixels of a camera, those "
        f"that count as different in at least {100 * other:.2f} %.",
        "",
        *([bounds(results), ""] if bounds(results) else []),
        "### Ways to the goal that need no memory",
        "",
    ]
    searched = any(result["any_order"] is not None for result in results)
    lines += _ways(results) or ["None was found." if searched else "They were not looked for."]
    return "\n".join(lines) + "\n"


def _ways(results: Sequence[Result]) -> list[str]:
    lines = []
    for result in results:
        if verdict(result) == "order":
            lines.append(f"- `{result['task']}` ({result['referent']}):")
            for rule in result["any_order"]["policy"]:
                when = " or ".join(f"`{text}`" if text else "*nothing of the goal*" for text in rule["when"])
                lines.append(f"  - seeing {when}: `{rule['do']}`")
    return lines


# --- files ---

PAGE_BEGIN, PAGE_END = "<!-- made by `memobench necessity --page`: -->", "<!-- end of what it made -->"


def read_results(path: Path) -> list[Result]:
    """Return the results that another run wrote into its ``necessity.json``.

    Raises:
        MemobenchError: it is missing, cannot be read or holds something else.
    """
    advice = f"name the {JSON_FILE} that `memobench necessity` wrote"
    try:
        found: list[Result] = read_json(path, list[KeptResult], advice)
    except FileNotFoundError:
        raise MemobenchError(f"there is no {path}; {advice}") from None
    return found


def around_table(page: Path) -> tuple[str, str]:
    """Return what stands before and after the table of a Markdown page, its marks included.

    Raises:
        MemobenchError: there is no such page, or it lacks the marks.
    """
    try:
        text = page.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MemobenchError(f"the page {page} cannot be read ({reason}); name a Markdown file") from None
    before, begin, rest = text.partition(PAGE_BEGIN)
    _, end, after = rest.partition(PAGE_END)
    if not begin or not end:
        raise MemobenchError(
            f"the page {page} lacks the lines {PAGE_BEGIN!r} and {PAGE_END!r}; put them where the table goes"
        )
    return before + begin, end + after


def put_into_page(page: Path, results: Sequence[Result], beside: Sequence[Result] | None = None) -> Path:
    """Put the table into a Markdown page, between its two marks; return the page.

    Args:
        beside: results of the published tasks; then the table shows those and their twins, which ``results`` are of.

    Raises:
        MemobenchError: see `around_table`.
    """
    before, after = around_table(page)
    table = markdown(results) if beside is None else side_by_side(beside, results)
    return write_file(page, f"{before}\n\n{table}\n{after}")


def write(out: Path, results: Sequence[Result]) -> list[Path]:
    """Write JSON, Markdown and, where a pair of moments looks the same, the figure; return their paths."""
    out.mkdir(parents=True, exist_ok=True)
    content = [{**result, "memory_needed": verdict(result)} for result in results]
    written = [
        write_file(out / JSON_FILE, json.dumps(content, indent=1) + "\n"),
        write_file(out / MARKDOWN_FILE, "# Memory necessity\n\n" + markdown(results)),
    ]
    picture = pairs_figure(out, results)
    if picture is not None:
        written.append(write_file(out / FIGURE_FILE, picture))
    return written
