"""The study's figure: retrieval from memory, from the last frame and by the own head, and the action loss."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lerobot_memobench.files import draft_of

COLOURS = {"none": "#7f7f7f", "semantic": "#56b4e9", "contrastive": "#e69f00", "framewise": "#009e73"}
"""Okabe and Ito's palette, apart for the colour-blind too."""

PANELS = {
    "memory": "From memory (readout)",
    "last frame": "From the last frame (readout)",
    "own head": "By the policy's own head",
    "memory, own task": "From memory, own task's subgoals",
    "action loss": "Action loss",
}
"""Measure of each panel, and its title."""


def draw(summary: dict[str, Any], path: Path) -> Path:
    """Draw every panel with every seed to ``path``; return it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(PANELS), figsize=(3.1 * len(PANELS), 3.3), constrained_layout=True)
    for axis, (name, title) in zip(axes, PANELS.items(), strict=True):
        _draw_alignments(axis, name, summary["alignments"])
        axis.set_title(title, fontsize=10)
        if name == "action loss":
            axis.set_ylabel("flow-matching loss")
        else:
            axis.set_ylim(0, 100)
            axis.set_ylabel("held-out top-1, %")
            _draw_baselines(axis, name, summary["baselines"])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    figure.suptitle(_headline(summary), fontsize=10)
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130)
    plt.close(figure)
    return path


def _draw_alignments(axis: Any, name: str, alignments: dict[str, Any]) -> None:
    """A bar for the mean of each alignment, a dot for each seed."""
    factor = 1.0 if name == "action loss" else 100.0
    for place, (align, measures) in enumerate(alignments.items()):
        measure = measures.get(name)
        if measure is None:
            axis.text(place, 7.0, "no head", ha="center", va="bottom", fontsize=8, color="#555555")
            continue
        axis.bar(place, factor * measure["mean"], 0.7, color=COLOURS.get(align, "#444444"), alpha=0.85)
        values = [factor * value for value in measure["values"]]
        axis.plot([place] * len(values), values, "o", color="black", markersize=3)
    axis.set_xticks(range(len(alignments)), alignments, rotation=25, fontsize=9)
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
        f"{summary['tasks']} tasks, {summary['candidates']} subgoals, {summary['frames']['test']} held-out frames; "
        f"{settings['size']}, {settings['steps']} updates of {settings['batch_size']}; bars: mean, dots: seeds"
    )
