"""Record values that stock LIBERO computes for the 130 tasks of its own suites, for comparisons with this package.

    PYTHONPATH=src:. LIBERO/bin/python scripts/libero_suite_records.py states predicates --out FOLDER

It runs in the environment of stock LIBERO that `results/libero_suites.md` builds. One file per kind and task: repeat
the command to make missing ones. `pack` selects what the tests use. Tasks, states, seeds and scenes below, except those
of `loads`, were chosen before any comparison. Records contain computed numbers and pictures only, no files of LIBERO.

Episode i has initial state i and seed 7 + i: `env.seed`, `env.reset`, `set_init_state`, ten steps without motion, as
LeRobot does. The seed matters because LIBERO draws the poses of fixtures, which initial states do not contain.
LIBERO draws the joints of (Open|Close|TurnOn|TurnOff x) in `:init`, before the poses, once for each load of the model
so far; the records follow the second load, the first reset of an environment.
"""

from __future__ import annotations

import argparse
import gc
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from scripts.libero_records import (
    COMPILED,
    NO_OP,
    RECORDS,
    STABILISATION_STEPS,
    cache_compiled,
    fields,
    fingerprint,
    fixture_poses,
    holds,
    middle_of,
    set_state,
    settle,
)

SUITES = {"libero_spatial": 10, "libero_object": 10, "libero_goal": 10, "libero_10": 10, "libero_90": 90}
"""Suite -> number of tasks."""
STATES, FIRST_STATES, FIRST_SEED = 50, 5, 7
"""Initial states per task, those of `first_states`, and the seed of episode 0; episode i has seed 7 + i."""
PREDICATE_STATES, SETTLED = 160, 8
"""States per task in which the goal is evaluated: 20,800; the first 8 are settled by physics."""
HANDS = [*((suite, k) for suite in SUITES if suite != "libero_90" for k in (1, 3, 5, 7))]
HANDS += [("libero_90", k) for k in (10, 30, 50, 70)]
"""Tasks of driven hands: 100 smooth random actions from initial state 0."""
HAND_STEPS, SMOOTHNESS = 100, 0.9
SCENES = [(suite, k) for suite in SUITES if suite != "libero_90" for k in range(0, 10, 2)]
SCENES += [("libero_90", k) for k in (0, 6, 11, 18, 22, 28, 33, 35, 38, 40, 46, 50, 55, 60, 65, 69, 73, 77, 81, 86)]
"""Tasks of pictures, all 20 scenes of libero_90 among them; entry k shows initial state k."""
SIZE = 256
OBSERVED = [("libero_spatial", 0), ("libero_object", 3), ("libero_10", 3)]
"""Tasks of observations by LeRobot's environment and processor, episode 0: after reset and after two steps."""
DRAWN_JOINTS = [("libero_spatial", 4), ("libero_10", 3), ("libero_10", 8), ("libero_10", 9)]
DRAWN_JOINTS += [("libero_90", k) for k in (*range(6), *range(22, 40))]
"""Tasks with (Open|Close|TurnOn|TurnOff x) in `:init`."""

OPEN, CLOSED = -1.0, 1.0
Waypoint = tuple[str, tuple[float, float, float], float, int]
"""Body or site, offset from it when the waypoint becomes the current one, m, gripper action, and fewest steps."""


def carry(thing: str, place: str, grasp: tuple[float, float, float], drop: float) -> list[Waypoint]:
    """Return the waypoints that grasp an object at an offset and drop it from a height over a place."""
    x, y, z = grasp
    return [
        *((thing, (x, y, z + 0.12), OPEN, 0), (thing, grasp, OPEN, 0), (thing, grasp, CLOSED, 12)),
        *((thing, (x, y, z + 0.22), CLOSED, 0), (place, (x, y, z + 0.25), CLOSED, 0)),
        *((place, (x, y, z + drop), CLOSED, 0), (place, (x, y, z + drop), OPEN, 15), (place, (x, y, 0.25), OPEN, 0)),
    ]


