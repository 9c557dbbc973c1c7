"""One claim as it is reported: a JSON line, a row of a table."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

from lerobot_memobench.bench.machine import machine


@dataclass(frozen=True)
class Line:
    """One claim, measured. ``ratio`` is how many times better ours is."""

    name: str
    ours: float
    theirs: float
    ratio: float
    unit: str
    machine: str
    detail: dict[str, Any]

    def json(self) -> str:
        """Return the line as one JSON object."""
        record = asdict(self)
        detail = record.pop("detail")
        return json.dumps({**record, **detail})


def line_of(name: str, ours: float, theirs: float, detail: dict[str, Any]) -> Line:
    """Return the line of two durations, s."""
    return Line(name, round(1e3 * ours, 3), round(1e3 * theirs, 3), round(theirs / ours, 2), "ms", machine(), detail)


def table(lines: list[Line]) -> str:
    """Return a Markdown table of lines, the machine above it."""
    rows = ["| what | ours | stock robosuite 1.4.1 | ratio | |", "| --- | ---: | ---: | ---: | --- |"]
    for line in lines:
        notes = ", ".join(
            f"{key.replace('_', ' ')} {line.detail[key]}"
            for key in ("quality", "memory_mb", "their_memory_mb", "over_bare")
            if key in line.detail
        )
        name = line.name.replace("_", " ")
        rows.append(f"| {name} | {line.ours:g} {line.unit} | {line.theirs:g} {line.unit} | {line.ratio:g}× | {notes} |")
    return "\n".join([*([lines[0].machine, ""] if lines else []), *rows])
