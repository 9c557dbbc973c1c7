"""The figure of aliased pairs: moments that look the same and ask for different answers, side by side."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.necessity.study import Result, pictures_path
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import DRAWN

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image as Strip

LARGEST_FIGURE = 300_000
"""Bytes: the figure of the documentation is kept in the repository."""

CAMERAS = ("third person", "wrist")


def figure(out: Path, results: Sequence[Result]) -> bytes | None:
    """Return a PNG of a few aliased pairs: both moments side by side, and what is right at each; None without any.

    One pair within an episode and one between goals, the two ways in which memory is needed; of drawn tasks one of each
    family.
    """
    shown = _chosen(out, results)
    if not shown:
        return None
    found = _small_png(_drawn(shown))
    if len(found) > LARGEST_FIGURE:
        raise MemobenchError(f"the figure has {len(found)} bytes, expected at most {LARGEST_FIGURE}; draw it smaller")
    return found


def _chosen(out: Path, results: Sequence[Result]) -> list[tuple[Result, Strip]]:
    from PIL import Image

    shown: list[tuple[Result, Strip]] = []
    for result in results:
        if not result["examples"] or any(_kind(other) == _kind(result) for other, _ in shown):
            continue
        path = pictures_path(out, result["task"], result["referent"], result["examples"][0]["seed"])
        if path.is_file():
            shown.append((result, Image.open(path).convert("RGB")))
    return shown


def _kind(result: Result) -> str | bool:
    """Return the family of a drawn task; of others whether the first pair lies within one episode."""
    if result["referent"] == DRAWN:
        return get_task(result["task"]).family
    pair = result["examples"][0]
    return bool(pair["a"]["variant"] == pair["b"]["variant"])


def _drawn(shown: Sequence[tuple[Result, Strip]]) -> Figure:
    from matplotlib.figure import Figure

    plot = Figure(figsize=(10, 3.1 * len(shown)), layout="constrained")
    grid = plot.subplots(len(shown), 4, squeeze=False)
    for axes, (result, strip) in zip(grid, shown, strict=True):
        pair, side = result["examples"][0], strip.height
        for k, axis in enumerate(axes):
            axis.imshow(strip.crop((k * side, 0, (k + 1) * side, side)))
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_xlabel(CAMERAS[k % 2], fontsize=8)
        for axis, moment in ((axes[0], pair["a"]), (axes[2], pair["b"])):
            axis.set_title(f"step {moment['step']}: {_short(moment['answer'])}", fontsize=9, loc="left")
        axes[0].set_ylabel(_wrapped(result["task"]), fontsize=8)
    return plot


def _small_png(plot: Figure) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    plot.savefig(buffer, dpi=110 if len(plot.axes) <= 8 else 64, format="png")
    small = Image.open(buffer).convert("RGB").quantize(192, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    small.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _short(answer: str) -> str:
    return answer.strip("()").replace("_1", "").replace("_", " ")


def _wrapped(name: str, width: int = 26) -> str:
    return "\n".join(textwrap.wrap(name.replace("_", " "), width))
