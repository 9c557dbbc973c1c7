"""A scene as one list of triangles."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.gl.drawlist import build_draw_list, disc


def test_draw_list_has_outward_faces() -> None:
    """Every primitive is closed and wound counter-clockwise: volumes by the divergence theorem are right."""
    spec = mujoco.MjSpec()
    kinds = {
        "mjGEOM_BOX": ([0.1, 0.2, 0.3], 8 * 0.1 * 0.2 * 0.3),
        "mjGEOM_SPHERE": ([0.1, 0, 0], 4 / 3 * np.pi * 0.1**3),
        "mjGEOM_ELLIPSOID": ([0.1, 0.2, 0.3], 4 / 3 * np.pi * 0.1 * 0.2 * 0.3),
        "mjGEOM_CYLINDER": ([0.1, 0.2, 0], np.pi * 0.1**2 * 0.4),
        "mjGEOM_CAPSULE": ([0.1, 0.2, 0], np.pi * 0.1**2 * 0.4 + 4 / 3 * np.pi * 0.1**3),
    }
    for kind, (size, _) in kinds.items():
        spec.worldbody.add_geom(type=getattr(mujoco.mjtGeom, kind), size=size, group=1)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 1, 1], group=0)  # not seen
    draw_list = build_draw_list(spec.compile())
    assert len(draw_list.geoms) == len(kinds)
    faces = draw_list.indices.reshape(-1, 3)
    for row, (_, expected) in enumerate(kinds.values()):
        mine = faces[draw_list.vertices["geom"][faces[:, 0]] == row]
        a, b, c = (draw_list.vertices["position"][mine[:, k]].astype(float) for k in range(3))
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(expected, rel=0.03)
        normals = draw_list.vertices["normal"][mine[:, 0]]
        assert np.all(np.einsum("ij,ij->i", normals, np.cross(b - a, c - a)) >= -1e-9)
    np.testing.assert_allclose(np.linalg.norm(draw_list.vertices["normal"], axis=1), 1, atol=1e-5)


def test_shape_that_is_not_drawn() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="endless", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], group=1)
    with pytest.raises(MemobenchError, match="'endless' is a plane, which is not drawn"):
        build_draw_list(spec.compile())


def test_disc_faces_up() -> None:
    points, _, _, triangles = disc()
    a, b, c = (points[triangles[:, k]] for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] >= -1e-12)
