"""Measure a detector on unseen labelled images, by both cameras together, as policies use it.

The result is a table in Markdown and its rows in JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from lerobot_memobench.datasets.card import markdown as table
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.perception.detector import Detections, detections, load_detector
from lerobot_memobench.perception.objects import LIT, ObjectLocalizer
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from research.detector.data import SCENES, Pictures
from research.detector.labels import Rows, images_of, kinds
from research.detector.randomisation import NEAR

VISIBLE = 30
"""Pixels of a rendered image (256 x 256) from which on an object should be detected."""
LARGEST_ERROR = 5.0
"""Distance from which on a detection counts as one of another object, cm."""
TABLE, NUMBERS = "detector_test.md", "detector_test.json"

OBJECT = np.dtype(
    [("kind", "u1"), ("scene", "u1"), ("near", "?"), ("lit", "?"), ("detected_lit", "?"), ("error", "<f4")]
)
"""Outcome of an object that a camera shows. ``near``: the hand is within `NEAR`. ``error``: of its position, cm,
infinite if it is missed. ``lit``: it is in a highlight; ``detected_lit``: the detector agrees."""

Outcomes = NDArray[np.void]
"""Outcomes (n,) of dtype `OBJECT`."""
Localise = Callable[[Rows], tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]]
"""From the images of one frame, one of each camera, to kinds (n,), positions (n, 3), m, and whether lit (n,)."""


def evaluate(file: Path, folder: Path, pictures: Callable[[], Pictures]) -> str:
    """Evaluate the detector of a file on images, both cameras' of each frame in turn, and return the written table."""
    detector = load_detector(file)
    if detector.kinds != kinds():
        raise MemobenchError(f"the detector of {file} knows other kinds of objects than this version; train a new one")
    found = figures(*outcomes(localising(ObjectLocalizer(detector)), pictures()))
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / NUMBERS, json.dumps(found, indent=1, allow_nan=False))
    text = results_table(found)
    write_file(folder / TABLE, text)
    return text


def localising(localizer: ObjectLocalizer) -> Localise:
    """Return a function that places the objects of a frame in the world."""

    @torch.inference_mode()
    def localise(rows: Rows) -> Any:
        found: Sequence[Detections] = detections(localizer.detector(images_of(rows)))
        names = [list(MJCF_CAMERAS)[row["camera"]] for row in rows]
        objects = localizer.objects(dict(zip(names, found, strict=True)), dict(zip(names, rows, strict=True)))
        return (
            np.array([one.kind for one in objects], np.int64),
            np.array([one.position for one in objects]).reshape(-1, 3),
            np.array([one.lit > LIT for one in objects], bool),
        )

    return localise


def outcomes(localise: Localise, pictures: Pictures) -> tuple[Outcomes, Outcomes]:
    """Return the outcomes of visible objects (n,) and false detections (m,); images are both cameras' of each frame."""
    right: list[Outcomes] = [np.zeros(0, OBJECT)]
    wrong: list[Outcomes] = [np.zeros(0, OBJECT)]
    for start in range(0, len(pictures), len(MJCF_CAMERAS)):
        rows = pictures.rows(np.arange(start, start + len(MJCF_CAMERAS)))
        found, false = _frame_outcomes(rows, *localise(rows))
        right.append(found)
        wrong.append(false)
    return np.concatenate(right), np.concatenate(wrong)


def _frame_outcomes(
    rows: Rows, found_kinds: NDArray[np.int64], found_at: NDArray[np.float64], lit: NDArray[np.bool_]
) -> tuple[Outcomes, Outcomes]:
    shown = [one for row in rows for one in row["things"][: row["count"]]]
    true = {(int(one["kind"]), *one["position"]): one for one in shown}
    visible = {(int(one["kind"]), *one["position"]) for one in shown if one["pixels"] >= VISIBLE}
    places = np.array([one["position"] for one in true.values()]).reshape(-1, 3)

    def near(where: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(where - rows["hand"][0], axis=1) <= NEAR)

    found = np.zeros(len(true), OBJECT)
    found["kind"], found["scene"], found["error"] = [kind for kind, *_ in true], rows["scene"][0], np.inf
    found["near"], found["lit"] = near(places), [one["lit"] for one in true.values()]
    errors = 100 * np.linalg.norm(places[:, None] - found_at[None], axis=-1)
    matched = match(found["kind"], found_kinds, errors)
    there = np.flatnonzero(matched >= 0)
    found["error"][there] = errors[there, matched[there]]
    found["detected_lit"][there] = lit[matched[there]]
    wrong = np.setdiff1d(np.arange(len(found_kinds)), matched)
    false = np.zeros(len(wrong), OBJECT)
    false["kind"], false["scene"], false["near"] = found_kinds[wrong], rows["scene"][0], near(found_at[wrong])
    return found[[key in visible for key in true]], false


def match(true: NDArray[np.integer], found: NDArray[np.int64], errors: NDArray[np.float64]) -> NDArray[np.int64]:
    """Match objects and detections of the same kind, each at most once, with the smallest sum of errors.

    Args:
        true: (n,) kinds of the objects. found: (m,) kinds of the detections. errors: (n, m) distances, cm.

    Returns:
        (n,) index of each object's detection, -1 for none.
    """
    matched = np.full(len(true), -1)
    for kind in np.intersect1d(true, found):
        mine, theirs = np.flatnonzero(true == kind), np.flatnonzero(found == kind)
        costs = np.minimum(errors[np.ix_(mine, theirs)], LARGEST_ERROR)
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            if costs[row, column] < LARGEST_ERROR:
                matched[mine[row]] = theirs[column]
    return matched


def figures(found: Outcomes, false: Outcomes) -> list[dict[str, Any]]:
    """Return a row for each kind of scene, for objects near the hand in each, and for each kind of object."""
    groups: list[tuple[str, Outcomes, Outcomes]] = []
    for scene, name in enumerate(SCENES):
        right, wrong = (one[one["scene"] == scene] for one in (found, false))
        groups += [(name, right, wrong), (f"{name}, hand within 15 cm", right[right["near"]], wrong[wrong["near"]])]
    groups += [(name, found[found["kind"] == kind], false[false["kind"] == kind]) for kind, name in enumerate(kinds())]
    return [
        {
            "objects": name,
            "shown": len(right),
            "detected": float(np.isfinite(right["error"]).mean()),
            "median_cm": _percentile(right["error"], 50),
            "p90_cm": _percentile(right["error"], 90),
            "false_per_shown": round(len(wrong) / len(right), 4),
            "lit": int(right["lit"].sum()),
            "lit_right": int((right["lit"] & right["detected_lit"]).sum()),
            "lit_wrong": int((~right["lit"] & right["detected_lit"]).sum()),
        }
        for name, right, wrong in groups
        if len(right)
    ]


def _percentile(values: NDArray[Any], percent: int) -> float | None:
    found = float(np.percentile(values, percent, method="higher"))
    return round(found, 4) if math.isfinite(found) else None


def results_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of `figures`."""
    cells = [
        [
            row["objects"],
            f"{_text(row['median_cm'])} / {_text(row['p90_cm'])} ({row['detected']:.3f} of {row['shown']})",
            f"{row['false_per_shown']:.3f}",
            f"{row['lit_right']} of {row['lit']}, {row['lit_wrong']} wrong",
        ]
        for row in rows
    ]
    head = (
        f"Error in space, cm: median / 90th percentile (share detected of the objects shown by {VISIBLE} pixels or "
        "more); – is infinite."
    )
    return f"{head}\n\n{table(['objects', 'error, cm', 'false detections per object', 'highlighted'], cells)}\n"


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
