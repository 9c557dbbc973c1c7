"""Measure a detector on unseen labelled images: every visible object, whether it is detected, and its errors.

The result is one table, numbers as JSON, and images with the detections drawn in.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.optimize import linear_sum_assignment

from lerobot_memobench.datasets.lerobot_format.card import markdown as table
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of, write_file
from lerobot_memobench.perception.detector import Detections, Detector, detections
from lerobot_memobench.perception.geometry import depth_at_height, projected, rays
from lerobot_memobench.perception.objects import DRAWERS, LIT, PARTS, ObjectLocalizer
from lerobot_memobench.perception.visual_encoder import SIDE, VisualEncoder, resized
from lerobot_memobench.perception.weights import load_detector
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from research.detector.data import SCENES, Pictures
from research.detector.labels import Rows, images_of, kinds
from research.detector.randomisation import NEAR

VISIBLE = 30
"""Pixels of the rendered image (256 x 256) from which on an object should be detected."""
FAR = 5.0
"""Error from which on a detection is of something else, cm."""
BATCH = 32
VIEWS = ("third person", "wrist", "wrist, hand within 15 cm")
TABLE, NUMBERS, PICTURE = "detector_test.md", "detector_test.json", "detector_test.png"
COLUMNS, DRAWN_ROWS = 6, 4
"""Images in a row of the drawing, and its rows."""

OUTCOME = np.dtype(
    [
        ("kind", "u1"),
        ("camera", "u1"),
        ("scene", "u1"),
        ("near", "?"),
        ("error", "<f4"),
        ("space", "<f4"),
        ("joint", "<f4"),
        ("turn", "<f4"),
    ]
)
"""Outcome of a visible object in one image. ``near``: the hand is within `NEAR`. ``error``, cm, infinite where it is
missed: for the third-person camera on the level plane of its origin, for the wrist's across the line of sight.
``space``: of its position by the detected depth (wrist) or height (third person), cm. ``joint``: cm or rad; ``turn``:
degrees. Both NaN where there is none."""

OBJECT = np.dtype([("kind", "u1"), ("scene", "u1"), ("near", "?"), ("lit", "?"), ("said_lit", "?"), ("error", "<f4")])
"""Outcome of an object that a camera shows, by both cameras together. ``error``: of its position, cm, infinite where it
is missed. ``lit``: it stands in a highlight; ``said_lit``: it is detected so."""

Outcomes = NDArray[np.void]
Detect = Callable[[Rows], list[Detections]]
"""From labelled images to the detections of each."""
Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Evaluation:
    """A detector's evaluation.

    Attributes:
        kinds: names. fine, tokens, pooled: outcomes by each of `detector.READINGS`, (n,) of dtype `OUTCOME`.
        false: false detections per image. pictures: number of images. milliseconds: of one core for an image.
        objects: outcomes by both cameras together, of dtype `OBJECT`; false_objects: false ones.
    """

    kinds: Sequence[str]
    fine: Outcomes
    tokens: Outcomes
    pooled: Outcomes
    false: float
    pictures: int
    milliseconds: float
    objects: Outcomes
    false_objects: Outcomes


def evaluate(file: Path, folder: Path, pictures: Callable[[], Pictures]) -> str:
    """Evaluate the detector of a file and write table, numbers and drawing to a folder; return the table.

    Args:
        pictures: makes the labelled images, once the detector is known to be of today's kinds.

    Raises:
        MemobenchError: the file holds no detector, or one of other kinds.
    """
    detector = load_detector(file)
    if detector.kinds != kinds():
        raise MemobenchError(f"the detector of {file} knows other kinds of things than there are now; train it anew")
    images = pictures()
    fine, false = outcomes(detecting(detector), images)
    tokens, pooled = (outcomes(detecting(detector, reading), images)[0] for reading in ("tokens", "pooled"))
    took, objects = milliseconds(detector.encoder), object_outcomes(detector, images)
    evaluation = Evaluation(detector.kinds, fine, tokens, pooled, false, len(images), took, *objects)
    count = min(len(images), COLUMNS * DRAWN_ROWS)
    chosen = np.linspace(0, len(images) - 1, count).astype(np.int64)
    rows = images.rows(chosen - (chosen + np.arange(count)) % len(MJCF_CAMERAS))  # one camera's after the other's
    return write_report(evaluation, drawn(rows, detecting(detector)(rows), detector.kinds), folder)


def detecting(detector: Detector, reading: str = "fine") -> Detect:
    """Return a function that detects by one of `READINGS`."""

    @torch.inference_mode()
    def detect(rows: Rows) -> list[Detections]:
        return detections(detector(images_of(rows))[reading])

    return detect


def outcomes(detect: Detect, pictures: Pictures) -> tuple[Outcomes, float]:
    """Return the outcome of every visible object, (n,) of dtype `OUTCOME`, and false detections per image."""
    found, false = [np.zeros(0, OUTCOME)], 0
    for start in range(0, len(pictures), BATCH):
        rows = pictures.rows(np.arange(start, min(start + BATCH, len(pictures))))
        for row, detected in zip(rows, detect(rows), strict=True):
            things = row["things"][: row["count"]]
            matched = _matched(things["kind"], detected["kind"], partial(_index_errors, row, things, detected))
            false += len(detected) - int((matched >= 0).sum())
            found.append(_outcomes(row, things, detected, matched)[things["pixels"] >= VISIBLE])
    return np.concatenate(found), false / max(1, len(pictures))


def _outcomes(row: Rows, things: Rows, detected: Detections, matched: Indices) -> Outcomes:
    """Return the outcome of each object of an image."""
    found = np.zeros(len(things), OUTCOME)
    found["kind"], found["camera"], found["scene"] = things["kind"], row["camera"], row["scene"]
    found["near"] = np.linalg.norm(things["position"] - row["hand"], axis=1) <= NEAR
    found["error"] = found["space"] = np.inf
    found["joint"] = found["turn"] = np.nan
    there = matched >= 0
    mine, theirs = things[there], detected[matched[there]]
    found["error"][there] = _errors(row, mine, theirs)
    found["space"][there] = 100 * np.linalg.norm(_in_space(row, theirs) - mine["position"], axis=1)
    unit = np.where(mine["kind"] < len(DRAWERS), 100.0, 1.0)
    found["joint"][there] = unit * np.abs(theirs["joint"] - mine["joint"])
    angles = [np.arctan2(turn[:, 1], turn[:, 0]) for turn in (theirs["turn"], mine["turn"])]
    found["turn"][there] = np.degrees(np.abs(np.angle(np.exp(1j * (angles[0] - angles[1]))))) / 2
    return found


def _errors(row: Rows, things: Rows, detected: Detections) -> Array:
    """Return the errors of detections, broadcast with objects, cm: see `OUTCOME`."""
    sight = rays(detected["place"].astype(np.float64), row)
    position = things["position"].astype(np.float64)
    if row["camera"] == list(MJCF_CAMERAS).index("wrist"):
        at = row["eye"] + sight * projected(position, row)[1][..., None]
    else:
        at = _on_plane(row, sight, position[..., 2])
    return np.asarray(100 * np.linalg.norm(at - position, axis=-1))


def _index_errors(row: Rows, things: Rows, detected: Detections, mine: Indices, theirs: Indices) -> Array:
    return _errors(row, things[mine], detected[theirs])


def _in_space(row: Rows, detected: Detections) -> Array:
    """Return the detected positions (n, 3)."""
    sight = rays(detected["place"].astype(np.float64), row)
    if row["camera"] == list(MJCF_CAMERAS).index("wrist"):
        return np.asarray(row["eye"] + sight * detected["depth"][:, None])
    return _on_plane(row, sight, TABLE_TOP + detected["height"])


def _on_plane(row: Rows, sight: Array, height: Array) -> Array:
    """Return the points in which lines of sight (..., 3) meet level planes."""
    return np.asarray(row["eye"] + sight * depth_at_height(sight, height, row)[..., None])


def object_outcomes(detector: Detector, pictures: Pictures) -> tuple[Outcomes, Outcomes]:
    """Return the outcome of every visible object by both cameras together, as policies use detections.

    Args:
        pictures: both cameras' of each frame, one after the other.

    Returns:
        Outcomes (n,) of dtype `OBJECT`, and false objects (m,) likewise.
    """
    localizer = ObjectLocalizer(detector)
    found: list[Outcomes] = [np.zeros(0, OBJECT)]
    false: list[Outcomes] = [np.zeros(0, OBJECT)]
    for start in range(0, len(pictures), BATCH):
        rows = pictures.rows(np.arange(start, min(start + BATCH, len(pictures))))
        with torch.inference_mode():
            detected = detections(detector.detect(images_of(rows)))
        for pair in range(0, len(rows), len(MJCF_CAMERAS)):
            both = slice(pair, pair + len(MJCF_CAMERAS))
            right, wrong = _frame_outcomes(rows[both], localizer, detected[both])
            found.append(right)
            false.append(wrong)
    return np.concatenate(found), np.concatenate(false)


def _frame_outcomes(rows: Rows, localizer: ObjectLocalizer, detected: list[Detections]) -> tuple[Outcomes, Outcomes]:
    """Return the outcomes of one frame, and its false objects."""

    def near(where: Array) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(where - rows["hand"][0], axis=1) <= NEAR)

    names = [list(MJCF_CAMERAS)[row["camera"]] for row in rows]
    objects = localizer.objects(dict(zip(names, detected, strict=True)), dict(zip(names, rows, strict=True)))
    true = {(int(one["kind"]), *one["position"]): one for row in rows for one in row["things"][: row["count"]]}
    visible = {
        (int(one["kind"]), *one["position"])
        for row in rows
        for one in row["things"][: row["count"]]
        if one["pixels"] >= VISIBLE
    }
    found, places = np.zeros(len(true), OBJECT), np.array([one["position"] for one in true.values()]).reshape(-1, 3)
    found["kind"], found["scene"], found["error"] = [kind for kind, *_ in true], rows["scene"][0], np.inf
    found["near"] = near(places)
    found["lit"] = [one["lit"] for one in true.values()]
    found_kinds = np.array([one.kind for one in objects], np.int64)
    found_at = np.array([one.position for one in objects]).reshape(-1, 3)
    lit = np.array([one.lit > LIT for one in objects], bool)

    def errors(mine: Indices, theirs: Indices) -> Array:
        return np.asarray(100 * np.linalg.norm(places[mine] - found_at[theirs], axis=-1))

    matched = _matched(found["kind"], found_kinds, errors)
    there = matched >= 0
    found["error"][there] = errors(np.flatnonzero(there), matched[there])
    found["said_lit"][there] = lit[matched[there]]
    wrong = np.setdiff1d(np.arange(len(objects)), matched)
    false = np.zeros(len(wrong), OBJECT)
    false["kind"], false["scene"], false["near"] = found_kinds[wrong], rows["scene"][0], near(found_at[wrong])
    return found[[key in visible for key in true]], false


def _matched(true: Indices, found: Indices, errors: Callable[[Indices, Indices], Array]) -> Indices:
    """Match objects and detections of the same kind, each at most once, with the least sum of errors.

    Args:
        true, found: kinds of the objects and of the detections.
        errors: of detections by the indices of objects and detections, which broadcast, cm.

    Returns:
        The index of each object's detection, -1 for none.
    """
    matched = np.full(len(true), -1)
    for kind in np.intersect1d(true, found):
        mine, theirs = np.flatnonzero(true == kind), np.flatnonzero(found == kind)
        far = np.minimum(errors(mine[:, None], theirs[None]), FAR)
        for thing, detection in zip(*linear_sum_assignment(far), strict=True):
            if far[thing, detection] < FAR:
                matched[mine[thing]] = theirs[detection]
    return matched


def milliseconds(encoder: VisualEncoder, rounds: int = 30) -> float:
    """Return the encoder's time for an image of 256 x 256 on one core: the median, both cameras' at once."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    images = torch.randint(0, 256, (len(MJCF_CAMERAS), 3, 256, 256), dtype=torch.uint8)
    times = []
    try:
        with torch.inference_mode():
            for _ in range(1 + rounds):
                began = time.process_time()
                encoder(resized(images) / 255)
                times.append(1000 * (time.process_time() - began) / len(images))
    finally:
        torch.set_num_threads(threads)
    return float(np.median(times[1:]))


