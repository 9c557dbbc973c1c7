"""A pixel policy's update as it is made beside one without what makes it quick, with a memory and without.

    python benchmarks/pixel_update.py [--moments 6] [--episodes 12] [--repeats 5]

The batch has several moments of each episode, which remember many of the same frames. The other side attends by
LeRobot's eager attention. An update is forward, backward, clipping, AdamW and the weight average, on one thread;
seconds are of the CPU. Prints one JSON line: ratio (other side / as it is made) and seconds.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from policies import config, histories, remembered, training_batch, updates
from turns import medians

from lerobot_memobench.perception.visual_encoder import GRID, POOLED, WIDTH
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import encoded_key
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.network import attend_fused
from lerobot_memobench.policies.memobench_mem.products import keep_freed_memory

SLOTS = 50
"""Remembered frames of an episode: its prompt, and an execution of 250 steps."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=6)
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--repeats", type=int, default=5)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does, on both sides
    result: dict[str, object] = {"benchmark": "pixel_update", "samples": asked.moments * asked.episodes}
    for name, memory_fusion in {"memory": "modulation", "no_memory": "none"}.items():
        settings = config("small", device="cpu", memory_fusion=memory_fusion)
        batch = pixel_batch(settings, asked.episodes, asked.moments)
        sides = {"made": updater(settings, batch, quick=True), "plain": updater(settings, batch, quick=False)}
        seconds = medians(sides, asked.repeats, warm_up=2)
        result[name] = {"ratio": round(seconds["plain"] / seconds["made"], 3)} | {
            f"{side}_s": round(value, 4) for side, value in seconds.items()
        }
    print(json.dumps(result))


def pixel_batch(settings: MemobenchMemConfig, episodes: int, moments: int) -> dict[str, torch.Tensor]:
    """Return a preprocessed training batch of some moments of each of some episodes."""
    torch.manual_seed(0)
    rows, frames = episodes * moments, settings.memory_frames
    numbers = remembered(rows, moments, frames, SLOTS)
    stored = torch.randn(episodes * SLOTS, POOLED**2, WIDTH).to(torch.bfloat16)
    batch = {key: value for key, value in training_batch(settings, rows).items() if "images" not in key}
    for camera in settings.image_features:
        batch[encoded_key(camera)] = torch.randn(rows, GRID**2, WIDTH).to(torch.bfloat16)
    return batch | histories(numbers, stored, SLOTS, settings.memory_stride)


def updater(settings: MemobenchMemConfig, batch: dict[str, torch.Tensor], quick: bool) -> Callable[[], None]:
    """Return a function that makes one update."""
    torch.manual_seed(0)
    policy = MemobenchMemPolicy(settings)
    if quick:
        attend_fused(policy)
    return updates(policy, batch)


if __name__ == "__main__":
    main()
