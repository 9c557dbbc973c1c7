"""Draw images, depths and segmentations of any model, with the interface of `mujoco.Renderer`."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoco_raster.drawlist import Image, build_draw_list
from mujoco_raster.errors import RasterError
from mujoco_raster.geometry import Target
from mujoco_raster.rasterizer import Rasterizer, View, mean_of_four
from mujoco_raster.view import Camera, clipping, scene_camera

LARGEST = 16384
"""Largest height and width of an image, pixels."""
SAMPLES = (1, 4)
"""Numbers of samples per pixel."""
COLOUR, DEPTH, SEGMENTATION = "colour", "depth", "segmentation"

Groups = tuple[tuple[int, ...], tuple[int, ...]]
"""Drawn groups of geoms and of sites."""


class Renderer:
    """Draw a model on the CPU without OpenGL; equal inputs give equal bits on every x86-64 processor.

    Poses, colours and alpha of geoms and sites are read at each `update_scene`. Shapes, textures, materials and the
    colours of lights are read once: create a new renderer after changing them. A renderer serves one thread at a time.

    Args:
        model: compiled model; one warning names its objects that are not drawn, see `not_drawn`.
        height: height of the images, pixels; the model's offscreen buffer does not limit it.
        width: width of the images, pixels.
        samples: samples per pixel, 1 or 4. MuJoCo's default is 4.

    Raises:
        RasterError: the size or the number of samples is not possible.
    """

    def __init__(self, model: mujoco.MjModel, height: int = 240, width: int = 320, *, samples: int = 1) -> None:
        if not (1 <= height <= LARGEST and 1 <= width <= LARGEST):
            raise RasterError(f"an image of {height}×{width} pixels cannot be drawn; use sizes from 1 to {LARGEST}")
        if samples not in SAMPLES:
            raise RasterError(f"samples is {samples}; expected 1 or 4")
        if missing := not_drawn(model):
            warnings.warn(f"mujoco_raster does not draw {', '.join(missing)} of this model", stacklevel=2)
        self._model, self._height, self._width, self._samples = model, height, width, samples
        self._output = COLOUR
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(model, maxgeom=1)  # computes cameras; contains no geoms
        self._groups: Groups | None = None
        self._rasterizer: Rasterizer
        self._view: View | None = None

    @property
    def model(self) -> mujoco.MjModel:
        """Drawn model."""
        return self._model

    @property
    def height(self) -> int:
        """Height of the images, pixels."""
        return self._height

    @property
    def width(self) -> int:
        """Width of the images, pixels."""
        return self._width

    def update_scene(
        self,
        data: mujoco.MjData,
        camera: int | str | mujoco.MjvCamera = -1,
        scene_option: mujoco.MjvOption | None = None,
    ) -> None:
        """Take the state and the camera of the next images.

        Args:
            data: state after `mujoco.mj_forward` or a step.
            camera: name or id of a camera of the model, -1 for the default free camera, or a camera of your own.
            scene_option: its ``geomgroup`` and ``sitegroup`` choose groups, by default 0 to 2; its flags are not used.

        Raises:
            RasterError: the camera does not exist or is orthographic, or a position is not finite.
        """
        viewed = self._camera(data, camera)
        option = scene_option or self._option
        groups = tuple(np.flatnonzero(option.geomgroup).tolist()), tuple(np.flatnonzero(option.sitegroup).tolist())
        if groups != self._groups:
            self._rasterizer, self._groups = self._make_rasterizer(groups), groups
        self._view = self._rasterizer.view(self._model, data, viewed)

    def render(self, *, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return the image of the last `update_scene`, first row on top.

        Args:
            out: array of the image's shape to write to and return.

        Returns:
            Colours (height, width, 3) uint8. With depth rendering: distances along the optical axis (height, width)
            float32, m; the far clipping distance where nothing is seen. With segmentation rendering: (height, width, 2)
            int32, id and type (`mujoco.mjtObj`) of a geom or site, -1 where nothing is seen. Depth and segmentation
            sample pixel centres and include translucent objects.

        Raises:
            RasterError: there is no scene, or ``out`` has another shape.
        """
        if self._view is None:
            raise RasterError("there is no scene to render; call update_scene first")
        image = self._colours(self._view) if self._output == COLOUR else self._depth_or_segmentation(self._view)
        if out is None:
            return image
        if out.shape != image.shape:
            raise RasterError(f"out has the shape {out.shape}; expected {image.shape}")
        out[:] = image
        return out

    def enable_depth_rendering(self) -> None:
        """Return distances from `render`."""
        self._output = DEPTH

    def disable_depth_rendering(self) -> None:
        """Return colours from `render`, if it returns distances."""
        self._output = COLOUR if self._output == DEPTH else self._output

    def enable_segmentation_rendering(self) -> None:
        """Return ids and types of objects from `render`."""
        self._output = SEGMENTATION

    def disable_segmentation_rendering(self) -> None:
        """Return colours from `render`, if it returns ids and types."""
        self._output = COLOUR if self._output == SEGMENTATION else self._output

    def close(self) -> None:
        """Forget the scene; there is no context to free."""
        self._view = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _camera(self, data: mujoco.MjData, camera: int | str | mujoco.MjvCamera) -> Camera:
        """Return a camera in the state of ``data``, computed by MuJoCo."""
        model = self._model
        if not isinstance(camera, mujoco.MjvCamera):
            number = camera_id(model, camera)
            camera = mujoco.MjvCamera()
            camera.fixedcamid = number
            if number < 0:
                mujoco.mjv_defaultFreeCamera(model, camera)
            else:
                camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        mujoco.mjv_updateCamera(model, data, camera, self._scene)
        fixed = camera.type == mujoco.mjtCamera.mjCAMERA_FIXED
        still = model.body_weldid[model.cam_bodyid[camera.fixedcamid]] == 0 if fixed else True
        return scene_camera(self._scene, self._height, self._width, bool(still))

    def _make_rasterizer(self, groups: Groups) -> Rasterizer:
        factor = 2 if self._samples == 4 else 1
        draw_list = build_draw_list(self._model, groups=groups[0], site_groups=groups[1], sky=True)
        return Rasterizer(self._model, draw_list, factor * self._width, factor * self._height, self._samples)

    def _colours(self, view: View) -> Image:
        image = self._rasterizer.draw_view(view)
        return mean_of_four(image) if self._samples == 4 else image

    def _depth_or_segmentation(self, view: View) -> NDArray[Any]:
        shape = self._height, self._width
        target = Target(np.zeros(shape, np.float32), np.zeros(shape, np.int32))
        rows, inverse = self._rasterizer.visible_rows(view, self._rasterizer.rows_with_alpha(), target)
        seen = rows >= 0
        if self._output == DEPTH:
            far = np.full(shape, clipping(self._model)[1], np.float32)
            return np.divide(np.float32(1), inverse, out=far, where=seen)
        ids, types = self._rasterizer.objects_of_rows()
        image = np.full((*shape, 2), -1, np.int32)
        image[seen, 0], image[seen, 1] = ids[rows[seen]], types[rows[seen]]
        return image


