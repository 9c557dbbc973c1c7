"""From the words of ``lerobot eval env=memobench`` to the plan: defaults, and what cannot be asked for.

Everything that a look at settings, folders and configurations can tell is told here, before anything is run: a mistake
costs a sentence and not a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from lerobot_memobench.envs.observations import PIXELS, obs_type_of
from lerobot_memobench.envs.prompting import prompt_in
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.executors import ELSEWHERE
from lerobot_memobench.policies.checkpoint import check_checkpoint
from lerobot_memobench.run.configurations import check_shown, check_sight, env_config, policy_config
from lerobot_memobench.run.defaults import ENVIRONMENT, unused_folder, with_batch_size, with_policy, with_protocol
from lerobot_memobench.run.flags import whole_number
from lerobot_memobench.run.grid import Grid, Place
from lerobot_memobench.run.orders import Orders, take_orders
from lerobot_memobench.run.plan import LOG, OUTPUT, EvaluationPlan
from lerobot_memobench.run.reading import read_settings
from lerobot_memobench.run.translation import LerobotSettings
from lerobot_memobench.run.words import split_words
from lerobot_memobench.tasks.catalogue import load_task

if TYPE_CHECKING:
    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig


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
    if obs_type_of(policy) not in (None, PIXELS):
        settings = settings.default("env.obs_type", obs_type_of(policy))
    settings = with_protocol(settings, getattr(policy, "n_action_steps", None), in_parts=orders.shards > 0)
    if policy is not None:  # else LeRobot's process finds out
        settings = settings.default("env.prompt_in", prompt_in(policy))
    environment = cast("MemobenchEnvConfig | None", env_config(settings))
    check_sight(policy, environment)
    check_shown(settings, policy, environment)
    if environment is None and orders.any:
        raise MemobenchError("resume=, shard= and shards= cannot go with config_path=; give its settings on the line")
    grid = None if environment is None else make_grid(settings, environment)
    plan = EvaluationPlan(
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
    if plan.draws and orders.executor not in ELSEWHERE:  # there, each part finds out
        check_rendering()
    return plan


def check_rendering() -> None:
    """Refuse to start without a GL library: every episode would fail at its first frame."""
    from lerobot_memobench.sim.rendering import gl_backend

    gl_backend()


def _output(settings: LerobotSettings, orders: Orders) -> Path:
    """Return the folder that was asked for, that of the part in it, or a new one."""
    given = settings.get(OUTPUT)
    if given is None:
        return unused_folder(settings)
    return Path(given) / orders.shard.folder if orders.shard is not None else Path(given)


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