SUCCESSES: dict[tuple[str, int], list[Waypoint]] = {
    ("libero_spatial", 2): carry("akita_black_bowl_1", "plate_1", (0.0, 0.045, 0.04), 0.02),
    ("libero_object", 1): carry("cream_cheese_1", "basket_1", (0.0, 0.0, 0.0), 0.15),
    ("libero_goal", 6): carry("cream_cheese_1", "akita_black_bowl_1", (0.0, 0.0, 0.0), 0.1),
    ("libero_10", 7): [
        *carry("alphabet_soup_1", "basket_1", (0.0, 0.0, 0.02), 0.13),
        *carry("cream_cheese_1", "basket_1", (0.0, 0.0, 0.0), 0.15),
    ],
    ("libero_90", 0): [
        ("wooden_cabinet_1_top_region", (0.0, 0.2, 0.1), CLOSED, 0),
        ("wooden_cabinet_1_top_region", (0.0, 0.2, 0.01), CLOSED, 0),
        ("wooden_cabinet_1_top_region", (0.0, -0.1, 0.01), CLOSED, 0),
    ],
}
"""Task -> waypoints of an execution from initial state 0 that succeeds."""
WAYPOINT_STEPS, REACHED, STEP_LENGTH = 100, 0.006, 0.05
"""Most steps to a waypoint, its tolerance and the displacement of a full action, m."""

Arrays = dict[str, NDArray[Any]]


class Place(NamedTuple):
    """A task of LIBERO."""

    suite: str
    number: int

    @property
    def file(self) -> str:
        """Name of the task's records."""
        return f"{self.suite}.{self.number:02}.npz"


ALL = [Place(suite, index) for suite, count in SUITES.items() for index in range(count)]


# --- stock LIBERO ---


def suite_of(place: Place) -> Any:
    """Return LIBERO's benchmark object of a suite."""
    from libero.libero import benchmark

    return benchmark.get_benchmark_dict()[place.suite]()


def make(place: Place, images: bool = False) -> Any:
    """Return LIBERO's environment of a task, after its first reset; with images, each step renders both cameras."""
    from libero.libero.envs.env_wrapper import ControlEnv

    env = ControlEnv(
        suite_of(place).get_task_bddl_file_path(place.number),
        use_camera_obs=images,
        has_offscreen_renderer=images,
        camera_heights=SIZE,
        camera_widths=SIZE,
    )
    env.reset()
    return env


def initial_states(place: Place) -> NDArray[np.float64]:
    """Return LIBERO's initial states of a task: time, qpos, qvel, (50, 1 + nq + nv)."""
    return np.asarray(suite_of(place).get_task_init_states(place.number))


def start(env: Any, states: NDArray[np.float64], episode: int) -> Any:
    """Reset to an episode, and return the observation after the steps without motion.

    A reset without a new model equals one with it to the bit once the gripper's filter is cleared.
    """
    env.env.hard_reset = False
    env.seed(FIRST_SEED + episode)
    env.reset()
    env.robots[0].gripper.current_action[:] = 0.0
    observation = env.set_init_state(states[episode])
    for _ in range(STABILISATION_STEPS):
        observation = env.step(NO_OP)[0]
    return observation


def goal(env: Any) -> list[str]:
    """Return the atoms of the goal."""
    return [" ".join(atom) for atom in env.env.parsed_problem["goal_state"]]


# --- records: one function per kind, of an environment ---


def models(place: Place, env: Any) -> Arrays:
    """Record the fields of the model that affect physics, and both cameras."""
    (model,) = COMPILED.values()
    cameras = [model.camera(name).id for name in ("agentview", "robot0_eye_in_hand")]
    seen = {name: np.array(getattr(model, name)[cameras]) for name in ("cam_pos", "cam_quat", "cam_fovy", "cam_bodyid")}
    return {**fields(model), **seen, "name": np.array(suite_of(place).get_task(place.number).name)}


def first_states(place: Place, env: Any) -> Arrays:
    """Record the first episodes' starts, for an early comparison."""
    return states(place, env, FIRST_STATES)


