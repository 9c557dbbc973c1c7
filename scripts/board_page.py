"""The board's table for the site: HTML of the rows in ``results/board``.

`scripts/docs_reference.py` puts it into ``docs/benchmark/board.md``. ``docs/javascripts/board.js`` makes it sortable.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from html import escape
from pathlib import Path

from lerobot_memobench.evaluation.metrics import METRICS, Rate
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE
from tools.board.rows import BoardRow, board_rows, evidence_text, pauses_text, rate_text

BOARD = Path(__file__).resolve().parents[1] / "results" / "board"
PLACE = "<!-- board -->"
"""Line of the page that the table replaces."""
TABLE = "board-table"
"""Id of the table; the page's heading has the id ``board``."""
HEAD = (
    *("policy", "rank", *METRICS, "follows evidence", "change by pauses", "without memory, SR", "suite", "assets"),
    *("inputs", "parameters", "training data", "episodes of each task", "run by us"),
)
UNRANKED = 1000
"""Value by which rows without a rank are sorted."""

Cell = tuple[str, float | str]
"""HTML of a cell, and the value by which it is sorted."""


def table() -> str:
    """Return the board as an HTML table."""
    ranks = itertools.count(1)
    lines = [_line(next(ranks) if row.ranked else None, row) for row in board_rows(BOARD)]
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in HEAD)
    body = "\n".join(lines)
    whole = f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>"
    return f'<div class="board">\n<table id="{TABLE}">\n{whole}\n</table>\n</div>'


def _line(rank: int | None, row: BoardRow) -> str:
    """Return the HTML of one row; a row that was not rerun is grey."""
    about = row.about
    links = " ".join(f'<a href="{escape(link)}" rel="nofollow noopener">{key}</a>' for key, link in about.links.items())
    policy = f"{escape(about.model)}<br><small>{escape(about.submitter)}, {about.date}{links and f', {links}'}</small>"
    count = about.parameters
    cells: list[Cell] = [
        (policy, about.model.lower()),
        (NOT_APPLICABLE, UNRANKED) if rank is None else (str(rank), rank),
        *(_rate(row.rates[metric]) for metric in METRICS),
        (evidence_text(row.evidence), (row.evidence.rates["follows"].value or 0) if row.evidence else -1),
        (pauses_text(row.pauses), row.pauses.value if row.pauses else -2),
        _rate(row.without_memory),
        *((escape(text), text) for text in (row.suite, row.assets, row.inputs)),
        (NOT_APPLICABLE if count is None else f"{count:,}", -1 if count is None else count),
        (escape(about.training_data), about.training_data),
        (f"{row.episodes}<br><small>{escape(row.seeds)}</small>", row.episodes),
        ("yes" if row.rerun else "no", int(row.rerun)),
    ]
    return _html(cells, "" if row.rerun else "unverified")


def _rate(rate: Rate | None) -> Cell:
    return rate_text(rate), -1 if rate is None or rate.value is None else rate.value


def _html(cells: Iterable[Cell], kind: str) -> str:
    made = "".join(f'<td data-sort="{escape(str(value))}">{text}</td>' for text, value in cells)
    return f'<tr class="{kind}">{made}</tr>' if kind else f"<tr>{made}</tr>"
