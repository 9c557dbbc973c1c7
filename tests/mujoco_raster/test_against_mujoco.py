"""Images, depths and segmentations against MuJoCo's own renderer, where OpenGL is available."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mujoco_raster import Renderer

THEIRS = """
import sys
import mujoco, numpy as np
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 120, 160) as renderer:
    found = {}
    for camera in (-1, 0):
        renderer.update_scene(data, camera)
        found[f"colours{camera}"] = renderer.render()
        renderer.enable_depth_rendering()
        found[f"depth{camera}"] = renderer.render()
        renderer.enable_segmentation_rendering()
        found[f"objects{camera}"] = renderer.render()
        renderer.disable_segmentation_rendering()
np.savez(sys.argv[2], **found)
"""


@pytest.fixture
def theirs(model_file: Path, tmp_path: Path) -> dict[str, np.ndarray]:
    """Return the output of `mujoco.Renderer`; another process, because `MUJOCO_GL` is read at the import."""
    file = tmp_path / "theirs.npz"
    for backend in ("egl", "osmesa"):
        command = [sys.executable, "-c", THEIRS, str(model_file), str(file)]
        subprocess.run(command, env={**os.environ, "MUJOCO_GL": backend}, capture_output=True, timeout=300)
        if file.exists():
            with np.load(file) as found:
                return dict(found)
    pytest.skip("neither EGL nor OSMesa can draw")


def test_equals_mujocos_renderer(model_file: Path, theirs: dict[str, np.ndarray]) -> None:
    """Except for some pixels at edges, and the reflection of the translucent cylinder, which is not drawn."""
    model = mujoco.MjModel.from_xml_path(str(model_file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, 120, 160, samples=4)
    for camera in (-1, 0):
        renderer.update_scene(data, camera)
        off = np.abs(renderer.render().astype(int) - theirs[f"colours{camera}"]).max(axis=2)
        assert off.mean() < 2
        assert (off <= 4).mean() > 0.93
        renderer.enable_segmentation_rendering()
        same = (renderer.render() == theirs[f"objects{camera}"]).all(axis=2)
        assert same.mean() > 0.998
        assert len(np.unique(theirs[f"objects{camera}"][..., 0])) > 4
        renderer.enable_depth_rendering()
        depth, expected = renderer.render(), theirs[f"depth{camera}"]
        off_by = np.abs(depth - expected)[same] / expected[same]
        assert np.median(off_by) < 1e-5
        assert (off_by < 1e-3).mean() > 0.98
        renderer.disable_depth_rendering()
