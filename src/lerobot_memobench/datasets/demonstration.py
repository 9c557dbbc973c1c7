"""The one in-memory form of a demonstration, and the one place its labels are computed.

An episode is recorded by the scripted expert, read from HDF5 or taken from a rollout; whatever its origin it
becomes a :class:`Demonstration`. Every checkpoint column of the dataset is a function of it, :func:`labels`,
so that writers, validators and policies cannot disagree about what a column means.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.memory_text import memory_text
from lerobot_memobench.tasks.task import LEVELS, OPERATIONS, Task

FPS = 20
"""Control steps, and therefore frames, per second (paper, section 5.1)."""

MAX_CHECKPOINTS = 6
"""Width of ``checkpoint.completed``: no task of the benchmark has more checkpoints."""

ACTION_DIM = 7
PROPRIO_DIM = 8
CAMERAS = ("image", "wrist_image")

PROMPT, EXECUTION = 0, 1
"""Values of ``phase``."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode, T frames of it; frame t shows what was seen before ``actions[t]`` was applied.

    Attributes:
        task: the task as it was carried out; with ``variant`` k > 0 this is ``task.variant(k)`` already.
        seed: seed of the scene.
        referent: ``"fixed"`` or ``"random"``.
        variant: which admissible referent or order was asked for; 0 is the published one.
        states: (T, D) float64, the simulator's flattened state (1 + nq + nv).
        actions: (T, 7) float32, OSC pose deltas and gripper, as they were really applied.
        proprio: (T, 8) float32, end-effector position 3, axis-angle 3, gripper joints 2.
        images: ``{"image", "wrist_image"}`` to (T, H, W, 3) uint8, or None.
        exec_start: the frame at which execution starts; the frames before it are the prompt video.
        satisfied: (T, K) bool, predicate of checkpoint k true at frame t; false throughout the prompt. The
            world is evaluated after a control step, so frame ``exec_start`` (step 0) is false as well.
        success: whether the goal was reached.
        fixture_poses: fixture name to (7,) position and quaternion wxyz.
        model_xml: the scene as MJCF, or empty.
        scene_hash: hash of the initial scene, or empty.

    Raises:
        MemobenchError: arrays of different length, or of another type or width than stated above.
    """

    task: Task
    seed: int
    referent: str
    variant: int
    states: NDArray[np.float64]
    actions: NDArray[np.float32]
    proprio: NDArray[np.float32]
    images: dict[str, NDArray[np.uint8]] | None
    exec_start: int
    satisfied: NDArray[np.bool_]
    success: bool
    fixture_poses: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    model_xml: str = ""
    scene_hash: str = ""

    def __post_init__(self) -> None:
        length, count = len(self.states), len(self.task.checkpoints)
        self._check("states", self.states, np.float64, (length, None))
        self._check("actions", self.actions, np.float32, (length, ACTION_DIM))
        self._check("proprio", self.proprio, np.float32, (length, PROPRIO_DIM))
        self._check("satisfied", self.satisfied, np.bool_, (length, count))
        for camera, frames in (self.images or {}).items():
            self._check(f"images[{camera!r}]", frames, np.uint8, (length, None, None, 3))
        if self.images is not None and set(self.images) != set(CAMERAS):
            raise MemobenchError(
                f"{self._where()}: images of {sorted(self.images)} given, expected {sorted(CAMERAS)} or none"
            )
        if not 0 <= self.exec_start < max(length, 1) or length == 0:
            raise MemobenchError(
                f"{self._where()}: execution starts at frame {self.exec_start} of {length}; "
                "it must be one of the episode's frames"
            )
        if self.satisfied[: self.exec_start].any():
            raise MemobenchError(
                f"{self._where()}: a checkpoint is satisfied in the prompt video, before frame "
                f"{self.exec_start}; "
                "checkpoints count from the start of execution only"
            )

    def _where(self) -> str:
        return f"demonstration of {self.task.name} with seed {self.seed}"

    def _check(self, name: str, array: NDArray, dtype: type, shape: tuple[int | None, ...]) -> None:
        matches = len(array.shape) == len(shape) and all(
            want is None or have == want for have, want in zip(array.shape, shape, strict=False)
        )
        if array.dtype != np.dtype(dtype) or not matches:
            want = tuple("any" if n is None else n for n in shape)
            raise MemobenchError(
                f"{self._where()}: {name} has type {array.dtype} and shape {array.shape}, "
                f"expected {np.dtype(dtype)} and {want}"
            )

    def __len__(self) -> int:
        """Return T, the number of frames, prompt video included."""
        return len(self.states)

    @property
    def steps(self) -> int:
        """Number of execution frames, those held after success included."""
        return len(self) - self.exec_start

    def prefix(self, length: int) -> Demonstration:
        """Return the first ``length`` frames; their labels are the first ``length`` labels of the whole."""
        if not self.exec_start < length <= len(self):
            raise MemobenchError(
                f"{self._where()}: a prefix of {length} frames was asked for; "
                f"it must reach into the execution, frames {self.exec_start + 1} to {len(self)}"
            )
        images = None if self.images is None else {k: v[:length] for k, v in self.images.items()}
        cut = {name: getattr(self, name)[:length] for name in ("states", "actions", "proprio", "satisfied")}
        return replace(self, images=images, **cut)


@dataclass(frozen=True, eq=False)
class Labels:
    """Per-frame columns of one episode of T frames (attribute to column name: :meth:`columns`).

    Attributes:
        phase: (T,) int64, 0 prompt, 1 execution.
        index: (T,) int64, checkpoints completed in order at frames before t: the number of the one worked on.
        operation: (T,) int64, 0 S, 1 U, 2 C of that checkpoint, -1 when none is left.
        completed: (T, 6) bool, checkpoint k has been satisfied at some frame up to and including t.
        event: (T,) bool, some checkpoint is satisfied for the first time at frame t.
        simple_subgoal: T strings, intermediate-level text of the checkpoint worked on. Once all are done the
            last one's text stays (``operation`` is -1 there), so the column is never empty.
        grounded_subgoal, coarse_subgoal: the same at the fine and at the coarse level.
        memory: T strings, intermediate-level texts of the checkpoints completed in order before t, joined by
            "; "; empty at the start. The oracle memory of the paper (:mod:`lerobot_memobench.tasks.memory_text`).
        key_frames: (K,) int64, the frame at which checkpoint k was completed in order, -1 if it never was.
    """

    phase: NDArray[np.int64]
    index: NDArray[np.int64]
    operation: NDArray[np.int64]
    completed: NDArray[np.bool_]
    event: NDArray[np.bool_]
    simple_subgoal: list[str]
    grounded_subgoal: list[str]
    coarse_subgoal: list[str]
    memory: list[str]
    key_frames: NDArray[np.int64]

    def columns(self) -> dict[str, NDArray | list[str]]:
        """Return the dataset's column names and their T values each."""
        return {
            "phase": self.phase,
            "checkpoint.index": self.index,
            "checkpoint.operation": self.operation,
            "checkpoint.completed": self.completed,
            "checkpoint.event": self.event,
            "simple_subgoal": self.simple_subgoal,
            "grounded_subgoal": self.grounded_subgoal,
            "coarse_subgoal": self.coarse_subgoal,
            "memory": self.memory,
        }


