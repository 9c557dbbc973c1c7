"""The policies of a study in one table and one figure: mean and spread over training seeds, beside the baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from research.alignment.measures import mean_and_deviation
from research.drawing import pyplot, save
from research.learning.results import COLOURS, WRONG_COLOUR, markdown

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


PANELS = {
    "memory": "Subgoal from memory (readout)",
    "last frame": "Subgoal from the last frame (readout)",
    "own head": "Subgoal by the policy's own head",
    "memory, own task": "From memory, own task's subgoals",
    "action loss": "Action loss, held-out episodes",
}
"""Measure of each panel after the first, and its title."""


def draw(summary: dict[str, Any], path: Path) -> Path:
    """Draw every panel with every training seed to ``path``; return it."""
    plt = pyplot()
    figure, axes = plt.subplots(2, 3, figsize=(9.2, 6.2), constrained_layout=True)
    _draw_solved(axes.flat[0], {arm: found["all"] for arm, found in summary["outcomes"].items()})
    for axis, (name, title) in zip(axes.flat[1:], PANELS.items(), strict=True):
        _draw_measure(axis, name, {arm: found.get(name) for arm, found in summary["measures"].items()})
        axis.set_title(title, fontsize=10)
        if name != "action loss":
            axis.set_ylim(0, 100)
            axis.set_ylabel("held-out top-1, %")
            _draw_baselines(axis, name, summary["baselines"])
    handles = [label for axis in axes.flat[:2] for label in zip(*axis.get_legend_handles_labels(), strict=True)]
    figure.legend(*zip(*handles, strict=True), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    figure.suptitle(_headline(summary), fontsize=10)
    return save(figure, path)


def _draw_solved(axis: Any, arms: dict[str, Any]) -> None:
    """Success with its interval, what was wrong above it."""
    for place, found in enumerate(arms.values()):
        solved, (low, high) = 100 * found["success"], found["interval"]
        label = "failed at a wrong referent, order, place or count" if place == 0 else None
        _draw_bar(axis, place, solved, [100 * value for value in found["of_seeds"]])
        axis.bar(place, 100 * found["wrong_share"], 0.7, bottom=solved, color=WRONG_COLOUR, alpha=0.35, label=label)
        axis.plot([place + 0.25] * 2, [100 * low, 100 * high], color="black", linewidth=1.2)
    axis.set_ylim(0, 100)
    axis.set_ylabel("rollouts solved, %")
    axis.set_title("Success (line: 95 % interval of rollouts)", fontsize=10)
    _name_arms(axis, arms)


def _draw_measure(axis: Any, name: str, arms: dict[str, Any]) -> None:
    factor = 1.0 if name == "action loss" else 100.0
    for place, measure in enumerate(arms.values()):
        if measure is None:
            axis.text(place, 3.0, "none", ha="center", va="bottom", fontsize=8, color="#555555")
        else:
            _draw_bar(axis, place, factor * measure["mean"], [factor * value for value in measure["values"]])
    _name_arms(axis, arms)


def _draw_bar(axis: Any, place: int, mean: float, values: list[float]) -> None:
    """A bar for the mean of an arm, a dot for each training seed."""
    axis.bar(place, mean, 0.7, color=COLOURS[place % len(COLOURS)])
    axis.plot([place] * len(values), values, "o", color="black", markersize=3)


def _name_arms(axis: Any, arms: dict[str, Any]) -> None:
    axis.set_xticks(range(len(arms)), arms, rotation=30, fontsize=9, ha="right", rotation_mode="anchor")
    axis.set_xlim(-0.6, len(arms) - 0.4)  # also where the first or the last has no bar
    axis.spines[["top", "right"]].set_visible(False)


def _draw_baselines(axis: Any, name: str, baselines: dict[str, Any]) -> None:
    """Lines for chance, and for a policy with random weights."""
    key = "own_task" if "own task" in name else "all"
    axis.axhline(100 * baselines["chance"][key], color="black", linestyle=":", linewidth=1, label="chance")
    if name != "own head":
        source = baselines["untrained_last_frame" if name == "last frame" else "untrained_memory"]
        axis.axhline(100 * source[key], color="#cc79a7", linestyle="--", linewidth=1.2, label="untrained weights")


def _headline(summary: dict[str, Any]) -> str:
    settings = summary["settings"]
    return (
        f"{len(summary['tasks'])} tasks, {settings['steps']} updates, {settings['rollouts']} rollouts of each task and "
        f"policy; {summary['candidates']} subgoals, {summary['frames']['test']} held-out frames; bars: mean, dots: "
        "training seeds"
    )
