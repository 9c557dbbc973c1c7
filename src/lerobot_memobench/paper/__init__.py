"""The figures that the MEMOBench paper publishes: its tables as data (``tables.json``), and typed access to them.

Source: H. Sun, H. Wang, J. Chen et al., "MEMOBench: A Process Level Memory Benchmark for Robotic Manipulation",
https://github.com/Collab-Gen/MEMOBench. The data are the figures as printed there, percentages with one decimal. It
imports only errors of the project, so every other package may use them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest

TABLES = ("main", "alignment", "oracle", "memer")
"""The paper's tables of rates: main results, memory alignment, oracle memory, MemER with privileged supervision."""

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


@dataclass(frozen=True)
class PublishedRow:
    """One row of one of the paper's tables of rates.

    Attributes:
        table: key of ``TABLES``. model: as ``tables.json`` names it. replan_steps: None where the paper does not say.
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


@cache
def raw_tables() -> dict[str, Any]:
    """Return the content of ``tables.json``; do not change it."""
    content: dict[str, Any] = json.loads(Path(__file__).with_name("tables.json").read_text(encoding="utf-8"))
    return content


def published_rows(*tables: str) -> list[PublishedRow]:
    """Return the rows of some of the paper's tables of rates, of all of them by default, in the paper's order.

    Raises:
        MemobenchError: there is no table of that name.
    """
    for table in tables:
        if table not in TABLES:
            raise MemobenchError(f"the paper has no table {table!r} of rates, {nearest(table, TABLES)}")
    raw = raw_tables()
    found = [_row("main", row["model"], row["replan_steps"], row) for row in raw["main_results"]]
    found += [_row("alignment", row["model"], row["replan_steps"], row) for row in raw["alignment_results"]]
    oracle = raw["oracle_memory"]
    found += [_row("oracle", key, oracle["replan_steps"], oracle[key]) for key in ("standard_pi05", "oracle_pi05")]
    found.append(_row("memer", "memer", None, raw["memer"]))
    return [row for row in found if not tables or row.table in tables]


def _row(table: str, model: str, replan_steps: int | None, entry: Mapping[str, Any]) -> PublishedRow:
    types = {name: dict(figures) for name, figures in entry.items() if isinstance(figures, dict)}
    return PublishedRow(table, model, replan_steps, types, types.pop("average"))


def failure_taxonomy() -> dict[str, int]:
    """Return the rollouts per outcome of the paper's temporal task of three checkpoints (S, U, U), and their number."""
    return dict(raw_tables()["failure_taxonomy"])


def shuffled_control() -> dict[str, list[float]]:
    """Return the prefix completion per checkpoint of that task, per cent: with normal and with shuffled subgoals."""
    found = raw_tables()["shuffled_control"]
    return {"normal": list(found["normal_prefix"]), "shuffled": list(found["shuffled_prefix"])}
