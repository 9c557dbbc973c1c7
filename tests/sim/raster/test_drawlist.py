"""A scene as one list of triangles."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.raster.drawlist import DrawList, build_draw_list
from lerobot_memobench.sim.raster.shapes import disc, mesh_in_file
from lerobot_memobench.sim.rendering import SHADOWLESS_BODIES
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task


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
    faces = draw_list.triangles
    for row, (_, expected) in enumerate(kinds.values()):
        mine = faces[draw_list.vertices["row"][faces[:, 0]] == row]
        a, b, c = (draw_list.vertices["position"][mine[:, k]].astype(float) for k in range(3))
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(expected, rel=0.03)
        normals = draw_list.vertices["normal"][mine[:, 0]]
        assert np.all(np.einsum("ij,ij->i", normals, np.cross(b - a, c - a)) >= -1e-9)
    np.testing.assert_allclose(np.linalg.norm(draw_list.vertices["normal"], axis=1), 1, atol=1e-5)


def test_shape_that_is_not_drawn() -> None:
    spec = mujoco.MjSpec()
    spec.add_hfield(name="hills", size=[1, 1, 1, 0.1], nrow=2, ncol=2, userdata=[0.0, 1.0, 1.0, 0.0])
    spec.worldbody.add_geom(name="land", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hills", group=1)
    with pytest.raises(MemobenchError, match="'land' has the type hfield, which is not drawn"):
        build_draw_list(spec.compile())


def test_disc_faces_up() -> None:
    points, _, _, triangles = disc()
    a, b, c = (points[triangles[:, k]] for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] >= -1e-12)


WEDGE = np.array([(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0, 0, 0.1)])
WEDGE_FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
HORN = np.array([0.3, 0.3, 0.4])


def wedge(points: np.ndarray, faces: np.ndarray) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.add_mesh(name="wedge", uservert=points.ravel().tolist(), userface=faces.ravel().tolist())
    turned = np.array([0.8, 0.2, -0.4, 0.4])
    body = spec.worldbody.add_body(pos=[1.0, 2.0, 3.0], quat=(turned / np.linalg.norm(turned)).tolist())
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="wedge", group=1)
    return spec.compile()


def in_world(draw_list: DrawList, model: mujoco.MjModel, what: str) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    turned = draw_list.vertices[what] @ data.geom_xmat[0].reshape(3, 3).T
    return turned + data.geom_xpos[0] if what == "position" else turned


def test_finer_mesh_has_the_pose_of_the_coarse_one() -> None:
    """The compiler turns each mesh into its own axes, and one with another corner has others."""
    coarse = wedge(WEDGE, WEDGE_FACES)
    fine = wedge(np.vstack([WEDGE, HORN]), np.vstack([WEDGE_FACES[:3], (1, 2, 4), (2, 3, 4), (3, 1, 4)]))
    assert np.abs(coarse.mesh_quat - fine.mesh_quat).max() > 0.05
    ours, theirs = build_draw_list(coarse, meshes={"wedge": mesh_in_file(fine, 0)}), build_draw_list(fine)
    assert len(ours.triangles) == 6
    for place in in_world(theirs, fine, "position"):
        distance = np.linalg.norm(in_world(ours, coarse, "position") - place, axis=1)
        assert distance.min() < 1e-6
    assert len(build_draw_list(coarse, meshes={"another": mesh_in_file(fine, 0)}).triangles) == 4


def test_edges_of_a_finer_mesh_are_sharp() -> None:
    """Each corner of a wedge has its faces' normals, as MuJoCo's renderer draws it, not their mean."""
    model = wedge(WEDGE, WEDGE_FACES)
    sharp = build_draw_list(model, meshes={"wedge": mesh_in_file(model, 0)})
    straight = build_draw_list(model, as_mujoco=True).vertices
    for what in ("position", "normal"):
        np.testing.assert_allclose(straight[what], sharp.vertices[what], atol=1e-6)
    faces = sharp.triangles
    a, b, c = (sharp.vertices["position"][faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    for corner in range(3):
        agreement = np.einsum("ij,ij->i", sharp.vertices["normal"][faces[:, corner]], flat)
        assert agreement.min() > 0.8 - 1e-5


def test_static_rows_come_first() -> None:
    """Doors, the hand and objects move; the microwave's body and the arm's base do not."""
    sim = Simulation(get_task("open_and_close_the_microwave"))
    listed = build_draw_list(sim.model, SHADOWLESS_BODIES)
    names = np.array([sim.model.body(sim.model.geom_bodyid[geom]).name for geom in listed.geoms])
    still, moving = set(names[: listed.still]), set(names[listed.still :])
    assert {"microwave_1", "robot0_link0", "mount0_pedestal", *SHADOWLESS_BODIES} <= still
    assert {"robot0_link1", "white_bowl_1", "plate_1"} <= moving
    assert {body for body in moving if body.startswith("microwave_1_")}, "its door"
    assert set(names[~listed.casting]) == set(SHADOWLESS_BODIES)
    np.testing.assert_array_equal(np.unique(listed.vertices["row"]), np.arange(len(listed.geoms)))
