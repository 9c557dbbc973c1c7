"""No memory: nothing is written and nothing is read, in training as in a rollout."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.policies.memobench_mem.memory.mechanism import Frame, MemoryMechanism


class NoMemory(MemoryMechanism):
    """The baseline without a memory."""

    name = "none"
    capacity = 0

    def __init__(self, frames: int = 0) -> None:
        super().__init__(frames=0)  # whatever others would read

    def write(self, kept: list[Frame], frame: Frame) -> None:
        """Forget the frame."""

    def read(self, kept: Sequence[Frame]) -> list[Frame]:
        """Return nothing."""
        return []
