"""The board's table for the site: HTML of the rows in ``results/board`` and of rows that wait for a result.

`scripts/docs_reference.py` puts it into ``docs/benchmark/board.md``. ``docs/javascripts/board.js`` makes it sortable.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import cache
from html import escape
from pathlib import Path

from lerobot_memobench.board.rows import BoardRow, board_json, board_rows, evidence_text, pauses_text, rate_text
from lerobot_memobench.evaluation.metrics import METRICS, Rate
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE

BOARD = Path(__file__).resolve().parents[1] / "results" / "board"
PLACE = "<!-- board -->"
"""Line of the page that the table replaces."""
HEAD = (
    *("rank", "policy", "suite", "assets", "inputs", "parameters", "training data"),
    *METRICS,
    *("follows evidence", "change by pauses", "without memory, SR", "episodes of each task", "run by us"),
)
WAITING = ("ACT", "Diffusion Policy", "SmolVLA", "π0.5")
"""Policies with a recipe on the page and without a result."""

__all__ = ["PLACE", "board_json", "rows", "table"]

Cell = tuple[str, float | str]
"""HTML of a cell, and the value by which it is sorted."""


@cache
def rows() -> tuple[BoardRow, ...]:
    """Return the rows of the board; they are computed once per build."""
    return tuple(board_rows(BOARD))


def table() -> str:
    """Return the board as an HTML table."""
    ranks = iter(range(1, len(rows()) + 1))
    lines = [
        _line((str(rank), rank) if row.ranked and (rank := next(ranks)) else (NOT_APPLICABLE, math.inf), row)
        for row in rows()
    ]
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in HEAD)
    body = "\n".join([*lines, *_waiting()])
    whole = f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>"
    data = '<p><a href="../board.json">Data as JSON</a></p>'
    return f'<div class="board">\n<table id="board">\n{whole}\n</table>\n</div>\n{data}'


def _line(rank: Cell, row: BoardRow) -> str:
    """Return the HTML of one row; a row that was not rerun is grey."""
    about = row.about
    links = " ".join(f'<a href="{escape(link)}" rel="nofollow noopener">{key}</a>' for key, link in about.links.items())
    policy = f"{escape(about.model)}<br><small>{escape(about.submitter)}, {about.date}{links and f', {links}'}</small>"
    count = about.parameters
    cells: list[Cell] = [
        rank,
        (policy, about.model.lower()),
        *((escape(text), text) for text in (row.suite, row.assets, row.inputs)),
        (NOT_APPLICABLE if count is None else f"{count:,}", -1 if count is None else count),
        (escape(about.training_data), about.training_data),
        *(_rate(row.rates[metric]) for metric in METRICS),
        (evidence_text(row.evidence), (row.evidence.rates["follows"].value or 0) if row.evidence else -1),
        (pauses_text(row.pauses), row.pauses.value if row.pauses else -2),
        _rate(row.without_memory),
        (f"{row.episodes}<br><small>{escape(row.seeds)}</small>", row.episodes),
        ("yes" if row.rerun else "no", int(row.rerun)),
    ]
    return _html(cells, "" if row.rerun else "unverified")


def _rate(rate: Rate | None) -> Cell:
    return rate_text(rate), -1 if rate is None or rate.value is None else rate.value


def _waiting() -> Iterator[str]:
    """Yield grey rows of policies that wait for a result."""
    for name in WAITING:
        policy = f'{name}<br><small><a href="#recipes">recipe</a></small>'
        known: list[Cell] = [(NOT_APPLICABLE, math.inf), (policy, name.lower())]
        known += [(text, text) for text in ("strict", "package", "pixels")]
        yield _html([*known, *[(NOT_APPLICABLE, -2)] * (len(HEAD) - len(known) - 1), ("not run", -1)], "unverified")


def _html(cells: Iterable[Cell], kind: str) -> str:
    made = "".join(f'<td data-sort="{escape(str(value))}">{text}</td>' for text, value in cells)
    return f'<tr class="{kind}">{made}</tr>' if kind else f"<tr>{made}</tr>"
