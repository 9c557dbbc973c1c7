"""Time to act at a replan, with a full memory beside plain pi0.5, and what the memory of an environment takes.

    python benchmarks/action_latency.py [--size tiny middle] [--rows 1] [--repeats 9] [--device cpu]

A replan takes in the observation (with a memory: the frozen tower's tokens of the new frame too), gathers 32 frames,
and denoises a chunk in ten steps. Prints one JSON line: seconds and ratio (memory / plain) per size; seconds of the
steps between replans, in which plain pi0.5 does nothing and a memory takes in a frame; and the bytes that the history
of one environment holds after an episode of 1,200 steps, measured at the benchmark's sizes and stated for the full one.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from policies import SIZES, config, observation
from turns import medians

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy

HORIZON = 1200
ENCODED = 200
"""Frames in the history when it is measured; any number above 32 costs the same."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs="+", default=["tiny", "middle"])
    parser.add_argument("--rows", type=int, default=1, help="environments in the batch")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    clock = time.process_time if asked.device == "cpu" else time.perf_counter
    result: dict[str, Any] = {"benchmark": "action_latency", "rows": asked.rows}
    for size in asked.size:
        actors = {
            name: Actor(size, asked.rows, asked.device, memory)
            for name, memory in (("memory", "frames"), ("plain", "none"))
        }
        replan = medians({name: actor.replan for name, actor in actors.items()}, asked.repeats, 2, clock)
        between = medians({name: actor.between for name, actor in actors.items()}, asked.repeats, 2, clock)
        result[size] = {
            "ratio": round(replan["memory"] / replan["plain"], 3),
            **{f"{name}_replan_s": round(value, 4) for name, value in replan.items()},
            **{f"{name}_between_s": round(value, 4) for name, value in between.items()},
            "history_mib_per_env": round(actors["memory"].bytes_per_frame() * HORIZON / 2**20, 2),
        }
    full = 2 * 16 * SIZES["pi05"].vlm.width * HORIZON  # bfloat16
    print(json.dumps(result | {"pi05_history_mib_per_env": round(full / 2**20, 1)} | {"ratio": result[size]["ratio"]}))


class Actor:
    """A policy in the middle of an episode."""

    def __init__(self, size: str, rows: int, device: str, memory: str) -> None:
        torch.manual_seed(0)
        settings = config(size, device=device, memory=memory)
        self.policy = MemobenchMemPolicy(settings).eval()
        self.batch = {key: value.to(device) for key, value in observation(settings, rows).items()}
        self.rows, self.step = rows, 0
        self.batch["observation.phase"] = torch.ones(rows, 1)
        for _ in range(ENCODED):
            self._tick()
            self.policy.observe(self.batch)

    def _tick(self) -> None:
        self.batch["observation.step"] = torch.full((self.rows, 1), float(self.step))
        self.step += 1

    def replan(self) -> None:
        """One call that takes in an observation and plans."""
        for row in self.policy.rollout.rows:
            row.queue.clear()
        self._tick()
        self.policy.select_action(self.batch)
        if self.batch["observation.state"].is_cuda:
            torch.cuda.synchronize()

    def between(self) -> None:
        """One call that acts by the plan it has."""
        if not self.policy.rollout.rows[0].queue:
            self.replan()
        self._tick()
        self.policy.select_action(self.batch)

    def bytes_per_frame(self) -> float:
        """Bytes one remembered frame takes, as held."""
        (kept,) = self.policy.rollout.rows[0].memory
        return sum(frame.stored.nbytes for frame in kept) / len(kept)


if __name__ == "__main__":
    main()
