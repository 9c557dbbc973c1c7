"""Draw a `DrawList` on the CPU with deferred shading: find the visible triangle of each pixel, then shade it once.

The lighting model is MuJoCo's: headlight, ambient light, directional lights and spots, Blinn's specular term and
modulating textures; light is clipped to 1 before it is multiplied by the texture. Shadows are not drawn. For a static
camera the image of static rows is cached; only moving rows are drawn.
"""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoco_raster.compiled import compiled
from mujoco_raster.drawlist import POSITION, ROW, TABLE_LINES, DrawList, Floats, Image, Mirror
from mujoco_raster.errors import RasterError
from mujoco_raster.geometry import Integers, Shapes, Target, clip_space, draw_triangles, set_planes
from mujoco_raster.highlights import Highlight, fill_table
from mujoco_raster.shading import IMAGE, TRANSLUCENT, Surfaces, scratch, shade
from mujoco_raster.textures import LAYER_SIZE
from mujoco_raster.view import Camera, Lights, SceneLights, camera_matrix, clipping, cropped, mirrored, model_camera

MAX_COORDINATE = 1e6
"""Largest coordinate in a scene, m."""
OPAQUE_ALPHA = 0.995
"""Smallest alpha of opaque geoms in MuJoCo."""
MAX_STILL_STATES = 4
"""Cached states of static rows, and cached cameras of each; simulations of one scene differ in fixture poses."""


@dataclass(frozen=True)
class Background:
    """A camera's image of the static rows: colours, depths and visible triangles."""

    image: Image
    depth: Floats
    triangle: NDArray[np.int32]


