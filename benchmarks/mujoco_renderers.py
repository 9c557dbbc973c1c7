"""Compare `mujoco_raster` with MuJoCo's renderer on each OpenGL backend: CPU time and images, in one process.

    python benchmarks/mujoco_renderers.py [--models FILE ...] [--backends egl osmesa] [--frames 20] [--sheet PNG]

Without ``--models``: robots of Gymnasium, and a task in LIBERO's kitchen. Shadows are switched off, because
`mujoco_raster` draws none. CPU time counts all threads, and `mj_kinematics` of each frame; it leaves out a GPU.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from turns import medians

TASK = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
ROBOTS = ("ant", "half_cheetah", "humanoid", "pusher")
SIZES = ((256, 256), (480, 640))
"""Heights and widths, pixels."""
GROUP = 1
"""Geom group that LIBERO draws; its sites are not drawn."""

Draw = Callable[[int], np.ndarray]


def libero_model() -> mujoco.MjModel:
    """Return LIBERO's kitchen with all meshes and textures."""
    from lerobot_memobench.sim.scene import ARENA_BYTES, scene_xml
    from lerobot_memobench.tasks.catalogue import get_task

    spec = mujoco.MjSpec.from_string(scene_xml(get_task(TASK), visuals=True))
    spec.nconmax, spec.njmax, spec.memory = -1, -1, ARENA_BYTES
    return spec.compile()


def models(files: list[Path]) -> Iterator[tuple[str, mujoco.MjModel, mujoco.MjvOption, int | str]]:
    """Yield name, model, drawn groups and camera of each scene."""
    import gymnasium

    assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    for path in files or [assets / f"{name}.xml" for name in ROBOTS]:
        model = mujoco.MjModel.from_xml_path(str(path))
        yield path.stem, model, mujoco.MjvOption(), 0 if model.ncam else -1
    if not files:
        option = mujoco.MjvOption()
        option.geomgroup[:], option.sitegroup[:] = 0, 0
        option.geomgroup[GROUP] = 1
        yield "LIBERO's kitchen", libero_model(), option, "agentview"


def states(model: mujoco.MjModel, count: int) -> np.ndarray:
    """Return positions (count, nq) of a simulation without control, 10 physics steps apart."""
    data, found = mujoco.MjData(model), []
    for _ in range(count):
        found.append(data.qpos.copy())
        for _ in range(10):
            mujoco.mj_step(model, data)
    return np.array(found)


def drawing(renderer: Any, model: mujoco.MjModel, option: mujoco.MjvOption, camera: int | str, frames: int) -> Draw:
    """Return a function that draws a state by its number."""
    data, positions = mujoco.MjData(model), states(model, frames)

    def draw(number: int) -> np.ndarray:
        data.qpos[:] = positions[number % frames]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        renderer.update_scene(data, camera, option)
        if isinstance(renderer, mujoco.Renderer):
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        image: np.ndarray = renderer.render()
        return image

    return draw


def in_turn(draw: Draw) -> Callable[[], object]:
    """Return a function that draws the next state at each call."""
    numbers = iter(range(sys.maxsize))
    return lambda: draw(next(numbers))


def compare(backend: str, files: list[Path], frames: int, sheet: Path | None) -> None:
    """Print a row for each model and size; the backend is that of this process."""
    from mujoco_raster import Renderer

    warnings.simplefilter("ignore")  # objects that are not drawn
    images = []
    for name, model, option, camera in models(files):
        model.vis.global_.offheight, model.vis.global_.offwidth = np.max(SIZES, axis=0)
        for height, width in SIZES:
            renderers = {
                "mujoco": mujoco.Renderer(model, height, width),
                "one": Renderer(model, height, width),
                "four": Renderer(model, height, width, samples=4),
            }
            draws = {k: drawing(renderer, model, option, camera, frames) for k, renderer in renderers.items()}
            ms = {k: 1000 * v for k, v in medians({k: in_turn(draw) for k, draw in draws.items()}, frames).items()}
            theirs, one, four = (draws[k](frames - 1).astype(int) for k in renderers)
            row = [name, f"{width}×{height}", backend, *(f"{ms[k]:.1f}" for k in renderers)]
            row += [f"{ms['mujoco'] / ms[k]:.1f}" for k in ("one", "four")]
            print(
                "|",
                " | ".join([*row, *(f"{np.abs(theirs - ours).mean():.2f}" for ours in (one, four))]),
                "|",
                flush=True,
            )
            for renderer in renderers.values():
                renderer.close()
            if (height, width) == SIZES[-1]:
                images.append(np.hstack([theirs, four, np.minimum(4 * np.abs(theirs - four), 255)]))
    if sheet:
        from PIL import Image

        Image.fromarray(np.vstack(images).astype(np.uint8)).save(sheet)


def main() -> None:
    """Print the table; each backend runs in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, nargs="*", default=[], help="MJCF files")
    parser.add_argument("--backends", nargs="+", default=["egl", "osmesa"], help="values of MUJOCO_GL")
    parser.add_argument("--frames", type=int, default=20, help="drawn frames of each renderer")
    parser.add_argument("--sheet", type=Path, help="file of MuJoCo's images, ours, and four times the difference")
    given = parser.parse_args()
    if len(given.backends) == 1 and os.environ.get("MUJOCO_GL") == given.backends[0]:
        compare(given.backends[0], given.models, given.frames, given.sheet)
        return
    print("| model | size | backend | MuJoCo, ms | 1 sample, ms | 4 samples, ms | ratio, 1 | 4 | difference, 1 | 4 |")
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for backend in given.backends:
        command = [sys.executable, "-W", "ignore", __file__, "--backends", backend, "--frames", str(given.frames)]
        command += ["--models", *map(str, given.models)] if given.models else []
        command += ["--sheet", str(given.sheet)] if given.sheet else []
        done = subprocess.run(command, env={**os.environ, "MUJOCO_GL": backend}, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            print(f"{backend} cannot draw here: {reason}", file=sys.stderr)


if __name__ == "__main__":
    main()
