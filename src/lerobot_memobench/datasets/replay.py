"""Replay an episode: recorded actions, played again in the simulator, give the recorded states, success and labels.

The scene is reset to the episode's seed and the actions are applied as they were recorded, in the prompt
video too; no expert and no gym environment is asked. Everything is compared exactly, bit for bit, but pictures: of each
camera some frames are drawn again, and videos are only near to what was drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import Demonstration, digest, labels, persistent_rows
from lerobot_memobench.datasets.lerobot_format.layout import EXECUTED_ACTION, OBJECTS, image_key, objects_column
from lerobot_memobench.datasets.lerobot_format.reading import Columns, RecordedEpisode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.demonstration_prompt import highlights_at
from lerobot_memobench.protocol import CAMERAS, CONTROL_HZ, IMAGE_SIZE
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task

PICTURES = 8
"""Frames of each camera that are drawn again, evenly chosen, the first, the last and that where execution starts among
them."""
NEAR_DB, NEAR_LEVELS, BLOCKS = 26.0, 40.0, 8
"""A recorded picture is of what was drawn if its PSNR is at least so many dB, and no block of 8 × 8 of them differs by
more than so many of 255 levels, channel by channel. Measured, at 32 to 256 pixels: H.264 as it is recorded 28.8 dB and
28 levels at worst, AV1 as LeRobot's tools encode again 28.1 and 33; five frames late 15.8 to 24.8 dB at the median, the
other camera 12."""

Pictures = Callable[[Sequence[int]], dict[str, NDArray[np.uint8]]]
"""Frame numbers (n,) to what each camera has there, (n, H, W, 3)."""


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


def replay(
    recorded: Demonstration | RecordedEpisode, *, task: Task | None = None, pictures: Pictures | None = None
) -> Disagreement | None:
    """Play an episode again and return the first disagreement, or None.

    Compared are states (where recorded), proprioception, visible objects, instruction, numbering and every label
    column, language rows, success, key frames, the scene's hash and the episode's: it covers the
    states, which LeRobot's dataset tools leave behind. ``task`` replaces the catalogue's task of that
    name, for datasets of tasks of one's own. ``pictures`` returns recorded pictures, to compare some frames.

    Raises:
        MemobenchError: no such task, the actions are gone, or there are pictures and nothing to draw them with.
    """
    if isinstance(recorded, Demonstration):
        task, start, wanted, executed = recorded.task, 0, recorded.actions, recorded.applied
        columns, whole = _columns(recorded, OBJECTS), _whole(recorded)
    else:
        published = (task or get_task(recorded.task_name)).in_world(recorded.world)
        task, start = published.variant(recorded.variant), recorded.start
        columns, whole = recorded.columns, recorded.whole
        if "action" not in columns:
            raise MemobenchError(
                "its frames have no column 'action' (a tool removed it), so nothing can be played again"
            )
        wanted, executed = columns["action"], columns[EXECUTED_ACTION if EXECUTED_ACTION in columns else "action"]
    watch = _PictureCheck(recorded.exec_start, len(wanted), pictures)
    again = resimulate(task, recorded.seed, executed, recorded.exec_start, watch)
    again = replace(again, referent=recorded.referent, variant=recorded.variant)
    if not np.array_equal(wanted, executed):
        again = replace(again, actions=wanted, executed=again.actions)
    found = _whole_difference(whole, _whole(again))
    if found is not None and found.column == "digest" and again.executed is not None:
        found = replace(found, column="action (it alone is in the episode's hash and not in its states)")
    frames = np.arange(len(wanted))
    numbering = {
        "task": [task.language] * len(wanted),
        "frame_index": frames,
        "index": start + frames,
        "timestamp": (frames / CONTROL_HZ).astype(np.float32),
    }
    replayed = numbering | _columns(again, objects_column(columns))
    return _first_difference(columns, replayed) or watch.difference or found


class _PictureCheck:
    """Draws some frames while an episode is played again, and keeps the first that was recorded otherwise."""

    def __init__(self, exec_start: int, length: int, pictures: Pictures | None) -> None:
        self.difference: Disagreement | None = None
        even = np.linspace(0, length - 1, PICTURES).round().astype(int).tolist()
        self._frames = sorted({*even, min(max(exec_start, 0), length - 1)})
        self._recorded = {} if pictures is None else pictures(self._frames)
        height, width = next((frames.shape[1:3] for frames in self._recorded.values()), (IMAGE_SIZE, IMAGE_SIZE))
        self.settings = RenderSettings(height=height, width=width)

    def compare(self, sim: Simulation, frame: int) -> None:
        """Compare the present pictures, where this frame is one of those chosen."""
        if frame not in self._frames or self.difference is not None:
            return
        for camera, frames in self._recorded.items():
            drawn, recorded = sim.render(CAMERAS[camera]), frames[self._frames.index(frame)]
            difference = _unlike(drawn, recorded)
            if difference:
                self.difference = Disagreement(image_key(camera), frame, difference, "what the simulator draws")
                return


def _unlike(drawn: NDArray[np.uint8], recorded: NDArray[np.uint8]) -> str:
    """Return how far a recorded picture is from one that was drawn, "" where a codec explains it."""
    if drawn.shape != recorded.shape:
        return f"a picture of {recorded.shape[0]}×{recorded.shape[1]} pixels"
    off = drawn.astype(np.float32) - recorded
    psnr = 10 * np.log10(255**2 / max(float((off**2).mean()), 1e-9))
    rows, columns = (np.linspace(0, size, BLOCKS + 1).astype(int)[:-1] for size in off.shape[:2])
    sums = np.add.reduceat(np.add.reduceat(off, rows, axis=0), columns, axis=1)
    areas = np.outer(np.diff([*rows, off.shape[0]]), np.diff([*columns, off.shape[1]]))
    levels = float(np.abs(sums / areas[..., None]).max())
    return f"a picture {psnr:.0f} dB and {levels:.0f} levels off" if psnr < NEAR_DB or levels > NEAR_LEVELS else ""


def resimulate(
    task: Task, seed: int, actions: NDArray[np.float32], exec_start: int, watch: _PictureCheck | None = None
) -> Demonstration:
    """Apply (T, 7) float32 actions, starting in the scene of ``seed``; return the demonstration they make.

    It has no images; ``watch`` looks at each frame. Where the prompt is over the scene goes back to where it began, but
    for what was hidden: at frame ``exec_start``, or where the robot begins to idle, which is an action of zeros.
    """
    sim = Simulation(task, None if watch is None else watch.settings)
    sim.reset(seed)
    start, scene_hash, fixture_poses = sim.snapshot(), sim.scene_hash(), sim.fixture_poses()
    progress = Progress(task)
    look = ObjectSlots(sim)
    states, proprio, satisfied = [], [], []
    objects: list[NDArray[np.float32]] = []
    success = False
    rests = False
    for frame, action in enumerate(actions):
        rested, rests = rests, task.idles and frame < exec_start and not action.any()
        if frame > 0 and not rested and (rests or frame == exec_start):
            sim.end_prompt(start, () if task.prompt is None else task.prompt.places)
        if frame > 0 and frame == exec_start:
            sim.begin_execution()
        sim.highlights = highlights_at(task, sim, frame) if frame < exec_start else ()
        if watch is not None:
            watch.compare(sim, frame)
        states.append(sim.state())
        proprio.append(sim.proprio())
        objects.append(objects[-1] if rests and rested else look.observe())
        satisfied.append(progress.satisfied)
        success = success or progress.success
        if not rests:
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


def _columns(demo: Demonstration, objects: str) -> Columns:
    """Return states, proprioception and labels under the dataset's column names; ``objects`` is that of the objects."""
    return {
        "states": demo.states,
        "observation.state": demo.proprio,
        objects: demo.objects,
        **labels(demo).columns(),
    }


def _whole(demo: Demonstration) -> dict[str, Any]:
    found = labels(demo)
    return {
        "memory_type": demo.task.memory_type,
        "family": demo.task.family,
        "operations": demo.task.operations,
        "success": demo.success,
        "key_frames": found.key_frames.tolist(),
        "scene_hash": demo.scene_hash,
        "fixture_poses": {name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()},
        "language_persistent": persistent_rows(found),
        "digest": digest(demo),
    }


def _first_difference(recorded: Columns, replayed: Columns) -> Disagreement | None:
    """The earliest frame at which a column that both have differs; at one frame, the first of the columns."""
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
