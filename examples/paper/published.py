"""The tables of the MEMOBench paper as data (``tables.json``).

Source: H. Sun, H. Wang, J. Chen et al., "MEMOBench: A Process Level Memory Benchmark for Robotic Manipulation",
https://github.com/Collab-Gen/MEMOBench. The data are the numbers as printed there, percentages with one decimal.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

TABLES = ("main", "alignment", "oracle", "memer")
"""The paper's tables of rates: main results, memory alignment, oracle memory, MemER with privileged supervision."""
RAW: dict[str, Any] = json.loads(Path(__file__).with_name("tables.json").read_text(encoding="utf-8"))

LABELS = {
    "pi0": "π0",
    "pi05": "π0.5",
    "pi05 + RoboMME Memory Module": "π0.5 + memory module",
    "Contrastive Memory Alignment": "contrastive alignment",
    "Semantic Memory Alignment": "semantic alignment",
    "Framewise Memory Alignment": "framewise alignment",
    "Memory module": "π0.5 + memory module",
    "standard_pi05": "π0.5",
    "oracle_pi05": "π0.5 + oracle memory",
    "memer": "MemER",
}

Figures = Mapping[str, float | None]
"""Metric -> per cent, None where the paper prints a dash."""


class PublishedRow(NamedTuple):
    """One row of one of the paper's tables of rates.

    Attributes:
        table: key of ``TABLES``. model: as ``tables.json`` names it. replan_steps: None where the paper states none.
        memory_types: memory type -> figures. average: the paper's own average column.
    """

    table: str
    model: str
    replan_steps: int | None
    memory_types: Mapping[str, Figures]
    average: Figures

    @property
    def label(self) -> str:
        """The model's name for tables and figures."""
        return LABELS.get(self.model, self.model)


def published_rows(*tables: str) -> list[PublishedRow]:
    """Return the rows of some of `TABLES`, of all of them by default, in the paper's order."""
    found = [_row("main", row["model"], row["replan_steps"], row) for row in RAW["main_results"]]
    found += [_row("alignment", row["model"], row["replan_steps"], row) for row in RAW["alignment_results"]]
    oracle = RAW["oracle_memory"]
    found += [_row("oracle", key, oracle["replan_steps"], oracle[key]) for key in ("standard_pi05", "oracle_pi05")]
    found.append(_row("memer", "memer", None, RAW["memer"]))
    return [row for row in found if row.table in (tables or TABLES)]


def _row(table: str, model: str, replan_steps: int | None, entry: Mapping[str, Any]) -> PublishedRow:
    types = {name: dict(figures) for name, figures in entry.items() if isinstance(figures, dict)}
    return PublishedRow(table, model, replan_steps, types, types.pop("average"))
