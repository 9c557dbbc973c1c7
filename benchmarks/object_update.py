"""Compare updates and plans of small object-based policies at another commit and at this commit, in turns.

    python benchmarks/object_update.py FOLDER [--rounds 9] [--memory frames bank …] [--words 16]

FOLDER holds `lerobot_memobench` of the other commit (`git worktree add /tmp/before COMMIT`, then `/tmp/before/src`). An
update is forward, backward, clipping, AdamW and the weight average on 12 episodes x 6 samples. A plan is one chunk of
the shipped `memobench_strict` with a full memory. Both sides run in processes of their own, on one thread. Prints a
Markdown table of median CPU milliseconds and the median ratio before / after.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_ENV_STATE, OBS_LANGUAGE_ATTENTION_MASK
from policies import MEMORY_FRAMES, config, observation, training_batch, updates
from turns import Worker, answer_requests

from lerobot_memobench.constants import OBS_PHASE, OBS_STEP
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.frames import sample_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES, STEPS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE, frame_row
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH
from lerobot_memobench.training.loop import keep_freed_memory

HERE = Path(__file__).parents[1] / "src"
EPISODES, SAMPLES = 12, 6
STORED, OBJECTS = 50, 8
"""Stored frames per episode of 400 steps, and objects per frame."""
MEMORIES = ("frames", "none", "bank", "fast_weights", "recurrent")
PLAN, PLANS_PER_REQUEST = "plan", 20


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--memory", nargs="+", default=list(MEMORIES))
    parser.add_argument("--words", type=int, default=16)
    args = parser.parse_args()
    print("| | before, ms | after, ms | ratio |\n| --- | ---: | ---: | ---: |")
    for name in (*args.memory, PLAN):
        workers = [
            Worker(__file__, args.before, name, str(args.words)),
            Worker(__file__, HERE, name, str(args.words)),
        ]
        for worker in workers * 2:  # the second update still allocates
            worker.ask()
        values = [[worker.ask()[0] for worker in workers] for _ in range(args.rounds)]
        before, after = (statistics.median(side) for side in zip(*values, strict=True))
        ratio = statistics.median(old / new for old, new in values)
        print(f"| {name} | {before:.1f} | {after:.1f} | {ratio:.2f} |", flush=True)
        for worker in workers:
            worker.close()


def serve(name: str, words: int) -> None:
    """Answer each request with the CPU milliseconds of an update or a plan."""
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does
    torch.manual_seed(0)
    if name == PLAN:
        count, work = PLANS_PER_REQUEST, planner(words)
    else:
        count, work = 1, updater(policy_config(name), words)

    def measure(_: str) -> list[float]:
        started = time.process_time()
        for _ in range(count):
            work()
        return [1e3 * (time.process_time() - started) / count]

    answer_requests(measure)


def policy_config(memory: str) -> MemobenchMemConfig:
    """Return the configuration of a small object-based policy."""
    settings = config("small", device="cpu", perception="objects", memory=memory)
    settings.input_features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (SIZE,))
    return settings


def random_slots(count: int) -> torch.Tensor:
    """Return object slots (count, SIZE) of random scenes with 8 objects."""
    slots = torch.zeros(count, SLOTS, WIDTH)
    slots[:, :OBJECTS] = 0.3 * torch.randn(count, OBJECTS, WIDTH)
    slots[:, :OBJECTS, 0] = 1.0
    slots[:, :OBJECTS, 1] = torch.arange(OBJECTS)
    return slots.flatten(1)


def instruction_mask(settings: MemobenchMemConfig, rows: int, words: int) -> dict[str, torch.Tensor]:
    """Return the token mask of instructions of a given length."""
    return {OBS_LANGUAGE_ATTENTION_MASK: torch.arange(settings.tokenizer_max_length or 0).expand(rows, -1) < words}


def frame_numbers(rows: int, frames: int | None) -> torch.Tensor:
    """Return the numbers (rows, N) of the stored frames that each sample reads, -1 for padding.

    Args:
        frames: size of a memory that samples frames; None for a memory that reads all earlier frames.
    """
    numbers = torch.full((rows, frames or STORED), -1)
    for row, length in enumerate(torch.randint(STORED // 3, STORED, (rows,)).tolist()):
        read = torch.tensor(sample_frames(length, frames)) if frames else torch.arange(length)
        numbers[row, : len(read)] = row // SAMPLES * STORED + read
    return numbers


def histories(numbers: torch.Tensor, stored: torch.Tensor, stride: int) -> dict[str, torch.Tensor]:
    """Return the history columns of a batch; a frame that several samples read is included once."""
    unique, places = numbers.unique(return_inverse=True)
    padding = int(unique[0] < 0)
    used = unique[padding:]
    return {FRAMES: stored[used], STEPS: used % STORED * stride, PLACES: places - padding}


def updater(settings: MemobenchMemConfig, words: int) -> Callable[[], None]:
    """Return a function that makes one update on samples of several episodes."""
    rows, count = EPISODES * SAMPLES, EPISODES * STORED
    numbers = frame_numbers(rows, MEMORY_FRAMES if settings.memory == "frames" else None)
    stored = frame_row(random_slots(count), torch.randn(count, 8), torch.ones(count))
    batch = {key: value for key, value in training_batch(settings, rows).items() if "images" not in key}
    batch |= {OBS_ENV_STATE: random_slots(rows), OBS_RAW_STATE: torch.randn(rows, 8)}
    batch |= instruction_mask(settings, rows, words) | histories(numbers, stored, settings.memory_stride or 1)
    return updates(MemobenchMemPolicy(settings), batch)


def planner(words: int) -> Callable[[], None]:
    """Return a function that makes one plan of the shipped policy, 300 steps into an episode."""
    import lerobot_memobench

    shipped = Path(lerobot_memobench.__file__).parent / "policies/shipped/memobench_strict"
    policy = MemobenchMemPolicy.from_pretrained(shipped)
    batch = observation(policy.config, 1) | {OBS_ENV_STATE: random_slots(1), OBS_RAW_STATE: torch.randn(1, 8)}
    batch |= {OBS_PHASE: torch.ones(1, 1)} | instruction_mask(policy.config, 1, words)
    for step in range(300):
        policy.observe(batch | {OBS_STEP: torch.full((1, 1), float(step))})
    noise = torch.zeros(1, policy.config.chunk_size, policy.config.max_action_dim)

    def plan() -> None:
        with torch.no_grad():
            policy.plan(batch, [0], noise)

    return plan


if __name__ == "__main__":
    if sys.argv[1] == "--serve":
        serve(sys.argv[2], int(sys.argv[3]))
    else:
        main()
