"""Draw the losses of a training."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lerobot_memobench.io import draft_of

STYLES = {"fine": "-", "tokens": ":", "pooled": "--"}
"""How a loss is drawn whose name begins with this word, in one colour with all whose names go on alike."""


def mean_of(window: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the mean of each number over the updates that tell it, in the order in which they first appear."""
    values = {name: [float(one[name]) for one in window if name in one] for name in dict.fromkeys(chain(*window))}
    return {name: sum(found) / len(found) for name, found in values.items()}


def draw_curve(
    points: Sequence[Mapping[str, float]],
    window: int,
    path: Path,
    *,
    marked: Mapping[str, Sequence[tuple[float, float]]] = MappingProxyType({}),
    hidden: Collection[str] = (),
    shares: Collection[str] = (),
    columns: int = 4,
) -> None:
    """Draw means over windows of so many updates to a PNG; nothing before the first.

    Args:
        marked: name -> losses beside these, each after so many updates.
        hidden: names of what is left out. shares: names of what is no loss, and runs from 0 to 1.
        columns: of the legend.
    """
    import matplotlib as mpl

    if not points:
        return
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 3.4), constrained_layout=True)
    looks = _looks(name for name in dict.fromkeys(chain(*points)) if name not in hidden)
    right = axis.twinx() if set(looks) & set(shares) else None
    updates = [window * (place + 1) for place in range(len(points))]
    for name, look in looks.items():
        own = right if right is not None and name in shares else axis
        own.plot(updates, [point.get(name) for point in points], **look, lw=1.2, label=name)
    for name, places in marked.items():
        if places:
            axis.plot(*zip(*places, strict=True), "o--", color="black", ms=3, lw=0.8, label=name)
    axis.set(xlabel="updates", ylabel="loss", yscale="log")
    if right is not None:
        right.set(ylabel="share", ylim=(0, 1))
    axis.grid(alpha=0.3, which="both", lw=0.5)
    figure.legend(loc="outside upper center", ncols=columns, fontsize=8, frameon=False)
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130, format="png")
    plt.close(figure)


def _looks(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return name -> style and colour of its line."""
    colours: dict[str, str] = {}
    looks = {}
    for name in names:
        first, _, rest = name.partition(" ")
        of = rest if first in STYLES else name
        looks[name] = {"linestyle": STYLES.get(first, "-"), "color": colours.setdefault(of, f"C{len(colours)}")}
    return looks
