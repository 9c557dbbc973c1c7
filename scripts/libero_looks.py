"""Compare pictures with MuJoCo's renderer on LIBERO's complete files, one scene of each task without scans.

    python scripts/libero_looks.py [--sheet FILE]

Needs ``PYTHONPATH=src:.`` and MuJoCo's renderer (``MUJOCO_GL=egl``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_memobench.sim.scene import ARENA_BYTES, scene_xml
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import Task

Pixels = NDArray[np.uint8]

FIRST_SEED = 21
"""First compared seed; the renderer was tuned on seed 7."""
STEPS = 25
"""Control steps with one random action before the comparison."""
DIFFERENT_ABOVE = 16
"""Error of a channel (of 255) above which a pixel counts as different."""
VISIBLE_GROUP, HIDDEN_GROUP = 5, 4
"""Groups of sites."""


def tasks() -> list[Task]:
    """Return the tasks whose classes are all from LIBERO."""
    return [task for name in task_names() if (task := get_task(name)).memory_type != "spatial"]


def scene(task: Task, seed: int) -> Simulation:
    """Return a simulation with a random arm pose and random drawer, door and knob positions."""
    rng, sim = np.random.default_rng(seed), Simulation(task)
    sim.reset(seed)
    action = np.append(rng.uniform(-0.6, 0.6, 6) * [1, 1, 0.5, 0.3, 0.3, 0.3], -1.0)
    for _ in range(STEPS):
        sim.step(action)
    for asset in sim.assets.values():
        for part in asset.articulations.values():
            low, high = sorted((part.closed_q, part.open_q))
            sim.data.joint(part.joint).qpos[0] = rng.uniform(low, high)
    mujoco.mj_step1(sim.model, sim.data)
    return sim


def whole_model(sim: Simulation) -> mujoco.MjModel:
    """Return LIBERO's scene with all meshes and textures; the burner is visible if it is on."""
    spec = mujoco.MjSpec.from_string(scene_xml(sim.task, visuals=True))
    spec.nconmax, spec.njmax, spec.memory = -1, -1, ARENA_BYTES
    for site in spec.sites:
        site.group = HIDDEN_GROUP
    for name, asset in sim.assets.items():
        for part in asset.articulations.values():
            if part.kind == "knob" and sim.data.joint(part.joint).qpos[0] >= part.on_at_least:
                spec.site(f"{name}_burner").group = VISIBLE_GROUP
    return spec.compile()


def mujocos(sim: Simulation, model: mujoco.MjModel, samples: int) -> list[Pixels]:
    """Return the images of both cameras from MuJoCo's renderer, with ``samples`` samples per pixel."""
    data = mujoco.MjData(model)
    for name, pose in sim.fixture_poses().items():
        body = model.body(name).id
        model.body_pos[body], model.body_quat[body] = pose[:3], pose[3:]
    data.qpos[:] = sim.data.qpos
    mujoco.mj_forward(model, data)
    model.vis.quality.offsamples = samples
    option, images = mujoco.MjvOption(), []
    option.geomgroup[0] = 0
    option.sitegroup[:] = 0
    option.sitegroup[VISIBLE_GROUP] = 1
    with mujoco.Renderer(model, sim.render_settings.height, sim.render_settings.width) as renderer:
        for camera in MJCF_CAMERAS.values():
            renderer.update_scene(data, camera, option)
            images.append(renderer.render())
    return images


def errors(sheet: Path | None) -> None:
    """Print the mean error (of 255) and the share of different pixels of each scene and camera."""
    table, rows = [], []
    print("task | seed | agentview, wrist (one sample) | differing | agentview, wrist (four samples)")
    for seed, task in enumerate(tasks(), FIRST_SEED):
        sim = scene(task, seed)
        ours = [sim.render(camera) for camera in MJCF_CAMERAS]
        model = whole_model(sim)
        row: list[float] = []
        for samples in (0, 4):
            theirs = mujocos(sim, model, samples)
            differences = [np.abs(a.astype(int) - b) for a, b in zip(ours, theirs, strict=True)]
            row += [float(error.mean()) for error in differences]
            row += [100 * float((error.max(axis=2) > DIFFERENT_ABOVE).mean()) for error in differences]
        table.append(row)
        rows.append(np.hstack([image for pair in zip(theirs, ours, strict=True) for image in pair]))
        print(_line(task.name, seed, row), flush=True)
    print(_line("mean", "", np.mean(table, axis=0).tolist()))
    print(_line("largest", "", np.max(table, axis=0).tolist()))
    if sheet:
        half = (len(rows) + 1) // 2
        rows += [np.zeros_like(rows[0])] * (2 * half - len(rows))
        Image.fromarray(np.hstack([np.vstack(rows[:half]), np.vstack(rows[half:])])).save(sheet)


def _line(name: str, seed: int | str, row: list[float]) -> str:
    one_sample, four_samples = (", ".join(f"{value:.2f}" for value in part) for part in (row[:2], row[4:6]))
    return f"{name} | {seed} | {one_sample} | {row[2]:.1f} %, {row[3]:.1f} % | {four_samples}"


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sheet", type=Path, help="file of all pictures")
    errors(parser.parse_args().sheet)


if __name__ == "__main__":
    main()