def labels(demo: Demonstration) -> Labels:
    """Compute every checkpoint column of a demonstration.

    A checkpoint is completed in order at the first frame at which its predicate holds while all earlier ones
    have been completed (at that frame or before it). Several may be completed at one frame. A predicate that
    held too early and no longer holds when its turn comes is not completed, though ``completed`` and
    ``event``, which ignore the order, show it.
    """
    checkpoints, length = demo.task.checkpoints, len(demo)
    count = len(checkpoints)
    if count > MAX_CHECKPOINTS:
        raise MemobenchError(
            f"task {demo.task.name} has {count} checkpoints; the column checkpoint.completed has room for "
            f"{MAX_CHECKPOINTS}, so merge some of them"
        )
    key_frames = _ordered_completion(demo.satisfied)
    done = np.zeros(length, dtype=np.int64)  # completed in order at frames <= t
    for frame in key_frames[key_frames >= 0]:
        done[frame:] += 1
    index = np.concatenate([[0], done[:-1]]).astype(np.int64)

    ever = np.logical_or.accumulate(demo.satisfied, axis=0)
    first = ever.copy()
    first[1:] &= ~ever[:-1]
    completed = np.zeros((length, MAX_CHECKPOINTS), dtype=np.bool_)
    completed[:, :count] = ever

    # One entry per value of index, 0 ... K; the last stands for "none left". A code is a position in "SUC".
    codes = [OPERATIONS.index(c.operation) for c in checkpoints] + [-1]
    texts = {
        level: _with_last_kept([c.language[k] for c in checkpoints] or [demo.task.language], count)
        for k, level in enumerate(LEVELS)
    }
    memories = [memory_text(demo.task, k) for k in range(count + 1)]
    return Labels(
        phase=np.where(np.arange(length) < demo.exec_start, PROMPT, EXECUTION).astype(np.int64),
        index=index,
        operation=np.array(codes, dtype=np.int64)[index],
        completed=completed,
        event=np.asarray(first.any(axis=1), dtype=np.bool_),
        simple_subgoal=[texts["intermediate"][k] for k in index],
        grounded_subgoal=[texts["fine"][k] for k in index],
        coarse_subgoal=[texts["coarse"][k] for k in index],
        memory=[memories[k] for k in index],
        key_frames=key_frames,
    )


def _ordered_completion(satisfied: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(T, K) truth table to (K,) frames of ordered completion, -1 for never."""
    key_frames = np.full(satisfied.shape[1], -1, dtype=np.int64)
    frame = 0
    for k in range(satisfied.shape[1]):
        holds = np.flatnonzero(satisfied[frame:, k])
        if holds.size == 0:
            break
        frame += int(holds[0])  # the next checkpoint may hold at this same frame
        key_frames[k] = frame
    return key_frames


def _with_last_kept(texts: Sequence[str], count: int) -> list[str]:
    return [*texts, texts[-1]] if count else list(texts)


def digest(demo: Demonstration) -> str:
    """Return the sha256 (hex) of an episode: identity, states, actions and the label columns.

    Images are left out: they follow from the states, and a renderer may differ in a pixel where physics does
    not. So is ``coarse_subgoal``, which the other columns and the task decide: it came later than the first datasets,
    and their hashes stay what they are.
    """
    found = labels(demo)
    identity = {
        "task": demo.task.name,
        "seed": demo.seed,
        "referent": demo.referent,
        "variant": demo.variant,
        "exec_start": demo.exec_start,
        "success": bool(demo.success),
    }
    columns: dict[str, NDArray | list[str]] = {"states": demo.states, "actions": demo.actions}
    columns |= {f.name: getattr(found, f.name) for f in fields(found) if f.name != "coarse_subgoal"}
    return digest_columns(identity, columns)


def digest_columns(identity: dict, columns: dict[str, NDArray | list[str]]) -> str:
    """Hash an identity and named columns; independent of byte order, memory layout and dictionary order."""
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