def states(place: Place, env: Any, episodes: int = STATES) -> Arrays:
    """Record fixtures, state and success of each episode after its reset."""
    initial, found = initial_states(place), []
    for episode in range(episodes):
        start(env, initial, episode)
        sim = env.sim.data
        found.append((fixture_poses(env.env), np.array(sim.qpos), np.array(sim.qvel), env.check_success()))
    fixtures, qpos, qvel, success = (np.array(values) for values in zip(*found, strict=True))
    return {"fixtures": fixtures, "qpos": qpos, "qvel": qvel, "success": success}


def predicates(place: Place, env: Any) -> Arrays:
    """Record the atoms of the goal and the goal itself in perturbed states."""
    initial, rng = initial_states(place), np.random.default_rng(5)
    start(env, initial, 0)
    atoms, qpos, answers = goal(env), [], []
    for sampled in perturbed_states(env, atoms, initial, rng):
        rounded = np.round(sampled * 1e6).astype(np.int32)
        set_state(env, rounded / 1e6)
        qpos.append(rounded)
        answers.append([*(holds(env.env, atom) for atom in atoms), env.check_success()])
    return {
        "atoms": np.array(atoms),
        "fixtures": fixture_poses(env.env),
        "qpos": np.array(qpos),
        "answers": np.array(answers, bool),
    }


def perturbed_states(
    env: Any, atoms: list[str], initial: NDArray[np.float64], rng: np.random.Generator
) -> Iterator[NDArray[np.float64]]:
    """Yield states with objects in, on and near the places of the goal, and joints near their thresholds."""
    model, data = env.sim.model._model, env.sim.data._data
    heights: dict[str, list[float]] = {}
    for k in range(PREDICATE_STATES):
        set_state(env, initial[k % STATES, 1 : 1 + model.nq])
        set_joints(env, rng)
        env.sim.forward()
        for atom in atoms:
            _, thing, *place = atom.split()
            if place and rng.random() < 0.85:
                put(env, thing, place[0], heights.setdefault(atom, []), k, rng)
        if k < SETTLED:
            data.qvel[:] = 0
            settle(model, data)
            for atom in atoms:
                _, thing, *place = atom.split()
                if place:
                    heights.setdefault(atom, []).append(float(data.qpos[address_of(model, thing) + 2]))
        yield np.array(data.qpos)


def set_joints(env: Any, rng: np.random.Generator) -> None:
    """Set random positions of drawers, doors and knobs, half of them near a threshold of their class."""
    model, data = env.sim.model._model, env.sim.data._data
    for fixture in env.env.fixtures_dict.values():
        edges = {0.0}.union(*fixture.object_properties.get("articulation", {}).values())
        for joint in fixture.joints:
            low, high = model.joint(joint).range
            near = sorted(edges)[rng.integers(len(edges))] + rng.normal(0, 0.003)
            value = near if rng.random() < 0.5 else rng.uniform(low, high)
            data.qpos[model.joint(joint).qposadr[0]] = np.clip(value, low - 0.002, high + 0.002)


def put(env: Any, thing: str, place: str, heights: list[float], k: int, rng: np.random.Generator) -> None:
    """Put an object at, in or near a place: near its height at rest, or at a random height with a tilt."""
    model, data = env.sim.model._model, env.sim.data._data
    address = address_of(model, thing)
    middle, spread = middle_of(env.env, place)
    data.qpos[address : address + 2] = middle[:2] + rng.uniform(-1, 1, 2) * spread * rng.choice([0.3, 0.6, 1.0])
    if k < SETTLED:
        data.qpos[address + 2] = middle[2] + 0.04
    elif k % 2 and heights:
        data.qpos[address + 2] = heights[rng.integers(len(heights))] + rng.uniform(-0.004, 0.004)
    else:
        data.qpos[address + 2] = middle[2] + rng.uniform(-0.06, 0.12)
        tilted = np.zeros(4)
        small = np.array([1.0, *rng.normal(0, 0.15, 3) / 2])
        mujoco.mju_mulQuat(tilted, small, data.qpos[address + 3 : address + 7].copy())
        data.qpos[address + 3 : address + 7] = tilted / np.linalg.norm(tilted)
    env.sim.forward()


def address_of(model: mujoco.MjModel, thing: str) -> int:
    """Return the first index of an object's pose in qpos."""
    return int(model.joint(f"{thing}_joint0").qposadr[0])


