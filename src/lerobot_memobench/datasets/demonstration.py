"""A demonstration in memory, its labels and its hash.

Episodes recorded by the scripted expert and episodes read from HDF5 both become a `Demonstration`. Every checkpoint
column of a dataset is computed from it by `labels`, so that writers, validators and policies use the same definition.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import (
    ACTION_DIM,
    CAMERAS,
    CONTROL_HZ,
    EXECUTION,
    LIBERO,
    NO_CLOCK,
    OBS_PHASE,
    OBS_STEP,
    PROMPT,
    PROPRIO_DIM,
    WORLD,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.memory_text import memory_text, subtask_texts
from lerobot_memobench.tasks.task import LEVELS, OPERATIONS, STRICT, Task

MAX_CHECKPOINTS = 6  # width of `checkpoint.completed`: no task of the benchmark has more checkpoints
MIN_FRAMES_BETWEEN_ROWS = 5
"""LeRobot's ``emitted_at`` searches 0.1 s to either side and raises if it finds two rows of a style, so rows of one
style must be more than 0.2 s apart: at 20 frames/s, at least 5 frames."""
LEVEL_COLUMNS = {level: f"subgoal.{level}" for level in LEVELS}
"""Level of a checkpoint's text -> column with its text at every frame."""
INSTRUCTION_COLUMN, MEMORY_COLUMN, HELD_COLUMN = "subgoal.instruction", "oracle_memory", "held"
HASHED = {
    "index": "checkpoint.index",
    "operation": "checkpoint.operation",
    "completed": "checkpoint.completed",
    "event": "checkpoint.event",
    "simple_subgoal": LEVEL_COLUMNS["intermediate"],
    "grounded_subgoal": LEVEL_COLUMNS["fine"],
    "memory": MEMORY_COLUMN,
}
"""Name of a label in an episode's hash -> its column."""
Labels = dict[str, Any]  # column -> T values: an array, or a list of texts
LanguageRow = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode, T frames of it; frame t is the observation before ``actions[t]`` was applied.

    Frames before ``exec_start`` are the demonstration prompt and the rest after it, whose actions are zeros. Predicates
    are evaluated after a control step of the execution, so ``satisfied`` is false in the prompt and at ``exec_start``.

    Raises:
        MemobenchError: arrays have different lengths, or another type or width than stated below.
    """

    task: Task  # the performed variant of the task: `task.variant(k)` for `variant` k > 0
    seed: int
    referent: str  # "fixed" or "random"; of a strict task "drawn"
    variant: int  # number of the requested referent or order; 0 is the published one
    states: NDArray[np.float64]  # (T, D), the simulator's flattened state (1 + nq + nv)
    actions: NDArray[np.float32]  # (T, 7), OSC pose deltas and gripper: labels of the frames
    proprio: NDArray[np.float32]  # (T, 8), end-effector position 3, axis-angle 3, gripper joints 2
    images: dict[str, NDArray[np.uint8]] | None  # "image" and "wrist_image" to (T, H, W, 3)
    exec_start: int  # first frame of the execution
    satisfied: NDArray[np.bool_]  # (T, K), whether the predicate of checkpoint k is true at frame t
    success: bool
    objects: NDArray[np.float32]  # (T, SIZE), the visible objects (`sim.object_slots`)
    fixture_poses: dict[str, NDArray[np.float64]] = field(default_factory=dict)  # to (7,) position and quaternion wxyz
    scene_hash: str = ""  # of the initial scene
    stand_ins: tuple[str, ...] = ()  # classes of the scene whose missing scans this package's objects replaced
    executed: NDArray[np.float32] | None = None  # (T, 7), the applied actions of a perturbed episode; None: `actions`
    held: NDArray[np.bool_] | None = None  # (T,), whether the scene is held, so that the action, zeros, has no effect

    def __post_init__(self) -> None:
        for problem in self._problems():
            raise MemobenchError(f"demonstration of {self.task.name} with seed {self.seed}: {problem}")

    def _problems(self) -> Iterator[str]:
        length, images = len(self.states), self.images or {}
        arrays: dict[str, tuple[NDArray | None, type, tuple[int | None, ...]]] = {
            "states": (self.states, np.float64, (None,)),
            "actions": (self.actions, np.float32, (ACTION_DIM,)),
            "proprio": (self.proprio, np.float32, (PROPRIO_DIM,)),
            "satisfied": (self.satisfied, np.bool_, (len(self.task.checkpoints),)),
            "objects": (self.objects, np.float32, (None,)),
            "executed": (self.executed, np.float32, (ACTION_DIM,)),
            "held": (self.held, np.bool_, ()),
            **{f"images[{camera!r}]": (frames, np.uint8, (None, None, 3)) for camera, frames in images.items()},
        }
        for name, (array, dtype, widths) in arrays.items():
            if array is None:
                continue
            expected = tuple("any" if n is None else n for n in (length, *widths))
            same_shape = array.ndim == len(expected) and all(map(lambda n, m: n in ("any", m), expected, array.shape))
            if array.dtype != np.dtype(dtype) or not same_shape:
                types = f"{name} has type {array.dtype} and shape {array.shape}"
                yield f"{types}, expected {np.dtype(dtype)} and {expected}"
        if images and set(images) != set(CAMERAS):
            yield f"images of {sorted(images)} given, expected {sorted(CAMERAS)} or none"
        if not 0 <= self.exec_start < length:
            yield f"execution starts at frame {self.exec_start} of {length}; expected one of the episode's frames"
        if self.satisfied[: self.exec_start].any():
            yield f"a checkpoint is satisfied in the demonstration prompt, before frame {self.exec_start}"

    def __len__(self) -> int:
        """Return T, demonstration prompt included."""
        return len(self.states)

    @property
    def applied(self) -> NDArray[np.float32]:
        """The applied actions (T, 7); replaying them gives the states."""
        return self.actions if self.executed is None else self.executed


# --- labels ---


def labels(demo: Demonstration) -> Labels:
    """Return the label columns of a demonstration by their names in a dataset, T values each (`layout.COLUMNS`).

    A checkpoint is completed in order at the first frame at which its predicate is true and all earlier checkpoints
    were completed at this frame or before. Several may be completed at one frame. A predicate that was true too early
    and is false in its turn is not completed in order; ``completed`` and ``event`` ignore the order. After the last
    checkpoint its texts remain, so the columns of subgoals are never empty.
    """
    task, length = demo.task, len(demo)
    if len(task.checkpoints) > MAX_CHECKPOINTS:
        raise MemobenchError(
            f"task {task.name} has {len(task.checkpoints)} checkpoints; the column checkpoint.completed has room for "
            f"{MAX_CHECKPOINTS}; merge some of them"
        )
    completion = key_frames(demo)
    # An event's own frame does not count: its checkpoint is the present one until the next frame.
    index = np.searchsorted(completion[completion >= 0], np.arange(length), side="left").astype(np.int64)
    ever = np.logical_or.accumulate(demo.satisfied, axis=0)
    # One entry per value of index, 0 ... K; the last follows the last checkpoint. A code is a position in "SUC".
    codes = [OPERATIONS.index(checkpoint.operation) for checkpoint in task.checkpoints] + [-1]
    texts = {
        LEVEL_COLUMNS[level]: [checkpoint.language[number] for checkpoint in task.checkpoints] or [task.language]
        for number, level in enumerate(LEVELS)
    }
    texts[INSTRUCTION_COLUMN] = subtask_texts(task)
    texts = {column: [*of_index, of_index[-1]] for column, of_index in texts.items()}
    texts[MEMORY_COLUMN] = [memory_text(task, k) for k in range(len(task.checkpoints) + 1)]
    frames = np.arange(length)
    acting = frames >= demo.exec_start
    step = np.where(acting, NO_CLOCK if task.suite == STRICT else frames - demo.exec_start, frames)
    return {
        OBS_PHASE: np.where(acting, EXECUTION, PROMPT).astype(np.float32),
        OBS_STEP: step.astype(np.float32),
        HELD_COLUMN: np.zeros(length, np.bool_) if demo.held is None else demo.held,
        "checkpoint.index": index,
        "checkpoint.operation": np.array(codes, dtype=np.int64)[index],
        "checkpoint.completed": np.pad(ever, [(0, 0), (0, MAX_CHECKPOINTS - ever.shape[1])]),
        "checkpoint.event": np.asarray(np.diff(ever, axis=0, prepend=False).any(axis=1)),
        **{column: [of_index[k] for k in index] for column, of_index in texts.items()},
    }


def key_frames(demo: Demonstration) -> NDArray[np.int64]:
    """Return the frame (K,) at which each checkpoint was completed in order (`labels`), -1 if it never was."""
    completion = np.full(demo.satisfied.shape[1], -1, dtype=np.int64)
    frame = 0
    for k in range(demo.satisfied.shape[1]):
        holds = np.flatnonzero(demo.satisfied[frame:, k])
        if holds.size == 0:
            break
        frame += int(holds[0])  # the next checkpoint may hold at this same frame
        completion[k] = frame
    return completion


# --- language rows ---


def persistent_rows(columns: Labels) -> list[LanguageRow]:
    """Return an episode's language rows for LeRobot's training recipes, sorted by timestamp, style, role.

    LeRobot stores them in the column ``language_persistent``: one list per episode, repeated on every frame, each row
    active from its timestamp until the next of its style (``lerobot.datasets.language``). The styles are those of its
    annotation pipeline: ``subtask`` (the next step, as an instruction) and ``memory`` (the completed steps, in the past
    tense; none before the first completion).
    """
    # A text that is replaced within 0.2 s gets no row: the text before it stays active until the one after it begins,
    # so no row names a completion too early.
    rows = [_row("subtask", text, frame) for frame, text in _changes(columns[INSTRUCTION_COLUMN])]
    rows += [_row("memory", text, frame) for frame, text in _changes(columns[MEMORY_COLUMN]) if text]
    return sorted(rows, key=lambda row: (row["timestamp"], row["style"], row["role"]))


def _changes(texts: list[str]) -> list[tuple[int, str]]:
    changes: list[tuple[int, str]] = []
    for frame, text in enumerate(texts):
        if not text or (frame > 0 and text == texts[frame - 1]):
            continue
        if changes and frame - changes[-1][0] < MIN_FRAMES_BETWEEN_ROWS:
            replaced, _ = changes.pop()
            frame = 0 if replaced == 0 else frame  # a text must be active from the first frame on
        changes.append((frame, text))
    return changes


def _row(style: str, text: str, frame: int) -> LanguageRow:
    # LeRobot's frame timestamps are float32; a row must equal its frame's to the bit.
    timestamp = float(np.float32(frame / CONTROL_HZ))
    return {
        "role": "assistant",
        "content": text,
        "style": style,
        "timestamp": timestamp,
        # LeRobot's annotation writer uses None here, but `lerobot-dataset-viz` cannot open such a dataset: torch's
        # collate function does not accept None. LeRobot's recipes treat empty values like None.
        "camera": "",
        "tool_calls": [],
    }


# --- the hash ---


def digest(demo: Demonstration) -> str:
    """Return the sha256 (hex) of an episode: identity, states, actions and the label columns.

    Images are not hashed: they are determined by the states, and a renderer may differ in a pixel where physics does
    not. Visible objects and the other labels are determined by the hashed columns too.
    """
    frame_labels = labels(demo)
    identity = {
        "task": demo.task.name,
        "seed": demo.seed,
        "referent": demo.referent,
        "variant": demo.variant,
        "exec_start": demo.exec_start,
        "success": bool(demo.success),
        WORLD: LIBERO,
    }
    columns: Labels = {"states": demo.states, "actions": demo.actions, "key_frames": key_frames(demo)}
    if demo.executed is not None:
        columns["executed"] = demo.executed
    if demo.held is not None and demo.held.any():  # the column changes no hash of an episode without holds
        columns["held"] = demo.held
    columns |= {name: frame_labels[column] for name, column in HASHED.items()}
    columns["phase"] = frame_labels[OBS_PHASE].astype(np.int64)
    # The hash is independent of byte order, memory layout and dictionary order.
    sha = hashlib.sha256(json.dumps(identity, sort_keys=True).encode())
    for name in sorted(columns):
        column = columns[name]
        if isinstance(column, list):
            sha.update(json.dumps([name, column]).encode())
            continue
        flat = np.ascontiguousarray(column).astype(column.dtype.newbyteorder("<"), copy=False)
        sha.update(json.dumps([name, flat.dtype.str, list(flat.shape)]).encode())
        sha.update(flat.tobytes())
    return sha.hexdigest()
