"""Cached images change no pixel, shapes are closed, and compiled functions round every operation."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numba
import numpy as np
import pytest
from numba.core import caching, config

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.raster.compiled import compiled
from lerobot_memobench.sim.raster.drawlist import build_draw_list
from lerobot_memobench.sim.raster.highlights import Highlight
from lerobot_memobench.sim.raster.rasterizer import Rasterizer
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task

SCENES = {
    "put_the_tomato_into_the_top_drawer_of_the_cabinet": ("wooden_cabinet_1_top_level", -0.12),
    "open_and_close_the_microwave": ("microwave_1_microjoint", -1.5),
    "turn_on_the_stove_and_turn_it_off": ("flat_stove_1_button", 1.0),
}
"""A task with a fixture, and where its door, drawer or knob is open or on."""
REACH = np.array([0.6, -0.5, -0.8, 0.2, 0.0, 0.5, 1.0])


def states(sims: list[Simulation], joint: str, opened: float) -> Iterator[str]:
    """Bring simulations of one scene into states that differ in their still rows, and name them."""
    for k, sim in enumerate(sims):
        sim.reset(7 + k)
    yield "fixtures at different places"
    sims[0].step(REACH)
    sims[1].data.joint(joint).qpos[0] = opened
    mujoco.mj_step1(sims[1].model, sims[1].data)
    yield "one moved, one open"
    sims[0].highlights = (Highlight((0.1, 0.0, 0.902), 0.12),)
    yield "one highlighted"
    sims[0].set_state(sims[1].state(), sims[1].fixture_poses())
    yield "one as the other"
    sims[1].reset(9)
    yield "one reset"


@pytest.mark.parametrize("task", SCENES)
def test_frames_do_not_depend_on_caches(task: str) -> None:
    """They equal those of a new renderer, and nearly those of a renderer without static rows.

    Levels of textures are chosen per visible part of a surface, and objects in front of it may divide it.
    """
    settings = RenderSettings(128, 128)
    sims = [Simulation(get_task(task), settings) for _ in range(2)]
    sims[0].reset(7)
    drawing, _, draw_list = sims[0]._drawing()
    others = {
        most: Rasterizer(drawing, listed, 128, 128)
        for most, listed in {0: draw_list, 2: replace(draw_list, still=0)}.items()
    }
    for state in states(sims, *SCENES[task]):
        for sim in sims:
            for name, camera in MJCF_CAMERAS.items():
                ours = sim.render(name).astype(int)
                for most, other in others.items():
                    other._still.clear()
                    model, data, _ = sim._drawing()
                    off = np.abs(ours - other.draw(model, data, camera, sim.highlights))
                    assert off.max() <= most, f"{state}, {name}"


@pytest.mark.parametrize("place", [np.nan, 1e9])
def test_non_finite_state_is_refused(place: float) -> None:
    sim = Simulation(get_task("open_and_close_the_microwave"), RenderSettings(32, 32))
    sim.reset(7)
    expected = sim.render()
    sim.data.joint(f"{next(iter(sim.task.objects))}_joint0").qpos[:3] = place
    for draw in (sim.render, sim.visible_bodies):
        with pytest.raises(MemobenchError, match="expected a finite state"):
            draw()
    sim.reset(7)
    np.testing.assert_array_equal(sim.render(), expected)


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
