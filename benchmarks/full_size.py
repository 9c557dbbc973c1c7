"""The policy at full size on the accelerator that is here: planning in the rendered environment, and training.

    python benchmarks/full_size.py [--size pi05] [--device cuda] [--steps 100] [--batch 8] [--train expert|all]

Builds pi0.5 with its memory from random weights in bfloat16 (no checkpoint is needed, and no network); lets it act in
the environment, drawn with EGL, and times plans and control steps; then takes training steps under bfloat16 autocast on
batches as the preprocessor makes them, 32 remembered frames each. ``--train expert`` trains memory and action expert
with the language model frozen, ``--train all`` everything but the image tower, with gradient checkpointing. Prints one
JSON line, and a row for the table in docs/train.md. Without an accelerator it runs on the CPU: hours at full size,
seconds with ``--size tiny``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs.utils import preprocess_observation
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from policies import config, training_batch

from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.random_weights import random_policy
from lerobot_memobench.tasks.catalogue import get_task
from research.speed.sides import TASK, machine

WARM_UP = 3
REPLAN = 5
COLUMNS = ("GPU", "size", "build", "plan", "control step", "peak, acting", "trained", "training step", "peak, training")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="pi05")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--steps", type=int, default=100, help="training steps")
    parser.add_argument("--control-steps", type=int, default=100)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--train", choices=("expert", "all"), default="expert")
    asked = parser.parse_args()
    settings = config(
        asked.size,
        device=asked.device,
        dtype="bfloat16",
        n_action_steps=REPLAN,
        train_expert_only=asked.train == "expert",
        gradient_checkpointing=asked.train == "all",
    )
    started = time.perf_counter()
    policy = random_policy(settings)
    synchronise()
    result: dict[str, Any] = {
        "benchmark": "full_size",
        "gpu": torch.cuda.get_device_name() if asked.device.startswith("cuda") else asked.device,
        "size": asked.size,
        "batch": asked.batch,
        "train": asked.train,
        "build_s": round(time.perf_counter() - started, 1),
        "weights_gib": gib(sum(parameter.nbytes for parameter in policy.parameters())),
        "build_peak_gib": peak_gib(),
    }
    result |= act(policy.eval(), asked.control_steps)
    result |= train(policy, asked.steps, asked.batch)
    result |= {"torch": torch.__version__, "machine": machine()}
    print(json.dumps(result))
    print("\n".join(markdown(result)))


def act(policy: MemobenchMemPolicy, steps: int) -> dict[str, float]:
    """Roll the policy out in the rendered environment; milliseconds per plan, per other call and per control step."""
    env = gym.vector.SyncVectorEnv([lambda: MemobenchEnv(str(get_task(TASK).folder), demonstration_prompt=False)])
    words = prompt(policy)
    observation = env.reset(seed=[7])[0]
    policy.reset()
    plans, between, controls = [], [], []
    for step in range(steps + WARM_UP * REPLAN):
        seen = {key: value.to(policy.config.device) for key, value in preprocess_observation(observation).items()}
        acting, action = timed(policy.select_action, seen | words)
        stepping, (observation, *_) = timed(env.step, action.float().cpu().numpy().clip(-1, 1))
        if step >= WARM_UP * REPLAN:
            (plans if step % REPLAN == 0 else between).append(acting)
            controls.append(stepping)
    env.close()
    return {
        "plan_ms": milliseconds(plans),
        "between_plans_ms": milliseconds(between),
        "control_step_ms": milliseconds(controls),
        "act_peak_gib": peak_gib(),
    }


def prompt(policy: MemobenchMemPolicy) -> dict[str, torch.Tensor]:
    """Sixty random words: the tokenizer of the full size is not to be had without a network."""
    batch = training_batch(policy.config, 1)
    return {key: batch[key].to(policy.config.device) for key in (OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK)}


def train(policy: MemobenchMemPolicy, steps: int, rows: int) -> dict[str, Any]:
    """Take training steps; milliseconds of one, peak memory, and the losses of the first and the last."""
    device = torch.device(policy.config.device)
    policy.train()
    learning = policy.get_optim_params()
    optimizer = policy.config.get_optimizer_preset().build(learning)
    torch.manual_seed(0)
    batch = {key: value.to(device) for key, value in training_batch(policy.config, rows).items()}
    batch["action_is_pad"] = torch.zeros(batch["action"].shape[:2], dtype=torch.bool, device=device)

    def step() -> float:
        with torch.autocast(device.type, dtype=torch.bfloat16):
            loss, _ = policy.forward(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(learning, 1.0)
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
        return loss.item()

    seconds, losses = zip(*(timed(step) for _ in range(steps + WARM_UP)), strict=True)
    if not np.isfinite(losses).all():
        raise SystemExit(f"the loss is not finite: {losses}")
    return {
        "trained_millions": round(sum(parameter.numel() for parameter in learning) / 1e6, 1),
        "trained_dtypes": sorted({str(parameter.dtype).removeprefix("torch.") for parameter in learning}),
        "train_steps": steps,
        "train_step_ms": milliseconds(seconds[WARM_UP:]),
        "train_peak_gib": peak_gib(),
        "first_loss": round(losses[0], 4),
        "last_loss": round(losses[-1], 4),
    }


def timed[Result](work: Callable[..., Result], *given: Any) -> tuple[float, Result]:
    """Seconds that work took, on the accelerator too, and what it gave."""
    synchronise()
    started = time.perf_counter()
    result = work(*given)
    synchronise()
    return time.perf_counter() - started, result


def synchronise() -> None:
    """Wait for the accelerator."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def peak_gib() -> float:
    """GiB that this process has held at most, on the accelerator where there is one."""
    if torch.cuda.is_available():
        return gib(torch.cuda.max_memory_allocated())
    return gib(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)


def gib(size: int) -> float:
    """Bytes as GiB."""
    return round(size / 2**30, 2)


def milliseconds(seconds: Any) -> float:
    """Median of durations, ms."""
    return round(1e3 * statistics.median(seconds), 2)


def markdown(result: dict[str, Any]) -> list[str]:
    """The table's head and the row of a result."""
    cells = (
        result["gpu"],
        result["size"],
        f"{result['build_s']:g} s, {result['build_peak_gib']:g} GiB",
        f"{result['plan_ms']:g} ms",
        f"{result['control_step_ms']:g} ms",
        f"{result['act_peak_gib']:g} GiB",
        f"{result['train']}, {result['trained_millions']:g} M, batch {result['batch']}",
        f"{result['train_step_ms']:g} ms",
        f"{result['train_peak_gib']:g} GiB",
    )
    return [f"| {' | '.join(row)} |" for row in (COLUMNS, ["---"] * len(COLUMNS), cells)]


if __name__ == "__main__":
    main()
