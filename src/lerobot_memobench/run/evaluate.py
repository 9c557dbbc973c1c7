"""The evaluation loop: run a policy in the environments of each task, batch after batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.device_utils import get_safe_torch_device
from lerobot.utils.random_utils import set_seed

from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.envs.evaluation_file import INPUTS, POLICY, Acting, read_evaluation
from lerobot_memobench.envs.lerobot import Opener
from lerobot_memobench.envs.settings import SWAP
from lerobot_memobench.jobs.threads import limit_torch
from lerobot_memobench.policies.lerobot_config import quiet
from lerobot_memobench.policies.memory_reads import noting_reads
from lerobot_memobench.run.plan import Cell, EvaluationPlan, PlannedTask
from lerobot_memobench.run.rollout import Actor, BatchSeeds, roll

Advance = Callable[[int, int, str], None]
"""Called after each batch with the finished episodes, all episodes of the run, and the task's name."""


def evaluate(plan: EvaluationPlan, cells: Sequence[Cell], begin: Callable[[], None], advance: Advance) -> None:
    """Run batches of episodes; the environments write the log.

    Args:
        cells: the batches, those of one task in succession.
        begin: called once, after the policy is loaded and before the first scene; writes the evaluation's file.

    Raises:
        MemobenchError: the policy and the environment do not fit. Any error of LeRobot.
    """
    policy: Any = plan.policy
    device = get_safe_torch_device(policy.device)
    torch.backends.cudnn.benchmark = True
    torch.backends.cuda.matmul.allow_tf32 = True
    set_seed(plan.seed)
    actor = load_actor(plan)
    limit_torch(sum(parameter.numel() for parameter in actor.policy.parameters()))
    begin()
    # Logged rows of a resumed batch rest, and have no memory to swap.
    rests = plan.environment.corrupt != SWAP
    environment = replace(plan.environment, resume=rests and has_log(plan.log))
    asked = range(plan.seed, plan.seed + plan.grid.runs)
    facts = read_evaluation(plan.log)
    by = Acting(facts[POLICY], facts["protocol"][INPUTS], asked)
    # The loaded policy's configuration: some policies of LeRobot replace their plan by that of the checkpoint.
    opened = environment.opener(actor.policy.config, by, plan.log)
    environments = Environments(opened, plan.settings.use_async_envs is not False)
    seeds = BatchSeeds(actor.policy, plan.seed)
    scenes = environment.settings
    reads = partial(noting_reads, plan.log, scenes) if plan.options.memory_reads else None
    amp = torch.autocast(device_type=device.type) if policy.use_amp else nullcontext()
    done, total = 0, sum(len(plan.grid.runs_of(number)) for _, number in cells)
    with amp, closing(environments):
        for task, number in cells:
            runs = plan.grid.runs_of(number)
            batch = range(plan.seed + runs.start, plan.seed + runs.stop)
            env = environments.of(task, len(batch))
            seeds.begin(task.name, batch.start)
            with nullcontext() if reads is None else reads(task.name, actor.policy, batch) as ended:
                roll(env, actor, batch, ended, scenes.corrupt)
            done += len(batch)
            advance(done, total, task.name)


class Environments:
    """The vector environment of one task and batch size at a time.

    Args:
        opened: makes one. use_async: gives each row a process of its own.
    """

    def __init__(self, opened: Opener, use_async: bool) -> None:
        self._opened, self._use_async = opened, use_async
        self._key: tuple[PlannedTask, int] | None = None
        self._env: Any = None

    def of(self, task: PlannedTask, rows: int) -> Any:
        """Return the environment of a task with a number of rows, after closing any other."""
        if self._key != (task, rows):
            self.close()
            self._env, self._key = self._opened(task.folder, rows, self._use_async), (task, rows)
        return self._env

    def close(self) -> None:
        """Close the environment that is open."""
        if self._env is not None:
            self._env.close()
        self._env = self._key = None


def load_actor(plan: EvaluationPlan) -> Actor:
    """Return the plan's policy and its processors, as LeRobot makes them."""
    policy, environment = copy(plan.policy), plan.environment
    policy.pretrained_path = None if plan.policy_path is None else Path(plan.policy_path)
    renamed = dict(plan.settings.rename_map)
    with quiet() if plan.policy_path is None else nullcontext():  # LeRobot warns that there are no weights
        loaded = make_policy(cfg=policy, env_cfg=environment, rename_map=renamed).eval()
    before, after = make_pre_post_processors(
        policy_cfg=policy,
        pretrained_path=policy.pretrained_path,
        preprocessor_overrides={
            "device_processor": {"device": str(loaded.config.device)},
            "rename_observations_processor": {"rename_map": renamed},
        },
    )
    env_before, env_after = environment.get_env_processors()  # LeRobot's function would give any XVLA those of LIBERO
    return Actor(loaded, (env_before, before), (after, env_after))
