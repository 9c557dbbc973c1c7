"""LeRobot's name for the benchmark: `--env.type=memobench`.

Importing this module registers the environment and nothing more: no simulator, no GL. Both open in the process that
steps the environment, at its first reset.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
from lerobot.configs import PolicyFeature, PreTrainedConfig, parser
from lerobot.envs.configs import EnvConfig

from lerobot_memobench.envs.acting import Acting, acting, parameters_of
from lerobot_memobench.envs.command_line import asked_seeds, policy_being_run, rename_map, training_runs
from lerobot_memobench.envs.episode_log import SETTINGS, check_protocol, revision
from lerobot_memobench.envs.observations import (
    AUTO,
    EVERY,
    METADATA,
    OBJECTS,
    OBS_TYPES,
    PIXELS,
    PROMPT_IN,
    action_space,
    check_counts,
    check_obs_type,
    observation_space,
    policy_features,
    policy_names,
    prompt_in,
)
from lerobot_memobench.envs.pacing import check_pacing, longest
from lerobot_memobench.envs.upstream import upstream_settings
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.jobs.threads import ACTING, limit_torch, use_threads
from lerobot_memobench.protocol import BY_PAPER, CONTROL_HZ, EVALUATION_SEED, HORIZON, PROTOCOLS, UPSTREAM
from lerobot_memobench.tasks.evidence import check_referent
from lerobot_memobench.tasks.task import DRAWN, MEMOBENCH, PUBLISHED, REFERENTS, STRICT, SUITES, check_world

Opener = Callable[[Path, int, bool], gym.vector.VectorEnv]
"""Called with a task's folder, the number of rows, and whether each has a process of its own."""

PolicyCheck = Callable[[str, PreTrainedConfig, dict[str, PolicyFeature], dict[str, str]], None]
"""Called with a checkpoint's path and configuration, what is shown by its names at the policy, and LeRobot's
``rename_map``; raises where they do not go together."""

POLICY_CHECKS: list[PolicyCheck] = []
"""What is asked of the checkpoint that LeRobot is about to evaluate; filled by `registration`, since checkpoints are
the business of `policies`."""
PATH_CHECKS: list[Callable[[str], None]] = []
"""Called with the path of a checkpoint on LeRobot's command line, before LeRobot looks for it; filled like
`POLICY_CHECKS`."""


