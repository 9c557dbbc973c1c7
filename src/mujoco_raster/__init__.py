"""Draw MuJoCo models on the CPU, without OpenGL: the same bits on every x86-64 processor.

`Renderer` has the interface of `mujoco.Renderer`. `rasterizer.Rasterizer` is the faster layer below it for one fixed
set of geoms. ``python -m mujoco_raster model.xml image.png`` draws a file.
"""

from mujoco_raster.errors import RasterError
from mujoco_raster.renderer import Renderer, not_drawn

__all__ = ["RasterError", "Renderer", "not_drawn"]
