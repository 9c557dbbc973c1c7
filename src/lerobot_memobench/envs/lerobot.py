"""The benchmark as a LeRobot environment: ``--env.type=memobench``.

Importing this module registers the environment without loading the simulator. Each process that steps an environment
loads it at the first reset.
"""

from __future__ import annotations

import sys
import typing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from datetime import datetime
from functools import partial
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
from lerobot.configs import PipelineFeatureType, PolicyFeature, parser
from lerobot.envs.configs import EnvConfig
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline, ProcessorStepRegistry

from lerobot_memobench.constants import CLOCK, CONTROL_HZ, ENDED, NO_CLOCK
from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.envs.evaluation_file import UNKNOWN_POLICY, Acting, check_facts, facts_of
from lerobot_memobench.envs.observations import (
    METADATA,
    action_space,
    observation_space,
    policy_features,
    policy_names,
    reads_prompt,
)
from lerobot_memobench.envs.pacing import longest
from lerobot_memobench.envs.settings import AUTO, INTACT, RESET, STEPS, EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import (
    check_states,
    find_tasks,
    group_of,
    lerobots_choice,
    load_task,
    resolve_tasks,
    task_folder,
    task_index,
)
from lerobot_memobench.tasks.task import LIBERO_SUITES, STRICT

Opener = Callable[[Path, int, bool], gym.vector.VectorEnv]
"""Called with a task's folder, the number of rows, and whether each row runs in its own process."""

EXECUTED = ("n_action_steps", "n_action_repeats", "action_chunk_size")
"""Fields of LeRobot's policies with the actions executed per plan: of most, of TD-MPC (its larger one), of VQ-BeT."""
UNKNOWN_PLAN = (
    "a strict task holds the scene for longer than a plan, and the number of actions that the policy executes per plan "
    "is unknown here; set {}, to 1 for a policy that plans at every step"
)
"""Message of a refusal, without the setting's name."""


def lerobots_command() -> str | None:
    """Return ``eval`` or ``train`` in the process of ``lerobot-eval`` or ``lerobot-train``, None in any other."""
    name = Path(sys.argv[0]).stem.replace("_", "-")  # `lerobot_eval.py` of `python -m` too
    return name.removeprefix("lerobot-") if name in ("lerobot-eval", "lerobot-train") else None


@contextmanager
def ending_lerobots_command() -> Iterator[None]:
    """End ``lerobot-eval`` and ``lerobot-train`` with the message of a `MemobenchError`, as this package's commands."""
    try:
        yield
    except MemobenchError as error:
        if (command := lerobots_command()) is None:
            raise
        print(f"lerobot-{command}: {error}", file=sys.stderr)
        raise SystemExit(2) from error


_TYPES = typing.get_type_hints(EnvSettings)
# LeRobot reads `--env.<name>` into fields of the configuration itself.
_WithSettings: Any = make_dataclass(
    "_WithSettings",
    [(setting.name, _TYPES[setting.name], field(default=setting.default)) for setting in fields(EnvSettings)],
    bases=(EnvConfig,),
)