@EnvConfig.register_subclass("memobench")
@dataclass
class MemobenchEnvConfig(EnvConfig):
    """The benchmark's 30 tasks, as LeRobot's suites: temporal, spatial, object, procedural.

    Args:
        suite: `published`, or `strict`: memory-necessary variants of the 30 tasks, not solvable without a memory.
        world: `memobench`, the package's own scenes, or `libero`, the paper's: LIBERO's assets, placement, contacts and
            predicates. Figures of two worlds do not compare.
        protocol: `paper`, or `upstream`, the authors' evaluation: no demonstration prompt, fixed referents, an end when
            all checkpoints have held, at most 990 steps (`envs.upstream`).
        tasks: `all`, memory types or task names, separated by commas.
        task: the same, for those used to LeRobot's field.
        task_dir: a folder in the published format to run instead of the catalogue (one task, or a tree of them), all
            of it.
        obs_type: observations beside the arm's state: `pixels_agent_pos`, pictures; `environment_state_agent_pos`, what
            they would show as object slots (`observation.environment_state`), and nothing is drawn; or `both`.
        referent: `fixed`, the published goals, or `random`: by seed another admissible referent or order. Strict tasks
            are drawn by seed whatever is said here: `drawn`.
        demonstration_prompt: whether object and procedural tasks begin with their demonstration prompt.
        prompt_in: `steps`, the policy observes the prompt step by step, with `phase` 0; `reset`, it plays before the
            first observation; `auto`: in steps for a policy that reads prompts, else in reset.
        horizon: execution steps per episode.
        render: `fast` (no shadows), `default`, or `high` (four samples per pixel, finer shadows, the arm's
            whole meshes: for films, at ten times the cost).
        render_every: draw images every so many execution steps and repeat the last in between. Set it to the number
            of actions a policy executes per prediction: it looks at nothing else. A policy that remembers the frames
            in between refuses it; `observation.picture_age` has the control steps since the pictures were drawn.
        replan_steps: that number, noted in the episode log; None for the policy's own `n_action_steps`.
        expert_action: offer the scripted expert's action as `observation.expert_action`.
        blind_action: offer that of the published routine, blind to prompt and instruction, as
            `observation.blind_action`.
        oracle_memory: write what has been completed so far behind the instruction (the paper's oracle memory control),
            word for word as the column `memory` of a dataset says it for the same frame.
        pause_steps: the robot rests for so many control steps at moments that the seed draws: actions have no effect,
            the scene stands still, and the horizon waits (`pacing`). It begins and ends between two predictions.
        speed: 1, or 0.5, 0.33 and so on: an action takes two, three control steps, and the horizon is as much longer.
        evidence: run each scene with each of a task's variants, so that only the past differs, and note which one was
            acted on. Episodes go through the variants of the first scene, then of the next. Tasks that have no
            variants are left out.
        log_dir: where the episode log goes; LeRobot's output folder when left out.
        videos: record so many episodes of each task, from episode 0 on, as `<log_dir>/videos/<task>.<episode>.mp4`,
            annotated as `render()` is; −1 records every one, none is recorded when left out.
        seed_base: the seed that counts as episode 0.
        resume: leave out the episodes that the log in `log_dir` holds already.
    """

    suite: str = PUBLISHED
    world: str = MEMOBENCH
    protocol: str = BY_PAPER
    task: str | None = None
    tasks: str = "all"
    task_dir: str | None = None
    fps: int = CONTROL_HZ
    obs_type: str = PIXELS
    referent: str = "fixed"
    demonstration_prompt: bool = True
    prompt_in: str = AUTO
    horizon: int = HORIZON
    render: str = "default"
    render_every: int = 1
    replan_steps: int | None = None
    expert_action: bool = False
    blind_action: bool = False
    oracle_memory: bool = False
    pause_steps: int = 0
    speed: float = 1.0
    evidence: bool = False
    log_dir: str | None = None
    videos: int | None = None
    seed_base: int = EVALUATION_SEED
    resume: bool = False
    features: dict[str, PolicyFeature] = field(default_factory=policy_features)
    features_map: dict[str, str] = field(default_factory=policy_names)

    def __post_init__(self) -> None:
        if self.fps != CONTROL_HZ:
            raise MemobenchError(f"fps is {self.fps}; the benchmark's control rate is {CONTROL_HZ}, leave it out")
        for name, value, known in (
            ("obs_type", self.obs_type, OBS_TYPES),
            ("suite", self.suite, SUITES),
            ("protocol", self.protocol, PROTOCOLS),
            ("referent", self.referent, (*REFERENTS, DRAWN) if self.suite == STRICT else REFERENTS),
            ("prompt_in", self.prompt_in, PROMPT_IN),
            ("render", self.render, ("fast", "default", "high")),
        ):
            check_choice(f"env.{name}", value, known)
        check_world("env.", self.world, self.suite)
        check_counts("env.", horizon=self.horizon, render_every=self.render_every)
        check_pacing("env.", self.pause_steps, self.speed)
        if self.replan_steps is not None:
            check_counts("env.", replan_steps=self.replan_steps)
        if self.videos is not None and self.videos < EVERY:
            raise MemobenchError(f"env.videos is {self.videos}; expected a number of episodes from 0 on, or -1 for all")
        if self.task is not None and self.tasks != "all":
            raise MemobenchError(
                f"env.task={self.task} and tasks={self.tasks} both choose the tasks; leave one of them out"
            )
        if self.task_dir is not None and (chosen := self.task or self.tasks) != "all":
            raise MemobenchError(
                f"env.task_dir={self.task_dir} runs every task in that folder, and tasks={chosen} chooses among the "
                "catalogue's; leave tasks= out, or name the folder of one task by env.task_dir="
            )
        if self.suite == STRICT:
            self.referent = DRAWN  # each of its tasks draws its own
        if self.protocol == UPSTREAM:
            for name, value in upstream_settings("env.", vars(self)).items():
                setattr(self, name, value)
        if self.evidence:
            check_referent("env.", self.referent)
        if self.obs_type != PIXELS:
            self.features, self.features_map = policy_features(self.obs_type), policy_names(self.obs_type)
        if _program() in ("lerobot-eval", "lerobot-train"):
            path = parser.get_path_arg("policy")
            for check in PATH_CHECKS if path else ():
                check(path)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What every sub-environment is made with, but for what follows from the policy."""
        names = (*SETTINGS, "expert_action", "blind_action", "videos")
        return {name: getattr(self, name) for name in names if name not in ("suite", "prompt_in")}

    @property
    def agreed_settings(self) -> dict[str, Any]:
        """What must agree for two evaluations to be one, or to be compared; without what is still `auto`."""
        chosen = {name: getattr(self, name) for name in SETTINGS if getattr(self, name) != AUTO}
        return {**chosen, **revision(self.suite)}

    def selected(self) -> list[tuple[str, int, Path]]:
        """Return memory type, task id and folder of each chosen task; unknown names raise `MemobenchError`."""
        from lerobot_memobench.tasks.catalogue import find_tasks, load_task, resolve_tasks, task_folder, task_index

        if self.task_dir is not None:
            loaded = [load_task(folder) for folder in find_tasks(self.task_dir)]
            for task in loaded:
                if task.suite != self.suite:
                    raise MemobenchError(
                        f"{task.folder} holds a task of the {task.suite} suite and env.suite is {self.suite}; say "
                        f"suite={task.suite} for folders of such tasks"
                    )
            tasks = [(task.memory_type, index, task.folder) for index, task in enumerate(loaded)]
            return self._with_variants(tasks)
        spec = self.task if self.task is not None else self.tasks
        folders = [task_folder(name) for name in resolve_tasks(spec, self.suite)]
        return self._with_variants([(folder.parent.name, task_index(folder.name), folder) for folder in folders])

    def _with_variants(self, tasks: Sequence[tuple[str, int, Path]]) -> list[tuple[str, int, Path]]:
        """Return the tasks that `evidence` can be asked of, all where it is not."""
        from lerobot_memobench.tasks.catalogue import load_task

        if not self.evidence:
            return [*tasks]
        found = [task for task in tasks if load_task(task[2]).num_variants > 1]
        if not found:
            raise MemobenchError(
                "env.evidence=true runs each scene with each variant, and none of the chosen tasks has any; choose "
                "object or procedural tasks, or suite=strict"
            )
        return found

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return `{memory type: {task id: vector env}}`; nothing is simulated before an env's first reset."""
        policy = policy_being_run()
        self._check_checkpoint(policy)
        chosen = self.selected()  # before anything is written: a wrong name leaves nothing behind
        _check_recording(n_envs, self.obs_type)
        _use_threads(policy)
        by = acting(policy, parser.get_path_arg("policy"), asked_seeds(), self.obs_type, self.oracle_memory)
        opened = self.opener(policy, by, self.resolved_log_dir())
        suites: dict[str, dict[int, gym.vector.VectorEnv]] = {}
        for memory_type, task_id, folder in chosen:
            suites.setdefault(memory_type, {})[task_id] = opened(folder, n_envs, use_async_envs)
        return suites

    def opener(self, policy: Any, by: Acting, log_dir: Path) -> Opener:
        """Return a function that opens the vector environment of a task for a policy.

        Args:
            policy: its configuration, or the class of it.
            by: who acts, for the log.
            log_dir: folder of the episode log.

        Raises:
            MemobenchError: the folder holds a log of another protocol.
        """
        from lerobot_memobench.envs.memobench_env import MemobenchEnv, SkipLogged

        prompt = prompt_in(policy) if self.prompt_in == AUTO else self.prompt_in
        replan_steps = self._replan_steps(policy)
        told = {"prompt_in": prompt, "replan_steps": replan_steps}
        settings = {**self.gym_kwargs, **told, "acting": by, "log_dir": str(log_dir)}
        check_protocol(log_dir, {**self.agreed_settings, **told, **by.protocol})  # before an episode is simulated
        most = longest(self.horizon, self.pause_steps, self.speed, replan_steps)

        def opened(folder: Path, rows: int, use_async_envs: bool) -> gym.vector.VectorEnv:
            make: Callable[[], gym.Env[Any, Any]] = partial(MemobenchEnv, str(folder), **settings)
            if self.resume:
                make = partial(SkipLogged, make, log_dir, self.referent, self.seed_base)
            return self._vector([make] * rows, use_async_envs and rows > 1, most)

        return opened

    def get_env_processors(self) -> tuple[Any, Any]:
        """Return what LeRobot does to observations and actions of these environments."""
        from lerobot.processor import PolicyProcessorPipeline

        from lerobot_memobench.envs.processor_memobench import ClockProcessorStep

        return PolicyProcessorPipeline(steps=[ClockProcessorStep()]), PolicyProcessorPipeline(steps=[])

    def _replan_steps(self, policy: Any) -> int | None:
        """Return how many actions are executed per prediction; None where only a policy's type is known."""
        if self.replan_steps is not None or isinstance(policy, type):
            return self.replan_steps
        found: int | None = getattr(policy, "n_action_steps", None)
        return found

    def _check_checkpoint(self, policy: Any) -> None:
        """Refuse the checkpoint on LeRobot's command line where it was made for something else than is shown here."""
        from lerobot.envs.utils import env_to_policy_features

        path = None if training_runs() else parser.get_path_arg("policy")
        if path is not None:
            check_obs_type(policy, self.obs_type)
            for check in POLICY_CHECKS:
                check(path, policy, env_to_policy_features(self), rename_map())

    def _vector(
        self, make: list[Callable[[], gym.Env[Any, Any]]], use_async_envs: bool, most: int
    ) -> gym.vector.VectorEnv:
        from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end

        if use_async_envs:
            # LeRobot's workers are forked from a server: it imports torch and the simulator once for all of them.
            get_context("forkserver").set_forkserver_preload(["lerobot_memobench.envs.memobench_env"])
            # What a vector environment must know before its workers exist.
            space = observation_space(self.expert_action, self.render_every, self.obs_type, self.blind_action, most)
            return _LazyAsyncVectorEnv(make, space, action_space(), METADATA)
        # LeRobot freezes finished rows of its own async envs only; a sync row would be reset and go on.
        return gym.vector.SyncVectorEnv(
            [freeze_after_episode_end(one) for one in make], autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP
        )

    def resolved_log_dir(self) -> Path:
        """Return the folder of the episode log: given, else the run's output folder, else a dated one.

        Each evaluation within a training has its own in there, ``evaluation-1`` and so on: a policy that has learned
        on is another.
        """
        # The configuration of an environment does not hold the run's output folder; LeRobot's parser tells it.
        output = parser.parse_arg("output_dir") or f"outputs/eval/{datetime.now():%Y-%m-%d/%H-%M-%S}_memobench"
        folder = Path(output if self.log_dir is None else self.log_dir)
        if not training_runs():
            return folder
        return next(place for k in count(1) if not (place := folder / f"evaluation-{k}").exists())


