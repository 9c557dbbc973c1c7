"""One claim as it is reported: a JSON line, a row of a table."""

from __future__ import annotations

import json
import statistics
from dataclasses import asdict, dataclass
from typing import Any

from lerobot_memobench.bench.machine import machine
from lerobot_memobench.bench.sides import Times


@dataclass(frozen=True)
class Line:
    """One claim, measured. ``ratio`` is how many times better ours is.

    Durations are those on the wall, which is what a user waits for. Those of processors stand in ``detail`` as
    ``cpu_ours``, ``cpu_theirs`` and ``cpu_ratio``: they are what to compare where other programs run beside.
    """

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


def line_of(name: str, pairs: list[tuple[Times, Times]], detail: dict[str, Any]) -> Line:
    """Return the line of both sides' durations, taken in pairs: each figure is the pairs' median, the ratio too."""

    def medians(clock: str) -> tuple[float, float, float]:
        taken = [(getattr(ours, clock), getattr(theirs, clock)) for ours, theirs in pairs]
        mine, other = (round(1e3 * statistics.median(side), 3) for side in zip(*taken, strict=True))
        return mine, other, round(statistics.median(theirs / ours for ours, theirs in taken), 2)

    cpu = dict(zip(("cpu_ours", "cpu_theirs", "cpu_ratio"), medians("cpu"), strict=True))
    return Line(name, *medians("wall"), "ms", machine(), {**detail, **cpu})


def table(lines: list[Line]) -> str:
    """Return a Markdown table of lines, the machine above it: durations on the wall, then those of processors."""
    rows = [
        "| what | ours | stock robosuite 1.4.1 | ratio | ours, CPU | stock, CPU | ratio, CPU | |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for line in lines:
        notes = ", ".join(
            f"{key.replace('_', ' ')} {line.detail[key]}"
            for key in ("quality", "memory_mb", "their_memory_mb", "over_bare", "over_bare_before", "beside")
            if key in line.detail
        )
        name = line.name.replace("_", " ")
        cells = [name, *_figures(line.ours, line.theirs, line.ratio, line.unit)]
        if "cpu_ratio" in line.detail:
            cells += _figures(line.detail["cpu_ours"], line.detail["cpu_theirs"], line.detail["cpu_ratio"], line.unit)
        else:
            cells += ["", "", ""]
        rows.append(f"| {' | '.join([*cells, notes])} |")
    return "\n".join([*([lines[0].machine, ""] if lines else []), *rows])


def _figures(ours: float, theirs: float, ratio: float, unit: str) -> list[str]:
    return [f"{ours:g} {unit}", f"{theirs:g} {unit}", f"{ratio:g}×"]
