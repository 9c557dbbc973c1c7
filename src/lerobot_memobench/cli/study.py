"""``memobench study``: train the small policy with every alignment and show what its memory then knows."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from lerobot_memobench.cli.console import console

COLOURS = {"none": "#7f7f7f", "semantic": "#56b4e9", "contrastive": "#e69f00", "framewise": "#009e73"}
"""Okabe and Ito's palette, apart for the colour-blind too."""


def study(
    dataset: Annotated[Path, typer.Argument(help="Folder of a generated dataset of eight tasks or more.")],
    out: Annotated[Path, typer.Option(help="Folder of runs, table and figure; the same command goes on there.")],
    steps: Annotated[int, typer.Option(min=1, help="Updates per run.")] = 300,
    batch_size: Annotated[int, typer.Option(min=2, help="Samples per update.")] = 16,
    seeds: Annotated[int, typer.Option(min=1, help="Runs per alignment.")] = 3,
    held_out: Annotated[int, typer.Option(min=1, help="Episodes per task that are never trained on.")] = 2,
    level: Annotated[str, typer.Option(help="Subgoal level: coarse, intermediate or fine.")] = "intermediate",
    size: Annotated[str, typer.Option(help="Size of the policy.")] = "tiny",
) -> int:
    """Train with none, semantic, contrastive and framewise alignment from the same seeds, and compare what a memory
    tells about the active subgoal on held-out episodes: one table and one figure. A killed run is continued.
    """
    from lerobot_memobench.studies.alignment.study import ALIGNMENTS, Study, StudySettings

    screen = console()

    def say(text: str) -> None:
        screen.print(text, markup=False, soft_wrap=True)

    settings = StudySettings(steps=steps, batch_size=batch_size, seeds=seeds, held_out=held_out, level=level, size=size)
    work = Study(dataset, out, settings, say)
    baselines = work.baselines()
    # Seed by seed, so that an unfinished study already compares all objectives.
    runs = [work.run(align, seed) for seed in range(seeds) for align in ALIGNMENTS]
    summary = {
        "settings": json.loads((out / "settings.json").read_text()) | {"seeds": seeds},
        "tasks": len(set(work.frames.tasks.tolist())),
        "episodes": len(work.frames.episodes) - 1,
        "candidates": len(work.candidates),
        "frames": {"fit": len(work.split.fit), "test": len(work.split.test), "train": len(work.split.train)},
        "baselines": baselines,
        "alignments": {align: summarise([run for run in runs if run["align"] == align]) for align in ALIGNMENTS},
    }
    table = markdown_table(summary)
    for name, text in (("study.json", json.dumps(summary, indent=1)), ("study.md", table + "\n")):
        part = out / f"{name}.part"
        part.write_text(text)
        os.replace(part, out / name)
    draw(summary, out / "alignment_study.png")
    say(table)
    say(f"figure: {out / 'alignment_study.png'}")
    return 0


MEASURES = {
    "memory": ("memory", "all"),
    "memory, own task": ("memory", "own_task"),
    "last frame": ("last_frame", "all"),
    "last frame, own task": ("last_frame", "own_task"),
    "own head": ("head", "all"),
    "own head, own task": ("head", "own_task"),
    "action loss": ("action_loss",),
}


def summarise(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return per measure the values of all seeds, their mean and their sample standard deviation."""
    from lerobot_memobench.studies.alignment.retrieval import mean_and_deviation

    found: dict[str, Any] = {}
    for name, path in MEASURES.items():
        values: list[float] = []
        for run in runs:
            value: Any = run
            for key in path:
                value = value.get(key) if isinstance(value, dict) else None
            if value is not None:
                values.append(float(value))
        if values:
            mean, deviation = mean_and_deviation(values)
            found[name] = {"values": values, "mean": mean, "deviation": deviation}
    return found


def markdown_table(summary: dict[str, Any]) -> str:
    """Return the study's table: a row per alignment and per baseline."""
    names = list(MEASURES)
    lines = [["", *names], ["---", *["---:"] * len(names)]]
    for align, found in summary["alignments"].items():
        cells = []
        for name in names:
            measure = found.get(name)
            if measure is None:
                cells.append("–")
            elif name == "action loss":
                cells.append(f"{measure['mean']:.4f} ± {measure['deviation']:.4f}")
            else:
                cells.append(f"{100 * measure['mean']:.1f} ± {100 * measure['deviation']:.1f}")
        lines.append([f"align={align}", *cells])
    base = summary["baselines"]
    rows = {
        "untrained weights": ("untrained_memory", "untrained_last_frame"),
        "tower's tokens, no clock": ("tower_history", "tower_last_frame"),
    }
    for label, (memory, last) in rows.items():
        cells = [f"{100 * base[name][key]:.1f}" for name in (memory, last) for key in ("all", "own_task")]
        lines.append([label, *cells, "–", "–", "–"])
    for label, name in (("commonest subgoal", "commonest"), ("chance", "chance")):
        cells = [f"{100 * base[name][key]:.1f}" for key in ("all", "own_task")]
        lines.append([label, *cells, *["–"] * (len(names) - 2)])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def draw(summary: dict[str, Any], path: Path) -> None:
    """Draw retrieval from memory, from the last frame and by the own head, and the action loss, with every seed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = (
        ("memory", "From memory (readout)"),
        ("last frame", "From the last frame (readout)"),
        ("own head", "By the policy's own head"),
        ("memory, own task", "From memory, own task's subgoals"),
        ("action loss", "Action loss"),
    )
    aligns = list(summary["alignments"])
    base = summary["baselines"]
    figure, axes = plt.subplots(1, len(panels), figsize=(3.1 * len(panels), 3.3), constrained_layout=True)
    for axis, (name, title) in zip(axes, panels, strict=True):
        factor = 1.0 if name == "action loss" else 100.0
        for place, align in enumerate(aligns):
            measure = summary["alignments"][align].get(name)
            if measure is None:
                axis.text(place, 7.0, "no head", ha="center", va="bottom", fontsize=8, color="#555555")
                continue
            axis.bar(place, factor * measure["mean"], 0.7, color=COLOURS.get(align, "#444444"), alpha=0.85)
            values = [factor * value for value in measure["values"]]
            axis.plot([place] * len(values), values, "o", color="black", markersize=3)
        axis.set_title(title, fontsize=10)
        axis.set_xticks(range(len(aligns)), aligns, rotation=25, fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
        if name == "action loss":
            axis.set_ylabel("flow-matching loss")
            continue
        axis.set_ylim(0, 100)
        axis.set_ylabel("held-out top-1, %")
        key = "own_task" if "own task" in name else "all"
        axis.axhline(100 * base["chance"][key], color="black", linestyle=":", linewidth=1, label="chance")
        if name != "own head":
            source = "untrained_last_frame" if name == "last frame" else "untrained_memory"
            axis.axhline(
                100 * base[source][key], color="#cc79a7", linestyle="--", linewidth=1.2, label="untrained weights"
            )
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    settings = summary["settings"]
    figure.suptitle(
        f"{summary['tasks']} tasks, {summary['candidates']} subgoals, {summary['frames']['test']} held-out frames; "
        f"{settings['size']}, {settings['steps']} updates of {settings['batch_size']}; bars: mean, dots: seeds",
        fontsize=10,
    )
    part = path.with_name(f"{path.stem}.part.png")
    figure.savefig(part, dpi=130)
    plt.close(figure)
    os.replace(part, path)