@EnvConfig.register_subclass("memobench")
@dataclass
class MemobenchEnvConfig(_WithSettings):
    """The benchmark's 30 tasks, as LeRobot's suites: temporal, spatial, object, procedural; or those of LIBERO.

    The fields are those of `EnvSettings` and:

    Args:
        tasks: `all`, memory types, task names, numbers and ranges of numbers (12, 3-7), separated by commas.
        task: LeRobot's field of every environment; sets ``suite`` if it names suites of LIBERO, else ``tasks``.
            Several suites are run with their own defaults and logs, in LeRobot's commands only.
        task_ids: ids of LIBERO's tasks, from 0.
        task_dir: folder in the published format (one task, or a tree of tasks) that replaces the catalogue.
        log_dir: folder of the episode log; by default a dated folder in ``outputs/eval``. In a folder with a log, the
            log goes to a subfolder ``evaluation-2`` and so on, unless ``resume`` is set.
        resume: skip episodes that the log in `log_dir` already contains.
    """

    task: str | None = None
    task_ids: list[int] | None = None
    tasks: str = "all"
    task_dir: str | None = None
    log_dir: str | None = None
    resume: bool = False
    fps: int = CONTROL_HZ
    check_policy: ClassVar[Callable[[MemobenchEnvConfig], tuple[Any, Acting]]] = lambda config: (None, UNKNOWN_POLICY)
    """`prepare_lerobots_command`. `registration` sets it, because policies depend on environments."""
    features: dict[str, PolicyFeature] = field(default_factory=policy_features)
    features_map: dict[str, str] = field(default_factory=policy_names)

    @ending_lerobots_command()
    def __post_init__(self) -> None:
        suites, self.tasks = lerobots_choice(self.task, self.task_ids, self.suite, self.tasks)
        self.__dict__.update(suite=suites[0])
        self.task, self.task_ids = None if len(suites) == 1 else ",".join(suites), None
        if self.fps != CONTROL_HZ:
            raise MemobenchError(f"env.fps is {self.fps}; the control rate is {CONTROL_HZ}, leave env.fps out")
        for name, value in asdict(self.settings).items():  # some follow from the rules and the suite
            setattr(self, name, value)
        if self.task_dir is not None and self.tasks != "all":
            raise MemobenchError(
                f"env.task_dir={self.task_dir} runs every task of that folder and excludes tasks={self.tasks}; remove "
                "tasks=, or set env.task_dir= to the folder of one task"
            )
        if (features := policy_features(self.settings)) != policy_features():
            self.features, self.features_map = features, policy_names(self.settings)

    @property
    def settings(self) -> EnvSettings:
        """Settings of each environment."""
        return EnvSettings(**{setting.name: getattr(self, setting.name) for setting in fields(EnvSettings)})

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Settings by name, for `MemobenchEnv`."""
        return asdict(self.settings)

    def selected(self) -> list[tuple[str, int, Path]]:
        """Return memory type, task id and folder of each chosen task that the controls apply to; raise without one."""
        if self.task_dir is None:
            names = resolve_tasks(self.tasks, self.suite)
            tasks = [(group_of(name), task_index(name), task_folder(name)) for name in names]
        else:
            loaded = [load_task(folder) for folder in find_tasks(self.task_dir)]
            for task in loaded:
                if task.suite != self.suite:
                    raise MemobenchError(
                        f"{task.folder} holds a task of the {task.suite} suite and env.suite is {self.suite}; set "
                        f"suite={task.suite} for folders of such tasks"
                    )
            tasks = [(task.memory_type, index, task.folder) for index, task in enumerate(loaded)]
        if self.settings.needs_prompt:
            tasks = [task for task in tasks if load_task(task[2]).prompt is not None]
            if not tasks:
                raise MemobenchError(
                    "corrupt= (at step 0), reshow= and interference= act on the demonstration prompt, and no chosen "
                    "task has one; choose object or procedural tasks, or set corrupt_step="
                )
        if self.evidence and self.suite != STRICT:  # strict tasks with one variant run each scene once
            tasks = [task for task in tasks if load_task(task[2]).num_variants > 1]
            if not tasks:
                raise MemobenchError(
                    "env.evidence=true runs each scene with each variant, but no chosen task has variants; choose "
                    "object or procedural tasks, or suite=strict"
                )
        return tasks

    @ending_lerobots_command()
    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return ``{memory type or suite of LIBERO: {task id: vector env}}`` for LeRobot's own commands.

        The first reset of an env starts its simulation.
        """
        envs: dict[str, dict[int, gym.vector.VectorEnv]] = {}
        if self.task is not None:  # suites of LIBERO, each with its own defaults and folder of its log
            folder = self.resolved_log_dir()
            for suite in self.task.split(","):
                own = asdict(self.settings.changed(suite=suite))
                config = replace(self, task=None, log_dir=str(folder / suite), **own)
                envs |= config.create_envs(n_envs, use_async_envs)
                # Features are of the checkpoint's convention.
                self.features, self.features_map = config.features, config.features_map
            return envs
        self._number_as_lerobot()
        chosen = self.selected()  # raises before a folder is created
        check_loop(self.settings)
        policy, by = type(self).check_policy(self)
        self.declare_plans(policy)
        opened = self.opener(policy, by, self.resolved_log_dir())
        for memory_type, task_id, folder in chosen:
            envs.setdefault(memory_type, {})[task_id] = opened(folder, n_envs, use_async_envs)
        return envs

    def _number_as_lerobot(self) -> None:
        """Let the first episode of ``lerobot-eval`` in a suite of LIBERO have the first initial state."""
        if self.suite not in LIBERO_SUITES or lerobots_command() != "eval":
            return
        from lerobot.configs.default import EvalConfig
        from lerobot.configs.eval import EvalPipelineConfig

        seed = int(parser.parse_arg("seed") or EvalPipelineConfig.seed or 0)
        if parser.parse_arg("env.seed_base") is None:
            self.__dict__.update(seed_base=seed)
        episodes = int(parser.parse_arg("eval.n_episodes") or EvalConfig.n_episodes)
        check_states(self.suite, seed - self.seed_base, episodes)

    def declare_plans(self, policy: Any) -> None:
        """Set the actions and frames of a plan from a policy's configuration. Errors as of `settings_for`."""
        planned = self.settings_for(policy)
        known = 1 if policy is not None and self.suite == STRICT else None  # it plans at every step
        self.replan_steps, self.window_steps = planned.replan_steps or known, planned.window_steps

    def settings_for(self, policy: Any) -> EnvSettings:
        """Return the settings with defaults that follow from a policy's configuration (None if unknown)."""
        settings, executed = self.settings, executed_actions(policy)
        if settings.prompt_in == AUTO:
            settings = settings.changed(prompt_in=STEPS if policy is None or reads_prompt(policy) else RESET)
        if settings.replan_steps is None:
            if self.suite == STRICT and (policy is None or getattr(policy, "plans_unseen", False)):
                raise MemobenchError(UNKNOWN_PLAN.format("env.replan_steps"))
            settings = settings.changed(replan_steps=executed or None)
        elif executed and settings.replan_steps % executed:  # a hold must be longer than a plan, and end with one
            raise MemobenchError(
                f"env.replan_steps is {settings.replan_steps}, but the policy executes {executed} actions per plan; "
                f"leave env.replan_steps out, or set both by replan={settings.replan_steps}"
            )
        observed = getattr(policy, "n_obs_steps", 1)  # a hold must be longer than the policy's input
        if getattr(policy, "temporal_ensemble_coeff", None) is not None:  # ACT averages the plans of so many steps
            observed += policy.chunk_size - 1
        return settings.changed(window_steps=max(settings.window_steps, observed))

    def opener(self, policy: Any, by: Acting, log_dir: Path) -> Opener:
        """Return a function that opens the vector environment of a task for a policy; refuse another protocol's log.

        ``policy``: its configuration, None if unknown. ``by``: its description for the log.
        """
        from lerobot_memobench.envs.env import MemobenchEnv, SkipLogged

        settings = self.settings_for(policy)
        check_facts(log_dir, facts_of(settings, by))  # fail before the first episode

        def opened(folder: Path, rows: int, use_async_envs: bool) -> gym.vector.VectorEnv:
            make: Any = partial(MemobenchEnv, str(folder), settings, log_dir=str(log_dir), acting=by)
            if self.resume:
                make = partial(SkipLogged, make, log_dir, settings)
            return _vector([make] * rows, settings, use_async_envs and rows > 1)

        return opened

    def get_env_processors(self) -> tuple[Any, Any]:
        """Return LeRobot's processors of observations and actions."""
        return PolicyProcessorPipeline(steps=[ClockProcessorStep()]), PolicyProcessorPipeline(steps=[])

    def resolved_log_dir(self) -> Path:
        """Return the folder of the episode log; see ``log_dir``."""
        if self.log_dir is None:
            return Path(f"outputs/eval/{datetime.now():%Y-%m-%d/%H-%M-%S}_memobench")
        folder = Path(self.log_dir)
        if self.resume or not has_log(folder):
            return folder
        return next(candidate for k in count(2) if not (candidate := folder / f"evaluation-{k}").exists())


