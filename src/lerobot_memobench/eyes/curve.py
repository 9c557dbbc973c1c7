"""How the losses fell, as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lerobot_memobench.files import draft_of


def draw_curve(points: Sequence[Mapping[str, float]], window: int, path: Path) -> None:
    """Draw means of losses over windows of so many updates to a PNG; nothing before the first."""
    import matplotlib as mpl

    if not points:
        return
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 3.4), constrained_layout=True)
    updates = [window * (place + 1) for place in range(len(points))]
    for colour, name in enumerate(points[0]):
        style = "--" if name.startswith("pooled ") else "-"
        axis.plot(updates, [point[name] for point in points], style, color=f"C{colour % 4}", lw=1.2, label=name)
    axis.set(xlabel="updates", ylabel="loss", yscale="log")
    axis.grid(alpha=0.3, which="both", lw=0.5)
    figure.legend(loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130, format="png")
    plt.close(figure)
