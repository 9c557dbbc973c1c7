"""Updates and plans of small policies that see objects, by this source and by another one, in turns in one run.

    python benchmarks/object_update.py FOLDER [--rounds 9] [--memory frames bank …] [--words 16] [--compile]

FOLDER holds the other state's `lerobot_memobench` (`git worktree add /tmp/before COMMIT`, then `/tmp/before/src`). An
update is forward, backward, clipping, the policy's own AdamW and the weight average, of 12 episodes x 6 samples. A plan
is one of the shipped `memobench_small`, whose memory is full. Each side is a process of its own on one thread, which
waits until it is asked. Prints a Markdown table: medians of CPU milliseconds, and the median ratio before / after.
With --compile the updates of this source run under policy.compile_model=true; that takes a C++ compiler and minutes,
and FOLDER may be this source too.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_ENV_STATE, OBS_LANGUAGE_ATTENTION_MASK
from policies import config, histories, observation, remembered, training_batch, updates

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE, frame_row
from lerobot_memobench.protocol import OBS_PHASE, OBS_STEP
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH
from lerobot_memobench.training.speed import keep_freed_memory

HERE = Path(__file__).parents[1] / "src"
EPISODES, MOMENTS = 12, 6
REMEMBERED, THINGS = 50, 8
"""Frames that are remembered of an episode of 400 steps, and things in each."""
MEMORIES = ("frames", "none", "bank", "fast_weights", "recurrent")
PLAN, MANY = "plan", 20


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--memory", nargs="+", default=list(MEMORIES))
    parser.add_argument("--words", type=int, default=16)
    parser.add_argument("--compile", action="store_true")
    asked = parser.parse_args()
    print("| | before, ms | after, ms | ratio |\n| --- | ---: | ---: | ---: |")
    for name in (*asked.memory, PLAN):
        sides = [Side(asked.before, name, asked.words), Side(HERE, name, asked.words, asked.compile)]
        for side in sides * 2:  # the second update still allocates
            side.milliseconds()
        taken = [[side.milliseconds() for side in sides] for _ in range(asked.rounds)]
        before, after = (statistics.median(side) for side in zip(*taken, strict=True))
        ratio = statistics.median(other / ours for other, ours in taken)
        print(f"| {name} | {before:.1f} | {after:.1f} | {ratio:.2f} |", flush=True)
        for side in sides:
            side.process.communicate()


class Side:
    """A process that serves."""

    def __init__(self, source: Path, name: str, words: int, compiled: bool = False) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", __file__, "--serve", name, str(words), "compiled" * compiled],
            env={**os.environ, "PYTHONPATH": f"{source}{os.pathsep}{source.parent}"},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def milliseconds(self) -> float:
        """Let it do its work once."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print("go", file=self.process.stdin, flush=True)
        return float(self.process.stdout.readline())


def serve(name: str, words: int, compiled: bool) -> None:
    """Answer each line with the CPU milliseconds of an update, or of a plan."""
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does
    torch.manual_seed(0)
    times, work = (MANY, planner(words)) if name == PLAN else (1, updater(settings_of(name, compiled), words))
    for _ in sys.stdin:
        started = time.process_time()
        for _ in range(times):
            work()
        print(1e3 * (time.process_time() - started) / times, flush=True)


def settings_of(memory: str, compiled: bool = False) -> MemobenchMemConfig:
    """Return the configuration of a small policy of objects."""
    compiling = {"compile_model": True, "compile_mode": "default"} if compiled else {}
    settings = config("small", device="cpu", perception="objects", memory=memory, **compiling)
    settings.input_features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (SIZE,))
    return settings


def scene(count: int) -> torch.Tensor:
    """Return slots (count, SIZE) of frames with some things each."""
    slots = torch.zeros(count, SLOTS, WIDTH)
    slots[:, :THINGS] = 0.3 * torch.randn(count, THINGS, WIDTH)
    slots[:, :THINGS, 0] = 1.0
    slots[:, :THINGS, 1] = torch.arange(THINGS)
    return slots.flatten(1)


def spoken(settings: MemobenchMemConfig, rows: int, words: int) -> dict[str, torch.Tensor]:
    """Return the mask of instructions of so many words."""
    return {OBS_LANGUAGE_ATTENTION_MASK: torch.arange(settings.tokenizer_max_length or 0).expand(rows, -1) < words}


def updater(settings: MemobenchMemConfig, words: int) -> Callable[[], None]:
    """Return a function that makes one update on some moments of each of some episodes."""
    rows, count = EPISODES * MOMENTS, EPISODES * REMEMBERED
    if settings.memory == "frames":
        numbers = remembered(rows, MOMENTS, settings.memory_settings["frames"], REMEMBERED)
    else:  # all frames up to a moment
        lengths = torch.randint(REMEMBERED // 3, REMEMBERED, (rows, 1))
        all_of = torch.arange(REMEMBERED) + torch.arange(rows)[:, None] // MOMENTS * REMEMBERED
        numbers = torch.where(torch.arange(REMEMBERED) < lengths, all_of, -1)
    stored = frame_row(scene(count), torch.randn(count, 8), torch.ones(count))
    batch = {key: value for key, value in training_batch(settings, rows).items() if "images" not in key}
    batch |= {OBS_ENV_STATE: scene(rows), OBS_RAW_STATE: torch.randn(rows, 8)} | spoken(settings, rows, words)
    return updates(
        MemobenchMemPolicy(settings), batch | histories(numbers, stored, REMEMBERED, settings.memory_stride or 1)
    )


def planner(words: int) -> Callable[[], None]:
    """Return a function that makes one plan of the shipped policy, 300 steps into an episode."""
    import lerobot_memobench

    shipped = Path(lerobot_memobench.__file__).parent / "policies/shipped/memobench_small"
    policy = MemobenchMemPolicy.from_pretrained(shipped)
    seen = observation(policy.config, 1) | {OBS_ENV_STATE: scene(1), OBS_RAW_STATE: torch.randn(1, 8)}
    seen |= {OBS_PHASE: torch.ones(1, 1)} | spoken(policy.config, 1, words)
    for step in range(300):
        policy.observe(seen | {OBS_STEP: torch.full((1, 1), float(step))})
    noise = torch.zeros(1, policy.config.chunk_size, policy.config.max_action_dim)

    def plan() -> None:
        with torch.no_grad():
            policy.plan(seen, [0], noise)

    return plan


if __name__ == "__main__":
    if sys.argv[1] == "--serve":
        serve(sys.argv[2], int(sys.argv[3]), sys.argv[4] == "compiled")
    else:
        main()