def executed_actions(policy: Any) -> int:
    """Return the number of actions that a policy executes per plan; 0 if its configuration states none."""
    stated = max(getattr(policy, name, None) or 0 for name in EXECUTED)
    if getattr(policy, "type", None) != "groot":
        return stated
    from lerobot.policies.groot.configuration_groot import infer_groot_n1_7_action_execution_horizon as horizon

    # GR00T executes no more actions than its base model was made for.
    return min(stated, horizon(policy.base_model_path, policy.embodiment_tag) or stated)


def check_loop(settings: EnvSettings) -> None:
    """Raise `MemobenchError` for corruption in the loops of other tools, which do not pass it on to the policy."""
    if settings.corrupt != INTACT:
        raise MemobenchError(
            f"found corrupt={settings.corrupt} in a loop that cannot change a policy's memory; use `lerobot eval "
            "env=memobench`, or leave it out"
        )


def _vector(
    make: list[Callable[[], gym.Env[Any, Any]]], settings: EnvSettings, use_async_envs: bool
) -> gym.vector.VectorEnv:
    from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end

    if use_async_envs:
        # Workers are forked from a server, which imports torch and the simulator once.
        get_context("forkserver").set_forkserver_preload(["lerobot_memobench.envs.env"])
        space = observation_space(settings, longest(settings))
        return _LazyAsyncVectorEnv(make, space, action_space(), METADATA)
    # LeRobot freezes finished rows of async environments only; a sync row would start another episode.
    return gym.vector.SyncVectorEnv(
        [freeze_after_episode_end(make_env) for make_env in make], autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP
    )


@dataclass
@ProcessorStepRegistry.register(name="memobench_clock")
class ClockProcessorStep(ObservationProcessorStep):
    """Reshape phase and step from (B, 1) to (B,), the shape of one-number columns in a LeRobot training batch."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Reshape the two."""
        return {key: value.reshape(len(value)) if key in CLOCK else value for key, value in observation.items()}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Return the features unchanged."""
        return features


# --- the clock of observations, read by policies ---

Clock = tuple[int, int]
"""Phase and step of an observation (`lerobot_memobench.constants`)."""


def begins_episode(last: Clock | None, now: Clock) -> bool:
    """Return whether an observation is the first of an episode, given the clock of the one before."""
    return last is None or (now[1] != ENDED and (now < last or last[1] == ENDED))


def is_frozen(last: Clock | None, now: Clock) -> bool:
    """Return whether an observation repeats the one before, because the episode has ended."""
    return now[1] == ENDED or (now == last and now[1] != NO_CLOCK)