def write_report(evaluation: Evaluation, sheet: Image.Image, folder: Path) -> str:
    """Write table, numbers and drawing to a folder; return the table."""
    folder.mkdir(parents=True, exist_ok=True)
    found = numbers(evaluation)
    write_file(folder / NUMBERS, json.dumps(found, indent=1, allow_nan=False))
    with draft_of(folder / PICTURE) as draft:
        sheet.save(draft, "png")
    text = markdown(found)
    write_file(folder / TABLE, text)
    return text


def numbers(evaluation: Evaluation) -> dict[str, Any]:
    """Return the whole evaluation as JSON has it; infinite errors are null."""
    fine = evaluation.fine
    groups = [("all", fine), ("all, by tokens", evaluation.tokens), ("all, by pooled tokens", evaluation.pooled)]
    groups += [(f"all, {name}", fine[fine["scene"] == scene]) for scene, name in enumerate(SCENES)]
    groups += [(name, fine[fine["kind"] == kind]) for kind, name in enumerate(evaluation.kinds)]
    rows = [
        {"kind": name, "view": VIEWS[view], **_figures(_in_view(found, view))}
        for name, found in groups
        for view in range(len(VIEWS))
        if len(_in_view(found, view))
    ]
    return {
        "pictures": evaluation.pictures,
        "least_pixels": VISIBLE,
        "ms_per_picture": round(evaluation.milliseconds, 2),
        "false_detections_per_picture": round(evaluation.false, 3),
        "rows": rows,
        "objects": _object_rows(evaluation),
        "joints": [row for kind, name in enumerate(PARTS) for row in _joint_rows(fine, kind, name)],
    }


