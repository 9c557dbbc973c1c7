"""What a picture shows, by the simulator: its things, where they are, how much of them is seen, and the camera.

Places in a picture are fractions of its side, x to the right and y down, from its upper left corner.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_memobench.perception.kinds import kinds_of
from lerobot_memobench.perception.tower import SIDE, shrunk
from lerobot_memobench.sim.object_layout import SLOTS
from lerobot_memobench.sim.object_slots import ObjectSlots, is_lit
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation

MASK = 32
"""Side of the masks: each of their cells says what the picture shows in its middle."""

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
"""``pixels``: how many of the rendered picture (256 x 256) show it. ``anchor``: the middle of those, a place in the
picture. ``position``: of its origin in the world, m. ``joint``: m or rad, NaN without one.
``lit``: it stands in a highlight.
``turn``: cosine and sine of twice the angle at which its x axis lies in the picture (a half turn changes what it looks
like little); NaN of round things."""

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
"""One picture with its labels. ``mask``: kind + 1 of what is shown, 0 for none of the things. ``things``: the first
``count`` are seen. ``camera``: index into `MJCF_CAMERAS`. ``scene``: how the moment came about, see `pictures.SCENES`.
``hand``: of the grip site, m. ``eye``, ``turned``: position and rotation of the camera, which looks along -z;
``slope``: tangent of half its field of view."""

Rows = NDArray[np.void]
"""Pictures, of dtype `PICTURE`, or things, of dtype `THING`."""
Array = NDArray[np.float64]


def images_of(rows: Rows) -> torch.Tensor:
    """Return the pictures of rows (N,) as the tower takes them, float (N, 3, SIDE, SIDE) in [0, 1]."""
    return torch.from_numpy(rows["pixels"]).float() / 255


class Labeller:
    """Take labelled pictures of one simulation."""

    def __init__(self, sim: Simulation) -> None:
        self._sim, self._slots = sim, ObjectSlots(sim)
        self._kinds = kinds_of(sim, self._slots.things)
        self._round = {sim.model.body(name).id for name, asset in sim.assets.items() if asset.round}

    @cached_property
    def _cells(self) -> NDArray[np.int64]:
        """The middle pixel of each of the masks' cells, along one side."""
        side = self._sim.render_settings.height
        return ((np.arange(MASK) + 0.5) * side / MASK).astype(np.int64)

    def look(self, camera: str, scene: int = 0) -> Rows:
        """Return what a camera (`agentview` or `wrist`) sees now, one row () of `PICTURE`."""
        sim, row = self._sim, np.zeros((), PICTURE)
        image = torch.from_numpy(sim.render(camera)).permute(2, 0, 1)[None]
        row["pixels"] = shrunk(image)[0].round().to(torch.uint8).numpy()
        owners = self._slots.owners(sim.geoms(camera))
        row["mask"] = np.array([0, *(kind + 1 for kind in self._kinds)])[owners[np.ix_(self._cells, self._cells)] + 1]
        view = sim.model.camera(MJCF_CAMERAS[camera]).id
        seen = self._seen(owners, sim.data.cam_xmat[view].reshape(3, 3))
        row["things"][: len(seen)], row["count"] = seen, len(seen)
        row["camera"], row["scene"] = list(MJCF_CAMERAS).index(camera), scene
        row["hand"], row["eye"] = sim.eef_pose()[0], sim.data.cam_xpos[view]
        row["turned"] = sim.data.cam_xmat[view].reshape(3, 3)
        row["slope"] = np.tan(np.radians(float(sim.model.cam_fovy[view])) / 2)
        return row

    def _seen(self, owners: NDArray[np.int64], camera: Array) -> Rows:
        """Return the things (n,) of which at least a pixel is seen, given the rotation (3, 3) of the camera."""
        height, width = owners.shape
        there = owners >= 0
        rows, columns = np.nonzero(there)
        counts, across, down = (
            np.bincount(owners[there], weights, len(self._kinds)) for weights in (None, columns + 0.5, rows + 0.5)
        )
        found = np.zeros(len(self._kinds), THING)
        for index, thing in enumerate(self._slots.things):
            anchor = np.array([across[index] / width, down[index] / height]) / max(counts[index], 1)
            joint = np.nan if thing.joint is None else self._sim.data.qpos[thing.joint]
            position = self._sim.data.xpos[thing.body]
            lit, turn = is_lit(position, self._sim.highlights), self._turn(thing.body, camera)
            found[index] = (self._kinds[index], counts[index], anchor, position, joint, lit, turn)
        return found[counts > 0]

    def _turn(self, body: int, camera: Array) -> Array:
        """Return cosine and sine (2,) of twice the angle at which a body's x axis lies in the picture."""
        if body in self._round:
            return np.full(2, np.nan)
        x, y, _ = camera.T @ self._sim.data.xmat[body].reshape(3, 3)[:, 0]
        return np.array([x * x - y * y, 2 * x * y]) / max(x * x + y * y, 1e-9)


def projected(positions: Array, picture: Rows | Mapping[str, Array]) -> tuple[Array, Array]:
    """Return where points (..., 3) of the world are in pictures: places (..., 2), and depths (...) along the view, m.

    Args:
        picture: rows (...) of `PICTURE`, or their ``eye``, ``turned`` and ``slope``.
    """
    local = np.einsum("...ij,...i->...j", picture["turned"], positions - picture["eye"])
    depth = -local[..., 2]
    reach = np.maximum(np.abs(depth), 1e-3) * picture["slope"]
    return np.stack([1 + local[..., 0] / reach, 1 - local[..., 1] / reach], axis=-1) / 2, depth


def rays(places: Array, picture: Rows | Mapping[str, Array]) -> Array:
    """Return the lines of sight (..., 3) in the world through places (..., 2), one long along the camera's view."""
    slope = np.asarray(picture["slope"])
    across, up = (2 * places[..., 0] - 1) * slope, (1 - 2 * places[..., 1]) * slope
    local = np.stack([across, up, -np.ones_like(across)], axis=-1)
    return np.asarray(np.einsum("...ij,...j->...i", picture["turned"], local))


def level_depth(sight: Array, height: Array, picture: Rows | Mapping[str, Array]) -> Array:
    """Return the depth (...) at which lines of sight (..., 3) meet level planes; far away where they look up."""
    return np.asarray((height - picture["eye"][2]) / np.minimum(sight[..., 2], -1e-3))


def settle(sim: Simulation) -> None:
    """Bring all that depends on poses up to date after they were written."""
    mujoco.mj_fwdPosition(sim.model, sim.data)
