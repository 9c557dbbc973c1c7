"""What a report may be written as: the terminal's tables, text, Markdown, LaTeX, JSON; and rows as CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence

from lerobot_memobench.evaluation.documents.latex import latex
from lerobot_memobench.evaluation.documents.markdown import markdown
from lerobot_memobench.evaluation.documents.tables import Report
from lerobot_memobench.evaluation.documents.terminal import terminal, text

__all__ = ["WRITERS", "csv_text", "json_text", "latex", "markdown", "terminal", "text"]


def json_text(report: Report) -> str:
    """Return the figures of a report as JSON."""
    return json.dumps(report.data, indent=2) + "\n"


WRITERS: Mapping[str, Callable[[Report], str]] = {
    "table": text,
    "markdown": markdown,
    "latex": latex,
    "json": json_text,
}
"""Format -> what writes a report in it."""


def csv_text(rows: Sequence[Sequence[object]], header: Sequence[str]) -> str:
    """Return rows as CSV (RFC 4180, but lines end in a plain line feed); None is an empty field."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    return out.getvalue()
