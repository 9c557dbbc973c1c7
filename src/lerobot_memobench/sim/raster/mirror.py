"""Reflections: MuJoCo's renderer mirrors a scene in the upper side of one box or plane, the first that reflects."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
_REFLECTING = (mujoco.mjtGeom.mjGEOM_PLANE.value, mujoco.mjtGeom.mjGEOM_BOX.value)


@dataclass(frozen=True)
class Mirror:
    """A geom that reflects.

    Attributes:
        rows: of its geom in the draw list.
        height: of its upper side in its frame, m.
        reflectance: what part of the colours is reflected, 0 to 1.
    """

    rows: NDArray[np.int64]
    height: float
    reflectance: float

    def plane(self, table: Floats) -> tuple[Floats, Floats]:
        """Return a point of the upper side (3,) and its normal (3,) in the world."""
        pose = table[self.rows[0]]
        return pose[:3, 3] + np.float32(self.height) * pose[:3, 2], pose[:3, 2]


def find_mirror(model: mujoco.MjModel, geoms: NDArray[np.int64]) -> Mirror | None:
    """Return the first geom of a draw list's rows that reflects, None without one."""
    for geom in np.unique(geoms):
        material = int(model.geom_matid[geom])
        if material < 0 or model.geom_type[geom] not in _REFLECTING or model.mat_reflectance[material] <= 0:
            continue
        box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX.value
        height = float(model.geom_size[geom, 2]) if box else 0.0
        return Mirror(np.flatnonzero(geoms == geom), height, float(model.mat_reflectance[material]))
    return None


def mirrored(matrix: Floats, point: Floats, normal: Floats) -> Floats:
    """Return a camera's matrix (4, 4) for the mirrored scene, the picture turned left to right.

    Turned once in space and once in the picture, faces stay clockwise.
    """
    mirror = np.eye(4)
    mirror[:3, :3] -= 2.0 * np.outer(normal, normal)
    mirror[:3, 3] = 2.0 * (normal @ point) * normal
    turned: Floats = (np.diag([-1.0, 1.0, 1.0, 1.0]) @ matrix @ mirror).astype(np.float32)
    return turned


def cropped(matrix: Floats, whole: tuple[int, ...], corner: tuple[int, int], shape: tuple[int, ...]) -> Floats:
    """Return a camera's matrix (4, 4) for a part of its picture.

    Args:
        matrix: of the whole picture.
        whole: its height and width.
        corner: column and row at which the part begins.
        shape: height and width of the part.
    """
    crop = np.eye(4)
    for axis in range(2):
        pixels, part = whole[1 - axis], shape[1 - axis]
        crop[axis, axis] = pixels / part
        crop[axis, 3] = (pixels - 2 * corner[axis]) / part - 1.0
    part_of: Floats = (crop @ matrix).astype(np.float32)
    return part_of
