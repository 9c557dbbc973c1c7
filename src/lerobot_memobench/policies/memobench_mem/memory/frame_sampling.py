"""Frame sampling: an action chunk reads frames spread evenly over the episode so far (RoboMME; the paper's memory)."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.policies.memobench_mem.memory.mechanism import Frame, Load, MemoryMechanism


def sample_frames(step: int, max_frames: int) -> list[int]:
    """Choose at most ``max_frames`` of the frames 0 ... ``step``, evenly, first and last included.

    All of them while there are no more than ``max_frames``. Indices are rounded down and strictly increase.
    """
    if step < 0 or max_frames < 1:
        raise ValueError(f"step must be >= 0 and max_frames >= 1, got {step} and {max_frames}")
    if step < max_frames:
        return list(range(step + 1))
    if max_frames == 1:
        return [step]
    return [i * step // (max_frames - 1) for i in range(max_frames)]


class FrameSampling(MemoryMechanism):
    """Keeps every frame, because which are read changes with each new one; of an episode without end the latest."""

    name = "frame_sampling"
    capacity: int = 8192  # 512 MiB at size pi05, 32 MiB at tiny; with every frame remembered, seven minutes at 20 Hz

    def write(self, kept: list[Frame], frame: Frame) -> None:
        """Keep the frame."""
        kept.append(frame)
        del kept[: -self.capacity]

    def read(self, kept: Sequence[Frame]) -> list[Frame]:
        """Return the chosen frames."""
        return [kept[slot] for slot in sample_frames(len(kept) - 1, self.frames)]

    def recall(self, load: Load, slot: int) -> list[Frame]:
        """Load the chosen frames alone."""
        first = max(0, slot + 1 - self.capacity)
        return load([first + chosen for chosen in sample_frames(slot - first, self.frames)])
