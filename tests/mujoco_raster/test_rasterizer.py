"""Shapes are closed, and compiled functions round every operation."""

from __future__ import annotations

import pickle
from pathlib import Path

import mujoco
import numba
import numpy as np
import pytest
from numba.core import caching, config

from mujoco_raster.compiled import compiled
from mujoco_raster.drawlist import build_draw_list

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
    faces = draw_list.triangles
    for row, geom in enumerate(draw_list.geoms):
        _, expected = list(kinds.values())[geom]
        mine = faces[draw_list.vertices.row[faces[:, 0]] == row]
        a, b, c = (draw_list.vertices.position[mine[:, k]].astype(float) for k in range(3))
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(expected, rel=0.03)
        normals = draw_list.vertices.normal[mine[:, 0]]
        assert np.all(np.einsum("ij,ij->i", normals, np.cross(b - a, c - a)) >= -1e-9)
    np.testing.assert_allclose(np.linalg.norm(draw_list.vertices.normal, axis=1), 1, atol=1e-5)
