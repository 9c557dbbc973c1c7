"""Rows of a rollout: each keeps its memory, its action chunk and the seed of its noise, independent of other rows."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.policies.compatibility import begins_episode, is_frozen
from lerobot_memobench.policies.memobench_mem.objects import HAND_DIM, rotation
from lerobot_memobench.policies.memory_reads import Chunk

STALLED, PER_RADIAN = 0.006, 0.1
"""Movement between two chunks below which the hand counts as stalled, m, and the length that a radian counts, m."""


@dataclass
class Row:
    """The episode of one environment.

    Attributes:
        clock: phase and control step since the phase began. position: control step since the episode began.
        memory: state of the memory mechanism; None before the first frame. intact: its state before a corruption.
        emptied: whether the next frame is the memory's first, after a corruption.
        stored: the last frame that was written.
        missed: step of the first frame that should have been written and was not observed; None: none.
        queue: remaining planned actions. last: the last action (A,).
        pose: of the hand when the last chunk was planned, and skipped: actions of that chunk that were left out
            (`begin_chunk`).
        reads: memory reads of the episode's chunks, if they are watched.
    """

    clock: tuple[int, int] | None = None
    position: int = 0
    frozen: bool = False
    memory: Any = None
    intact: Any = None
    emptied: bool = False
    stored: Tensor | None = None
    missed: int | None = None
    seed: int = 0
    queue: deque[Tensor] = field(default_factory=deque)
    last: Tensor | None = None
    pose: Tensor | None = None
    skipped: int = 0
    reads: list[Chunk] = field(default_factory=list)

    def drop_chunk(self) -> None:
        """Discard planned actions; the action is zero until the next plan."""
        self.queue.clear()
        self.last = self.pose = None

    def begin_chunk(self, chunk: Tensor, count: int, state: Tensor | None = None) -> None:
        """Queue the first ``count`` actions of a chunk (n, A), or the following ones if the hand has stalled.

        A hand that replans the same action after too few steps could stall forever. A hand whose pose is the same bit
        for bit has not stalled: the environment holds it, or it rests. A plan has ``count`` actions in all cases, as
        the policy declares to the environment, so that plans stay in step with its holds.

        Args:
            state: the robot's state (8,), m and rad, to compare with that of the last chunk; None: never stalled.
        """
        pose = None
        if state is not None:
            rotated = rotation(state[None, 3:HAND_DIM]).flatten() * PER_RADIAN
            pose = torch.cat([state[:3], rotated, state[HAND_DIM:]]).cpu()
        last, self.pose = self.pose, pose
        moved = 0.0 if pose is None or last is None else float((pose - last).abs().max())
        self.skipped = min(self.skipped + count, len(chunk) - count) if 0 < moved < STALLED else 0
        self.queue.extend(chunk[self.skipped : self.skipped + count])

    def draw_seed(self, observed: Iterable[Tensor]) -> None:
        """Set the seed of the episode's noise from its first observation and the process's seed."""
        digest = hashlib.blake2b(str(torch.initial_seed()).encode(), digest_size=7)
        for value in observed:
            digest.update(value.detach().to("cpu").contiguous().numpy().tobytes())
        self.seed = int.from_bytes(digest.digest(), "big")

    def noise(self, shape: tuple[int, int]) -> Tensor:
        """Return noise on the CPU for a chunk at the present position."""
        return torch.randn(shape, generator=torch.Generator().manual_seed(self.seed + self.position))


class Rollout:
    """The rows of a vector environment.

    A row detects by its clock that an episode begins or has ended (`begins_episode`, `is_frozen`). If observations have
    no clock, each observation is a control step.

    Args:
        remembers: whether frames are written.
        stride: control steps between written frames; an episode's first frame is always written.

    Attributes:
        late: whether the next observed frame replaces frames that were due and not observed.
    """

    def __init__(self, remembers: bool, stride: int) -> None:
        self.remembers, self.stride, self.late = remembers, stride, False
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.rows: list[Row] = []

    def observe(
        self, clocks: Sequence[tuple[int, int]], write: Callable[[list[int]], None]
    ) -> tuple[list[int], list[bool], list[bool]]:
        """Process one observation per row.

        Args:
            clocks: phase (0 prompt, 1 execution) of each row, and the control step since the phase began.
            write: writes the frames of given rows; called at most once.

        Returns:
            Per row: the control step since the episode began, prompt included; whether a new episode began; and
            whether the row is frozen.
        """
        if len(self.rows) != len(clocks):
            self.rows = [Row() for _ in clocks]
        before = [row.position for row in self.rows]
        started = [self._tick(row, clock) for row, clock in enumerate(clocks)]
        for held, begins, last in zip(self.rows, started, before, strict=True):
            due = (last // self.stride + 1) * self.stride  # the next written step
            if not begins and due < held.position and held.missed is None and not self.late:
                held.missed = due
        steps, frozen = [row.position for row in self.rows], [row.frozen for row in self.rows]
        written = [
            begins
            or held.emptied
            or step % self.stride == 0
            or (self.late and step // self.stride > last // self.stride)
            for held, begins, step, last in zip(self.rows, started, steps, before, strict=True)
        ]
        wanted = [row for row, writes in enumerate(written) if writes and not frozen[row]]
        if wanted and self.remembers:
            write(wanted)
        for row in wanted:
            self.rows[row].emptied = False
        return steps, started, frozen

    def _tick(self, number: int, clock: tuple[int, int]) -> bool:
        """Set a row's clock; return whether a new episode began."""
        row, step = self.rows[number], clock[1]
        last = row.clock
        if begins_episode(last, clock):
            self.rows[number] = Row(clock, max(step, 0))
            return True
        assert last is not None  # else an episode begins
        row.clock, row.frozen = clock, is_frozen(last, clock)
        if not row.frozen:  # the execution's clock starts at 0, continues the prompt's, or is missing
            row.position += step - last[1] if step > last[1] >= 0 else 1 + max(step, 0)
        return False

    def corrupt(self, rows: Sequence[int], changed: Callable[[int], Any]) -> None:
        """Replace the memories of rows.

        Args:
            changed: returns the new memory of a row; None: the row begins with its next frame, as an episode does.
        """
        for row in rows:
            self.rows[row].intact = self.rows[row].memory
        for row in rows:
            self.rows[row].memory = changed(row)
            self.rows[row].emptied = self.rows[row].memory is None

    def of_next(self, row: int) -> Any:
        """Return the memory of the next row of the batch, as it was before a corruption."""
        other = self.rows[(row + 1) % len(self.rows)]
        return other.memory if other.intact is None else other.intact

    def writes_next(self) -> bool:
        """Return whether the next frame of any row will be written."""
        moving = [row.position for row in self.rows if row.clock is not None and not row.frozen]
        return self.remembers and any((step + 1) % self.stride == 0 for step in moving)

    def missed(self, rows: Sequence[int]) -> int | None:
        """Return the first step of these rows that should have been written and was not observed; None: none."""
        steps = (self.rows[row].missed for row in rows)
        return min((step for step in steps if step is not None), default=None)
