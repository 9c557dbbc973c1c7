"""Memory mechanisms, one file each, by their names. `mechanism` is their interface, `encoder` makes memory tokens."""

from __future__ import annotations

from lerobot_memobench.policies.memobench_mem.memory.frame_sampling import FrameSampling
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism
from lerobot_memobench.policies.memobench_mem.memory.none import NoMemory

MECHANISMS: dict[str, type[MemoryMechanism]] = {NoMemory.name: NoMemory, FrameSampling.name: FrameSampling}


def make_mechanism(name: str, frames: int) -> MemoryMechanism:
    """Build a mechanism by its name; a plan reads at most ``frames`` frames."""
    return MECHANISMS[name](frames)
