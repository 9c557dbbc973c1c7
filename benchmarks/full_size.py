"""The policy at full size on the GPU that is here: memory and seconds of training updates and of plans.

    python benchmarks/full_size.py [--steps 20] [--batch 1 8 32] [--arms paper contrastive] [--card 80] [--ddp]

Needs no weights, no dataset and no network: pi0.5 with its memory has random weights, and batches are random, of the
shapes that the preprocessor makes, 32 remembered frames each. An update is LeRobot's (forward, backward, clipping,
AdamW) with the weight average, in the precision of `config=train_paper`. ``--card`` lets PyTorch have no more GiB than
that, as on a smaller card; ``--ddp`` trains under DistributedDataParallel, in a process group of one. Prints a JSON
line for each measurement and two tables. Without a GPU: seconds with ``--size tiny --device cpu``, and no memory.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from policies import config, observation, training_batch
from random_weights import random_policy
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy

ARMS: dict[str, dict[str, Any]] = {
    "paper": {"gradient_checkpointing": True},
    "contrastive": {"gradient_checkpointing": True, "align": "contrastive"},
    "no checkpointing": {},
    "no memory": {"gradient_checkpointing": True, "memory_fusion": "none"},
    "expert only": {"gradient_checkpointing": True, "train_expert_only": True},
}
"""What is trained; ``paper`` is `config=train_paper`."""
WARM_UP = 2


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="pi05")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--steps", type=int, default=20, help="timed updates, or plans, per row")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--arms", nargs="*", choices=list(ARMS), default=list(ARMS))
    parser.add_argument("--rows", type=int, nargs="*", default=[1, 8], help="environments that are planned for")
    parser.add_argument("--card", type=float, help="GiB that PyTorch may have")
    parser.add_argument("--ddp", action="store_true")
    asked = parser.parse_args()
    if asked.device == "cuda":
        torch.backends.cuda.matmul.allow_tf32 = True  # as LeRobot trains and evaluates
        if asked.card:
            torch.cuda.set_per_process_memory_fraction(asked.card * 2**30 / torch.cuda.mem_get_info()[1])
    if asked.ddp:
        torch.distributed.init_process_group("nccl", init_method="tcp://127.0.0.1:29511", rank=0, world_size=1)
    card = torch.cuda.get_device_name() if asked.device == "cuda" else asked.device
    where = {"card": card, "limit_gib": asked.card, "size": asked.size, "ddp": asked.ddp, "torch": torch.__version__}
    shared = {"size": asked.size, "device": asked.device, "dtype": "bfloat16"}
    rows = []
    for arm in asked.arms:
        rows += training(arm, asked.batch, asked.steps, asked.ddp, config(**shared, **ARMS[arm]), where)
        clear()
    table(rows)
    plans = []
    for memory_fusion in ("modulation", "none") if asked.rows else ():
        policy = random_policy(config(**shared, memory_fusion=memory_fusion)).eval()
        plans += [note(where, planning(policy, count, asked.steps)) for count in asked.rows]
        del policy
        clear()
    table(plans)


def training(
    arm: str, batches: list[int], steps: int, ddp: bool, settings: Any, where: dict[str, Any]
) -> list[dict[str, Any]]:
    """Train one policy on batches of several sizes, until one has no room; a row for each size."""
    rows = []
    policy = random_policy(settings).train()
    learning = policy.get_optim_params()
    learner = DistributedDataParallel(policy, find_unused_parameters=True) if ddp else policy
    optimizer = settings.get_optimizer_preset().build(learning)
    for size in batches:
        torch.manual_seed(0)
        batch = {key: value.to(settings.device) for key, value in training_batch(settings, size).items()}
        row: dict[str, Any] = {"arm": arm, "batch": size}
        try:
            updates = [update(learner, policy, optimizer, batch) for _ in range(steps + WARM_UP)]
        except torch.OutOfMemoryError as error:
            row["out_of_memory"] = str(error).split(". ")[0]
        else:
            row |= {key: round(statistics.median(one[key] for one in updates[WARM_UP:]), 3) for key in updates[0]}
            row |= {"loss_first": mean_loss(updates[:3]), "loss_last": mean_loss(updates[-3:])}
            row |= {"trained": sum(parameter.numel() for parameter in learning), **held(policy, optimizer)}
        rows.append(note(where, row))
        optimizer.zero_grad()
        clear()
        if "out_of_memory" in row:
            break
    return rows


def update(learner: Any, policy: MemobenchMemPolicy, optimizer: Any, batch: Mapping[str, Tensor]) -> dict[str, float]:
    """Update once, as LeRobot does: its seconds, loss, and in GiB what forward leaves and the peaks of its parts."""
    before, started = allocated(), time.perf_counter()
    loss, _ = learner(batch)
    forward, kept = peak(), allocated() - before
    loss.backward()
    backward = peak()
    torch.nn.utils.clip_grad_norm_(policy.parameters(), policy.config.optimizer_grad_clip_norm)
    optimizer.step()
    optimizer.zero_grad()
    policy.update()
    stepped = peak()
    return {
        "update_s": time.perf_counter() - started,
        "loss": loss.item(),
        "before_gib": before,
        "kept_by_forward_gib": kept,
        "peak_forward_gib": forward,
        "peak_backward_gib": backward,
        "peak_step_gib": stepped,
    }


def held(policy: MemobenchMemPolicy, optimizer: Any) -> dict[str, float]:
    """GiB of what stays between two updates."""
    parameters = list(policy.parameters())
    state = [value for kept in optimizer.state.values() for value in kept.values() if torch.is_tensor(value)]
    free, total = torch.cuda.mem_get_info() if torch.cuda.is_available() else (0, 0)
    return {
        "trained_gib": gib(sum(parameter.nbytes for parameter in parameters if parameter.requires_grad)),
        "frozen_gib": gib(sum(parameter.nbytes for parameter in parameters if not parameter.requires_grad)),
        "adamw_gib": gib(sum(value.nbytes for value in state)),
        "average_gib": gib(sum(value.nbytes for value in policy.average.average.values()) if policy.average else 0),
        "reserved_gib": gib(torch.cuda.memory_reserved()),
        "card_used_gib": gib(total - free),
    }


def mean_loss(updates: list[dict[str, float]]) -> float:
    """Mean loss of some updates."""
    return round(statistics.mean(one["loss"] for one in updates), 3)


def planning(policy: MemobenchMemPolicy, count: int, steps: int) -> dict[str, Any]:
    """Fill the memories of ``count`` environments; milliseconds of taking in a frame, and of a plan."""
    policy.reset()
    seen = {key: value.to(policy.config.device) for key, value in observation(policy.config, count).items()}
    frames, plans = [], []
    for _ in range(policy.config.memory_frames):
        policy.observe(seen)
    peak()
    for _ in range(steps + WARM_UP):
        frames.append(timed(policy.observe, seen))
        plans.append(timed(policy.predict_action_chunk, seen))
    return {
        "memory": policy.config.memory_fusion,
        "environments": count,
        "frame_ms": round(1e3 * statistics.median(frames[WARM_UP:]), 2),
        "plan_ms": round(1e3 * statistics.median(plans[WARM_UP:]), 1),
        "peak_gib": peak(),
    }


def timed(work: Callable[..., Any], *given: Any) -> float:
    """Seconds that work takes, on the GPU too."""
    synchronise()
    started = time.perf_counter()
    work(*given)
    synchronise()
    return time.perf_counter() - started


def synchronise() -> None:
    """Wait for the GPU."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def peak() -> float:
    """Wait for the GPU; GiB that were allocated at most since the last call."""
    synchronise()
    found = gib(torch.cuda.max_memory_allocated())
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    return found


def allocated() -> float:
    """GiB of tensors."""
    return gib(torch.cuda.memory_allocated())


def gib(size: int) -> float:
    """Bytes as GiB."""
    return round(size / 2**30, 2)


def clear() -> None:
    """Give back what nothing holds."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def note(where: dict[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    """Print a measurement, and return it."""
    print(json.dumps(where | row), flush=True)
    return row


def table(rows: list[dict[str, Any]]) -> None:
    """Print measurements as a table."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    for cells in (names, ["---"] * len(names), *([str(row.get(name, "")) for name in names] for row in rows)):
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