def hands(place: Place, env: Any) -> Arrays:
    """Record qpos and grip site of a driven hand, and the observed hand, at each step."""
    start(env, initial_states(place), 0)
    rng, found, played = np.random.default_rng(place.number), [], []
    action: NDArray[np.float64] = np.zeros(7)
    for _ in range(HAND_STEPS):
        action = SMOOTHNESS * action + (1 - SMOOTHNESS) * rng.uniform(-1, 1, 7) * 3
        played.append(np.clip(action, -1, 1))
        observation = env.step(played[-1])[0]
        site = env.sim.data.get_site_xpos("gripper0_grip_site")
        found.append((np.array(env.sim.data.qpos), np.array(site), observation["robot0_eef_pos"]))
    qpos, site, observed = (np.array(values) for values in zip(*found, strict=True))
    return {"actions": np.array(played), "qpos": qpos, "eef": site, "observed_eef": observed}


def successes(place: Place, env: Any) -> Arrays:
    """Record the actions of a scripted execution up to its success, and qpos at each step."""
    start(env, initial_states(place), 0)
    actions, qpos = [], []
    for name, offset, gripper, fewest in SUCCESSES[place.suite, place.number]:
        target = position_of(env, name) + offset
        for step in range(WAYPOINT_STEPS):
            away = target - env.sim.data.get_site_xpos("gripper0_grip_site")
            if step >= fewest and np.abs(away).max() < REACHED:
                break
            actions.append(np.array([*np.clip(away / STEP_LENGTH, -1, 1), 0, 0, 0, gripper]))
            env.step(actions[-1])
            qpos.append(np.array(env.sim.data.qpos))
            if env.check_success():
                return {"actions": np.array(actions), "qpos": np.array(qpos), "success": np.array(len(actions))}
    raise AssertionError(f"no success in {place}")


def position_of(env: Any, name: str) -> NDArray[np.float64]:
    """Return the position of an object, fixture or site."""
    bodies = env.env.obj_body_id
    return np.array(env.sim.data.body_xpos[bodies[name]] if name in bodies else env.sim.data.get_site_xpos(name))


def pictures(place: Place, env: Any) -> Arrays:
    """Record both pictures of an episode's start, upright, and its state."""
    episode = SCENES.index((place.suite, place.number))
    names = ("agentview_image", "robot0_eye_in_hand_image")
    show(env, names, False)  # the steps before need no pictures
    start(env, initial_states(place), episode)
    show(env, names, True)
    observation = env.env._get_observations(force_update=True)
    images = np.array([observation[name][::-1] for name in names])
    state = {"qpos": np.array(env.sim.data.qpos), "fixtures": fixture_poses(env.env)}
    return {"images": images, "episode": np.array(episode), **state}


def show(env: Any, names: Iterable[str], enabled: bool) -> None:
    """Switch the pictures of an observation on or off."""
    for name in names:
        env.env.modify_observable(name, "enabled", enabled)


def observations(place: Place, env: Any) -> Arrays:
    """Record the observations of LeRobot's environment and processor in both control modes."""
    from lerobot.envs.libero import LiberoEnv
    from lerobot.envs.utils import preprocess_observation
    from lerobot.processor.env_processor import LiberoProcessorStep

    found: Arrays = {}
    raw = LiberoEnv(suite_of(place), place.number, place.suite, obs_type="pixels_agent_pos")
    for mode in ("relative", "absolute"):
        raw.control_mode, raw.init_state_id = mode, 0
        observation, _ = raw.reset(seed=FIRST_SEED)
        eef = observation["robot_state"]["eef"]["pos"]
        for step in range(3):
            for key, value in flat(observation):
                found[f"{mode}.{step}.raw.{key}"] = np.array(value)
            batch = {key: batched(value) for key, value in observation.items()}
            for key, value in LiberoProcessorStep().observation(preprocess_observation(batch)).items():
                found[f"{mode}.{step}.processed.{key}"] = value.numpy()
            found[f"{mode}.{step}.qpos"] = np.array(raw._env.sim.data.qpos)
            action = np.array([0.3, -0.4, 0.2, 0.1, -0.2, 0.3, 1.0])
            if mode == "absolute":
                action = np.array([*(eef + np.array([0.02, -0.03, 0.01])), 3.1, 0.05, -0.1, 1.0])
            found[f"{mode}.{step}.action"] = action
            observation = raw.step(action)[0]
        found[f"{mode}.fixtures"] = fixture_poses(raw._env.env)
    raw.close()
    return found


