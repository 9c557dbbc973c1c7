"""Label images by the simulator: visible objects, their positions and numbers of pixels, and the camera.

Places in an image are fractions of its side, x to the right and y down, from its upper left corner.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.objects import DRAWERS, PARTS, View
from lerobot_memobench.perception.visual_encoder import SIDE, area_averaged
from lerobot_memobench.sim.mjcf import known_classes
from lerobot_memobench.sim.object_layout import SLOTS
from lerobot_memobench.sim.object_slots import ObjectSlots, Thing, classes, is_lit
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation

MASK = 32
"""Side of the masks; a cell holds the kind in its centre."""

THING = np.dtype(
    [
        ("kind", "u1"),
        ("pixels", "<u4"),
        ("anchor", "<f4", 2),
        ("position", "<f4", 3),
        ("joint", "<f4"),
        ("lit", "?"),
        ("turn", "<f4", 2),
    ]
)
"""Label of an object. ``pixels``: how many of the rendered image (256 x 256) show it. ``anchor``: their centre, a place
in the image. ``position``: in the world, m, as in object slots. ``joint``: m or rad, NaN without one. ``lit``: it is in
a highlight. ``turn``: cosine and sine of twice the angle of its x axis in the image (a half turn changes its looks
little); NaN of round objects."""

PICTURE = np.dtype(
    [
        ("pixels", "u1", (3, SIDE, SIDE)),
        ("mask", "u1", (MASK, MASK)),
        ("things", THING, SLOTS),
        ("count", "u1"),
        ("camera", "u1"),
        ("scene", "u1"),
        ("hand", "<f4", 3),
        ("eye", "<f4", 3),
        ("turned", "<f4", (3, 3)),
        ("slope", "<f4"),
    ]
)
"""A labelled image. ``mask``: visible kind + 1, 0 for background. ``things``: the first ``count`` are visible.
``camera``: index into `MJCF_CAMERAS`. ``scene``: index into `data.SCENES`. ``hand``: position of the grip site, m.
``eye``, ``turned``, ``slope``: see `geometry.View`."""

Rows = NDArray[np.void]
"""Labelled images, of dtype `PICTURE`, or labels of objects, of dtype `THING`."""
Array = NDArray[np.float64]


def kinds() -> tuple[str, ...]:
    """Return the names of the kinds of objects, in the order of their indices."""
    return (*PARTS, *known_classes())


def kinds_of(sim: Simulation, things: list[Thing]) -> list[int]:
    """Return the index of the kind of each object of a scene."""
    regions = {
        int(sim.model.joint(part.joint).qposadr[0]): region
        for asset in sim.assets.values()
        for region, part in asset.articulations.items()
    }
    names = [
        regions[thing.joint].replace("_region", "_drawer")
        if thing.joint is not None and classes()[thing.kind] == "drawer"
        else classes()[thing.kind]
        for thing in things
    ]
    for name in names:
        if name not in kinds():
            raise MemobenchError(f"the detector knows {', '.join(DRAWERS)}, and {name!r} is none; leave its task out")
    return [kinds().index(name) for name in names]


def projected(positions: Array, view: View) -> tuple[Array, Array]:
    """Project points (..., 3) of the world: places (..., 2) in the image, and depths (...) along the view, m."""
    local = np.einsum("...ij,...i->...j", view["turned"], positions - view["eye"])
    depth = -local[..., 2]
    # Points in the camera's plane have no place; the bound keeps theirs finite.
    reach = np.maximum(np.abs(depth), 1e-3) * view["slope"]
    return np.stack([1 + local[..., 0] / reach, 1 - local[..., 1] / reach], axis=-1) / 2, depth


def images_of(rows: Rows) -> torch.Tensor:
    """Return the images of rows (N,) as the encoder takes them, float (N, 3, SIDE, SIDE) in [0, 1]."""
    return torch.from_numpy(rows["pixels"]).float() / 255


class Labeller:
    """Take labelled images of one simulation."""

    def __init__(self, sim: Simulation) -> None:
        self._sim, self._slots = sim, ObjectSlots(sim)
        self._kinds = kinds_of(sim, self._slots.things)
        self._round = {sim.model.body(name).id for name, asset in sim.assets.items() if asset.round}

    @cached_property
    def _cells(self) -> NDArray[np.int64]:
        side = self._sim.render_settings.height
        return ((np.arange(MASK) + 0.5) * side / MASK).astype(np.int64)

    def take(self, camera: str, scene: int = 0) -> Rows:
        """Return the present image of a camera (`agentview` or `wrist`), one row () of `PICTURE`."""
        sim, row = self._sim, np.zeros((), PICTURE)
        image = torch.from_numpy(sim.render(camera)).permute(2, 0, 1)[None]
        row["pixels"] = area_averaged(image)[0].round().to(torch.uint8).numpy()
        owners = self._slots.owners(sim.visible_bodies(camera))
        row["mask"] = np.array([0, *(kind + 1 for kind in self._kinds)])[owners[np.ix_(self._cells, self._cells)] + 1]
        view = sim.model.camera(MJCF_CAMERAS[camera]).id
        visible = self._visible(owners, sim.data.cam_xmat[view].reshape(3, 3))
        row["things"][: len(visible)], row["count"] = visible, len(visible)
        row["camera"], row["scene"] = list(MJCF_CAMERAS).index(camera), scene
        row["hand"], row["eye"] = sim.eef_pose()[0], sim.data.cam_xpos[view]
        row["turned"] = sim.data.cam_xmat[view].reshape(3, 3)
        row["slope"] = np.tan(np.radians(float(sim.model.cam_fovy[view])) / 2)
        return row

    def _visible(self, owners: NDArray[np.int64], camera: Array) -> Rows:
        """Return the labels (n,) of objects that a pixel or more shows, given the rotation (3, 3) of the camera."""
        height, width = owners.shape
        there = owners >= 0
        rows, columns = np.nonzero(there)
        counts, across, down = (
            np.bincount(owners[there], weights, len(self._kinds)) for weights in (None, columns + 0.5, rows + 0.5)
        )
        labels = np.zeros(len(self._kinds), THING)
        for index, thing in enumerate(self._slots.things):
            anchor = np.array([across[index] / width, down[index] / height]) / max(counts[index], 1)
            joint = np.nan if thing.joint is None else self._sim.data.qpos[thing.joint]
            position = self._slots.position(thing)
            lit, turn = is_lit(position, self._sim.highlights), self._turn(thing.body, camera)
            labels[index] = (self._kinds[index], counts[index], anchor, position, joint, lit, turn)
        return labels[counts > 0]

    def _turn(self, body: int, camera: Array) -> Array:
        if body in self._round:
            return np.full(2, np.nan)
        x, y, _ = camera.T @ self._sim.data.xmat[body].reshape(3, 3)[:, 0]
        return np.array([x * x - y * y, 2 * x * y]) / max(x * x + y * y, 1e-9)
