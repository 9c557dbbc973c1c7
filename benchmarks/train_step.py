"""A training step with memory beside one of plain pi0.5, on the same batch and of the same dimensions.

    python benchmarks/train_step.py [--size tiny middle] [--batch 4] [--repeats 7] [--align contrastive]

A step is forward, backward, clipping, AdamW and the weight average; seconds are CPU seconds on a CPU. Plain pi0.5 is
``memory=none``, which a test holds to LeRobot's own pi05 parameter for parameter. Prints one JSON line: seconds
and ratio (memory / plain) per size that a CPU can train; and for the full size, which it cannot, the ratio of
floating-point operations of forward and backward, counted on the meta device.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from policies import config, training_batch, updates
from turns import medians

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy

SIDES = {"memory": {"memory": "frames"}, "plain": {"memory": "none"}}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs="+", default=["tiny", "middle"])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--align", default="contrastive")
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    result: dict[str, Any] = {"benchmark": "train_step", "batch": asked.batch, "align": asked.align}
    for size in asked.size:
        seconds = medians(
            {
                name: stepper(size, asked.batch, asked.device, fields | aligned(name, asked.align))
                for name, fields in SIDES.items()
            },
            asked.repeats,
            warm_up=2,
            clock=time.process_time if asked.device == "cpu" else time.perf_counter,
        )
        result[size] = {"ratio": round(seconds["memory"] / seconds["plain"], 3)} | {
            f"{name}_s": round(value, 4) for name, value in seconds.items()
        }
    operations = {name: count_operations(fields | aligned(name, asked.align)) for name, fields in SIDES.items()}
    result["pi05_operations"] = {"ratio": round(operations["memory"] / operations["plain"], 3)} | {
        f"{name}_tflop": round(value / 1e12, 2) for name, value in operations.items()
    }
    print(json.dumps(result | {"ratio": result[asked.size[-1]]["ratio"]}))


def aligned(name: str, align: str) -> dict[str, str]:
    """Only a policy with a memory has one to align."""
    return {"align": align} if name == "memory" else {}


def stepper(size: str, rows: int, device: str, fields: dict[str, Any]) -> Callable[[], None]:
    """Return a function that takes one training step."""
    torch.manual_seed(0)
    settings = config(size, device=device, **fields)
    return updates(MemobenchMemPolicy(settings), training_batch(settings, rows))


def count_operations(fields: dict[str, Any]) -> int:
    """Floating-point operations of one sample's forward and backward at full size; nothing is computed."""
    from torch.utils.flop_counter import FlopCounterMode

    from lerobot_memobench.policies.memobench_mem.alignment import make_alignment
    from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES, STEPS, Histories
    from lerobot_memobench.policies.memobench_mem.network import MemoryPI05, Observation

    settings = config("pi05", device="cpu", **fields)
    dims = settings.dimensions
    with torch.device("meta"):
        model = MemoryPI05(settings)
        head = make_alignment(settings.align, dims.vlm.width, dims.text_dim, 16)
    batch = {key: value.to("meta") for key, value in training_batch(settings, 1).items()}
    images = [batch["observation.images.image"], batch["observation.images.wrist_image"]]
    seen = torch.ones(1, dtype=torch.bool, device="meta")
    actions = torch.zeros(1, settings.chunk_size, settings.max_action_dim, device="meta")
    with FlopCounterMode(display=False) as counter:
        loss, reading = torch.zeros((), device="meta"), None
        if settings.memory != "none":
            assert model.memory is not None
            read = model.memory.replay(Histories(batch[FRAMES], batch[STEPS], batch[PLACES]))
            reading = model.reading(read)
            if head is not None:
                loss = loss + head(read.rows(), read.mask, batch["memory.text"])
        tokens, tokens_mask = batch["observation.language.tokens"], batch["observation.language.attention_mask"]
        time = torch.zeros(1, device="meta")
        observed = Observation(images, [seen, seen], tokens, tokens_mask)
        losses = model(observed, actions, torch.zeros_like(actions), time, reading)
        (loss + losses.mean()).backward()
    return counter.get_total_flops()


if __name__ == "__main__":
    main()