def _in_view(found: Outcomes, view: int) -> Outcomes:
    """Return the outcomes of one of `VIEWS`."""
    third = found["camera"] == list(MJCF_CAMERAS).index("agentview")
    return found[(third, ~third, ~third & found["near"])[view]]


def _figures(found: Outcomes) -> dict[str, float | int | None]:
    """Return the number of visible objects, the share detected, and percentiles of errors; a miss is infinite."""
    return {
        "shown": len(found),
        "found": float(np.isfinite(found["error"]).mean()) if len(found) else None,
        "median_cm": _percentile(found["error"], 50),
        "p90_cm": _percentile(found["error"], 90),
        "space_median_cm": _percentile(found["space"], 50),
        "turn_median_deg": _percentile(found["turn"][~np.isnan(found["turn"])], 50),
    }


def _percentile(values: NDArray[Any], percent: int) -> float | None:
    """A percentile, None where it is infinite or of nothing."""
    found = float(np.percentile(values, percent, method="higher")) if len(values) else math.inf
    return round(found, 4) if math.isfinite(found) else None


def _object_rows(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Return rows of objects by both cameras together, in each kind of scene, and of those that the hand is near."""
    rows = []
    for scene, name in enumerate(SCENES):
        found = evaluation.objects[evaluation.objects["scene"] == scene]
        false = evaluation.false_objects[evaluation.false_objects["scene"] == scene]
        near = f"{name}, hand within 15 cm"
        for which, some, none in ((name, found, false), (near, found[found["near"]], false[false["near"]])):
            if len(some):
                rows.append(
                    {
                        "scene": which,
                        "shown": len(some),
                        "found": float(np.isfinite(some["error"]).mean()),
                        "median_cm": _percentile(some["error"], 50),
                        "p90_cm": _percentile(some["error"], 90),
                        "false_per_shown": round(len(none) / len(some), 4),
                        "lit": int(some["lit"].sum()),
                        "lit_right": int((some["lit"] & some["said_lit"]).sum()),
                        "lit_wrong": int((~some["lit"] & some["said_lit"]).sum()),
                    }
                )
    return rows


def _joint_rows(fine: Outcomes, kind: int, name: str) -> list[dict[str, Any]]:
    found = fine[(fine["kind"] == kind) & ~np.isnan(fine["joint"])]
    return [
        {
            "part": name,
            "view": VIEWS[view],
            "unit": "cm" if kind < len(DRAWERS) else "rad",
            "found": len(_in_view(found, view)),
            "median": _percentile(_in_view(found, view)["joint"], 50),
            "p90": _percentile(_in_view(found, view)["joint"], 90),
        }
        for view in range(len(VIEWS))
        if len(_in_view(found, view))
    ]


def markdown(test: dict[str, Any]) -> str:
    """Return the table of an evaluation's numbers: error in cm, median / 90th percentile (share detected)."""
    cells: dict[str, dict[str, str]] = {}
    for row in test["rows"]:
        text = f"{_text(row['median_cm'])} / {_text(row['p90_cm'])} ({row['found']:.3f} of {row['shown']})"
        cells.setdefault(row["kind"], {})[row["view"]] = text
    for row in test["joints"]:
        text = f"{_text(row['median'], 3)} / {_text(row['p90'], 3)} {row['unit']}"
        cells.setdefault(f"{row['part']}: joint", {})[row["view"]] = text
    rows = [[name, *(found.get(view, "") for view in VIEWS)] for name, found in cells.items()]
    head = (
        f"Median / 90th percentile (share detected of how many shown by {test['least_pixels']} pixels or more), in "
        f"{test['pictures']} images; – is infinite: missed. {test['false_detections_per_picture']} false detections "
        f"per image, {test['ms_per_picture']} ms per image on one core."
    )
    objects = [
        [
            row["scene"],
            f"{_text(row['median_cm'])} / {_text(row['p90_cm'])} ({row['found']:.3f} of {row['shown']})",
            f"{row['false_per_shown']:.3f}",
            f"{row['lit_right']} of {row['lit']}, {row['lit_wrong']} wrong",
        ]
        for row in test["objects"]
    ]
    columns = ["objects, by both cameras", "error in space, cm", "false ones, per shown", "highlighted"]
    return f"{head}\n\n{table(['error, cm', *VIEWS], rows)}\n\n{table(columns, objects)}\n"


def _text(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def drawn(rows: Rows, detected: Sequence[Detections], kinds: Sequence[str]) -> Image.Image:
    """Return images beside one another: detections as green rings with their names, the true places as crosses."""
    sheet = Image.new("RGB", (COLUMNS * SIDE, -(-len(rows) // COLUMNS) * SIDE))
    for index, (row, found) in enumerate(zip(rows, detected, strict=True)):
        picture = Image.fromarray(row["pixels"].transpose(1, 2, 0))
        pen = ImageDraw.Draw(picture)
        things = row["things"][: row["count"]]
        for x, y in SIDE * projected(things["position"][things["pixels"] >= VISIBLE].astype(np.float64), row)[0]:
            pen.line((x - 3, y, x + 3, y), "white")
            pen.line((x, y - 3, x, y + 3), "white")
        for one in found:
            x, y = SIDE * one["place"].astype(float)
            pen.ellipse((x - 5, y - 5, x + 5, y + 5), outline="lime")
            pen.text((x + 7, y - 6), kinds[one["kind"]].replace("_", " "), "yellow")
        sheet.paste(picture, (index % COLUMNS * SIDE, index // COLUMNS * SIDE))
    return sheet
