"""Try one thing that may crash the process, in a process of its own.

A driver that is broken ends the process with a signal, which only its parent can report. The child is
``python -m lerobot_memobench.doctor.probe gl egl`` and prints JSON.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

PROBE = "lerobot_memobench.doctor.probe"

SCENE = """
<mujoco><worldbody><light pos='0 0 3'/><camera name='eye' pos='0 -1 0' xyaxes='1 0 0 0 0 1'/>
<geom type='sphere' size='.2' rgba='.9 .2 .1 1'/></worldbody></mujoco>
"""


def run_probe(*words: str, timeout_s: float = 180.0) -> dict[str, Any]:
    """Run a probe in a process of its own; return its answer, or {"error": …} however it ended."""
    command = [sys.executable, "-m", PROBE, *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"no answer in {timeout_s:.0f} s"}
    if done.returncode < 0:
        return {"error": f"the process was killed by {signal.Signals(-done.returncode).name}"}
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        reason = (done.stderr.strip().splitlines() or ["without a message"])[-1]
        return {"error": f"the process ended with status {done.returncode}: {reason}"}
    answer = json.loads(lines[-1])
    assert isinstance(answer, dict)
    return answer


def gl(backend: str) -> dict[str, Any]:
    """Render a sphere with a backend; return the GL strings and whether the sphere is there."""
    # MuJoCo has set PyOpenGL's platform to the backend in use where the parent imported it, and refuses any other.
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
    import mujoco

    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 64, 64) as renderer:
        from OpenGL import GL

        renderer.update_scene(data, "eye")
        image = renderer.render()
        names = {"renderer": GL.GL_RENDERER, "vendor": GL.GL_VENDOR, "version": GL.GL_VERSION}
        found = {key: GL.glGetString(name).decode() for key, name in names.items()}
    centre = image[32, 32].astype(int)
    return {**found, "sphere": bool(centre[0] > centre[1] + 40)}


def golden() -> dict[str, Any]:
    """Render the golden scene; return how far it is from the one that ships."""
    from lerobot_memobench.doctor.golden import difference, read_golden, render_golden

    return {"difference": difference(render_golden(), read_golden())}


def torchcodec() -> dict[str, Any]:
    """Load torchcodec, which loads FFmpeg's libraries."""
    from torchcodec.decoders import VideoDecoder

    return {"decoder": VideoDecoder.__name__}


PROBES: dict[str, Callable[..., dict[str, Any]]] = {"gl": gl, "golden": golden, "torchcodec": torchcodec}


if __name__ == "__main__":
    try:
        print(json.dumps(PROBES[sys.argv[1]](*sys.argv[2:])))
    except Exception as error:
        print(json.dumps({"error": " ".join(f"{type(error).__name__}: {error}".split())[:300]}))