def loads(place: Place, env: Any) -> Arrays:
    """Record fixtures in the first two episodes of LeRobot's environment, after three and four loads of the model."""
    lerobots, found = make(place), []
    for episode in range(2):
        lerobots.seed(FIRST_SEED + episode)
        lerobots.reset()
        found.append(fixture_poses(lerobots.env))
    lerobots.close()
    return {"fixtures": np.array(found)}


def flat(nested: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested dictionaries with dotted keys."""
    for key, value in nested.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def batched(value: Any) -> Any:
    """Add a batch axis to each array, as a vector environment does."""
    return {key: batched(one) for key, one in value.items()} if isinstance(value, dict) else np.asarray(value)[None]


KINDS: dict[str, tuple[Callable[[Place, Any], Arrays], list[Place]]] = {
    "models": (models, ALL),
    "first_states": (first_states, ALL),
    "states": (states, ALL),
    "predicates": (predicates, ALL),
    "hands": (hands, [Place(*place) for place in HANDS]),
    "successes": (successes, [Place(*place) for place in SUCCESSES]),
    "pictures": (pictures, [Place(*place) for place in SCENES]),
    "observations": (observations, [Place(*place) for place in OBSERVED]),
    "loads": (loads, [Place(*place) for place in DRAWN_JOINTS]),
}
"""Kind -> its function and its tasks."""


def record(kinds: list[str], suites: list[str], out: Path) -> None:
    """Make the missing records of some kinds, task by task."""
    cache_compiled()
    for place in (place for place in ALL if place.suite in suites):
        missing = [kind for kind in kinds if place in KINDS[kind][1] and not (out / kind / place.file).exists()]
        env = None
        for kind in missing:
            if kind not in ("observations", "loads") and env is None:
                env = make(place, images="pictures" in missing)
            path = out / kind / place.file
            path.parent.mkdir(parents=True, exist_ok=True)
            draft = path.with_suffix(".draft.npz")
            np.savez_compressed(draft, allow_pickle=False, **KINDS[kind][0](place, env))
            os.replace(draft, path)
            print(kind, path.name, flush=True)
        if env is not None:
            env.close()
            gc.collect()  # environments have circular references


def pack(records: Path, path: Path) -> None:
    """Write the part of the records that the tests use: fingerprints of all models, and the successes' actions."""
    known = [dict(np.load(records / "models" / place.file)) for place in ALL]
    names = [name for name in known[0] if not name.startswith(("cam_", "name"))]
    kept: Arrays = {"tasks": np.array([str(stored["name"]) for stored in known]), "fields": np.array(names)}
    kept["fingerprints"] = np.array([[fingerprint(stored[name]) for name in names] for stored in known])
    for suite, number in SUCCESSES:
        kept[f"{suite}:task_id"] = np.array(number)
        kept[f"{suite}:actions"] = np.load(records / "successes" / Place(suite, number).file)["actions"]
    np.savez_compressed(path / "executions.npz", allow_pickle=False, **kept)
    seen: Arrays = {}
    for place in (Place(*key) for key in OBSERVED[:2]):
        for name, values in np.load(records / "observations" / place.file).items():
            if name.startswith("relative.") and "processed.observation.images" not in name:
                thinned = values[::4, ::4] if "raw.pixels" in name else values
                if "raw.pixels" not in name or ".0." in name:
                    seen[f"{place.suite}:{name.removeprefix('relative.')}"] = thinned
    np.savez_compressed(path / "observations.npz", allow_pickle=False, **seen)


def main() -> None:
    """Make the selected records."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+", choices=[*KINDS, "pack"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--suites", nargs="+", choices=SUITES, default=[*SUITES])
    args = parser.parse_args()
    if args.kinds == ["pack"]:
        pack(args.out, RECORDS)
    else:
        record(args.kinds, args.suites, args.out)


if __name__ == "__main__":
    main()
