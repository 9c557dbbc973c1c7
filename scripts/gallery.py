"""Draw the initial scenes of a suite's tasks.

python scripts/gallery.py                              # outputs/gallery/tasks.png
python scripts/gallery.py --out docs/figures           # the image in README
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.io import write_file
from lerobot_memobench.sim.simulation import RenderSettings, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import PUBLISHED, STRICT, Task

Pixels = NDArray[np.uint8]

LARGEST_FILE = 400_000
"""Maximum size of a figure, bytes; figures are committed."""
SEED = 7
BACKGROUND, INK = (250, 250, 248), (30, 30, 34)


def main() -> None:
    """Write the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/gallery"), help="output folder")
    parser.add_argument("--suite", choices=(PUBLISHED, STRICT), default=PUBLISHED, help="suite of the tasks")
    args = parser.parse_args()
    print(save(draw_tasks(task_names(suite=args.suite)), args.out / "tasks.png"))


def draw_tasks(names: Sequence[str] | None = None, size: int = 256) -> Image.Image:
    """Return the initial scenes of tasks (default: all published) by memory type, from the agentview camera."""
    sheets = []
    for memory_type, tasks in _by_type(names).items():
        cells = []
        for task in tasks:
            sim = Simulation(task, RenderSettings(size, size, "high"))
            sim.reset(SEED)
            cells.append((task.title, sim.render("agentview")))
        sheets.append(grid(cells, *_columns_and_label(names, size), memory_type))
    return stack(sheets)


def task_places(names: Sequence[str] | None = None, size: int = 256) -> dict[str, tuple[int, int]]:
    """Return the position of each task's image in `draw_tasks`, name -> (left, top), pixels."""
    places: dict[str, tuple[int, int]] = {}
    top = 0
    for memory_type, tasks in _by_type(names).items():
        titles = [task.title for task in tasks]
        sheet = layout(titles, (size, size), *_columns_and_label(names, size), memory_type)
        places |= {task.name: (x, top + y) for task, (x, y) in zip(tasks, sheet.places, strict=True)}
        top += sheet.height
    return places


def _by_type(names: Sequence[str] | None) -> dict[str, list[Task]]:
    tasks: dict[str, list[Task]] = {}
    for task in map(get_task, names or task_names()):
        tasks.setdefault(task.memory_type, []).append(task)
    return tasks


def _columns_and_label(names: Sequence[str] | None, size: int) -> tuple[int, int]:
    return min(5, max(map(len, _by_type(names).values()))), size * 19 // 256


# --- sheets ---


GAP = 6
"""Between images, pixels."""


class Layout(NamedTuple):
    """Lines of each label, (left, top) of each image, and the size of the sheet, pixels."""

    labels: list[list[str]]
    places: list[tuple[int, int]]
    width: int
    height: int


def layout(names: Sequence[str], image: tuple[int, int], columns: int, label: int, heading: str) -> Layout:
    """Return the layout of `grid` for images of equal size; the longest label of a row sets its height."""
    width, height = image
    font = ImageFont.load_default(label)
    labels = [_wrapped(name, font, width) for name in names]
    top, places = GAP + (2 * (label + 3) if heading else 0), []
    for start in range(0, len(names), columns):
        row = labels[start : start + columns]
        places += [(GAP + column * (width + GAP), top) for column in range(len(row))]
        top += height + (label + 3) * max(map(len, row)) + 2 * GAP
    return Layout(labels, places, columns * (width + GAP) + GAP, top)


def grid(cells: Sequence[tuple[str, Pixels]], columns: int, label: int = 12, heading: str = "") -> Image.Image:
    """Return images of equal size in rows, each above its label, below an optional heading."""
    height, width = cells[0][1].shape[:2]
    placed = layout([name for name, _ in cells], (width, height), columns, label, heading)
    sheet = Image.new("RGB", (placed.width, placed.height), BACKGROUND)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(label)
    draw.text((GAP, GAP), heading, fill=INK, font=ImageFont.load_default(round(1.3 * label)))
    for (_, image), lines, (x, y) in zip(cells, placed.labels, placed.places, strict=True):
        sheet.paste(Image.fromarray(image), (x, y))
        for number, words in enumerate(lines):
            draw.text((x + 1, y + height + 2 + number * (label + 3)), words, fill=INK, font=font)
    return sheet


def _wrapped(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int) -> list[str]:
    lines: list[str] = []
    for word in text.split():
        if lines and font.getlength(f"{lines[-1]} {word}") <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines


def stack(sheets: Sequence[Image.Image]) -> Image.Image:
    """Return sheets stacked vertically."""
    stacked = Image.new(
        "RGB", (max(sheet.width for sheet in sheets), sum(sheet.height for sheet in sheets)), BACKGROUND
    )
    top = 0
    for sheet in sheets:
        stacked.paste(sheet, (0, top))
        top += sheet.height
    return stacked


def save(sheet: Image.Image, path: Path) -> Path:
    """Write a PNG of at most `LARGEST_FILE` bytes: reduce colours first, then size."""
    content = _png(sheet)
    while len(content) > LARGEST_FILE:
        sheet = sheet.resize((sheet.width * 9 // 10, sheet.height * 9 // 10), Image.Resampling.LANCZOS)
        content = _png(sheet)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_file(path, content)


def _png(sheet: Image.Image) -> bytes:
    """Return a PNG with as many colours as fit into `LARGEST_FILE`, or the minimum."""
    for colours in (256, 160, 96):
        buffer = io.BytesIO()
        # Median cut alone turns small bright objects grey, such as a tomato on a table.
        reduced = sheet.quantize(colours, Image.Quantize.MEDIANCUT, kmeans=4, dither=Image.Dither.NONE)
        reduced.save(buffer, "PNG", optimize=True)
        if buffer.tell() <= LARGEST_FILE:
            break
    return buffer.getvalue()


if __name__ == "__main__":
    main()