def camera_id(model: mujoco.MjModel, camera: int | str) -> int:
    """Return the id of a camera, given by its name or id; -1 is the default free camera.

    Raises:
        RasterError: there is no such camera.
    """
    if isinstance(camera, str):
        number = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA.value, camera))
        if number < 0:
            names = [name for k in range(model.ncam) if (name := model.camera(k).name)]
            raise RasterError(f"the model has no camera {camera!r}; {_known(camera, names)}")
        return number
    if not -1 <= camera < model.ncam:
        raise RasterError(f"the model has {model.ncam} cameras and no camera {camera}; -1 is the free camera")
    return int(camera)


def _known(given: str, names: Sequence[str]) -> str:
    """Return a hint with the nearest names, or all."""
    if not names:
        return "it has no named cameras, use -1 for the free camera"
    listed = ", ".join(repr(name) for name in names[:12]) + (" and others" if len(names) > 12 else "")
    close = difflib.get_close_matches(given, names, n=1)
    return f"its cameras are {listed}" + (f"; did you mean {close[0]!r}?" if close else "")


def not_drawn(model: mujoco.MjModel) -> list[str]:
    """Return the objects of a model that MuJoCo's renderer draws by default and this package does not."""
    joint, ray = mujoco.mjtWrap.mjWRAP_JOINT.value, mujoco.mjtSensor.mjSENS_RANGEFINDER.value
    counts = {
        "skins": model.nskin,
        "flexes": model.nflex,
        "spatial tendons": sum(int(model.wrap_type[start] != joint) for start in model.tendon_adr),
        "rangefinder rays": int((model.sensor_type == ray).sum()),
    }
    return [f"{name} ({count})" for name, count in counts.items() if count]
