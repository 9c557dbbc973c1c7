"""An update of the small policy that sees objects, with products in bfloat16 as it is made, beside one in float32.

    python benchmarks/object_update.py [--moments 6] [--episodes 12] [--repeats 15]

An update is forward, backward, clipping, AdamW and the weight average, on one thread, with a memory and without;
seconds are of the CPU. Prints one JSON line: ratio (float32 / as it is made) and seconds. A CPU that is not quicker
in bfloat16 has a ratio of 1.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from contextlib import nullcontext
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_ENV_STATE
from policies import config, histories, remembered, training_batch, updates
from turns import medians

from lerobot_memobench.policies.memobench_mem import modeling_memobench_mem
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE, frame_row
from lerobot_memobench.policies.memobench_mem.products import keep_freed_memory
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH

REMEMBERED, THINGS = 50, 10
"""Frames that are remembered of an episode of 400 steps, and things in each."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=6)
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--repeats", type=int, default=15)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does, on both sides
    result: dict[str, object] = {"benchmark": "object_update", "samples": asked.moments * asked.episodes}
    for name, memory_fusion in {"memory": "modulation", "no_memory": "none"}.items():
        settings = config("small", device="cpu", memory_fusion=memory_fusion, perception="objects")
        settings.input_features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (SIZE,))
        batch = object_batch(settings, asked.episodes, asked.moments)
        made, plain = updater(settings, batch), updater(settings, batch)
        sides = {"made": made, "plain": lambda plain=plain: in_float32(plain)}
        seconds = medians(sides, asked.repeats, warm_up=3)
        result[name] = {"ratio": round(seconds["plain"] / seconds["made"], 3)} | {
            f"{side}_s": round(value, 4) for side, value in seconds.items()
        }
    print(json.dumps(result))


def in_float32(update: Callable[[], None]) -> None:
    """Make an update without products in bfloat16."""
    with (
        mock.patch.object(modeling_memobench_mem, "quick_products", nullcontext),
        mock.patch.object(modeling_memobench_mem, "quick_gradients"),
    ):
        update()


def scene(count: int) -> torch.Tensor:
    """Return slots (count, SIZE) of frames with some things each."""
    slots = torch.zeros(count, SLOTS, WIDTH)
    slots[:, :THINGS] = 0.3 * torch.randn(count, THINGS, WIDTH)
    slots[:, :THINGS, 0] = 1.0
    slots[:, :THINGS, 1] = torch.arange(THINGS)
    return slots.flatten(1)


def object_batch(settings: MemobenchMemConfig, episodes: int, moments: int) -> dict[str, torch.Tensor]:
    """Return a preprocessed training batch of some moments of each of some episodes."""
    torch.manual_seed(0)
    rows, frames = episodes * moments, settings.memory_frames
    numbers = remembered(rows, moments, frames, REMEMBERED)
    count = episodes * REMEMBERED
    stored = frame_row(scene(count), torch.randn(count, 8), torch.ones(count))
    batch = {key: value for key, value in training_batch(settings, rows).items() if "images" not in key}
    return (
        batch
        | {
            OBS_ENV_STATE: scene(rows),
            OBS_RAW_STATE: torch.randn(rows, 8),
        }
        | histories(numbers, stored, REMEMBERED, settings.memory_stride)
    )


def updater(settings: MemobenchMemConfig, batch: dict[str, torch.Tensor]) -> Callable[[], None]:
    """Return a function that makes one update."""
    torch.manual_seed(0)
    return updates(MemobenchMemPolicy(settings), batch)


if __name__ == "__main__":
    main()
