"""Shapes are closed, compiled functions round every operation, and no visible triangle is skipped."""

from __future__ import annotations

import pickle
from pathlib import Path

import mujoco
import numba
import numpy as np
import pytest
from numba.core import caching, config

from mujoco_raster.compiled import compiled
from mujoco_raster.drawlist import POSITION, ROW, TABLE_LINES, build_draw_list
from mujoco_raster.geometry import Shapes, Target, clip_space, draw_triangles, set_planes
from mujoco_raster.shapes import distinct_rows
from mujoco_raster.view import Camera, camera_matrix

# --- compiled functions ---


def fused(a: float, b: float, c: float) -> float:
    return a * b + c


@pytest.mark.parametrize("kept", [True, False])
def test_compiled_functions_round_every_operation(kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not kept:
        monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
    function = compiled(fused)
    a, b = np.float64(1 + 2**-30), np.float64(1 - 2**-30)
    assert function(a, b, np.float64(-1.0)) == 0.0  # -2**-60 where the product is not rounded


def test_cache_of_a_version_with_other_modules_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    assert compiled(fused)(1.0, 2.0, 3.0) == 5.0
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(pickle.dumps(numba.__version__) + b"cno_such_module\nParameters\n.")
    assert compiled(fused)(1.0, 2.0, 3.0) == 5.0
    assert b"no_such_module" not in index.read_bytes()


# --- the list of triangles ---


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
    draw_list = build_draw_list(spec.compile(), groups=(1,))
    assert len(draw_list.geoms) == len(kinds)
    faces, origin = draw_list.triangles, draw_list.origin
    for row, geom in enumerate(draw_list.geoms):
        _, expected = list(kinds.values())[geom]
        mine = faces[origin[faces[:, 0], ROW] == row]
        a, b, c = (draw_list.points[origin[mine[:, k], POSITION]].astype(float) for k in range(3))
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(expected, rel=0.03)
        normals = draw_list.vertices[mine[:, 0], :3]
        assert np.all(np.einsum("ij,ij->i", normals, np.cross(b - a, c - a)) >= -1e-9)
    np.testing.assert_allclose(np.linalg.norm(draw_list.vertices[:, :3], axis=1), 1, atol=1e-5)


# --- triangles of an image ---


@pytest.mark.parametrize("size", [1e-5, 1e-3, 0.1])
@pytest.mark.parametrize(("distance", "squeezed"), [(0.3, 1.0), (2.0, 1.0), (2.0, 1e-3), (20.0, 1.0)])
def test_no_triangle_that_is_skipped_would_show(size: float, distance: float, squeezed: float) -> None:
    """Rounding can turn small triangles that are seen edge-on; they must not be skipped."""
    rng = np.random.default_rng(0)
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    camera = Camera(distance * frame[:, 2], frame, (2.0, 2.0), (0.0, 0.0), still=True)
    scale = np.diag([1.0, 1.0, squeezed])
    count = 20_000
    centre = rng.uniform(-0.1, 0.1, (count, 3)) @ scale
    corners = centre[:, None] + rng.normal(0.0, size, (count, 3, 3)) @ scale
    corners[::2, 1] = centre[::2] + rng.uniform(-size, size, (count // 2, 1)) * (centre[::2] - camera.position)
    corners[::2, 0] = centre[::2]  # the camera is in the plane of every second triangle
    position = np.ascontiguousarray((corners @ np.linalg.inv(scale)).reshape(-1, 3).T.astype(np.float32))
    points, planes = np.arange(3 * count, dtype=np.int32).reshape(-1, 3), np.empty((4, count), np.float32)
    set_planes(position, points, planes)
    ends = np.array([0, 3 * count], np.int32), np.array([0, count], np.int32)
    shapes = Shapes(points, points, position, *ends, planes, np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    table = np.zeros((1, TABLE_LINES, 4), np.float32)
    table[0, :3, :3] = scale
    clip, target = clip_space(shapes), Target(np.zeros((64, 64), np.float32), np.full((64, 64), -1, np.int32))
    matrix = camera_matrix(mujoco.MjModel.from_xml_string("<mujoco/>"), camera)
    draw_triangles(shapes, np.zeros(1, np.int32), table, matrix, np.float32(0.01), np.float32(50.0), clip, target)
    a, b, c = np.stack([clip.x, clip.y, clip.w], axis=1).astype(float)[points].transpose(1, 0, 2)
    volume = np.einsum("ti,ti->t", a, np.cross(c, b))  # positive if the triangle is drawn
    assert not (volume[~clip.front] > 0.0).any()
    assert 0.1 < clip.front.mean() < 0.9


def test_distinct_rows_are_in_order_of_first_use() -> None:
    rows = np.random.default_rng(0).integers(-3, 3, (5000, 4)).astype(np.int32)
    distinct, index = distinct_rows(rows)
    np.testing.assert_array_equal(distinct[index], rows)
    assert len(distinct) == len(np.unique(rows, axis=0))
    first = [index.tolist().index(k) for k in range(len(distinct))]
    assert first == sorted(first)
