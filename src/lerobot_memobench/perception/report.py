"""What a test of eyes found, as one table, as numbers, and as pictures with the found things drawn into them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lerobot_memobench.datasets.lerobot_format.card import markdown as table
from lerobot_memobench.io import draft_of, write_file
from lerobot_memobench.perception.kinds import DRAWERS, PARTS
from lerobot_memobench.perception.labels import SIDE, Rows, projected
from lerobot_memobench.perception.pictures import SCENES
from lerobot_memobench.perception.testing import SHOWN, Things
from lerobot_memobench.sim.simulation import MJCF_CAMERAS

VIEWS = ("third person", "wrist", "wrist, hand within 15 cm")
TABLE, NUMBERS, PICTURE = "eyes_test.md", "eyes_test.json", "eyes_test.png"
COLUMNS = 6
"""How many pictures stand in a row."""


@dataclass(frozen=True)
class Examined:
    """A test of eyes.

    Attributes:
        kinds: names. told: outcomes by the finer map, (n,) of dtype `testing.OUTCOME`; tokens, pooled: by all tokens,
            and by the pooled ones.
        false: false finds per picture. pictures: how many were looked at. milliseconds: of one core for a picture.
        objects: outcomes by both cameras together, of dtype `testing.OBJECT`; no_objects: false ones.
    """

    kinds: Sequence[str]
    told: Things
    tokens: Things
    pooled: Things
    false: float
    pictures: int
    milliseconds: float
    objects: Things
    no_objects: Things


def in_view(told: Things, view: int) -> Things:
    """Return the outcomes of one of `VIEWS`."""
    third = told["camera"] == list(MJCF_CAMERAS).index("agentview")
    return told[(third, ~third, ~third & told["near"])[view]]


def figures(told: Things) -> dict[str, float | int | None]:
    """Return how many things were shown, the share found, and errors; what is not found is infinitely far off."""
    return {
        "shown": len(told),
        "found": float(np.isfinite(told["error"]).mean()) if len(told) else None,
        "median_cm": _rank(told["error"], 50),
        "p90_cm": _rank(told["error"], 90),
        "space_median_cm": _rank(told["space"], 50),
        "turn_median_deg": _rank(told["turn"][~np.isnan(told["turn"])], 50),
    }


def _rank(values: NDArray[Any], percent: int) -> float | None:
    """A percentile, None where it is infinite or of nothing."""
    found = float(np.percentile(values, percent, method="higher")) if len(values) else math.inf
    return round(found, 4) if math.isfinite(found) else None


def numbers(tested: Examined) -> dict[str, Any]:
    """Return the whole test as JSON has it; errors that are infinite are null."""
    groups = [("all", tested.told), ("all, by tokens", tested.tokens), ("all, by pooled tokens", tested.pooled)]
    groups += [(f"all, {name}", tested.told[tested.told["scene"] == scene]) for scene, name in enumerate(SCENES)]
    groups += [(name, tested.told[tested.told["kind"] == kind]) for kind, name in enumerate(tested.kinds)]
    rows = [
        {"kind": name, "view": VIEWS[view], **figures(in_view(told, view))}
        for name, told in groups
        for view in range(len(VIEWS))
        if len(in_view(told, view))
    ]
    return {
        "pictures": tested.pictures,
        "least_pixels": SHOWN,
        "ms_per_picture": round(tested.milliseconds, 2),
        "false_finds_per_picture": round(tested.false, 3),
        "rows": rows,
        "objects": _object_rows(tested),
        "joints": [row for kind, name in enumerate(PARTS) for row in _joint_rows(tested.told, kind, name)],
    }


def _object_rows(tested: Examined) -> list[dict[str, Any]]:
    """What is found by both cameras together, in each kind of scene, and of that what the hand is near."""
    rows = []
    for scene, name in enumerate(SCENES):
        told = tested.objects[tested.objects["scene"] == scene]
        false = tested.no_objects[tested.no_objects["scene"] == scene]
        near = f"{name}, hand within 15 cm"
        for which, some, none in ((name, told, false), (near, told[told["near"]], false[false["near"]])):
            if len(some):
                found = np.isfinite(some["error"])
                rows.append(
                    {
                        "scene": which,
                        "shown": len(some),
                        "found": float(found.mean()),
                        "median_cm": _rank(some["error"], 50),
                        "p90_cm": _rank(some["error"], 90),
                        "false_per_shown": round(len(none) / len(some), 4),
                        "lit": int(some["lit"].sum()),
                        "lit_right": int((some["lit"] & some["said_lit"]).sum()),
                        "lit_wrong": int((~some["lit"] & some["said_lit"]).sum()),
                    }
                )
    return rows


def _joint_rows(told: Things, kind: int, name: str) -> list[dict[str, Any]]:
    found = told[(told["kind"] == kind) & ~np.isnan(told["joint"])]
    return [
        {
            "part": name,
            "view": VIEWS[view],
            "unit": "cm" if kind < len(DRAWERS) else "rad",
            "found": len(in_view(found, view)),
            "median": _rank(in_view(found, view)["joint"], 50),
            "p90": _rank(in_view(found, view)["joint"], 90),
        }
        for view in range(len(VIEWS))
        if len(in_view(found, view))
    ]


def markdown(test: dict[str, Any]) -> str:
    """Return the table of a test's numbers: error in cm, median / 90th percentile (share found), by kind and view."""
    cells: dict[str, dict[str, str]] = {}
    for row in test["rows"]:
        text = f"{_text(row['median_cm'])} / {_text(row['p90_cm'])} ({row['found']:.3f} of {row['shown']})"
        cells.setdefault(row["kind"], {})[row["view"]] = text
    for row in test["joints"]:
        text = f"{_text(row['median'], 3)} / {_text(row['p90'], 3)} {row['unit']}"
        cells.setdefault(f"{row['part']}: joint", {})[row["view"]] = text
    rows = [[name, *(found.get(view, "") for view in VIEWS)] for name, found in cells.items()]
    said = (
        f"Median / 90th percentile (share found of how many shown by {test['least_pixels']} pixels or more), in "
        f"{test['pictures']} pictures; – is infinite: not found. {test['false_finds_per_picture']} false finds per "
        f"picture, {test['ms_per_picture']} ms per picture on one core."
    )
    together = [
        [
            row["scene"],
            f"{_text(row['median_cm'])} / {_text(row['p90_cm'])} ({row['found']:.3f} of {row['shown']})",
            f"{row['false_per_shown']:.3f}",
            f"{row['lit_right']} of {row['lit']}, {row['lit_wrong']} wrong",
        ]
        for row in test["objects"]
    ]
    head = ["objects, by both cameras", "error in space, cm", "false ones, per shown", "highlighted"]
    return f"{said}\n\n{table(['error, cm', *VIEWS], rows)}\n\n{table(head, together)}\n"


