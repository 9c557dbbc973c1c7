"""Do recorded actions, played again in the simulator, give the recorded states, success and labels?

The scene is reset to the episode's seed and the actions are applied as they were recorded, in the prompt
video too; no expert and no gym environment is asked. Everything is compared exactly, bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.digest import digest
from lerobot_memobench.datasets.labels import labels
from lerobot_memobench.datasets.language import persistent_rows
from lerobot_memobench.datasets.lerobot_format.layout import EXECUTED_ACTION, OBJECTS, objects_column
from lerobot_memobench.datasets.lerobot_format.reading import Columns, RecordedEpisode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.prompts import highlights_at
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task


@dataclass(frozen=True)
class Disagreement:
    """The first thing that differs. ``frame`` is None for what belongs to the whole episode."""

    column: str
    frame: int | None
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        where = "" if self.frame is None else f" at frame {self.frame}"
        return f"{self.column}{where}: recorded {_short(self.recorded)}, replayed {_short(self.replayed)}"


def replay(recorded: Demonstration | RecordedEpisode, *, task: Task | None = None) -> Disagreement | None:
    """Play an episode again and return the first disagreement, or None.

    Compared are states (where recorded), proprioception, visible objects, every label column, language rows, success,
    key frames, the scene's hash and the episode's: it is of the states too, and so stands for them where LeRobot's
    dataset tools have left them behind. ``task`` replaces the catalogue's task of that name, for datasets of tasks of
    one's own.

    Raises:
        MemobenchError: no such task, or the actions are gone.
    """
    if isinstance(recorded, Demonstration):
        again = resimulate(recorded.task, recorded.seed, recorded.applied, recorded.exec_start)
        again = _labelled(again, recorded.actions, referent=recorded.referent, variant=recorded.variant)
        return _first_difference(demonstration_columns(recorded), demonstration_columns(again)) or _whole_difference(
            _whole(recorded), _whole(again)
        )
    task = (task or get_task(recorded.task_name)).variant(recorded.variant)
    if "action" not in recorded.columns:
        raise MemobenchError("its frames have no column 'action' (a tool removed it), so nothing can be played again")
    wanted = recorded.columns["action"]
    executed = recorded.columns[EXECUTED_ACTION if EXECUTED_ACTION in recorded.columns else "action"]
    again = resimulate(task, recorded.seed, executed, recorded.exec_start)
    again = _labelled(again, wanted, referent=recorded.referent)
    return _first_difference(
        recorded.columns, demonstration_columns(again, objects_column(recorded.columns))
    ) or _whole_difference(recorded.whole, _whole(again))


def resimulate(task: Task, seed: int, actions: NDArray[np.float32], exec_start: int) -> Demonstration:
    """Apply (T, 7) float32 actions, starting in the scene of ``seed``; return the demonstration they make.

    It has no images. At frame ``exec_start`` the scene goes back to where it began, as after a prompt video that hides
    nothing.
    """
    sim = Simulation(task)
    sim.reset(seed)
    start, scene_hash, fixture_poses = sim.snapshot(), sim.scene_hash(), sim.fixture_poses()
    progress = Progress(task)
    look = ObjectSlots(sim)
    states, proprio, objects, satisfied = [], [], [], []
    success = False
    for frame, action in enumerate(actions):
        if frame == exec_start and frame > 0:
            sim.end_prompt(start)
            sim.begin_execution()
        sim.highlights = highlights_at(task, sim, frame) if frame < exec_start else ()
        states.append(sim.state())
        proprio.append(sim.proprio())
        objects.append(look.observe())
        satisfied.append(progress.satisfied)
        success = success or progress.success
        sim.step(action)
        if frame >= exec_start:
            progress.step(sim.holds)
    return Demonstration(
        task=task,
        seed=seed,
        referent="fixed",
        variant=task.variant_index,
        states=np.array(states),
        actions=np.asarray(actions, dtype=np.float32),
        proprio=np.array(proprio, dtype=np.float32),
        images=None,
        exec_start=exec_start,
        satisfied=np.array(satisfied, dtype=np.bool_).reshape(len(states), len(task.checkpoints)),
        success=success,
        fixture_poses=fixture_poses,
        scene_hash=scene_hash,
        objects=np.array(objects),
    )


def _labelled(again: Demonstration, wanted: NDArray[np.float32], **identity: Any) -> Demonstration:
    """Say what was to be done in a demonstration that was played again, where something else was done."""
    if np.array_equal(wanted, again.actions):
        return replace(again, **identity)
    return replace(again, actions=wanted, executed=again.actions, **identity)


def demonstration_columns(demo: Demonstration, objects: str = OBJECTS) -> Columns:
    """Return states, proprioception and labels under the dataset's column names; ``objects`` is that of the objects."""
    seen = {} if demo.objects is None else {objects: demo.objects}
    return {"states": demo.states, "observation.state": demo.proprio, **seen, **labels(demo).columns()}


def _whole(demo: Demonstration) -> dict[str, Any]:
    found = labels(demo)
    return {
        "success": demo.success,
        "key_frames": found.key_frames.tolist(),
        "scene_hash": demo.scene_hash,
        "fixture_poses": {name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()},
        "language_persistent": persistent_rows(found),
        "digest": digest(demo),
    }


def _first_difference(recorded: Columns, replayed: Columns) -> Disagreement | None:
    """The earliest frame at which a column that both have differs; at one frame, states come first."""
    first: Disagreement | None = None
    for column, new in replayed.items():
        if column not in recorded:
            continue
        old = recorded[column]
        if np.shape(old) != np.shape(new):
            return Disagreement(f"shape of {column}", None, np.shape(old), np.shape(new))
        differs = [
            frame
            for frame, (a, b) in enumerate(zip(old, new, strict=True))
            if not np.array_equal(np.asarray(a), np.asarray(b))
        ]
        if differs and (first is None or first.frame is None or differs[0] < first.frame):
            first = Disagreement(column, differs[0], old[differs[0]], new[differs[0]])
    return first


def _whole_difference(recorded: dict[str, Any], replayed: dict[str, Any]) -> Disagreement | None:
    for key, old in recorded.items():
        if old != replayed[key]:
            return Disagreement(key, None, old, replayed[key])
    return None


def _short(value: Any) -> str:
    text = np.array2string(value, threshold=12) if isinstance(value, np.ndarray) else repr(value)
    return text if len(text) <= 200 else text[:197] + "..."