class Rasterizer:
    """Draw one draw list at one size; not thread-safe.

    Args:
        model: model with lights and clipping planes.
        draw_list: triangles to draw.
        width, height: size of the frames, pixels.
        averaged: number of pixels that are averaged to one; textures are as coarse as for that one, as in OpenGL.
    """

    def __init__(self, model: mujoco.MjModel, draw_list: DrawList, width: int, height: int, averaged: int = 1) -> None:
        self._list, self._width, self._height = draw_list, width, height
        self._scene_lights = SceneLights(model)
        self._shapes = _shapes(draw_list)
        self._surfaces = Surfaces(
            *(draw_list.vertices, draw_list.origin, draw_list.texels.ravel(), LAYER_SIZE),
            float(averaged * LAYER_SIZE**2),
        )
        self._rows = np.arange(draw_list.objects, dtype=np.int32)
        self._sky = draw_list.objects + np.arange(draw_list.sky, dtype=np.int32)
        self._upper = _upper_side(draw_list, len(draw_list.triangles))
        self._allocate()

    def copy(self) -> Rasterizer:
        """Return a rasterizer of the same draw list with buffers of its own, for another camera or thread."""
        other = copy.copy(self)
        other._scene_lights = copy.deepcopy(self._scene_lights)
        other._allocate()
        return other

    def _allocate(self) -> None:
        shape, triangles = (self._height, self._width), len(self._list.triangles)
        self._table = np.zeros((len(self._list.materials), TABLE_LINES, 4), np.float32)
        self._clip = clip_space(self._shapes)
        self._work = scratch(len(self._list.vertices), triangles, self._height * self._width)
        self._target = Target(np.zeros(shape, np.float32), np.zeros(shape, np.int32))
        self._still: OrderedDict[bytes, dict[bytes, Background]] = OrderedDict()

    # --- draw -----------------------------------------------------------------------------------------------

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, highlights: Sequence[Highlight] = ()
    ) -> Image:
        """Return a camera's image, (height, width, 3) uint8, first row on top.

        Args:
            model: copy of the model of the draw list.
            data: state to draw.
            camera: name of the camera.
            highlights: discs, drawn in this order.

        Raises:
            RasterError: a pose is not finite, or there are more than `HIGHLIGHTS` highlights.
        """
        of_model = model_camera(model, data, int(model.camera(camera).id), self._height, self._width)
        return self.draw_view(self.view(model, data, of_model, highlights), len(highlights))

    def draw_view(self, view: View, highlights: int = 0) -> Image:
        """Return the image of the newest view, with its first highlights."""
        rows = self._rows
        opaque = self._table[: len(rows), 3, 3] >= OPAQUE_ALPHA
        moving = rows >= self._list.still
        if view.camera.still:
            background = self._background(view, rows[opaque & ~moving])
            image = background.image.copy()
            self._target.depth[:] = background.depth
            self._target.triangle[:] = -1
            view.draw_triangles(rows[opaque & moving])
            behind = background.triangle
        else:
            image = np.zeros((self._height, self._width, 3), np.uint8)
            self._draw_sky(view, image)
            view.draw_triangles(rows[opaque])
            behind = self._target.triangle
        view.shade(IMAGE, image)
        if self._list.mirror is not None:
            shown = np.where(self._target.triangle >= 0, self._target.triangle, behind)
            self._add_reflection(view, self._list.mirror, rows[opaque], shown, image)
        translucent = self._near_to_far(view, rows[~opaque & (self._table[: len(rows), 3, 3] > 0.0)])
        # MuJoCo's renderer draws them twice, in this order.
        for row in [*translucent, *translucent[::-1], *(len(rows) + len(self._sky) + np.arange(highlights))]:
            self._draw_over(view, int(row), image)
        return image

    def draw_geoms(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> NDArray[np.int64]:
        """Return the visible geom's id at each pixel centre, (height, width), -1 for none; highlights are ignored."""
        of_model = model_camera(model, data, int(model.camera(camera).id), self._height, self._width)
        rows, _ = self.visible_rows(self.view(model, data, of_model), self._rows, self._target)
        geoms = self._list.geoms
        return np.where((rows >= 0) & (rows < len(geoms)), geoms[np.clip(rows, 0, len(geoms) - 1)], -1)

    def visible_rows(self, view: View, rows: Integers, target: Target) -> tuple[Integers, Floats]:
        """Find the nearest of some rows at each pixel centre, opaque or not.

        Args:
            view: newest view.
            rows: rows to draw.
            target: buffers of the image's proportions; overwritten.

        Returns:
            Rows (height, width), -1 for none; and inverse distances along the optical axis (height, width), 1/m, 0 for
            none.
        """
        view = copy.copy(view)
        view.target = target
        target.depth[:], target.triangle[:] = 0.0, -1
        view.draw_triangles(rows)
        shown = target.triangle
        return np.where(shown >= 0, self._surfaces.origin[self._shapes.triangles[shown, 0], ROW], -1), target.depth

    def objects_of_rows(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return ids and types (`mujoco.mjtObj`) of the rows of geoms and sites."""
        geoms, sites = self._list.geoms, self._list.sites
        kinds = mujoco.mjtObj.mjOBJ_GEOM.value, mujoco.mjtObj.mjOBJ_SITE.value
        return np.concatenate([geoms, sites]), np.repeat(kinds, (len(geoms), len(sites)))

    def rows_with_alpha(self) -> Integers:
        """Return the rows of geoms and sites that are not entirely transparent in the newest view."""
        return self._rows[self._table[: len(self._rows), 3, 3] > 0.0]

    def view(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, highlights: Sequence[Highlight] = ()
    ) -> View:
        """Fill the table with a state and return a camera's view of it, which is valid until the next call.

        Raises:
            RasterError: a pose is not finite, because compiled functions would write out of bounds.
        """
        fill_table(self._table, self._list, model, data, highlights)
        view = View(self, model, data, camera)
        if len(self._sky):
            half = 0.5 * float(view.far)  # its corners are within the far clipping plane
            self._table[self._sky, :3] = np.column_stack([half * np.eye(3), view.eye])
            self._table[self._sky, 3] = 1.0
        rows = len(self._rows) + len(self._sky) + len(highlights)
        for numbers in (self._table[:rows, :3], view.matrix):
            if numbers.size and not float(np.abs(numbers).max()) < MAX_COORDINATE:
                raise RasterError(
                    f"a drawn body, camera or highlight is not within {MAX_COORDINATE:g} m; expected a finite state"
                )
        return view

    def _draw_sky(self, view: View, image: Image) -> None:
        """Draw the sky into an image and clear the target: everything is in front of it."""
        self._clear()
        if len(self._sky):
            view.draw_triangles(self._sky)
            view.shade(IMAGE, image)
            self._clear()

    def _clear(self) -> None:
        self._target.depth[:] = 0.0
        self._target.triangle[:] = -1

    # --- static rows ----------------------------------------------------------------------------------------

    def _background(self, view: View, rows: NDArray[np.int32]) -> Background:
        """Return a static camera's image of the static rows, cached by their state and the camera."""
        state, camera = self._table[: self._list.still].tobytes() + view.lighting, view.matrix.tobytes()
        cameras = self._still.setdefault(state, {})
        self._still.move_to_end(state)
        if len(self._still) > MAX_STILL_STATES:
            self._still.popitem(last=False)
        if camera not in cameras:
            if len(cameras) >= MAX_STILL_STATES:  # a camera that is moved for each frame
                cameras.pop(next(iter(cameras)))
            cameras[camera] = self._draw_background(view, rows)
        return cameras[camera]

    def _draw_background(self, view: View, rows: NDArray[np.int32]) -> Background:
        image = np.zeros((self._height, self._width, 3), np.uint8)
        self._draw_sky(view, image)
        view.draw_triangles(rows)
        view.shade(IMAGE, image)
        return Background(image, self._target.depth.copy(), self._target.triangle.copy())

    # --- reflections ----------------------------------------------------------------------------------------

    def _add_reflection(
        self, view: View, mirror: Mirror, rows: NDArray[np.int32], shown: NDArray[np.int32], image: Image
    ) -> None:
        """Add the reflection in the mirror's upper side to an image with visible triangles ``shown``."""
        point, normal = mirror.plane(self._table)
        seen = self._upper[np.maximum(shown, 0)] & (shown >= 0)
        if (view.eye - point) @ normal <= 0 or not seen.any():
            return
        # Only this part of the image is drawn again; the mirrored scene is flipped horizontally.
        down, across = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        part = slice(down[0], down[-1] + 1), slice(across[0], across[-1] + 1)
        seen = seen[part][:, ::-1]
        reflection = np.zeros((*seen.shape, 3), np.uint8)
        other = view.mirrored(point, normal, (self._width - part[1].stop, part[0].start), seen.shape)
        colours = self._table[:, 3, :3].copy()
        self._table[:, 3, :3] *= mirror.reflectance
        other.draw_triangles(self._reach_above(rows[~np.isin(rows, mirror.rows)], point, normal))
        other.target.triangle[~seen] = -1
        other.shade(IMAGE, reflection)
        self._table[:, 3, :3] = colours
        # The reflection is black outside the mirror.
        image[part] = np.minimum(image[part].astype(np.uint16) + reflection[:, ::-1], 255)

    def _reach_above(self, rows: NDArray[np.int32], point: Floats, normal: Floats) -> NDArray[np.int32]:
        """Return the rows that may extend above a plane."""
        poses, centre, half = self._table[rows, :3], self._shapes.centre[rows], self._shapes.half[rows]
        middle = np.einsum("rij,rj->ri", poses[:, :, :3], centre) + poses[:, :, 3] - point
        reach = np.abs(np.einsum("rij,i->rj", poses[:, :, :3], normal)) * half
        return rows[middle @ normal + reach.sum(axis=1) > 0]

    # --- translucent rows -----------------------------------------------------------------------------------

    def _near_to_far(self, view: View, rows: NDArray[np.int32]) -> NDArray[np.int32]:
        distance = np.linalg.norm(self._table[rows, :3, 3] - view.eye, axis=1)
        return rows[np.argsort(distance, kind="stable")]

    def _draw_over(self, view: View, row: int, image: Image) -> None:
        """Draw a translucent row over an image without changing depths."""
        depth = self._target.depth.copy()
        self._target.triangle[:] = -1
        view.draw_triangles(np.array([row], dtype=np.int32))
        view.shade(TRANSLUCENT, image)
        self._target.depth[:] = depth


class View:
    """Camera and lights of one frame of a rasterizer."""

    def __init__(self, rasterizer: Rasterizer, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> None:
        of = self._of = rasterizer
        self.camera = camera
        self.matrix = camera_matrix(model, camera)
        self.eye: NDArray[np.floating] = camera.position.astype(np.float32)
        self.target = of._target
        self._near, self.far = (np.float32(distance) for distance in clipping(model))
        self._lights: Lights = of._scene_lights.update(data, camera)
        # The headlight moves with the camera, whose matrix is a separate key.
        self.lighting = self._lights.to[1:].tobytes() + self._lights.axis[1:].tobytes()

    def mirrored(self, point: Floats, normal: Floats, corner: tuple[int, int], shape: tuple[int, ...]) -> View:
        """Return a view of the scene mirrored in a plane, flipped horizontally, with the same lights.

        Args:
            point, normal: plane.
            corner: column and row of the drawn part in the flipped image.
            shape: height and width of the drawn part.
        """
        other = copy.copy(self)
        whole = self.target.triangle.shape
        other.matrix = cropped(mirrored(self.matrix, point, normal), whole, corner, shape)
        other.target = Target(np.zeros(shape, np.float32), np.full(shape, -1, np.int32))
        other.eye = self.eye - 2.0 * ((self.eye - point) @ normal) * normal
        return other

    def draw_triangles(self, rows: NDArray[np.int32]) -> None:
        """Update the visible triangle of each pixel with some rows."""
        of = self._of
        draw_triangles(of._shapes, rows, of._table, self.matrix, self._near, self.far, of._clip, self.target)

    def shade(self, mode: int, image: Image) -> None:
        """Shade the pixels with a visible triangle; see `shading.shade`."""
        of = self._of
        shade(
            *(of._shapes, of._surfaces, of._table, self._lights, self.eye, of._clip, self.target, of._work, mode),
            image.reshape(-1, 3),
        )


def mean_of_four(image: Image) -> Image:
    """Return an image of half the height and width, whose pixels are the rounded means of four."""
    height, width, channels = image.shape
    means = np.empty((height // 2, width // 2, channels), np.uint8)
    _average(image, means)
    return means


@compiled
def _average(image: Any, means: Any) -> None:
    for y in range(means.shape[0]):
        for x in range(means.shape[1]):
            for c in range(3):
                above = np.int32(image[2 * y, 2 * x, c]) + np.int32(image[2 * y, 2 * x + 1, c])
                below = np.int32(image[2 * y + 1, 2 * x, c]) + np.int32(image[2 * y + 1, 2 * x + 1, c])
                means[y, x, c] = (above + below + np.int32(2)) // np.int32(4)


def _upper_side(draw_list: DrawList, triangles: int) -> NDArray[np.bool_]:
    """Return a mask of the triangles of the mirror's upper side."""
    upper, mirror = np.zeros(triangles, np.bool_), draw_list.mirror
    if mirror is not None:
        mine = np.flatnonzero(np.isin(_row_of(draw_list), mirror.rows))
        upper[mine] = (draw_list.vertices[draw_list.triangles[mine], 2] > 0.99).all(axis=1)
    return upper


def _row_of(draw_list: DrawList) -> Integers:
    """Return the row of each triangle, (T,)."""
    rows: Integers = draw_list.origin[draw_list.triangles[:, 0], ROW]
    return rows


def _shapes(draw_list: DrawList) -> Shapes:
    """Return triangles by rows, with the bounding box of each row."""
    points, triangles, first_point = draw_list.points, draw_list.triangles, draw_list.first_point
    first_triangle = np.searchsorted(_row_of(draw_list), np.arange(len(first_point))).astype(np.int32)
    low, high = (f.reduceat(points, first_point[:-1], axis=0) for f in (np.minimum, np.maximum))
    centre, half = 0.5 * (low + high), 0.5 * (high - low) + np.float32(1e-6)
    position, corners = np.ascontiguousarray(points.T), draw_list.origin[triangles, POSITION]
    planes = np.empty((4, len(triangles)), np.float32)
    set_planes(position, corners, planes)
    return Shapes(triangles, corners, position, first_point, first_triangle, planes, centre, half)
