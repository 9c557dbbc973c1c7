"""Records of stock LIBERO, and simulations, for tests of scenes.

The programs that made the records, in an environment of stock LIBERO with MuJoCo 3.3.7, are in commit d63b3615:
`scripts/libero_records.py` and `scripts/libero_suite_records.py`.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.sim.scene import ARENA_BYTES, scene_xml
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom

RECORDS = Path(__file__).parents[1] / "sim/libero"
VISIBLE_GROUP, HIDDEN_GROUP = 5, 4
"""Groups of sites in MuJoCo's renderer."""


@cache
def record(kind: str) -> dict[str, NDArray[Any]]:
    with np.load(RECORDS / f"{kind}.npz", allow_pickle=False) as stored:
        return dict(stored)


def recorded_answers(sim: Simulation, kept: dict[str, NDArray[Any]], name: str) -> tuple[list[Atom], list[list[bool]]]:
    """Return a task's recorded atoms, and their values in the simulator in each recorded state."""
    atoms = [Atom(word, tuple(names)) for word, *names in (str(one).split() for one in kept[f"{name}:atoms"])]
    fixtures = dict(zip(sim.fixture_poses(), kept[f"{name}:fixtures"], strict=True))
    state, found = np.zeros(sim.state_dim), []
    for qpos in kept[f"{name}:qpos"]:
        state[1 : 1 + sim.model.nq] = qpos / 1e6
        sim.set_state(state, fixtures)
        found.append([sim.holds(atom) for atom in atoms])
    return atoms, found


KINDS_OF_SCENES = (
    "check_the_middle_drawer_of_the_cabinet",
    "turn_on_the_stove_and_turn_it_off_near_the_shelf",
    "open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate",
    "put_the_tomato_into_the_top_drawer_and_the_biscuit_into_the_middle_drawer",
    "put_the_butter_picked_up_in_the_prompt_video_on_the_plate",
    "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt",
)
"""Tasks that together have every fixture, box and way of placing."""


def some_of_all(names: list[str]) -> list[Any]:
    """Return tasks as parameters of a test; all but one of each kind of scene are slow."""
    return [name if name in KINDS_OF_SCENES else pytest.param(name, marks=pytest.mark.slow) for name in names]


def simulate(name: str) -> Simulation:
    return Simulation(get_task(name))


# --- models ---

FIELDS = (
    *("body_parentid", "body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "body_iquat"),
    *("body_gravcomp", "body_subtreemass", "body_invweight0"),
    *("jnt_type", "jnt_bodyid", "jnt_range", "jnt_axis", "jnt_pos", "jnt_stiffness", "jnt_solref", "jnt_solimp"),
    *("jnt_margin", "jnt_limited", "jnt_qposadr"),
    *("dof_damping", "dof_armature", "dof_frictionloss", "dof_solref", "dof_solimp", "dof_invweight0"),
    *("geom_type", "geom_bodyid", "geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_condim", "geom_solref"),
    *("geom_solimp", "geom_margin", "geom_gap", "geom_contype", "geom_conaffinity", "geom_priority", "geom_solmix"),
    *("actuator_gear", "actuator_ctrlrange", "actuator_forcerange", "actuator_gainprm", "actuator_biasprm"),
    *("actuator_ctrllimited", "actuator_forcelimited", "actuator_dyntype", "actuator_trntype"),
    *("qpos0", "qpos_spring", "npair", "nexclude"),
)
POLYNOMIALS = ("jnt_stiffness", "dof_damping")
OPTIONS = (
    *("timestep", "solver", "iterations", "ls_iterations", "tolerance", "ls_tolerance", "noslip_iterations"),
    *("impratio", "cone", "jacobian", "integrator", "gravity", "density", "viscosity", "wind"),
    *("disableflags", "enableflags"),
)


def fields(model: mujoco.MjModel) -> dict[str, NDArray[Any]]:
    """Return the fields of a model that affect physics, and the names of bodies, joints and actuators."""
    kinds = {
        "body": mujoco.mjtObj.mjOBJ_BODY,
        "joint": mujoco.mjtObj.mjOBJ_JOINT,
        "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    }
    counts = {"body": model.nbody, "joint": model.njnt, "actuator": model.nu}
    found: dict[str, NDArray[Any]] = {}
    for kind, number in kinds.items():
        names = [mujoco.mj_id2name(model, number, i) or "" for i in range(counts[kind])]
        found[f"{kind}_names"] = np.array([name.removesuffix("_main") for name in names])
    touched = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    for name in FIELDS:
        values = np.asarray(getattr(model, name), dtype=np.float64)
        if name in POLYNOMIALS and values.ndim == 2:  # newer MuJoCo adds higher-order coefficients
            assert not values[:, 1:].any()
            values = values[:, 0]
        found[name] = values[touched] if name.startswith("geom_") else values
    for name in OPTIONS:
        found[f"opt_{name}"] = np.asarray(getattr(model.opt, name), dtype=np.float64)
    regions = [i for i in range(model.nsite) if model.site_type[i] == mujoco.mjtGeom.mjGEOM_BOX]
    found["region_names"] = np.array([mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SITE, i) for i in regions])
    for name in ("site_bodyid", "site_pos", "site_quat", "site_size"):
        found[name] = np.asarray(getattr(model, name), dtype=np.float64)[regions]
    return found


def fingerprint(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return a checksum (3,) of a field: size, weighted sum and sum of magnitudes; sensitive to values and order."""
    flat = values.ravel()
    if flat.dtype.kind == "U":
        flat = np.frombuffer("\n".join(flat.tolist()).encode(), np.uint8)
    flat = flat.astype(np.float64)
    return np.array([flat.size, flat @ np.cos(np.arange(flat.size)), np.abs(flat).sum()])


# --- images ---


def moved_scene(name: str, seed: int) -> Simulation:
    """Return a simulation with a random arm pose and random drawer, door and knob positions."""
    rng, sim = np.random.default_rng(seed), simulate(name)
    sim.reset(seed)
    action = np.append(rng.uniform(-0.6, 0.6, 6) * [1, 1, 0.5, 0.3, 0.3, 0.3], -1.0)
    for _ in range(25):
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


def mujocos(sim: Simulation, model: mujoco.MjModel, samples: int) -> list[NDArray[np.uint8]]:
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
