"""Compare this package's simulation of LIBERO's suites with the records of `libero_suite_records.py`.

    PYTHONPATH=src:. python scripts/libero_suite_compare.py models states --records FOLDER

Prints each difference above the bound of its kind, and per kind the number of compared values and the largest
difference. Run it under MuJoCo 3.3.7, the version of the records.
"""

from __future__ import annotations

import argparse
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim import placement
from lerobot_memobench.sim.robot import SUBSTEPS
from lerobot_memobench.sim.scene import get_scene
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.libero_suites import get_libero_task, initial_states, libero_tasks
from scripts.libero_records import fields
from scripts.libero_suite_records import ALL, FIRST_SEED, Place

Arrays = dict[str, NDArray[Any]]
Differences = Iterator[tuple[str, int, float]]
"""What was compared, number of compared values, and the largest difference."""
CAMERAS = {"agentview": "agentview", "wrist": "robot0_eye_in_hand"}


def simulate(place: Place) -> Simulation:
    """Return the simulation of a task."""
    return Simulation(get_libero_task(libero_tasks(place.suite)[place.number]))


def start(sim: Simulation, episode: int) -> None:
    """Reset to an episode."""
    sim.reset(FIRST_SEED + episode, state=initial_states(sim.task.name)[episode])


def apart(ours: Any, theirs: Any) -> float:
    """Return the largest difference of two arrays; infinite for different shapes."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    if ours.shape != theirs.shape:
        return np.inf
    if ours.dtype.kind == "U":
        return float(not np.array_equal(ours, theirs))
    return float(np.abs(ours.astype(float) - theirs.astype(float)).max(initial=0.0))


def poses(sim: Simulation) -> NDArray[np.float64]:
    """Return the poses of the fixtures, (n, 7)."""
    return np.array(list(sim.fixture_poses().values())).reshape(-1, 7)


def set_recorded(sim: Simulation, qpos: NDArray[np.float64], fixtures: NDArray[np.float64]) -> None:
    """Set a recorded state without velocity."""
    state = np.concatenate([[0.0], qpos, np.zeros(sim.model.nv)])
    sim.set_state(state, dict(zip(sim.fixture_poses(), fixtures, strict=True)))


# --- comparisons: one function per kind ---


def models(place: Place, kept: Arrays) -> Differences:
    """Compare the fields of the model, and the cameras."""
    task = get_libero_task(libero_tasks(place.suite)[place.number])
    yield "name", 1, float(task.name != str(kept["name"]))
    model = get_scene(task).model
    for name, values in fields(model).items():
        yield name, values.size, apart(values, kept[name])
    cameras = [model.camera(name).id for name in CAMERAS.values() if has_camera(model, name)]
    for name in ("cam_pos", "cam_quat", "cam_fovy"):
        yield name, len(cameras), apart(getattr(model, name)[cameras], kept[name])


def has_camera(model: mujoco.MjModel, name: str) -> bool:
    """Return whether a model has a camera."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name) >= 0


def states(place: Place, kept: Arrays) -> Differences:
    """Compare fixtures, positions and velocities after the reset of each episode."""
    sim = simulate(place)
    for episode in range(len(kept["qpos"])):
        start(sim, episode)
        yield f"fixtures of episode {episode}", 1, apart(poses(sim), kept["fixtures"][episode])
        yield f"qpos of episode {episode}", 1, apart(sim.data.qpos, kept["qpos"][episode])
        yield f"qvel of episode {episode}", 1, apart(sim.data.qvel, kept["qvel"][episode])
        yield f"success of episode {episode}", 1, float(succeeds(sim) != kept["success"][episode])


def succeeds(sim: Simulation) -> bool:
    """Return whether the goal holds."""
    return all(sim.holds(atom) for atom in atoms(sim.task.goal))


def predicates(place: Place, kept: Arrays) -> Differences:
    """Compare the atoms of the goal, and the goal, in perturbed states: 1 for a different answer."""
    sim = simulate(place)
    names = [str(atom) for atom in kept["atoms"]]
    found = []
    for qpos in kept["qpos"]:
        set_recorded(sim, qpos / 1e6, kept["fixtures"])
        answers = [sim.holds(Atom(word, tuple(args))) for word, *args in (name.split() for name in names)]
        found.append([*answers, succeeds(sim)])
    for column, name in enumerate([*names, "goal"]):
        for k, (ours, theirs) in enumerate(zip(np.array(found)[:, column], kept["answers"][:, column], strict=True)):
            yield f"{name} in state {k}: theirs {theirs}", 1, float(ours != theirs)


def hands(place: Place, kept: Arrays) -> Differences:
    """Compare positions of arm, fingers and objects under random actions."""
    sim = simulate(place)
    start(sim, 0)
    for step, action in enumerate(kept["actions"]):
        sim.step(action)
        yield f"arm at step {step}", 1, apart(sim.data.qpos[:9], kept["qpos"][step, :9])
        yield f"objects at step {step}", 1, apart(sim.data.qpos[9:], kept["qpos"][step, 9:])


def successes(place: Place, kept: Arrays) -> Differences:
    """Compare the step of success, and positions, of a scripted execution."""
    sim = simulate(place)
    start(sim, 0)
    success = 0
    for step, action in enumerate(kept["actions"]):
        sim.step(action)
        success = success or (step + 1 if succeeds(sim) else 0)
        yield f"qpos at step {step}", 1, apart(sim.data.qpos, kept["qpos"][step])
    yield f"step of success {success}, theirs {kept['success']}", 1, abs(success - int(kept["success"]))


