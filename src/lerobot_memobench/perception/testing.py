"""How well eyes see pictures they have never seen: every shown thing, whether it was found, and how far off."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from lerobot_memobench.perception.finding import found
from lerobot_memobench.perception.kinds import DRAWERS
from lerobot_memobench.perception.labels import Rows, images_of, level_depth, projected, rays
from lerobot_memobench.perception.objects import LIT, ObjectFinder
from lerobot_memobench.perception.pictures import Pictures
from lerobot_memobench.perception.tower import Tower, shrunk
from lerobot_memobench.perception.walk import NEAR
from lerobot_memobench.perception.weights import Eyes
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.sim.simulation import MJCF_CAMERAS

SHOWN = 30
"""Pixels of the rendered picture (256 x 256) from which on a thing should be found."""
FAR = 5.0
"""Error from which on something else was found, cm."""
BATCH = 32

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
"""What became of a thing that a picture shows. ``near``: the hand is within `NEAR`. ``error``, cm, infinite where it
was not found: for the third-person camera on the level plane of its origin, for the wrist's across the line of sight.
``space``: of its place in the world by the found depth (wrist) or height (third person), cm. ``joint``: cm or rad;
``turn``: degrees. Both NaN where there is nothing to say."""

OBJECT = np.dtype([("kind", "u1"), ("scene", "u1"), ("near", "?"), ("lit", "?"), ("said_lit", "?"), ("error", "<f4")])
"""What became of a thing that a camera shows, by both cameras together. ``error``: of its place in the world, cm,
infinite where it was not found. ``lit``: it stands in a highlight; ``said_lit``: so it is said."""

Things = NDArray[np.void]
See = Callable[[Rows], list[Things]]
"""From pictures to what was found in each, of dtype `finding.FOUND`."""
Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


def seeing(eyes: Eyes, reading: str = "fine") -> See:
    """Return how eyes see pictures, by one of `READINGS`."""

    @torch.inference_mode()
    def see(rows: Rows) -> list[Things]:
        return found(eyes(images_of(rows))[reading])

    return see


def outcomes(see: See, pictures: Pictures) -> tuple[Things, float]:
    """Return what became of every shown thing, (n,) of dtype `OUTCOME`, and false finds per picture."""
    told, false = [np.zeros(0, OUTCOME)], 0
    for start in range(0, len(pictures), BATCH):
        rows = pictures.rows(np.arange(start, min(start + BATCH, len(pictures))))
        for row, finds in zip(rows, see(rows), strict=True):
            things = row["things"][: row["count"]]
            matched = _matched(things["kind"], finds["kind"], partial(_off, row, things, finds))
            false += len(finds) - int((matched >= 0).sum())
            told.append(_told(row, things, finds, matched)[things["pixels"] >= SHOWN])
    return np.concatenate(told), false / max(1, len(pictures))


def object_outcomes(eyes: Eyes, pictures: Pictures) -> tuple[Things, Things]:
    """Return what became of every shown thing where policies see objects, which both cameras find together.

    Args:
        pictures: both cameras' of each moment, one after the other.

    Returns:
        Outcomes (n,) of dtype `OBJECT`, and the false ones (m,) likewise.
    """
    finder = ObjectFinder(eyes)
    told: list[Things] = [np.zeros(0, OBJECT)]
    false: list[Things] = [np.zeros(0, OBJECT)]
    for start in range(0, len(pictures), BATCH):
        rows = pictures.rows(np.arange(start, min(start + BATCH, len(pictures))))
        with torch.inference_mode():
            finds = found(eyes.find(images_of(rows)))
        for pair in range(0, len(rows), len(MJCF_CAMERAS)):
            both = slice(pair, pair + len(MJCF_CAMERAS))
            right, wrong = _objects(rows[both], finder, finds[both])
            told.append(right)
            false.append(wrong)
    return np.concatenate(told), np.concatenate(false)


def _objects(rows: Rows, finder: ObjectFinder, finds: list[Things]) -> tuple[Things, Things]:
    """Return the outcomes of one moment, and the false ones."""

    def near(where: Array) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(where - rows["hand"][0], axis=1) <= NEAR)

    names = [list(MJCF_CAMERAS)[row["camera"]] for row in rows]
    seen = finder.merged(dict(zip(names, finds, strict=True)), dict(zip(names, rows, strict=True)))
    true = {(int(one["kind"]), *one["position"]): one for row in rows for one in row["things"][: row["count"]]}
    shown = {key for row in rows for key in _shown(row)}
    told, places = np.zeros(len(true), OBJECT), np.array([one["position"] for one in true.values()]).reshape(-1, 3)
    told["kind"], told["scene"], told["error"] = [kind for kind, *_ in true], rows["scene"][0], np.inf
    told["near"] = near(places)
    told["lit"] = [one["lit"] for one in true.values()]
    kinds = np.array([one.kind for one in seen], np.int64)
    found_at = np.array([one.place for one in seen]).reshape(-1, 3)
    lit = np.array([one.lit > LIT for one in seen], bool)

    def off(mine: Numbers, theirs: Numbers) -> Array:
        return np.asarray(100 * np.linalg.norm(places[mine] - found_at[theirs], axis=-1))

    matched = _matched(told["kind"], kinds, off)
    there = matched >= 0
    told["error"][there], told["said_lit"][there] = off(np.flatnonzero(there), matched[there]), lit[matched[there]]
    wrong = np.setdiff1d(np.arange(len(seen)), matched)
    others = np.zeros(len(wrong), OBJECT)
    others["kind"], others["scene"], others["near"] = kinds[wrong], rows["scene"][0], near(found_at[wrong])
    return told[[key in shown for key in true]], others


def _shown(row: Rows) -> set[tuple[float, ...]]:
    things = row["things"][: row["count"]]
    return {(int(one["kind"]), *one["position"]) for one in things[things["pixels"] >= SHOWN]}


def _matched(kinds: Numbers, found_kinds: Numbers, off: Callable[[Numbers, Numbers], Array]) -> Numbers:
    """Return for each thing which find is of it, -1 for none: of its kind, each at most once, the nearest in all.

    Args:
        off: how far finds are from things by the numbers of both, which broadcast, cm.
    """
    matched = np.full(len(kinds), -1)
    for kind in np.intersect1d(kinds, found_kinds):
        mine, theirs = np.flatnonzero(kinds == kind), np.flatnonzero(found_kinds == kind)
        far = np.minimum(off(mine[:, None], theirs[None]), FAR)
        for thing, find in zip(*linear_sum_assignment(far), strict=True):
            if far[thing, find] < FAR:
                matched[mine[thing]] = theirs[find]
    return matched


def _off(row: Rows, things: Things, finds: Things, mine: Numbers, theirs: Numbers) -> Array:
    """Return `_errors` of things and finds by their numbers."""
    return _errors(row, things[mine], finds[theirs])


def _errors(row: Rows, things: Things, finds: Things) -> Array:
    """Return how far off finds (broadcast with things) are, cm: see `OUTCOME`."""
    sight = rays(finds["place"].astype(np.float64), row)
    position = things["position"].astype(np.float64)
    if row["camera"] == list(MJCF_CAMERAS).index("wrist"):
        at = row["eye"] + sight * projected(position, row)[1][..., None]
    else:
        at = _on_plane(row, sight, position[..., 2])
    return np.asarray(100 * np.linalg.norm(at - position, axis=-1))


def _on_plane(row: Rows, sight: Array, height: Array) -> Array:
    """Return where lines of sight (..., 3) meet level planes."""
    return np.asarray(row["eye"] + sight * level_depth(sight, height, row)[..., None])


def _told(row: Rows, things: Things, finds: Things, matched: Numbers) -> Things:
    """Return the outcome of each thing of a picture."""
    told = np.zeros(len(things), OUTCOME)
    told["kind"], told["camera"], told["scene"] = things["kind"], row["camera"], row["scene"]
    told["near"] = np.linalg.norm(things["position"] - row["hand"], axis=1) <= NEAR
    told["error"] = told["space"] = np.inf
    told["joint"] = told["turn"] = np.nan
    there = matched >= 0
    mine, theirs = things[there], finds[matched[there]]
    told["error"][there] = _errors(row, mine, theirs)
    told["space"][there] = 100 * np.linalg.norm(_in_space(row, theirs) - mine["position"], axis=1)
    unit = np.where(mine["kind"] < len(DRAWERS), 100.0, 1.0)
    told["joint"][there] = unit * np.abs(theirs["joint"] - mine["joint"])
    angles = [np.arctan2(turn[:, 1], turn[:, 0]) for turn in (theirs["turn"], mine["turn"])]
    told["turn"][there] = np.degrees(np.abs(np.angle(np.exp(1j * (angles[0] - angles[1]))))) / 2
    return told


def _in_space(row: Rows, finds: Things) -> Array:
    sight = rays(finds["place"].astype(np.float64), row)
    if row["camera"] == list(MJCF_CAMERAS).index("wrist"):
        return np.asarray(row["eye"] + sight * finds["depth"][:, None])
    return _on_plane(row, sight, TABLE_TOP + finds["height"])


def milliseconds(tower: Tower, rounds: int = 30) -> float:
    """Return how long the tower takes for a picture of 256 x 256 on one core: the median, both cameras' at once."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            pictures = torch.randint(0, 256, (len(MJCF_CAMERAS), 3, 256, 256), dtype=torch.uint8)
            tower(shrunk(pictures) / 255)
            return float(np.median([_once(tower, pictures) for _ in range(rounds)]))
    finally:
        torch.set_num_threads(threads)


def _once(tower: Tower, pictures: torch.Tensor) -> float:
    began = time.process_time()
    tower(shrunk(pictures) / 255)
    return 1000 * (time.process_time() - began) / len(pictures)
