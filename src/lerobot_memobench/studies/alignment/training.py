"""Training one policy of the study, as ``lerobot-train`` does, on frames that were decoded before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.policies import make_policy, make_pre_post_processors

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.studies.alignment.frames import Frames, Say
from lerobot_memobench.studies.alignment.settings import StudySettings


@dataclass(frozen=True)
class Trained:
    """A policy after its updates, its processors, and what was logged every twentieth of the run."""

    policy: MemobenchMemPolicy
    before: Any
    after: Any
    curve: list[dict[str, float]]


def train(settings: StudySettings, frames: Frames, among: np.ndarray, align: str, seed: int, say: Say) -> Trained:
    """Train on the frames ``among``; order of batches and noise of the flow are the same for every objective."""
    config = settings.config(align, frames.features)
    torch.manual_seed(seed)
    policy = make_policy(config, ds_meta=frames.meta)
    before, after = make_pre_post_processors(config, dataset_stats=frames.meta.stats)
    preset = config.get_optimizer_preset()
    optimizer = preset.build(policy.get_optim_params())
    schedule = config.get_scheduler_preset().build(optimizer, settings.steps)
    policy.train()
    rng = np.random.default_rng(seed)
    torch.manual_seed(1_000 + seed)
    curve: list[dict[str, float]] = []
    window: list[dict[str, float]] = []
    for step in range(1, settings.steps + 1):
        indices = rng.choice(among, settings.batch_size, replace=False)
        loss, logged = policy.forward(before(frames.batch(indices, config.chunk_size)))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        policy.update()
        window.append({key: value for key, value in logged.items() if isinstance(value, float)})
        if step % max(1, settings.steps // 20) == 0:
            means = {key: float(np.mean([entry[key] for entry in window])) for key in window[-1]}
            curve.append({"step": step, **means})
            window = []
            say(f"{align}, seed {seed}: step {step} of {settings.steps}, loss {means['loss']:.3f}")
    return Trained(policy, before, after, curve)