def pictures(place: Place, kept: Arrays) -> Differences:
    """Compare both pictures of an episode's start in the recorded state: mean difference of 255."""
    sim = simulate(place)
    start(sim, int(kept["episode"]))
    set_recorded(sim, kept["qpos"], kept["fixtures"])
    for camera, theirs in zip(CAMERAS, kept["images"], strict=True):
        ours = sim.render(camera).astype(float)
        yield camera, 1, float(np.abs(ours - theirs).mean())


def observations(place: Place, kept: Arrays) -> Differences:
    """Compare LeRobot's observations after the reset and after two steps of relative actions.

    Stock LIBERO observes fingers and joints 2 ms before the end of the control step, hand and pictures 4 ms before it.
    """
    sim, shown = simulate(place), simulate(place)
    moments = watched_start(sim)
    yield "fixtures (LeRobot loads the model once more)", 1, apart(poses(sim), kept["relative.fixtures"])
    for step in range(3):
        (hand, drawn), (fingers, _), (state, last) = moments
        theirs = kept[f"relative.{step}.processed.observation.state"][0]
        yield f"state at the end of step {step}", 1, apart(state, theirs)
        yield f"earlier_state of step {step}", 1, apart([*hand[:6], *fingers[6:]], theirs)
        for camera, name in zip(CAMERAS, ("image", "image2"), strict=True):
            image = 255 * kept[f"relative.{step}.processed.observation.images.{name}"][0].transpose(1, 2, 0)
            for time, qpos in (("", last), ("earlier_", drawn)):
                set_recorded(shown, qpos, kept["relative.fixtures"])
                ours = shown.render(camera).astype(float)
                yield f"{time}mirrored_{camera} at step {step}", 1, float(np.abs(ours[:, ::-1] - image).mean())
                yield f"{time}unmirrored_{camera} at step {step}", 1, float(np.abs(ours - image).mean())
        action = kept[f"relative.{step}.action"]
        sim._controller.set_goal(sim.data, action)
        moments = []
        for substeps in (SUBSTEPS - 2, 1, 1):
            sim._controller.advance(sim.data, float(action[6]), substeps)
            moments.append((sim.proprio(), sim.data.qpos.copy()))


def watched_start(sim: Simulation) -> Sequence[tuple[NDArray[Any], NDArray[Any]]]:
    """Reset to episode 0, and return proprioception and qpos after its last three physics steps."""
    moments: deque[tuple[NDArray[Any], NDArray[Any]]] = deque(maxlen=3)
    advance = sim._controller.advance

    def watched(*args: Any, **options: Any) -> None:
        advance(*args, **options)
        moments.append((sim.proprio(), sim.data.qpos.copy()))

    with patch.object(sim._controller, "advance", watched):
        start(sim, 0)
    return moments


def loads(place: Place, kept: Arrays) -> Differences:
    """Compare fixtures with those of LeRobot's episodes, after as many loads of the model and after ours."""
    sim, usual = simulate(place), placement.MODEL_LOADS
    for episode, theirs in enumerate(kept["fixtures"]):
        placement.MODEL_LOADS = usual + 1 + episode
        sim._placer.place(FIRST_SEED + episode)
        placement.MODEL_LOADS = usual
        yield f"fixtures of LeRobot's episode {episode}", 1, apart(poses(sim), theirs)
        sim._placer.place(FIRST_SEED + episode)
        for name, ours, pose in zip(sim.fixture_poses(), poses(sim), theirs, strict=True):
            yield f"distance of {name} in episode {episode}", 1, float(np.linalg.norm(ours[:3] - pose[:3]))


KINDS: dict[str, tuple[Callable[[Place, Arrays], Differences], str, float]] = {
    "observations": (observations, "observations", 1e-5),
    "loads": (loads, "loads", 1e-9),
    "models": (models, "models", 0.0),
    "first_states": (states, "first_states", 1e-9),
    "states": (states, "states", 1e-9),
    "predicates": (predicates, "predicates", 0.0),
    "hands": (hands, "hands", 1e-6),
    "successes": (successes, "successes", 1e-6),
    "pictures": (pictures, "pictures", 2.5),
}
"""Kind -> its comparison, the folder of its records and the largest difference."""


SHOWN = 4
"""Most differences of a task that are printed."""


def compare(kind: str, records: Path, suites: list[str]) -> None:
    """Print the differences of a kind."""
    function, folder, bound = KINDS[kind]
    tasks = values = outside = 0
    differences: dict[str, list[float]] = defaultdict(list)
    for place in ALL:
        path = records / folder / place.file
        if place.suite not in suites or not path.exists():
            continue
        tasks += 1
        with np.load(path, allow_pickle=False) as stored:
            kept = dict(stored)
        try:
            found = list(function(place, kept))
        except Exception as error:
            print(f"{kind} | {path.stem} | {type(error).__name__}: {error}", flush=True)
            continue
        shown = 0
        for name, count, difference in found:
            values += count
            group = name.split()[0] if kind != "models" else kind
            differences[group].append(difference)
            if not difference <= bound:
                outside += 1
                shown += 1
                if shown <= SHOWN:
                    print(f"{kind} | {path.stem} | {name} | {difference:.3g}", flush=True)
    summary = ", ".join(f"{name} {max(found):.2g} ({np.mean(found):.2g})" for name, found in differences.items())
    print(f"{kind}: {tasks} tasks, {values} values, {outside} outside {bound:g}; largest (mean) {summary}", flush=True)


def main() -> None:
    """Compare the selected kinds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+", choices=KINDS)
    parser.add_argument("--records", type=Path, required=True)
    parser.add_argument("--suites", nargs="+", default=sorted({place.suite for place in ALL}))
    args = parser.parse_args()
    print(f"MuJoCo {mujoco.__version__}")
    for kind in args.kinds:
        compare(kind, args.records, args.suites)


if __name__ == "__main__":
    main()
