"""How studies draw: without a window, and a figure is there as a whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lerobot_memobench.io import draft_of


def pyplot() -> Any:
    """Return Matplotlib's pyplot, drawing to files; imported where something is drawn."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def save(figure: Any, path: Path) -> Path:
    """Save a figure to ``path`` and close it; return the path."""
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130)
    pyplot().close(figure)
    return path
