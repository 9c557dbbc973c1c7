"""What the policy keeps of each row of a rollout: its memory, its action chunk, the seed of its noise.

Rows are independent: what one does depends on no other, nor on how many there are.
"""

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

STILL, PER_RADIAN = 0.006, 0.1
"""How little a hand or a finger may move from one chunk to the next to be still, m, and what a radian counts, m."""


@dataclass
class Row:
    """One environment's episode.

    Attributes:
        clock: phase and control step since the phase began. position: control step since the episode began.
        memory: state of the memory mechanism; None: nothing has been written.
        missed: the first step of a frame that was to be written and was not offered; None where all were.
        queue: planned actions that are left. last: action (A,) that was taken last; None: none.
        stood: the robot's pose when the last chunk was planned.
        reads: how much each of the episode's chunks has read, where that is watched.
    """

    clock: tuple[int, int] | None = None
    position: int = 0
    frozen: bool = False
    memory: Any = None
    missed: int | None = None
    seed: int = 0
    queue: deque[Tensor] = field(default_factory=deque)
    last: Tensor | None = None
    stood: Tensor | None = None
    reads: list[Chunk] = field(default_factory=list)

    def drop_chunk(self) -> None:
        """Forget planned actions; until there are others the action is zero."""
        self.queue.clear()
        self.last = self.stood = None

    def begin_chunk(self, chunk: Tensor, count: int, state: Tensor | None = None) -> None:
        """Take the first actions of a chunk (n, A).

        Args:
            count: how many. state: the robot's (8,), as it is, m and rad; with it, a hand that stands as it stood when
                the last chunk was planned carries out the whole chunk. Where each chunk would do the next thing later
                than it is carried out, the hand would stand there for ever.
        """
        stands = None
        if state is not None:
            turned = rotation(state[None, 3:HAND_DIM]).flatten() * PER_RADIAN
            stands = torch.cat([state[:3], turned, state[HAND_DIM:]]).cpu()
        stood, self.stood = self.stood, stands
        still = stands is not None and stood is not None and bool((stands - stood).abs().max() < STILL)
        self.queue.extend(chunk if still else chunk[:count])

    def draw_seed(self, observed: Iterable[Tensor]) -> None:
        """Draw the seed of the episode's noise, from its first observation and the process's seed."""
        digest = hashlib.blake2b(str(torch.initial_seed()).encode(), digest_size=7)
        for value in observed:
            digest.update(value.detach().to("cpu").contiguous().numpy().tobytes())
        self.seed = int.from_bytes(digest.digest(), "big")

    def noise(self, shape: tuple[int, int]) -> Tensor:
        """Return noise on the CPU for a chunk that is planned now."""
        return torch.randn(shape, generator=torch.Generator().manual_seed(self.seed + self.position))


class Rollout:
    """The rows of a vector environment.

    By its clock a row knows when an episode begins and whether it has ended (`begins_episode`, `is_frozen`), whatever
    the other rows do. Where observations show no clock, an observation is a control step.

    Args:
        remembers: whether frames are written at all.
        stride: every how many control steps one is; an episode's first one always is.

    Attributes:
        late: whether the next frame stands for one that was to be written and was not offered.
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
        """Take in one observation per row.

        Args:
            clocks: of each row its phase (0 prompt, 1 execution) and the control step since that began.
            write: writes the frames of these rows; called at most once.

        Returns:
            Per row: its control step since the episode began, prompt included; whether a new episode began; and
            whether the row is frozen.
        """
        if len(self.rows) != len(clocks):
            self.rows = [Row() for _ in clocks]
        before = [row.position for row in self.rows]
        started = [self._tick(row, clock) for row, clock in enumerate(clocks)]
        for held, begins, last in zip(self.rows, started, before, strict=True):
            due = (last // self.stride + 1) * self.stride  # the next one that is written
            if not begins and due < held.position and held.missed is None and not self.late:
                held.missed = due
        steps, frozen = [row.position for row in self.rows], [row.frozen for row in self.rows]
        written = [
            begins or step % self.stride == 0 or (self.late and step // self.stride > last // self.stride)
            for begins, step, last in zip(started, steps, before, strict=True)
        ]
        wanted = [row for row, writes in enumerate(written) if writes and not frozen[row]]
        if wanted and self.remembers:
            write(wanted)
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
        if not row.frozen:  # a phase begins at step 0, one after the last of the prompt, or without a clock
            row.position += step - last[1] if step > last[1] >= 0 else 1 + max(step, 0)
        return False

    def writes_next(self) -> bool:
        """Whether the frame after a row's present one is written."""
        moving = [row.position for row in self.rows if row.clock is not None and not row.frozen]
        return self.remembers and any((step + 1) % self.stride == 0 for step in moving)

    def missed(self, rows: Sequence[int]) -> int | None:
        """Return the first step of some rows' frames that were to be written and were not offered; None: all were."""
        steps = (self.rows[row].missed for row in rows)
        return min((step for step in steps if step is not None), default=None)
