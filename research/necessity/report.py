"""Memory necessity: verdicts, a table for the terminal, Markdown for people, JSON for programs, a figure of pairs."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE, figure
from lerobot_memobench.io import write_file
from lerobot_memobench.protocol import LONGEST_HOLD
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import DRAWN
from research.necessity.study import Result, pictures_path
from research.necessity.trained import in_words as rate_in_words

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image as Strip


# --- verdicts ---

VERDICTS = {
    "no": "observations at the decisions, with the pose of the hand, decide each: no memory is needed",
    "order": "they do not decide the demonstrated order, but pictures decide another that the goal accepts",
    "clock": "observations decide together with the step counter",
    "not found": "no way without a memory was found, though every state was tried that can be reached before the "
    "horizon: a bound for decisions, not a proof",
    "cut off": "no way without a memory was found before the search was cut off",
    "open": "observations do not decide the demonstrated order; other ways were not searched",
    "unknown": "the expert solved none of the scenes",
}
"""Verdict -> meaning. Verdicts rest on observations as they happen, not on pictures with the arm at home."""


def verdict(result: Result) -> str:
    """Return which of `VERDICTS` holds."""
    in_order, any_order = result["in_order"], result["any_order"]
    if in_order is None:
        return "unknown"
    if in_order["as_it_happens"] >= 1.0:
        return "no"
    if any_order is not None and any_order["confirmed"] == any_order["of"]:
        return "order"
    if in_order["with_step"] >= 1.0:
        return "clock"
    if any_order is None:
        return "open"
    return "cut off" if any_order["cut_off"] else "not found"


# --- lower bounds ---


def _bounds_of(result: Result) -> list[str]:
    """Return the cells of the lower bounds that count, how far the search came, and the trained policy's."""
    in_order, any_order = result["in_order"], result["any_order"]
    happens = [NOT_APPLICABLE if in_order is None else figure(in_order[key]) for key in ("as_it_happens", "with_step")]
    found = [NOT_APPLICABLE] * 3
    if any_order is not None:
        found = [
            f"{figure(any_order['deterministic'])} ({any_order['confirmed']}/{any_order['of']})",
            figure(any_order["stochastic"]),
            f"cut off, {any_order['unexplored']} states left" if any_order["cut_off"] else "whole",
        ]
    return [*happens, *found, rate_in_words(result.get("trained"))]


def _expert(result: Result) -> list[str]:
    return [f"{result['expert']['success']}/{result['expert']['n']}"]


def bounds(results: Sequence[Result]) -> str:
    """Return in a paragraph how far policies without memory come at tasks whose goal is drawn; "" without any."""
    drawn = [result for result in results if result["referent"] == DRAWN]
    searched = [result for result in drawn if result["any_order"] is not None]
    if not searched:
        return ""
    open_ones = sum(verdict(result) in ("not found", "cut off") for result in drawn)
    values = [
        f"the {name} at most {figure(max(values))} %, on average {figure(sum(values) / len(values))} %"
        for name, values in (
            ("best fixed map in any order", [result["any_order"]["deterministic"] for result in searched]),
            ("best probabilities in any order", [result["any_order"]["stochastic"] for result in searched]),
            ("best fixed map of observations", [result["in_order"]["as_it_happens"] for result in searched]),
            ("same with the step counter", [result["in_order"]["with_step"] for result in searched]),
        )
    ]
    return (
        f"Without a memory no way was found to {open_ones} of {len(drawn)} tasks. Lower bounds of what such a policy "
        f"reaches: {'; '.join(values)}. {_cut_off(searched)}"
    )


def _cut_off(searched: Sequence[Result]) -> str:
    """Return a sentence on how many searches ended before every state had been tried, and by what."""
    number, cut = sum(r["any_order"]["searches"] for r in searched), sum(r["any_order"]["cut_off"] for r in searched)
    budgets = sorted({result["settings"]["budget"] for result in searched})
    left = sum(result["any_order"]["unexplored"] for result in searched)
    steps = ", ".join(f"{budget:,}" for budget in budgets)
    return (
        f"{cut} of {number} searches were cut off by their budget ({steps} control steps for each different start) "
        f"with {left} states left to try; all end at the horizon."
    )


