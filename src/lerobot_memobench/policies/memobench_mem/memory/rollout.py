"""The memory of a rollout: a mechanism writes what the rows of a vector environment see, each by its own clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.batch import MemoryBatch, collate_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Frame, MemoryMechanism


@dataclass
class Row:
    """History of one environment: the clock's last step, and what is kept of its episode."""

    last_step: int | None = None
    frozen: bool = False
    kept: list[Frame] = field(default_factory=list)


class RolloutMemory:
    """Histories of the rows of a vector environment.

    A row starts anew when its step goes back (step 0), and is frozen while its step stays the same (its episode is
    over, or the environment is waiting), whatever the other rows do.

    Args:
        mechanism: what is kept and read.
        stride: every how many control steps a frame is written; an episode's first one always is.
    """

    def __init__(self, mechanism: MemoryMechanism, stride: int) -> None:
        self.mechanism, self.stride = mechanism, stride
        self.rows: list[Row] = []

    def reset(self) -> None:
        """Forget everything."""
        self.rows = []

    def observe(self, steps: Sequence[int], encode: Callable[[list[int]], Tensor]) -> tuple[list[bool], list[bool]]:
        """Take in one observation per row.

        Args:
            steps: control step of each row since its episode began.
            encode: from row numbers (n,) to their frames' tokens (n, P, D); called at most once, for the rows whose
                frames are written.

        Returns:
            Per row: whether a new episode began, and whether the row is frozen.
        """
        if len(self.rows) != len(steps):
            self.rows = [Row() for _ in steps]
        started, frozen = map(list, zip(*(self._tick(row, step) for row, step in enumerate(steps)), strict=True))
        wanted = [
            row for row, step in enumerate(steps) if not frozen[row] and (started[row] or step % self.stride == 0)
        ]
        if wanted and self.mechanism.frames:
            for row, tokens in zip(wanted, encode(wanted).to("cpu"), strict=True):
                self.mechanism.write(self.rows[row].kept, Frame(steps[row], tokens))
        return started, frozen

    def _tick(self, number: int, step: int) -> tuple[bool, bool]:
        """Set a row's clock; return whether a new episode began, and whether the row is frozen."""
        last = self.rows[number].last_step
        started = last is None or step < last
        if started:
            self.rows[number] = Row()
        self.rows[number].last_step, self.rows[number].frozen = step, step == last
        return started, step == last

    def writes_next(self) -> bool:
        """Whether the frame after a row's present one is written."""
        moving = [row.last_step for row in self.rows if row.last_step is not None and not row.frozen]
        return self.mechanism.frames > 0 and any((step + 1) % self.stride == 0 for step in moving)

    def gather(self, rows: Sequence[int]) -> MemoryBatch:
        """Return what plans of some rows read."""
        return collate_frames([self.mechanism.read(self.rows[row].kept) for row in rows], self.mechanism.frames)
