"""Draw initial scenes of tasks, objects from four sides, and fixtures open and closed.

python scripts/gallery.py --out outputs/gallery            # tasks.png, objects.png, fixtures.png
python scripts/gallery.py --only tasks --out docs/figures  # the picture in README
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.io import write_file
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import COLLISION_GROUP, VISUAL_GROUP
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP, build_kitchen
from lerobot_memobench.sim.assets.registry import build_asset
from lerobot_memobench.sim.rendering import RenderSettings, make_renderer
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import PUBLISHED, STRICT, Task

Pixels = NDArray[np.uint8]

LARGEST_FILE = 400_000
"""Maximum size of a figure, bytes; figures are committed."""
SEED = 7
FOVY = 30.0
"""Field of view of the turntable's cameras, degrees."""
FRONTS = {"flat_stove": 0.0, "microwave": -90.0, "wooden_cabinet": -90.0, "wooden_two_layer_shelf": -90.0}
"""Azimuth of a fixture's front, degrees."""
BACKGROUND, INK = (250, 250, 248), (30, 30, 34)
GROUND = (0.80, 0.79, 0.77, 1.0)
"""Uniform colour: a table's wood grain takes more bytes than the objects on it."""


class View(NamedTuple):
    """Position of a camera: angles in degrees, azimuth 0 on the agentview's side; distance in object sizes."""

    azimuth: float
    elevation: float = 32.0
    distance: float = 4.2


TURNTABLE = tuple(View(azimuth) for azimuth in (25.0, 115.0, 205.0, 295.0))
FRONT, SIDE = View(20.0, 30.0, 5.6), View(-40.0, 42.0, 5.6)


def main() -> None:
    """Write the selected figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/gallery"), help="output folder")
    parser.add_argument("--suite", choices=(PUBLISHED, STRICT), default=PUBLISHED, help="suite of the tasks")
    parser.add_argument("--only", choices=("tasks", "objects", "fixtures"), help="draw one figure")
    parser.add_argument("--classes", nargs="+", help="object classes; default: all of the catalogue")
    args = parser.parse_args()
    figures = {
        "tasks": lambda: draw_tasks(task_names(suite=args.suite)),
        "objects": lambda: draw_objects(args.classes),
        "fixtures": draw_fixtures,
    }
    for name, draw in figures.items():
        if args.only in (None, name):
            print(save(draw(), args.out / f"{name}.png"))


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
    """Return the position of each task's picture in `draw_tasks`, name -> (left, top), pixels."""
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


def draw_objects(classes: Sequence[str] | None = None, size: int = 112) -> Image.Image:
    """Return each object class (default: all of the catalogue) from four sides."""
    cells = [_cells(name, TURNTABLE, size)[0] for name in classes or catalogue_classes("objects")]
    return grid(cells, min(3, len(cells)), label=20)


def draw_fixtures(classes: Sequence[str] | None = None, size: int = 224) -> Image.Image:
    """Return each fixture from two sides, closed or off, then open or on."""
    cells = []
    for name in classes or catalogue_classes("fixtures"):
        cells += _cells(name, [v._replace(azimuth=v.azimuth + FRONTS.get(name, 0.0)) for v in (FRONT, SIDE)], size)
    return grid(cells, 2, label=16)


def catalogue_classes(kind: Literal["objects", "fixtures"]) -> list[str]:
    """Return the sorted classes of the published tasks' objects or fixtures, without the table."""
    classes = {name for task in task_names() for name in getattr(get_task(task), kind).values()}
    return sorted(classes - {"kitchen_table"})