# --- aliased pairs: frames that look the same and ask for different answers ---

LARGEST_FIGURE = 400_000
"""Bytes: the figure of the documentation is kept in the repository."""

CAMERAS = ("third person", "wrist")
TITLE_WIDTH = 92
"""Largest number of characters in a line of a title."""


def pairs_figure(out: Path, results: Sequence[Result]) -> bytes | None:
    """Return a PNG of a few aliased pairs: both frames side by side with their right answers; None without any.

    One pair within an episode and one between goals, the two ways in which memory is needed; of drawn tasks one of each
    family.
    """
    shown = _chosen(out, results)
    if not shown:
        return None
    found = _small_png(_drawn(shown))
    if len(found) > LARGEST_FIGURE:
        raise MemobenchError(f"the figure has {len(found)} bytes, expected at most {LARGEST_FIGURE}; draw it smaller")
    return found


def _chosen(out: Path, results: Sequence[Result]) -> list[tuple[Result, Strip]]:
    from PIL import Image

    shown: list[tuple[Result, Strip]] = []
    for result in results:
        if not result["examples"] or any(_kind(other) == _kind(result) for other, _ in shown):
            continue
        path = pictures_path(out, result["task"], result["referent"], result["examples"][0]["seed"])
        if path.is_file():
            shown.append((result, Image.open(path).convert("RGB")))
    return shown


def _kind(result: Result) -> str | bool:
    """Return the family of a drawn task; of others whether the first pair lies within one episode."""
    if result["referent"] == DRAWN:
        return get_task(result["task"]).family
    pair = result["examples"][0]
    return bool(pair["a"]["variant"] == pair["b"]["variant"])


def _drawn(shown: Sequence[tuple[Result, Strip]]) -> Figure:
    from matplotlib.figure import Figure

    plot = Figure(figsize=(8.4, 2.75 * len(shown)), layout="constrained")
    for row, (result, strip) in zip(plot.subfigures(len(shown), 1, squeeze=False)[:, 0], shown, strict=True):
        pair, side = result["examples"][0], strip.height
        title = fill(get_task(result["task"]).title, TITLE_WIDTH)
        row.suptitle(title, fontsize=11, fontweight="bold", x=0.01, ha="left")
        axes = row.subplots(1, 4)
        for k, axis in enumerate(axes):
            axis.imshow(strip.crop((k * side, 0, (k + 1) * side, side)))
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_xlabel(CAMERAS[k % 2], fontsize=9)
        for axis, frame in ((axes[0], pair["a"]), (axes[2], pair["b"])):
            axis.set_title(f"step {frame['step']}: {in_words(frame['answer'])}", fontsize=10, loc="left")
    return plot


WORDS = {
    "open": "open the {}",
    "close": "close the {}",
    "turnon": "turn on the {}",
    "turnoff": "turn off the {}",
    "on": "put {} on {}",
    "in": "put {} into {}",
}
"""Atom -> the subtask that brings it about."""


def in_words(answer: str) -> str:
    """Return an answer, such as ``(open wooden_cabinet_1_top_region)``, in words."""
    predicate, *names = answer.strip("()").split()
    things = [re.sub(r"^.*_(top|middle|bottom)_(region|level)$", r"\1 drawer", name) for name in names]
    things = [re.sub(r"_1$", "", thing).replace("_", " ") for thing in things]
    template = WORDS.get(predicate.lower(), "")
    return template.format(*things) if template.count("{}") == len(things) > 0 else " ".join([predicate, *things])