def _text(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def drawn(rows: Rows, finds: Sequence[Things], kinds: Sequence[str]) -> Image.Image:
    """Return pictures beside one another: found things as green rings with their names, the true places as crosses."""
    sheet = Image.new("RGB", (COLUMNS * SIDE, -(-len(rows) // COLUMNS) * SIDE))
    for index, (row, things) in enumerate(zip(rows, finds, strict=True)):
        picture = Image.fromarray(row["pixels"].transpose(1, 2, 0))
        pen = ImageDraw.Draw(picture)
        shown = row["things"][: row["count"]]
        for x, y in SIDE * projected(shown["position"][shown["pixels"] >= SHOWN].astype(np.float64), row)[0]:
            pen.line((x - 3, y, x + 3, y), "white")
            pen.line((x, y - 3, x, y + 3), "white")
        for thing in things:
            x, y = SIDE * thing["place"].astype(float)
            pen.ellipse((x - 5, y - 5, x + 5, y + 5), outline="lime")
            pen.text((x + 7, y - 6), kinds[thing["kind"]].replace("_", " "), "yellow")
        sheet.paste(picture, (index % COLUMNS * SIDE, index // COLUMNS * SIDE))
    return sheet


def write_report(tested: Examined, sheet: Image.Image, folder: Path) -> str:
    """Write table, numbers and picture to a folder; return the table."""
    folder.mkdir(parents=True, exist_ok=True)
    found = numbers(tested)
    write_file(folder / NUMBERS, json.dumps(found, indent=1, allow_nan=False))
    with draft_of(folder / PICTURE) as draft:
        sheet.save(draft, "png")
    text = markdown(found)
    write_file(folder / TABLE, text)
    return text
