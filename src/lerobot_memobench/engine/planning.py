"""From the words of ``lerobot eval env=memobench`` to the plan: defaults, and what cannot be asked for.

Everything that a look at settings, folders and configurations can tell is told here, before anything is run: a mistake
costs a sentence and not a run.
"""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from lerobot_memobench.engine.grid import Grid, Place
from lerobot_memobench.engine.orders import Orders, take_orders
from lerobot_memobench.engine.plan import LOG, OUTPUT, EvaluationPlan
from lerobot_memobench.engine.resume import earlier_batch_size
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import check_checkpoint
from lerobot_memobench.settings.configurations import env_config, policy_config
from lerobot_memobench.settings.flags import whole_number
from lerobot_memobench.settings.reading import read_settings
from lerobot_memobench.settings.translation import LerobotSettings
from lerobot_memobench.settings.words import split_words
from lerobot_memobench.tasks.task import load_task

if TYPE_CHECKING:
    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig

ENVIRONMENT = "memobench"
EXPERT = "memobench_expert"
FIRST_SEED = 7
"""Episode i of the protocol uses seed 7 + i."""
EPISODES = 50
LARGEST_BATCH = 64


def is_benchmark(settings: LerobotSettings, orders: Orders) -> bool:
    """Return whether an evaluation is the benchmark's; another one gets no defaults, and is checked here.

    Raises:
        MemobenchError: no environment is named, or what only the benchmark has is asked of another one.
    """
    if not settings.has("env.type") and not settings.has("config_path"):
        raise MemobenchError("name an environment: env=memobench")
    if settings.get("env.type") == ENVIRONMENT:
        return True
    if orders.any:
        raise MemobenchError("resume=, shard= and shards= belong to the benchmark: name it with env=memobench")
    path = settings.get("policy.path")
    if path is not None:
        check_checkpoint(path)
    return False


def plan_line(line: Sequence[str]) -> EvaluationPlan:
    """Return the plan of the benchmark's evaluation that ``lerobot eval <line>`` asks for."""
    orders, words = take_orders(split_words(line))
    return make_plan(read_settings("eval", words), orders, ("lerobot", "eval", *line))


def make_plan(settings: LerobotSettings, orders: Orders, command: Sequence[str]) -> EvaluationPlan:
    """Complete the settings of the benchmark's evaluation and find out what they ask for.

    Raises:
        MemobenchError: it cannot be run as asked.
    """
    if orders.resume and not settings.has(OUTPUT):
        raise MemobenchError("resume=true needs the folder of the evaluation to go on with: output_dir=<folder>")
    settings = with_policy(settings)
    policy = policy_config(settings)
    output = _output(settings, orders)
    log = Path(settings.get(LOG) or output)
    settings = settings.changed(OUTPUT, output).changed(LOG, log)
    settings = with_batch_size(settings, orders, log, getattr(policy, "max_environments", None))
    settings = with_protocol(settings, getattr(policy, "n_action_steps", None))
    environment = cast("MemobenchEnvConfig | None", env_config(settings))
    if environment is None and orders.any:
        raise MemobenchError("resume=, shard= and shards= cannot go with config_path=; give its settings on the line")
    grid = None if environment is None else make_grid(settings, environment)
    check_rendering()
    return EvaluationPlan(
        settings=settings.without(OUTPUT, LOG),
        policy=policy,
        environment=environment,
        grid=grid,
        output=output,
        log=log,
        seed=whole_number(settings.get("seed")),
        batch=whole_number(settings.get("eval.batch_size")) or 1,
        orders=orders,
        command=tuple(command),
    )


def check_rendering() -> None:
    """Refuse to start without a GL library: every episode would fail at its first frame."""
    from lerobot_memobench.sim.rendering import gl_backend

    gl_backend()


def with_policy(settings: LerobotSettings) -> LerobotSettings:
    """Return settings with the scripted expert where no policy is named; the environment offers it its action."""
    if not settings.has("policy.path"):
        settings = settings.default("policy.type", EXPERT)
    name = settings.get("policy.type")
    if name == EXPERT:
        settings = settings.default("env.expert_action", True)
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
    episodes = int(settings.get("eval.n_episodes") or EPISODES)
    limit = max(1, min(int((os.cpu_count() or 4) * 0.7), episodes, most))
    return settings.changed("eval.batch_size", max(size for size in range(1, limit + 1) if episodes % size == 0))


def _batch_is_open(settings: LerobotSettings) -> bool:
    return (settings.get("eval.batch_size") or "0") == "0"


def with_protocol(settings: LerobotSettings, n_action_steps: int | None) -> LerobotSettings:
    """Return settings with the protocol's seed and episodes, a batch, a device, and the policy's replan interval."""
    import torch

    settings = settings.default("seed", FIRST_SEED).default("eval.n_episodes", EPISODES)
    settings = with_largest_batch(settings, LARGEST_BATCH)
    if not torch.cuda.is_available() and not torch.backends.mps.is_available():
        settings = settings.default("policy.device", "cpu")
    if n_action_steps is not None:
        settings = settings.default("env.replan_steps", n_action_steps)
    return settings


def _output(settings: LerobotSettings, orders: Orders) -> Path:
    """Return the folder that was asked for, that of the part in it, or a new one."""
    given = settings.get(OUTPUT)
    if given is None:
        return unused_folder(settings)
    return Path(given) / orders.shard.folder if orders.shard is not None else Path(given)


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


def make_grid(settings: LerobotSettings, environment: MemobenchEnvConfig) -> Grid:
    """Return the episodes that an evaluation consists of.

    Raises:
        MemobenchError: unknown tasks, or no episodes.
    """
    places = tuple(Place(suite, index, load_task(folder)) for suite, index, folder in environment.selected())
    runs, seed = whole_number(settings.get("eval.n_episodes")), whole_number(settings.get("seed"))
    if runs is None or seed is None or runs < 1:
        raise MemobenchError(
            f"found episodes={settings.get('eval.n_episodes')} and seed={settings.get('seed')}; expected whole "
            "numbers, and at least one episode"
        )
    batch = min(whole_number(settings.get("eval.batch_size")) or 1, runs)
    return Grid(places, runs, batch, seed - environment.seed_base)
