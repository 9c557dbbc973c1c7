"""``lerobot train policy=…``: the defaults and checks before LeRobot's training."""

from __future__ import annotations

import os

from lerobot_memobench.cli import preflight
from lerobot_memobench.cli.arguments import Translation
from lerobot_memobench.datasets.lerobot_format import DEFAULT_REPO_ID
from lerobot_memobench.errors import MemobenchError


def prepare_training(translation: Translation) -> None:
    """Complete and check the flags of a training run."""
    from_file = translation.has("config_path")
    if not from_file:
        if not any(
            translation.has(key) for key in ("policy.type", "policy.path", "reward_model.type", "reward_model.path")
        ):
            raise MemobenchError("name a policy: policy=memobench_mem")
        translation.add("dataset.repo_id", DEFAULT_REPO_ID)
        # LeRobot would ask for a repository to push to. Without one, the checkpoint stays here.
        if not translation.has("policy.repo_id") and (translation.has("policy.type") or translation.has("policy.path")):
            translation.add("policy.push_to_hub", False)
    preflight.check_dataset(translation)
    preflight.check_policy(translation)
    preflight.parse_choice(translation, "policy")
    preflight.parse_choice(translation, "env")
    add_logging(translation)
    cores = os.cpu_count() or 4
    if cores < 4 and not from_file:  # LeRobot's default of 4 loaders would only wait for one another
        translation.add("num_workers", cores)


def add_logging(translation: Translation) -> None:
    """Log a short run often enough to see its loss: LeRobot's default is every 200 steps."""
    steps = translation.get("steps")
    if steps is not None and steps.isdigit() and int(steps) < 2000:
        translation.add("log_freq", max(1, int(steps) // 10))
