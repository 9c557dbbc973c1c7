"""The benchmark's defaults: what an evaluation is where its user leaves it open. What a user sets stays."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

from lerobot_memobench.envs.observations import OBJECTS
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.protocol import EVALUATION_EPISODES, EVALUATION_SEED
from lerobot_memobench.run.flags import whole_number
from lerobot_memobench.run.orders import Orders
from lerobot_memobench.run.resume import earlier_batch_size
from lerobot_memobench.run.translation import LerobotSettings

ENVIRONMENT = "memobench"
EXPERT = "memobench_expert"
SCRIPTED = {EXPERT: "env.expert_action", "memobench_blind": "env.blind_action"}
"""Policies whose actions the environment offers, and by which setting it does."""
LARGEST_BATCH = 64
FILMS = 10
"""Episodes of each task that are filmed, as many as LeRobot renders of an environment without films of its own;
none where only objects are seen, so that nothing is drawn unasked."""


def with_policy(settings: LerobotSettings) -> LerobotSettings:
    """Return settings with the scripted expert where no policy is named; a scripted policy is offered its action."""
    if not settings.has("policy.path"):
        settings = settings.default("policy.type", EXPERT)
    name = settings.get("policy.type")
    if name in SCRIPTED:
        settings = settings.default(SCRIPTED[name], True)
    return settings if name is None else settings.choosing("policy", name)


def with_batch_size(settings: LerobotSettings, orders: Orders, log: Path, most: int | None) -> LerobotSettings:
    """Return settings with as many environments at once as the way it is run, or the policy, allows.

    Going on keeps the number of the earlier run: what a policy samples may depend on it. Parts run one at a time: by
    cores, each machine would cut the evaluation differently.

    Args:
        most: environments that the policy can serve, such as one for each of its servers.
    """
    earlier = earlier_batch_size(log) if orders.resume else None
    if earlier is not None and _batch_is_open(settings):
        settings = settings.changed("eval.batch_size", earlier)
    if orders.in_parts:
        settings = settings.default("eval.batch_size", 1)
    return settings if most is None else with_largest_batch(settings, most)


def with_largest_batch(settings: LerobotSettings, most: int) -> LerobotSettings:
    """Return settings with the largest batch that LeRobot would choose and that divides the episodes; at most ``most``.

    LeRobot runs whole batches and throws the surplus of the last one away, after simulating it.
    """
    if not _batch_is_open(settings):
        return settings
    episodes = int(settings.get("eval.n_episodes") or EVALUATION_EPISODES)
    limit = max(1, min(int(cores() * 0.7), episodes, most))
    return settings.changed("eval.batch_size", max(size for size in range(1, limit + 1) if episodes % size == 0))


def _batch_is_open(settings: LerobotSettings) -> bool:
    return (settings.get("eval.batch_size") or "0") == "0"


def with_protocol(settings: LerobotSettings, n_action_steps: int | None, in_parts: bool = False) -> LerobotSettings:
    """Return settings with the protocol's seed and episodes, a batch, a device, the policy's replan interval, films.

    Args:
        in_parts: all of them are run as jobs, each of which decides on its own machine which device there is.
    """
    import torch

    settings = settings.default("seed", EVALUATION_SEED).default("eval.n_episodes", EVALUATION_EPISODES)
    if whole_number(settings.get("seed")) is not None:
        settings = settings.default("env.seed_base", settings.get("seed"))  # episodes are counted from the first
    settings = with_largest_batch(settings, LARGEST_BATCH)
    # Where parts run elsewhere, that machine decides: this one may be a login node without a GPU, or with the only one.
    if not in_parts and not torch.cuda.is_available() and not torch.backends.mps.is_available():
        settings = settings.default("policy.device", "cpu")
    if n_action_steps is not None:
        settings = settings.default("env.replan_steps", n_action_steps)
    return settings.default("env.films", 0 if settings.get("env.obs_type") == OBJECTS else FILMS)


def unused_folder(settings: LerobotSettings) -> Path:
    """Return a folder that no evaluation has used: ``outputs/eval/<date>/<time>_memobench_<policy>``."""
    chosen = settings.chosen.get("policy")
    name = settings.get("policy.type") or (chosen.get_choice_name(chosen) if chosen else "policy")  # type: ignore[attr-defined]
    now = dt.datetime.now()
    base = Path("outputs/eval") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{ENVIRONMENT}_{name}"
    folder, k = base, 1
    while folder.exists():
        k += 1
        folder = base.with_name(f"{base.name}_{k}")
    return folder