def _cells(class_name: str, views: Sequence[View], size: int) -> list[tuple[str, Pixels]]:
    """Return labels and pictures of an instance: one, or two (closed or off, open or on) if it has joints."""
    spec = _plain_scene()
    asset = build_asset(spec, "thing", class_name)
    spec.body("thing").pos = [0.0, 0.0, TABLE_TOP - asset.bottom]
    low, high = np.array(asset.low), np.array(asset.high)
    middle = (low + high) / 2 + [0.0, 0.0, TABLE_TOP - asset.bottom]
    cameras = [f"view_{index}" for index in range(len(views))]
    for camera, view in zip(cameras, views, strict=True):
        _add_camera(spec, camera, middle, view, view.distance * float(np.linalg.norm(high - low)) / 2)
    model = spec.compile()
    data, renderer = mujoco.MjData(model), make_renderer(model, RenderSettings(size, size, "high"))
    states = ("off", "on") if asset.glow else ("closed", "open")
    labels = [f"{class_name}, {state}" for state in states] if asset.articulations else [class_name]
    cells = []
    for label, opened in zip(labels, (False, True), strict=False):
        _set_open(asset, model, data, opened)
        cells.append((label, np.hstack([renderer.draw(model, data, camera) for camera in cameras])))
    return cells


def _set_open(asset: Asset, model: mujoco.MjModel, data: mujoco.MjData, opened: bool) -> None:
    """Open or close all joints, and switch the burner on or off."""
    for articulation in asset.articulations.values():
        data.joint(articulation.joint).qpos[0] = articulation.open_q if opened else articulation.closed_q
    for geom in asset.glow:
        model.geom(geom).rgba = asset.glow_on if opened else asset.glow_off
    mujoco.mj_forward(model, data)


def _plain_scene() -> mujoco.MjSpec:
    """Return the kitchen's lights and cameras over uniform ground at table height; room and table are hidden."""
    spec = mujoco.MjSpec()
    build_kitchen(spec)
    for geom in [*spec.body("room").geoms, *spec.body("kitchen_table").geoms]:
        geom.group = COLLISION_GROUP
    ground = spec.body("kitchen_table").add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[9, 9, 0.01], pos=[0, 0, -0.0101], rgba=list(GROUND)
    )
    ground.group, ground.contype, ground.conaffinity = VISUAL_GROUP, 0, 0
    return spec


def _add_camera(spec: mujoco.MjSpec, name: str, target: NDArray[np.float64], view: View, distance: float) -> None:
    azimuth, elevation = np.radians(view.azimuth), np.radians(view.elevation)
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    frame, quaternion = np.stack([right, np.cross(back, right), back], axis=1), np.empty(4)
    mujoco.mju_mat2Quat(quaternion, frame.ravel())
    spec.worldbody.add_camera(name=name, pos=list(target + distance * back), quat=list(quaternion), fovy=FOVY)


# --- sheets ---


GAP = 6
"""Between pictures, pixels."""


class Layout(NamedTuple):
    """Lines of each label, (left, top) of each picture, and the size of the sheet, pixels."""

    labels: list[list[str]]
    places: list[tuple[int, int]]
    width: int
    height: int


def layout(names: Sequence[str], picture: tuple[int, int], columns: int, label: int, heading: str) -> Layout:
    """Return the layout of `grid` for pictures of equal size; the longest label of a row sets its height."""
    width, height = picture
    font = ImageFont.load_default(label)
    labels = [_wrapped(name, font, width) for name in names]
    top, places = GAP + (2 * (label + 3) if heading else 0), []
    for start in range(0, len(names), columns):
        row = labels[start : start + columns]
        places += [(GAP + column * (width + GAP), top) for column in range(len(row))]
        top += height + (label + 3) * max(map(len, row)) + 2 * GAP
    return Layout(labels, places, columns * (width + GAP) + GAP, top)


def grid(cells: Sequence[tuple[str, Pixels]], columns: int, label: int = 12, heading: str = "") -> Image.Image:
    """Return pictures of equal size in rows, each above its label, below an optional heading."""
    height, width = cells[0][1].shape[:2]
    placed = layout([name for name, _ in cells], (width, height), columns, label, heading)
    sheet = Image.new("RGB", (placed.width, placed.height), BACKGROUND)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(label)
    draw.text((GAP, GAP), heading, fill=INK, font=ImageFont.load_default(round(1.3 * label)))
    for (_, picture), lines, (x, y) in zip(cells, placed.labels, placed.places, strict=True):
        sheet.paste(Image.fromarray(picture), (x, y))
        for number, words in enumerate(lines):
            draw.text((x + 1, y + height + 2 + number * (label + 3)), words, fill=INK, font=font)
    return sheet


def _wrapped(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int) -> list[str]:
    """Break a text between words into lines of at most ``width`` pixels."""
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
