"""How the losses of a training run fell: kept beside each checkpoint as numbers and as a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_memobench.files import draft_of, write_file
from lerobot_memobench.files.reading import read_json

PICTURE, NUMBERS = "training_curve.png", "training_curve.json"
WINDOW = 10
"""Updates that one point is the mean of."""
SHARES = ("align_top1",)
"""What is no loss, and runs from 0 to 1."""


class TrainingCurve:
    """Means of what a policy logs, over windows of updates.

    Attributes:
        points: one per whole window, name -> mean.
    """

    def __init__(self) -> None:
        self.points: list[dict[str, float]] = []
        self._window: list[dict[str, float]] = []

    def note(self, logged: Mapping[str, Any]) -> None:
        """Take in what one update logged; lists are left out."""
        self._window.append({name: float(value) for name, value in logged.items() if isinstance(value, int | float)})
        if len(self._window) == WINDOW:
            self.points.append(_mean(self._window))
            self._window = []

    def save(self, folder: Path) -> None:
        """Write numbers and picture to a checkpoint's folder; nothing before the first whole window."""
        if not self.points:
            return
        write_file(folder / NUMBERS, json.dumps({"updates_per_point": WINDOW, "points": self.points}))
        with draft_of(folder / PICTURE) as draft:
            _draw(self.points, draft)

    @classmethod
    def read(cls, folder: Path) -> TrainingCurve:
        """Return the curve of a checkpoint's folder, to go on with; an empty one where there is none."""
        found = cls()
        if (folder / NUMBERS).is_file():
            found.points = read_json(folder / NUMBERS, dict[str, Any], "remove it; the curve then begins anew")[
                "points"
            ]
        return found


def _mean(window: list[dict[str, float]]) -> dict[str, float]:
    names = sorted(set().union(*window))
    values = {name: [numbers[name] for numbers in window if name in numbers] for name in names}
    return {name: sum(found) / len(found) for name, found in values.items()}


def _draw(points: list[dict[str, float]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    names = sorted(set().union(*points) - {"loss", "align_grad_norm", "align_temperature"})
    figure, axis = plt.subplots(figsize=(6, 3.4), constrained_layout=True)
    shares = axis.twinx() if set(names) & set(SHARES) else None
    updates = [WINDOW * (place + 1) for place in range(len(points))]
    for colour, name in enumerate(names):
        where = shares if shares is not None and name in SHARES else axis
        where.plot(updates, [point.get(name) for point in points], color=f"C{colour}", lw=1.2, label=name)
    axis.set(xlabel="updates", ylabel="loss", yscale="log")
    if shares is not None:
        shares.set(ylabel="share", ylim=(0, 1))
    axis.grid(alpha=0.3, which="both", lw=0.5)
    figure.legend(loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(path, dpi=130, format="png")
    plt.close(figure)
