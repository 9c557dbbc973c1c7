"""What the policies of a study know, in one table: mean and spread over training seeds, beside the baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_memobench.studies.alignment.readouts import mean_and_deviation
from lerobot_memobench.studies.learning.tables import markdown

MEASURES = {
    "memory": ("memory", "all"),
    "memory, own task": ("memory", "own_task"),
    "last frame": ("last_frame", "all"),
    "last frame, own task": ("last_frame", "own_task"),
    "own head": ("head", "all"),
    "own head, own task": ("head", "own_task"),
    "action loss": ("action_loss",),
}
"""Columns of the table, and where a run holds their numbers."""

BASELINES = {
    "untrained weights": ("untrained_memory", "untrained_last_frame"),
    "commonest subgoal": ("commonest",),
    "chance": ("chance",),
}
"""Last rows of the table, and the baselines of their first columns."""


def summarise(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return per measure the values of all seeds, their mean and their sample standard deviation."""
    found: dict[str, Any] = {}
    for name, path in MEASURES.items():
        values = [value for run in runs if (value := _value(run, path)) is not None]
        if values:
            mean, deviation = mean_and_deviation(values)
            found[name] = {"values": values, "mean": mean, "deviation": deviation}
    return found


def _value(run: dict[str, Any], path: Sequence[str]) -> float | None:
    """The number at a path of keys; None where a run has no such measure."""
    value: Any = run
    for key in path:
        value = value.get(key) if isinstance(value, dict) else None
    return None if value is None else float(value)


def measures_table(arms: Mapping[str, dict[str, Any]], baselines: Mapping[str, Any]) -> str:
    """Return a row per arm, as `summarise` tells it, and per baseline."""
    rows = [[arm, *(_cell(name, found.get(name)) for name in MEASURES)] for arm, found in arms.items()]
    for label, names in BASELINES.items():
        cells = [f"{100 * baselines[name][key]:.1f}" for name in names for key in ("all", "own_task")]
        rows.append([label, *cells, *["–"] * (len(MEASURES) - len(cells))])
    return markdown(["active subgoal, top-1 in %", *MEASURES], rows)


def _cell(name: str, measure: dict[str, Any] | None) -> str:
    if measure is None:
        return "–"
    unit, digits = (1, 4) if name == "action loss" else (100, 1)
    told = [unit * measure[key] for key in ("mean", "deviation") if measure[key] is not None]
    return " ± ".join(f"{number:.{digits}f}" for number in told)
