"""What stays of the frames that were seen? One file per mechanism, the same in training and in a rollout."""

from __future__ import annotations

from lerobot_memobench.policies.memobench_mem.memory.frame_sampling import FrameSampling
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism
from lerobot_memobench.policies.memobench_mem.memory.none import NoMemory

# ==== registry.py
# Which memory mechanisms are there?

MECHANISMS: dict[str, type[MemoryMechanism]] = {NoMemory.name: NoMemory, FrameSampling.name: FrameSampling}


def make_mechanism(name: str, frames: int) -> MemoryMechanism:
    """Build a mechanism by its name; a plan reads at most ``frames`` frames."""
    return MECHANISMS[name](frames)