def _small_png(plot: Figure) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    plot.savefig(buffer, dpi=110, format="png")
    small = Image.open(buffer).convert("RGB").quantize(192, kmeans=4, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    small.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


JSON_FILE, MARKDOWN_FILE, FIGURE_FILE = "necessity.json", "necessity.md", "aliased_pairs.png"


# --- tables ---


COLUMNS = {
    "referent": "setting of the goal; *both*: the task has one goal, so the settings are the same",
    "goals": "goals that may lie behind the same start",
    "decisions": "times per episode at which the expert turns to something new",
    "aliased": "frames that are alike and have more than one right answer: as it happens / with the step / arm at home",
    "as it happens ≥": "best map from observations at a decision, with the pose of the hand, to answers, in the "
    "demonstrated order",
    "with step ≥": "the same where the step counter is observed too: in strict tasks, whose holds "
    f"last up to {LONGEST_HOLD:,} steps, steps count as alike up to so many apart; a threshold may beat that",
    "any order ≥": "best map from pictures with the arm at home to answers if any order will do that the goal accepts: "
    "found, and confirmed in the simulator",
    "any order, prob. ≥": "best probabilities found, wrong answers corrected as the scene allows, within the horizon",
    "search": "of other orders: *whole*, or *cut off* by its budget with so many states left to try",
    "trained policy": "SR of a trained policy without a memory, its 95 % interval and number of scenes; empty where "
    "none was evaluated",
    "at home": "in the demonstrated order with the arm taken home, which no policy observes: even guesses / best map / "
    "best probabilities / best map if every pixel could be used (differences above 2 of 255)",
    "expert": "the expert's episodes that reached the goal",
    "without a memory": "; ".join(f"*{word}*: {meaning}" for word, meaning in VERDICTS.items()),
}
"""Heading -> its explanation under the table."""


def cells(result: Result, referent: str) -> list[str]:
    """Return a row of the table, without the task."""
    in_order, counts = result["in_order"], result["aliased"]
    alike, at_home = NOT_APPLICABLE, NOT_APPLICABLE
    if counts is not None:
        alike = " / ".join(f"{counts[key]:.1f}" for key in ("as_it_happens", "with_step", "at_home"))
    if in_order is not None:
        keys = ("chance", "deterministic", "stochastic", "pixel_exact")
        at_home = " / ".join(figure(in_order[key]) for key in keys)
    return [
        referent,
        str(result["variants"]),
        f"{result['decisions']:.1f}",
        alike,
        *_bounds_of(result),
        at_home,
        *_expert(result),
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

    from lerobot_memobench.evaluation.tables import Unbroken

    table = Table(header_style="bold", pad_edge=False)
    table.add_column("task")
    for name in COLUMNS:
        table.add_column(name, justify="left" if name in ("referent", "without a memory") else "right")
    before = None
    for memory_type, task, row in rows(results):
        if before not in (None, memory_type):
            table.add_section()
        before = memory_type
        table.add_row(task, *row)
    return Unbroken(table)


def markdown(results: Sequence[Result]) -> str:
    """Return the table, what its columns mean, what follows, and the best maps that were found."""
    lines = ["| task | " + " | ".join(COLUMNS) + " |"]
    lines.append("|---|" + "---|" * len(COLUMNS))
    lines += [f"| {memory_type}: `{task}` | " + " | ".join(row) + " |" for memory_type, task, row in rows(results)]
    lines += [
        "",
        "Per cent, means over scenes; ≥ is a lower bound of a policy without a memory. Columns:",
        "",
    ]
    lines += [f"- **{name}**: {meaning}." for name, meaning in COLUMNS.items()]
    same = max((result["largest_same"] for result in results), default=0.0)
    other = min((result["smallest_different"] for result in results), default=1.0)
    lines += [
        "",
        f"Frames that count as looking the same differ in at most {100 * same:.2f} % of the pixels of a camera, those "
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
                when = " or ".join(f"`{text}`" if text else "*no part of the goal*" for text in rule["when"])
                lines.append(f"  - seeing {when}: `{rule['do']}`")
    return lines


# --- files ---


def write(out: Path, results: Sequence[Result]) -> list[Path]:
    """Write JSON, Markdown and, where a pair of frames looks the same, the figure; return their paths."""
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
