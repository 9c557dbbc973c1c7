"""``python -m mujoco_raster``: images in new processes without OpenGL, equal bits, and errors."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from mujoco_raster import Renderer
from mujoco_raster.__main__ import main


def image_hash(path: Path) -> str:
    return hashlib.sha256(np.asarray(Image.open(path)).tobytes()).hexdigest()


def test_image_in_a_process_without_display_and_gl(model_file: Path, tmp_path: Path) -> None:
    """It equals the image of this process."""
    image = tmp_path / "image.png"
    code = (
        "import runpy, sys; runpy.run_module('mujoco_raster', run_name='__main__'); print('OpenGL.GL' in sys.modules)"
    )
    words = [str(model_file), str(image), "--camera", "corner", "--height", "60", "--width", "80", "--samples", "1"]
    hidden = {"DISPLAY": "", "MUJOCO_GL": "glfw", "OMP_NUM_THREADS": "3"}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *words],
        env={**os.environ, **hidden},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "False\n", "")
    model = mujoco.MjModel.from_xml_path(str(model_file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, 60, 80)
    renderer.update_scene(data, "corner")
    np.testing.assert_array_equal(np.asarray(Image.open(image)), renderer.render())


def test_a_second_process_compiles_nothing(model_file: Path, tmp_path: Path) -> None:
    """Numba reads its cache while modules are imported: a circular import would discard it without a message."""
    command = [sys.executable, "-W", "ignore", "-m", "mujoco_raster", str(model_file), str(tmp_path / "image.png")]
    for _ in range(2):
        done = subprocess.run(
            command, env={**os.environ, "NUMBA_DEBUG_CACHE": "1"}, check=True, capture_output=True, text=True
        )
    assert "data loaded" in done.stdout
    assert "data saved" not in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "variables",
    [
        {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
        {"NUMBA_OPT": "0"},
        {
            "OPENBLAS_CORETYPE": "Prescott",
            "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX",
            "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2_Usable,-FMA_Usable,-AVX2,-FMA",
        },
    ],
    ids=["no vector instructions", "not optimised", "other kernels of BLAS, NumPy and libm"],
)
def test_image_is_equal_on_another_processor(model_file: Path, tmp_path: Path, variables: dict[str, str]) -> None:
    images = [tmp_path / "here.png", tmp_path / "there.png"]
    for image, others in zip(images, ({}, {**variables, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}), strict=True):
        command = [sys.executable, "-W", "ignore", "-m", "mujoco_raster", str(model_file), str(image)]
        subprocess.run(command, env={**os.environ, **others}, check=True, timeout=500)
    assert image_hash(images[0]) == image_hash(images[1])


def test_keyframe_and_compiled_model(model_file: Path, tmp_path: Path) -> None:
    compiled = tmp_path / "model.mjb"
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_path(str(model_file)), str(compiled))
    size = ["--height", "40", "--width", "40", "--samples", "1"]
    words = {"first": [], "named": ["--keyframe", "lifted"], "numbered": ["--keyframe", "0"]}
    for name, keyframe in words.items():
        main([str(model_file), str(tmp_path / f"{name}.png"), *keyframe, *size])
    main([str(compiled), str(tmp_path / "compiled.png"), *size])
    hashes = {name: image_hash(tmp_path / f"{name}.png") for name in (*words, "compiled")}
    assert hashes["compiled"] == hashes["first"] != hashes["named"] == hashes["numbered"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["model.xml", "out.png", "--camera", "cornre"], "no camera 'cornre'; its cameras are 'corner'; did you mean"),
        (["model.xml", "out.png", "--keyframe", "lfted"], "lfted"),
        (["model.xml", "out.png", "--height", "0"], "0×640 pixels"),
        (["model.xml", "out.dat"], "no ending of a known image format"),
        (["missing.xml", "out.png"], "missing.xml"),
        (["broken.xml", "out.png"], "XML"),
    ],
)
def test_errors_end_with_status_2(
    model_file: Path,
    words: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(model_file.parent)
    Path("broken.xml").write_text("<mujoco><nothing/></mujoco>")
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    assert message in capsys.readouterr().err
    assert not Path("out.png").exists()
