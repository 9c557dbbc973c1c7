"""The one in-memory form of a demonstration.

An episode is recorded by the scripted expert, read from HDF5 or taken from a rollout; whatever its origin it becomes a
:class:`Demonstration`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import ACTION_DIM, CAMERAS, PROPRIO_DIM
from lerobot_memobench.tasks.task import Task


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode, T frames of it; frame t is the observation before ``actions[t]`` was applied.

    Attributes:
        task: the task as it was carried out; with ``variant`` k > 0 this is ``task.variant(k)`` already.
        seed: seed of the scene.
        referent: ``"fixed"`` or ``"random"``; of a strict task ``"drawn"``.
        variant: which admissible referent or order was asked for; 0 is the published one.
        states: (T, D) float64, the simulator's flattened state (1 + nq + nv).
        actions: (T, 7) float32, OSC pose deltas and gripper: the label of this frame.
        proprio: (T, 8) float32, end-effector position 3, axis-angle 3, gripper joints 2.
        images: ``{"image", "wrist_image"}`` to (T, H, W, 3) uint8, or None.
        exec_start: the frame at which execution starts; the frames before it are the demonstration prompt.
        satisfied: (T, K) bool, predicate of checkpoint k true at frame t; false throughout the prompt. The
            world is evaluated after a control step, so frame ``exec_start`` (step 0) is false as well.
        success: whether the goal was reached.
        fixture_poses: fixture name to (7,) position and quaternion wxyz.
        model_xml: the scene as MJCF, or empty.
        scene_hash: hash of the initial scene, or empty.
        objects: (T, SIZE) float32, the visible objects (`sim.object_slots`), or None.
        executed: (T, 7) float32, the actions really applied where the arm was moved off its way; None: ``actions``.

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
    objects: NDArray[np.float32] | None = None
    executed: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        length, count = len(self.states), len(self.task.checkpoints)
        self._check("states", self.states, np.float64, (length, None))
        self._check("actions", self.actions, np.float32, (length, ACTION_DIM))
        self._check("proprio", self.proprio, np.float32, (length, PROPRIO_DIM))
        self._check("satisfied", self.satisfied, np.bool_, (length, count))
        if self.objects is not None:
            self._check("objects", self.objects, np.float32, (length, None))
        if self.executed is not None:
            self._check("executed", self.executed, np.float32, (length, ACTION_DIM))
        self._check_images(length)
        self._check_start(length)

    def _check_images(self, length: int) -> None:
        for camera, frames in (self.images or {}).items():
            self._check(f"images[{camera!r}]", frames, np.uint8, (length, None, None, 3))
        if self.images is not None and set(self.images) != set(CAMERAS):
            raise MemobenchError(
                f"{self._where()}: images of {sorted(self.images)} given, expected {sorted(CAMERAS)} or none"
            )

    def _check_start(self, length: int) -> None:
        if not 0 <= self.exec_start < max(length, 1) or length == 0:
            raise MemobenchError(
                f"{self._where()}: execution starts at frame {self.exec_start} of {length}; "
                "it must be one of the episode's frames"
            )
        if self.satisfied[: self.exec_start].any():
            raise MemobenchError(
                f"{self._where()}: a checkpoint is satisfied in the demonstration prompt, before frame "
                f"{self.exec_start}; checkpoints count from the start of execution only"
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
        """Return T, the number of frames, demonstration prompt included."""
        return len(self.states)

    @property
    def applied(self) -> NDArray[np.float32]:
        """The actions (T, 7) that moved the arm: played again, they give the states."""
        return self.actions if self.executed is None else self.executed

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
        columns = ("states", "actions", "proprio", "satisfied", "objects", "executed")
        cut: dict[str, Any] = {
            name: None if (whole := getattr(self, name)) is None else whole[:length] for name in columns
        }
        return replace(self, images=images, **cut)
