"""The public renderer: sizes, depths and object ids that geometry determines, cameras, groups, errors."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np
import pytest

from mujoco_raster import RasterError, Renderer
from mujoco_raster.textures import pixels_of

GEOM, SITE = mujoco.mjtObj.mjOBJ_GEOM.value, mujoco.mjtObj.mjOBJ_SITE.value


def scene(body: str, assets: str = "", **visual: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Compile the content of a world, seen from 1 m above by the camera ``top`` of 90°."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset>{assets}</asset><statistic extent="1" center="0 0 0"/>'
        f'<worldbody><camera name="top" pos="0 0 1" fovy="90"/>{body}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def images(model: mujoco.MjModel, data: mujoco.MjData, camera: int | str = "top", size: int = 101, **settings: int):
    """Return colours, depth (m), ids and types of objects."""
    with Renderer(model, size, size, **settings) as renderer:
        renderer.update_scene(data, camera)
        colours = renderer.render()
        renderer.enable_depth_rendering()
        depth = renderer.render()
        renderer.enable_segmentation_rendering()
        objects = renderer.render()
    return colours, depth, objects[..., 0], objects[..., 1]


def tangents(size: int = 101) -> tuple[np.ndarray, np.ndarray]:
    """Return the tangents of the angles of pixel centres to the right and upwards, for 90° of view."""
    line = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(line, -line)
    return x, y


def test_sphere_has_the_silhouette_and_depth_of_a_sphere() -> None:
    """Within the deviation of a sphere of 32 sides, from outside the visible cone and at the pixel's ray."""
    radius, distance = 0.4, 1.0
    model, data = scene(f'<geom size="{radius}"/>')
    _, depth, ids, types = images(model, data)
    x, y = tangents()
    sine = np.hypot(x, y) / np.sqrt(1 + x**2 + y**2)
    inside, outside = sine < (radius - 0.01) / distance, sine > radius / distance
    assert (ids[inside] == 0).all()
    assert (types[inside] == GEOM).all()
    assert (ids[outside] == -1).all()
    assert (types[outside] == -1).all()
    # Nearest intersection of the ray t (x, y, -1) from (0, 0, 1) with the sphere; t is the distance along the axis.
    square = 1 + x**2 + y**2
    expected = (distance - np.sqrt(np.maximum(distance**2 - square * (distance**2 - radius**2), 0))) / square
    np.testing.assert_allclose(depth[inside], expected[inside], atol=0.02)
    far = model.vis.map.zfar * model.stat.extent
    assert (depth[outside] == np.float32(far)).all()


def test_groups_sites_and_transparent_geoms() -> None:
    """By default groups 0 to 2 are drawn; alpha 0 is invisible, and translucent geoms are segmented."""
    model, data = scene(
        '<geom size=".2"/><geom size=".3" group="3"/><site size=".4" group="4"/>'
        '<geom size=".35" rgba="1 1 1 0"/><site name="mark" type="box" size=".1 .1 .1" pos="0 0 .3"/>'
        '<geom size=".05" pos="0 0 .6" rgba="1 1 1 .1"/>'
    )
    renderer = Renderer(model, 101, 101)
    renderer.enable_segmentation_rendering()

    def seen(option: mujoco.MjvOption | None = None) -> set[tuple[int, int]]:
        renderer.update_scene(data, "top", option)
        return {(int(k), int(kind)) for k, kind in np.unique(renderer.render().reshape(-1, 2), axis=0)}

    default = {(-1, -1), (0, GEOM), (1, SITE), (3, GEOM)}
    assert seen() == default
    option = mujoco.MjvOption()
    option.geomgroup[3], option.sitegroup[:] = 1, 0
    assert seen(option) == {(-1, -1), (1, GEOM), (3, GEOM)}
    assert seen() == default


def test_of_coincident_geoms_the_last_is_seen() -> None:
    """As in MuJoCo; models often have a visual geom in the place of a geom for contacts."""
    box = '<geom type="box" size=".3 .2 .1" euler="10 20 30" material="{}"/>'
    model, data = scene(
        f"{box.format('plain')}{box.format('marked')}<body><freejoint/>{box.format('marked')}{box.format('plain')}</body>",
        '<texture name="t" type="cube" builtin="checker" rgb1="1 0 0" rgb2="0 1 0" width="8" height="48"/>'
        '<material name="marked" texture="t"/><material name="plain"/>',
    )
    _, _, ids, _ = images(model, data)
    assert set(np.unique(ids)) == {-1, 1}  # fixed geoms before moving ones, of which MuJoCo would draw 3
    model, data = scene(
        f"<body><freejoint/>{box.format('plain')}{box.format('plain')}</body>", '<material name="plain"/>'
    )
    _, _, ids, _ = images(model, data)
    assert set(np.unique(ids)) == {-1, 1}


def test_channels_and_colour_spaces_of_textures() -> None:
    """Alpha is left out, grey is repeated, and only flat textures are converted from sRGB, as in MuJoCo."""
    spec = mujoco.MjSpec()
    linear, srgb = mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR, mujoco.mjtColorSpace.mjCOLORSPACE_SRGB
    flat, cube = mujoco.mjtTexture.mjTEXTURE_2D, mujoco.mjtTexture.mjTEXTURE_CUBE
    expected = []
    for kind, space, pixel, colour in (
        (flat, linear, [10, 20, 30, 128], [10, 20, 30]),
        (flat, linear, [77], [77, 77, 77]),
        (flat, srgb, [255, 128, 0], [255, 55, 0]),  # ((128 / 255 + 0.055) / 1.055) ** 2.4 = 0.2158
        (cube, srgb, [255, 128, 0], [255, 128, 0]),
    ):
        texture = spec.add_texture(name=str(len(expected)), type=kind, colorspace=space, nchannel=len(pixel))
        texture.width = texture.height = 2
        texture.data = bytes(pixel * 4)
        expected.append(colour)
    spec.worldbody.add_geom(size=[0.1, 0.1, 0.1])
    model = spec.compile()
    for number, colour in enumerate(expected):
        np.testing.assert_array_equal(pixels_of(model, number), np.tile(np.array(colour, np.uint8), (2, 2, 1)))


