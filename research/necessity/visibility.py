"""Measure how far a drawer has to be pulled until a camera or the object observation shows its content.

    python -m research.necessity.visibility --scenes 5 --poses 400 --out outputs/visibility

Every drawer that holds an object is pulled by the same distance, its content with it. The agent's camera is fixed; the
wrist camera is tried from random poses of the arm near the cabinet. Per distance: the most pixels of a hidden object in
a picture, and in how many looks the object observation lists it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import typer
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.protocol import ACTION_DIM, EXECUTION, VALIDATION_SEED
from lerobot_memobench.sim import robot
from lerobot_memobench.sim.assets.registry import split_class
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.sim.scene import DEAD_CENTRE
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from research.command import run

DISTANCES = (DEAD_CENTRE["drawer"], 0.018, 0.020, 0.025, 0.030)
"""Distances by which drawers are pulled, m: at which the episode is lost, without a visible content, and beyond."""
NEAR = 0.30
"""Distance of the hand from the front of the cabinet within which a pose counts, m."""


def hidden(task: str, seed: int) -> Episode:
    """Return an episode of a finding task whose execution begins."""
    episode = Episode(get_task(task), referent="random", demonstration_prompt=False)
    episode.reset(seed)
    while episode.phase != EXECUTION:
        episode.step(np.zeros(ACTION_DIM, np.float32))
    return episode


def pull(sim: Simulation, places: tuple[tuple[str, str], ...], distance: float) -> None:
    """Pull the drawers in which something is hidden, with their content."""
    for thing, place in places:
        articulation, q = sim.world.articulation(place)
        address = int(sim.model.joint(articulation.joint).qposadr[0])
        before = sim.site_pose(place)[0]
        sim.data.qpos[address] = q - distance
        mujoco.mj_kinematics(sim.model, sim.data)
        free = int(sim.model.joint(int(sim.model.body(thing).jntadr[0])).qposadr[0])
        sim.data.qpos[free : free + 3] += sim.site_pose(place)[0] - before
    mujoco.mj_step1(sim.model, sim.data)


def poses(sim: Simulation, rng: np.random.Generator, count: int) -> Iterator[NDArray[np.float64]]:
    """Yield joint angles (7,) at which the hand is near the drawers."""
    addresses = [int(sim.model.joint(name).qposadr[0]) for name in robot.ARM_JOINTS]
    low, high = np.array([sim.model.joint(name).range for name in robot.ARM_JOINTS]).T
    front = np.mean([sim.site_pose(a.handle_site)[0] for a, _ in sim.world.joints.values()], axis=0)
    kept = sim.data.qpos.copy()
    while count:
        angles = np.clip(robot.ARM_START + rng.normal(0.0, 0.6, len(addresses)), low, high)
        sim.data.qpos[addresses] = angles
        mujoco.mj_kinematics(sim.model, sim.data)
        if np.linalg.norm(sim.eef_pose()[0] - front) < NEAR:
            count -= 1
            yield angles
    sim.data.qpos[:] = kept


def look(task: str, seed: int, count: int) -> dict[str, Any]:
    """Return the most pixels of a hidden object by camera and distance, and how many looks list one by distance."""
    episode = hidden(task, seed)
    sim, places = episode.sim, episode.task.prompt.places if episode.task.prompt else ()
    roots = [sim.model.body(thing).rootid[0] for thing, _ in places]
    content = np.isin(sim.model.body_rootid[sim.model.geom_bodyid], roots)
    kinds = {classes().index(split_class(sim.assets[thing].class_name)[0]) for thing, _ in places}
    pixels = {camera: [0] * len(DISTANCES) for camera in MJCF_CAMERAS}
    listed = [0] * len(DISTANCES)
    start = sim.snapshot()
    addresses = [int(sim.model.joint(name).qposadr[0]) for name in robot.ARM_JOINTS]
    for angles in [robot.ARM_START, *poses(sim, np.random.default_rng(seed), count)]:
        for level, distance in enumerate(DISTANCES):
            sim.restore(start)
            pull(sim, places, distance)
            sim.data.qpos[addresses] = angles
            mujoco.mj_step1(sim.model, sim.data)
            for camera, most in pixels.items():
                shown = sim.geoms(camera)
                most[level] = max(most[level], int(content[shown[shown >= 0]].sum()))
            seen = episode.objects().reshape(SLOTS, WIDTH)[:, STARTS["class"]].astype(int)
            listed[level] += bool(kinds & set(seen.tolist()))
    return {"task": task, "seed": seed, "poses": count, "pixels": pixels, "listed": listed}


def table(looks: list[dict[str, Any]]) -> str:
    """Return by distance the most pixels of a hidden object by camera, and the share of looks that list one."""
    tried = sum(one["poses"] + 1 for one in looks)
    lines = [
        f"{tried} looks, {len(looks)} scenes\n",
        f"| pulled, mm | {', pixels | '.join(MJCF_CAMERAS)}, pixels | object observation, looks |",
        "|---:|" + "---:|" * (len(MJCF_CAMERAS) + 1),
    ]
    for level, distance in enumerate(DISTANCES):
        most = " | ".join(str(max(one["pixels"][camera][level] for one in looks)) for camera in MJCF_CAMERAS)
        share = sum(one["listed"][level] for one in looks) / tried
        lines.append(f"| {1000 * distance:.0f} | {most} | {100 * share:.1f} % |")
    return "\n".join(lines)


def visibility(
    out: Annotated[Path, typer.Option(help="Folder of the looks; the same command goes on.")],
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each of the ten finding tasks.")] = 5,
    looks: Annotated[int, typer.Option("--poses", min=1, help="Poses of the arm per scene.")] = 400,
    seed: Annotated[int, typer.Option(help="First seed of the scenes.")] = VALIDATION_SEED,
) -> None:
    """Print the table, after scene 1 of all tasks, scene 2 and so on."""
    out.mkdir(parents=True, exist_ok=True)
    log = out / "looks.jsonl"
    found = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    done = {(one["task"], one["seed"], one["poses"]): one for one in found}
    asked = []
    for number in range(seed, seed + scenes):
        for task in (name for name in task_names(suite="strict") if name.startswith("find_")):
            if (one := done.get((task, number, looks))) is None:
                one = look(task, number, looks)
                with log.open("a") as file:
                    file.write(json.dumps(one) + "\n")
            asked.append(one)
    print(table(asked))


if __name__ == "__main__":
    sys.exit(run("necessity.visibility", visibility))