def _program() -> str:
    return Path(sys.argv[0]).stem.replace("_", "-")


def _check_recording(rows: int, obs_type: str) -> None:
    """Refuse what LeRobot's own recorder cannot: pictures, and a second batch; `lerobot eval` has another.

    Raises:
        MemobenchError: plain ``lerobot-eval`` was asked for it.
    """
    if (parser.parse_arg("eval.recording") or "").lower() != "true":
        return
    episodes = parser.parse_arg("eval.n_episodes") or "50"
    if obs_type != OBJECTS or (episodes.isdecimal() and int(episodes) > rows):
        raise MemobenchError(
            "eval.recording=true was asked of plain lerobot-eval, whose recorder takes neither pictures of this "
            "environment nor more episodes than run at once; `lerobot eval env=memobench eval.recording=true` records "
            "both"
        )


def _use_threads(policy: Any) -> None:
    """Give plain ``lerobot-eval`` the threads that `lerobot eval` has, as far as its libraries have not begun theirs.

    Any other program of LeRobot's, such as a training that evaluates in between, keeps what it has.
    """
    if _program() != "lerobot-eval":
        return
    use_threads(ACTING)
    path = parser.get_path_arg("policy")
    weightless = 0 if getattr(policy, "weightless", False) else None
    parameters = weightless if path is None else parameters_of(path)
    if parameters is not None:
        limit_torch(parameters)
