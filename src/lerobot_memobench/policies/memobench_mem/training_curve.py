"""How the losses of a training run fell: kept beside each checkpoint as numbers and as a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_memobench.io import draw_curve, mean_of, read_json, write_file

PICTURE, NUMBERS = "training_curve.png", "training_curve.json"
WINDOW = 10
"""Updates that one point is the mean of."""
LOSS = "action_loss"
SHARES = ("align_top1",)
"""What is no loss, and runs from 0 to 1."""
HIDDEN = ("loss", "align_grad_norm", "align_temperature")
"""What is kept as numbers, and not drawn."""


class TrainingCurve:
    """Means of what a policy logs, over windows of updates.

    Attributes:
        points: one per whole window, name -> mean.
        held_out: one per look at episodes that are not trained on: after how many updates, and the actions' mean loss.
    """

    def __init__(self) -> None:
        self.points: list[dict[str, float]] = []
        self.held_out: list[dict[str, float]] = []
        self._window: list[dict[str, float]] = []
        self._unseen: list[dict[str, float]] = []

    def note(self, logged: Mapping[str, Any]) -> None:
        """Take in what one update logged; lists are left out."""
        self._end_look()
        self._window.append({name: float(value) for name, value in logged.items() if isinstance(value, int | float)})
        if len(self._window) == WINDOW:
            self.points.append(dict(sorted(mean_of(self._window).items())))
            self._window = []

    def note_held_out(self, logged: Mapping[str, Any]) -> None:
        """Take in what one batch of held-out episodes logged; those between two updates make one look."""
        self._unseen.append({LOSS: logged[LOSS]})

    def _end_look(self) -> None:
        if self._unseen:
            updates = WINDOW * len(self.points) + len(self._window)
            self.held_out.append({"updates": updates, **mean_of(self._unseen)})
            self._unseen = []

    def save(self, folder: Path) -> None:
        """Write numbers and picture to a checkpoint's folder; nothing before the first whole window."""
        self._end_look()
        if not self.points:
            return
        numbers = {"updates_per_point": WINDOW, "points": self.points, "held_out": self.held_out}
        write_file(folder / NUMBERS, json.dumps(numbers))
        looks = {f"{LOSS}, held out": [(look["updates"], look[LOSS]) for look in self.held_out]}
        draw_curve(self.points, WINDOW, folder / PICTURE, marked=looks, hidden=HIDDEN, shares=SHARES, columns=3)

    @classmethod
    def read(cls, folder: Path) -> TrainingCurve:
        """Return the curve of a checkpoint's folder, to go on with; an empty one where there is none."""
        found = cls()
        if (folder / NUMBERS).is_file():
            told = read_json(folder / NUMBERS, dict[str, Any], "remove it; the curve then begins anew")
            found.points, found.held_out = told["points"], told.get("held_out", [])
        return found
