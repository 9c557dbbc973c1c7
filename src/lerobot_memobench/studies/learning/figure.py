"""The experiment as a picture: what share of rollouts each arm solved, and what share was wrong about what was seen."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_memobench.io import draft_of
from lerobot_memobench.studies.learning.outcomes import Outcome
from lerobot_memobench.tasks.task import MEMORY_TYPES

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette, apart for the colour-blind too; one per arm."""
WRONG = "#d55e00"
SCOPES = ("all", *MEMORY_TYPES)


def draw(arms: Mapping[str, Mapping[str, Outcome]], path: Path) -> Path:
    """Draw the means over memory types, or the one task there is, to ``path``; return it.

    Args:
        arms: arm -> scope -> outcome, as `outcomes.outcomes_of` finds them.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scopes = scopes_of(next(iter(arms.values())))
    figure, axis = plt.subplots(figsize=(7.0, 0.9 + 0.32 * len(scopes) * len(arms)), constrained_layout=True)
    for row, scope in enumerate(scopes):
        for place, name in enumerate(arms):
            _draw_bar(axis, row + 0.8 * ((place + 0.5) / len(arms) - 0.5), 0.74 / len(arms), arms[name][scope], place)
    axis.set_yticks(range(len(scopes)), [scope.replace("_", " ") for scope in scopes])
    axis.invert_yaxis()
    axis.set_xlim(0, 100)
    axis.set_xlabel("rollouts solved, % (black: 95 % interval)")
    axis.spines[["top", "right"]].set_visible(False)
    handles = [plt.Rectangle((0, 0), 1, 1, color=COLOURS[place % len(COLOURS)]) for place in range(len(arms))]
    handles.append(plt.Rectangle((0, 0), 1, 1, color=WRONG, alpha=0.35))
    labels = [*arms, "failed at a wrong referent, order, place or count"]
    columns = len(labels) if sum(map(len, labels)) < 72 else 2  # what the figure is wide enough for
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, fontsize=9, frameon=False)
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130)
    plt.close(figure)
    return path


def scopes_of(found: Mapping[str, Outcome]) -> list[str]:
    """Return what is drawn of an arm: the mean and the memory types; of one task, that task."""
    types = [scope for scope in SCOPES if scope in found]
    tasks = [scope for scope in found if scope not in SCOPES]
    return tasks if len(tasks) == 1 else types


def _draw_bar(axis: Any, at: float, height: float, outcome: Outcome, place: int) -> None:
    """Draw one arm: solved, what was wrong behind it, and the interval of the first."""
    solved = 100 * (outcome.success.value or 0.0)
    low, high = (100 * bound for bound in outcome.success.interval or (0.0, 0.0))
    axis.barh(at, solved, height, color=COLOURS[place % len(COLOURS)])
    axis.barh(at, 100 * outcome.wrong_share, height, left=solved, color=WRONG, alpha=0.35)
    axis.plot([low, high], [at, at], color="black", linewidth=1.2)
    axis.text(1, at, f"{solved:.0f}", va="center", fontsize=8, color="white" if solved > 6 else "black")