def test_render_returns_the_scene_of_the_update() -> None:
    """Later steps change it at the next update only; ``out`` is filled; modes can be changed between images."""
    model, data = scene('<body><joint type="slide" axis="1 0 0"/><geom size=".2" rgba="1 1 1 1"/></body>')
    renderer = Renderer(model, 60, 80)
    renderer.update_scene(data, "top")
    first = renderer.render()
    data.qpos[0] = 0.5
    mujoco.mj_forward(model, data)
    renderer.enable_depth_rendering()
    assert renderer.render().shape == (60, 80)
    renderer.disable_segmentation_rendering()  # another mode
    assert renderer.render().dtype == np.float32
    renderer.disable_depth_rendering()
    out = np.empty_like(first)
    assert renderer.render(out=out) is out
    np.testing.assert_array_equal(out, first)
    renderer.update_scene(data, "top")
    moved = renderer.render()
    assert np.argwhere(moved.any(2))[:, 1].mean() - np.argwhere(first.any(2))[:, 1].mean() == pytest.approx(15, abs=1)


def test_four_samples_average_edges() -> None:
    """A pixel is the mean of its quarters, whose centres lie inside or outside of a box."""
    model, data = scene('<geom type="box" size=".25 .25 .25" pos="0 0 .25" rgba="1 0 0 1"/>')
    one, *_ = images(model, data, size=6, samples=1)
    four, *_ = images(model, data, size=6, samples=4)
    fine, *_ = images(model, data, size=12, samples=1)
    np.testing.assert_allclose(four, fine.reshape(6, 2, 6, 2, 3).mean((1, 3)), atol=0.51)
    assert len(np.unique(four[..., 0])) > len(np.unique(one[..., 0]))


def test_headlight_is_on_or_off() -> None:
    """MuJoCo 4 marks a headlight that a model does not set with 2."""
    model, data = scene('<geom size=".3" rgba="1 1 1 1"/>')
    seen = {}
    for active in (0, 1, 2):
        model.vis.headlight.active = active
        seen[active] = images(model, data)[0]
    assert not seen[0].any()
    assert 100 < seen[1].max() < 255
    np.testing.assert_array_equal(seen[1], seen[2])


def test_free_camera_and_intrinsics() -> None:
    """A sphere at the centre of the free camera, and one on the ray of a camera's principal point."""
    model, data = scene(
        '<geom size=".1"/><camera name="sensor" pos="0 0 1" focal=".01 .01" principal=".002 .001" '
        'sensorsize=".012 .012" resolution="120 120"/>'
    )
    _, _, ids, _ = images(model, data, -1)
    np.testing.assert_allclose(np.argwhere(ids == 0).mean(0), 50, atol=0.6)
    _, _, ids, _ = images(model, data, "sensor", 120)
    centre = np.argwhere(ids == 0).mean(0)
    # 1 px is 0.1 mm of the sensor; MuJoCo's principal point is an offset of the sensor, so the object moves against it.
    np.testing.assert_allclose(np.abs(centre - 59.5), [10, 20], atol=0.6)


# --- errors ---


@pytest.mark.parametrize(
    ("camera", "message"), [("tpo", "did you mean 'top'"), (3, "no camera 3"), (-2, "no camera -2")]
)
def test_unknown_cameras_are_errors(camera: int | str, message: str) -> None:
    model, data = scene('<geom size=".1"/>')
    with pytest.raises(RasterError, match=message):
        Renderer(model).update_scene(data, camera)


def test_misuse_is_an_error() -> None:
    model, data = scene('<geom size=".1"/>')
    for height, width in ((0, 10), (10, 16385)):
        with pytest.raises(RasterError, match=f"{height}×{width} pixels"):
            Renderer(model, height, width)
    with pytest.raises(RasterError, match="samples is 2; expected 1 or 4"):
        Renderer(model, samples=2)
    renderer = Renderer(model)
    with pytest.raises(RasterError, match="call update_scene first"):
        renderer.render()
    renderer.update_scene(data)
    with pytest.raises(RasterError, match=r"\(1, 2\); expected \(240, 320, 3\)"):
        renderer.render(out=np.empty((1, 2)))
    data.geom_xpos[0] = np.nan
    with pytest.raises(RasterError, match="expected a finite state"):
        renderer.update_scene(data)
    model.vis.global_.orthographic = 1
    mujoco.mj_forward(model, data)
    with pytest.raises(RasterError, match="orthographic"):
        renderer.update_scene(data)


def test_objects_that_are_not_drawn_are_named_once() -> None:
    model, _ = scene('<site name="a"/><body pos="0 0 1"><joint/><geom size=".1"/><site name="b"/></body>')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Renderer(model)
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><site name="a"/><body pos="0 0 1"><joint/><geom size=".1"/><site name="b"/></body>'
        '</worldbody><tendon><spatial><site site="a"/><site site="b"/></spatial></tendon></mujoco>'
    )
    with pytest.warns(UserWarning, match=r"does not draw spatial tendons \(1\) of this model"):
        Renderer(spec.compile())


def test_empty_model_is_black() -> None:
    model, data = scene("")
    colours, depth, ids, _ = images(model, data)
    assert not colours.any()
    assert (depth == depth.max()).all()
    assert (ids == -1).all()
