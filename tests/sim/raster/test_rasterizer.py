"""Cached images change no pixel, and the light is that of MuJoCo's renderer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.raster.drawlist import VISUAL_GROUP, build_draw_list
from lerobot_memobench.sim.raster.geometry import Shapes, Target, clip_space, draw_triangles
from lerobot_memobench.sim.raster.highlights import Highlight
from lerobot_memobench.sim.raster.rasterizer import MAX_STILL_STATES, Rasterizer
from lerobot_memobench.sim.rendering import QUALITIES, SHADOWLESS_BODIES, RenderSettings
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


@pytest.mark.parametrize(
    ("task", "quality"), [*((task, "default") for task in SCENES), ("turn_on_the_stove_and_turn_it_off", "fast")]
)
def test_frames_do_not_depend_on_caches(task: str, quality: str) -> None:
    """They equal those of a new renderer, and nearly those of a renderer without static rows.

    Levels of textures are chosen per visible part of a surface, and objects in front of it may divide it.
    """
    settings = RenderSettings(128, 128, quality)
    sims = [Simulation(get_task(task), settings) for _ in range(2)]
    model, draw_list = sims[0].model, build_draw_list(sims[0].model, SHADOWLESS_BODIES)
    others = {
        most: Rasterizer(model, listed, 128, 128, QUALITIES[quality].shadow_map)
        for most, listed in {0: draw_list, 2: replace(draw_list, still=0)}.items()
    }
    for state in states(sims, *SCENES[task]):
        for sim in sims:
            for name, camera in MJCF_CAMERAS.items():
                ours = sim.render(name).astype(int)
                for most, other in others.items():
                    other._still.clear()
                    other._shown = None
                    off = np.abs(ours - other.draw(sim.model, sim.data, camera, sim.highlights))
                    assert off.max() <= most, f"{state}, {name}"


@pytest.mark.parametrize("place", [np.nan, np.inf, 1e9])
def test_non_finite_state_is_refused(place: float) -> None:
    sim = Simulation(get_task("open_and_close_the_microwave"), RenderSettings(32, 32))
    sim.reset(7)
    expected = sim.render()
    kept = sim.data.geom_xpos.copy()
    sim.data.geom_xpos[sim.model.geom_group == VISUAL_GROUP] = place
    for draw in (sim.render, sim.geoms):
        with pytest.raises(MemobenchError, match="expected a finite state"):
            draw()
    sim.data.geom_xpos[:] = kept
    np.testing.assert_array_equal(sim.render(), expected)


def test_the_cache_of_still_states_is_bounded() -> None:
    sim = Simulation(get_task("open_and_close_the_microwave"), RenderSettings(32, 32))
    rasterizer = Rasterizer(sim.model, build_draw_list(sim.model, SHADOWLESS_BODIES), 32, 32, 64)
    for seed in range(MAX_STILL_STATES + 2):
        sim.reset(seed)
        rasterizer.draw(sim.model, sim.data, "agentview")
    assert len(rasterizer._still) == MAX_STILL_STATES


def test_triangle_partly_behind_the_camera() -> None:
    """It is seen beyond the edge, away from the part behind the camera: here far outside of the picture."""
    corners = np.array([[-0.5, 0.9, 0.01], [0.0, 0.93, -0.05], [0.5, 0.9, 0.01]], np.float32)
    matrix, table = np.eye(4, dtype=np.float32)[[0, 1, 2, 2]], np.zeros((1, 5, 4), np.float32)
    table[0, :3, :3] = np.eye(3)
    for order in ([0, 1, 2], [2, 1, 0]):
        vertices, faces = np.array([0, 3], np.int32), np.array([0, 1], np.int32)
        shapes = Shapes(
            corners, vertices, np.array([order], np.int32), faces, np.zeros((1, 3), np.float32), np.ones((1, 3), "f4")
        )
        target = Target(np.zeros((64, 64), np.float32), np.full((64, 64), -1, np.int32))
        near, far = np.float32(1e-3), np.float32(50.0)
        draw_triangles(shapes, np.zeros(1, np.int32), table, matrix, near, far, clip_space(3, 1), target)
        assert (target.triangle == -1).all()


# --- a scene with the features of LIBERO's scenes ---


def textured_scene() -> mujoco.MjModel:
    """Return a scene with spots, directional light, cube and flat textures, a mirror and a translucent box."""
    spec, shapes = mujoco.MjSpec(), mujoco.mjtGeom
    spec.visual.headlight.ambient = [0.3, 0.3, 0.3]
    _add_material(spec, "floor", (64, 64), repeat=(3, 3), uniform=True)
    _add_material(spec, "picture", (64, 32), repeat=(2, 1), uniform=False)
    spec.add_material(name="mirror", rgba=[0.2, 0.2, 0.2, 1], reflectance=0.6)
    _add_material(spec, "cube", (6 * 64, 64), repeat=(1, 1), uniform=False)
    _add_material(spec, "one side", (64, 64), repeat=(1, 1), uniform=False, cube=True)
    spec.add_material(name="shiny", rgba=[0.8, 0.3, 0.2, 1], specular=0.8, shininess=0.7)
    lights, world = mujoco.mjtLightType, spec.worldbody
    world.add_light(pos=[1, 1, 4], dir=[0, -0.15, -1], type=lights.mjLIGHT_SPOT, diffuse=[0.9] * 3, castshadow=False)
    world.add_light(
        pos=[-1, -1, 3], dir=[0.3, 0.3, -1], type=lights.mjLIGHT_SPOT, cutoff=30, exponent=5, castshadow=False,
        attenuation=[1, 0.05, 0.02],
    )  # fmt: skip
    world.add_light(dir=[0.5, 0, -1], type=lights.mjLIGHT_DIRECTIONAL, ambient=[0.1, 0, 0], castshadow=False)
    for kind, size, place, material in (
        (shapes.mjGEOM_PLANE, [3, 3, 0.125], [0, 0, 0], "floor"),
        (shapes.mjGEOM_BOX, [0.4, 0.3, 0.2], [0, 0, 0.3], "cube"),
        (shapes.mjGEOM_BOX, [0.2, 0.3, 0.1], [-0.8, 0.4, 0.2], "picture"),
        (shapes.mjGEOM_BOX, [0.2, 0.1, 0.2], [1.2, -0.3, 0.3], "one side"),
        (shapes.mjGEOM_SPHERE, [0.25, 0, 0], [0.8, 0.5, 0.4], "shiny"),
        (shapes.mjGEOM_BOX, [0.5, 0.5, 0.05], [0.8, 0.3, 0.0], "mirror"),
    ):
        world.add_geom(type=kind, size=size, pos=place, material=material, group=1, quat=[0.95, 0.1, 0.05, 0.3])
    world.add_geom(
        type=shapes.mjGEOM_BOX, size=[0.3, 0.05, 0.3], pos=[-0.3, -0.9, 0.4], rgba=[0.2, 0.6, 1, 0.4], group=1
    )
    world.add_camera(name="above", pos=[0, -2.2, 2.0], xyaxes=[1, 0, 0, 0, 0.7, 0.75], fovy=50)
    world.add_camera(name="inside", pos=[1.5, -1.2, 0.5], xyaxes=[0.6, 0.8, 0, -0.2, 0.15, 1], fovy=70)
    return spec.compile()


def _add_material(
    spec: mujoco.MjSpec, name: str, shape: tuple[int, int], repeat: tuple[int, int], uniform: bool, cube: bool = False
) -> None:
    height, width = shape
    kind = mujoco.mjtTexture.mjTEXTURE_CUBE if cube or height > 2 * width else mujoco.mjtTexture.mjTEXTURE_2D
    squares = np.random.default_rng(3).integers(40, 255, (height // 8, width // 8, 3))
    pixels = np.kron(squares, np.ones((8, 8, 1))).astype(np.uint8)
    texture = spec.add_texture(name=name, type=kind, nchannel=3, height=height, width=width)
    texture.data = pixels.tobytes()
    material = spec.add_material(name=name, texrepeat=list(repeat), texuniform=uniform, specular=0.2, shininess=0.5)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


@pytest.mark.parametrize("camera", ["above", "inside"])
def test_looks_like_mujocos_own_renderer(mujoco_renderer: type[mujoco.Renderer], camera: str) -> None:
    model = textured_scene()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ours = Rasterizer(model, build_draw_list(model, as_mujoco=True), 256, 256, 0)
    model.vis.quality.offsamples = 0
    with mujoco_renderer(model, 256, 256) as renderer:
        option = mujoco.MjvOption()
        option.geomgroup[:] = [0, 1, 0, 0, 0, 0]
        renderer.update_scene(data, camera, option)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 1
        theirs = renderer.render().astype(int)
    off = np.abs(ours.draw(model, data, camera) - theirs)
    assert theirs.std() > 40
    assert off.mean() < 2.5
    assert (off.max(axis=2) > 16).mean() < 0.03


def test_mirror() -> None:
    model = textured_scene()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    listed = build_draw_list(model, as_mujoco=True)
    with_mirror, without = (
        Rasterizer(model, each, 128, 128, 0).draw(model, data, "above").astype(int)
        for each in (listed, replace(listed, mirror=None))
    )
    brighter = with_mirror - without
    assert brighter.min() == 0
    assert 0.005 < (brighter.max(axis=2) > 30).mean() < 0.2


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_face_partly_behind_the_camera(tilt: float) -> None:
    """Its corners are outside of the picture, some behind, and its near edge is level in the picture."""
    spec = mujoco.MjSpec()
    spec.visual.headlight.ambient = [1, 1, 1]
    turn = [float(np.cos(tilt / 2)), 0, 0, float(np.sin(tilt / 2))]
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[2, 1, 0.1], pos=[0, 0, -0.5], quat=turn, group=1)
    spec.worldbody.add_camera(name="level", pos=[0, 0, 0], xyaxes=[1, 0, 0, 0, 0, 1], fovy=60)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    shown = Rasterizer(model, build_draw_list(model), 64, 64, 0).draw_geoms(model, data, "level") == 0
    rows, columns = np.mgrid[:64, :64] + 0.5
    scale = 32 / np.tan(np.radians(30))
    rays = np.stack([(columns - 32) / scale, np.ones((64, 64)), (32 - rows) / scale], axis=-1).reshape(-1, 3)
    geoms, distances = np.zeros(len(rays), np.int32), np.zeros(len(rays))
    for k, ray in enumerate(rays):
        geom = np.zeros(1, np.int32)
        distances[k] = mujoco.mj_ray(model, data, np.zeros(3), ray, None, 1, -1, geom)
        geoms[k] = geom[0]
    assert (geoms == 0).any()
    assert (shown.ravel() != (geoms == 0)).mean() < 0.01
