"""The plan of an evaluation: its settings complete and typed. It is made once and never changed.

Making the plan checks arguments, folders and configurations, so that a mistake ends the command before anything runs.
Settings that a user names stay; the others get the benchmark's defaults.
"""

from __future__ import annotations

import datetime as dt
import itertools
import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from lerobot_memobench.envs.evaluation_file import read_evaluation
from lerobot_memobench.envs.observations import check_obs_type, obs_type_of
from lerobot_memobench.envs.settings import OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.jobs.slurm import read_options
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import check_as_trained, check_checkpoint
from lerobot_memobench.policies.compatibility import check_features
from lerobot_memobench.policies.lerobot_config import overrides, quiet
from lerobot_memobench.protocol import (
    EVALUATION_EPISODES,
    EVALUATION_SEED,
    EVIDENCE_EPISODES,
    PAPER,
    SEALED,
    SPLITS,
    VALIDATION,
)
from lerobot_memobench.run.arguments import (
    CONFIG_FILE,
    RUN_OPTIONS,
    Arguments,
    LerobotArguments,
    is_true,
    joined,
    read_arguments,
    split_arguments,
    without_flags,
)

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig

    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
    from lerobot_memobench.run.settings import EvaluationSettings

ENVIRONMENT = "memobench"
SCRIPTED = {"memobench_expert": "expert_action", "memobench_blind": "blind_action"}
"""Policies whose actions the environment offers -> the setting by which it does."""
OUTPUT = "output_dir"
LARGEST_BATCH = 64
OBJECT_BATCH = 10
"""Environments at once, in one process, of a policy that observes objects and runs on a CPU: a control step of one
episode took 3.8 ms against 6.1 ms one at a time."""
VIDEO_EPISODES = 10
"""Episodes of each task that are recorded as videos, as many as LeRobot renders of an environment without videos of its
own; none where only objects are observed, so that nothing is drawn without need."""
EVALUATED = (PAPER, VALIDATION, SEALED)
"""Splits that ``split=`` names."""


@dataclass(frozen=True)
class EvaluationPlan:
    """An evaluation that is ready to run.

    Attributes:
        settings: complete, as the card holds them.
        policy: its configuration. environment: its configuration.
        grid: the episodes it consists of.
        output: folder of LeRobot's own files.
        log: folder of the episode log, the report and the card.
        seed: of the run; that of the first episode of each task too.
        batch: environments at once.
        options: how it is run.
        command: the command line as it was given, for the card.
    """

    settings: EvaluationSettings
    policy: PreTrainedConfig
    environment: MemobenchEnvConfig
    grid: Grid
    output: Path
    log: Path
    seed: int
    batch: int
    options: RunOptions
    command: tuple[str, ...]

    @property
    def policy_path(self) -> str | None:
        """The model checkpoint or repository that is evaluated, None for a policy that is not loaded."""
        return self.settings.policy_path

    @property
    def split(self) -> str | None:
        """The split of `protocol.SPLITS` that holds the seeds of its scenes; None where no split holds them all."""
        seeds = self.seeds
        return next((name for name, split in SPLITS.items() if seeds[0] in split and seeds[-1] in split), None)

    @property
    def seeds(self) -> range:
        """Seeds of the scenes. With evidence, those of all tasks: tasks differ in their number of variants."""
        base, first, last = self.environment.seed_base, self.grid.first, self.grid.first + self.grid.runs - 1
        if self.environment.evidence:
            variants = self.variants.values()
            first, last = first // max(variants), last // min(variants)
        return range(base + first, base + last + 1)

    @property
    def variants(self) -> dict[str, int]:
        """Task -> number of variants with which each of its scenes is run, with evidence."""
        from lerobot_memobench.tasks.catalogue import load_task

        return {task.name: len(load_task(task.folder).random_variants) for task in self.grid.tasks}

    @property
    def going_on(self) -> str:
        """The command line that goes on with it, ready to be typed."""
        folder = self.output if self.options.shard is None else self.output.parent
        kept = [word for word in joined(self.command) if not word.startswith(("resume=", f"{OUTPUT}="))]
        return shlex.join([*without_flags(kept, OUTPUT), "resume=true", f"{OUTPUT}={folder}"])


# --- making it ---


def plan_line(line: Sequence[str]) -> EvaluationPlan:
    """Return the plan of the benchmark's evaluation that ``lerobot eval <line>`` asks for."""
    from lerobot_memobench.run.settings import read_settings

    options, given = take_run_options(split_arguments(line))
    return make_plan(read_settings(given), options, ("lerobot", "eval", *line))


def make_plan(asked: EvaluationSettings, options: RunOptions, command: Sequence[str]) -> EvaluationPlan:
    """Complete the settings of the benchmark's evaluation and check what they ask for.

    Raises:
        MemobenchError: it cannot be run as asked.
    """
    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
    from lerobot_memobench.run.settings import policy_of, with_policy

    if options.resume and asked.output_dir is None:
        raise MemobenchError("resume=true needs the folder of the evaluation to go on with: output_dir=<folder>")
    asked = with_policy(asked)
    if options.split is not None:
        check_choice("split", options.split, EVALUATED)
    asked = with_device(asked, options)
    policy = policy_of(asked)
    output = _output(asked, options, policy)
    log = Path(asked.env.get("log_dir") or output)
    asked = with_protocol(asked, options, policy)
    asked = with_batch_size(asked, options, log, policy)
    environment = MemobenchEnvConfig(**{**asked.env, "log_dir": None, "resume": False})
    for name, value in vars(environment.settings_for(policy)).items():
        setattr(environment, name, value)
    asked = asked.with_env(**environment.gym_kwargs)
    grid = make_grid(asked, environment)
    plan = EvaluationPlan(
        settings=asked,
        policy=policy,
        environment=environment,
        grid=grid,
        output=output,
        log=log,
        seed=environment.seed_base + grid.first,
        batch=asked.batch_size or 1,
        options=options,
        command=tuple(command),
    )
    if plan.policy_path is not None:
        check_checkpoint(plan.policy_path)
    check_inputs(asked, policy, environment)
    if options.memory_reads:
        check_memory_reads(policy)
    check_split(plan)
    check_scenes(plan)
    if options.slurm is None:  # there, each part checks its own machine
        _check_simulator(environment)
    return plan


def check_split(plan: EvaluationPlan) -> None:
    """Refuse seeds outside the split that was named, and the sealed ones where it was not.

    Raises:
        MemobenchError: they are.
    """
    asked, seeds, sealed = plan.options.split, plan.seeds, SPLITS[SEALED]
    if asked is not None and plan.split != asked:
        split = SPLITS[asked]
        raise MemobenchError(
            f"split={asked} has the seeds {split[0]} to {split[-1]}, and {seeds[0]} to {seeds[-1]} were asked for; "
            f"leave seed= out, and ask for at most {len(split)} episodes"
        )
    if asked is None and seeds[0] <= sealed[-1] and seeds[-1] >= sealed[0]:
        raise MemobenchError(
            f"seeds {seeds[0]} to {seeds[-1]} reach into the sealed test's ({sealed[0]} to {sealed[-1]}), which are "
            "looked at once per release, by `memobench test-sealed policy=…`; choose settings by split=validation"
        )


def check_scenes(plan: EvaluationPlan) -> None:
    """Refuse fewer episodes than a task has variants, where each scene is run with each: it would be in no rate.

    Raises:
        MemobenchError: of a task there would be no whole scene.
    """
    if not plan.environment.evidence:
        return
    variants = plan.variants
    name = max(variants, key=lambda name: variants[name])
    if variants[name] > plan.grid.runs:
        raise MemobenchError(
            f"evidence=true runs each scene with each variant, and {name} has {variants[name]}: with "
            f"episodes={plan.grid.runs} no scene of it is whole, and it would be in no rate; ask for at least "
            f"episodes={variants[name]}, or for other tasks"
        )


def _check_simulator(environment: MemobenchEnvConfig) -> None:
    """Refuse a machine on which every episode would fail: no arm or no assets."""
    from lerobot_memobench.sim.robot import robosuite_version
    from lerobot_memobench.sim.worlds import WORLDS

    robosuite_version()
    WORLDS[environment.world].check()


def _output(asked: EvaluationSettings, options: RunOptions, policy: PreTrainedConfig) -> Path:
    """Return the folder that was asked for, that of the part in it, or one that no evaluation has used."""
    if asked.output_dir is not None:
        return Path(asked.output_dir) / options.shard.folder if options.shard is not None else Path(asked.output_dir)
    now = dt.datetime.now()
    base = Path("outputs/eval") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{ENVIRONMENT}_{policy.type}"
    others = (base.with_name(f"{base.name}_{k}") for k in itertools.count(2))
    return next(folder for folder in itertools.chain([base], others) if not folder.exists())


def make_grid(asked: EvaluationSettings, environment: MemobenchEnvConfig) -> Grid:
    """Return the episodes that an evaluation consists of.

    Raises:
        MemobenchError: unknown tasks, or no episodes.
    """
    tasks = tuple(PlannedTask(*chosen) for chosen in environment.selected())
    runs, seed = asked.episodes, asked.seed
    if runs is None or seed is None or runs < 1:
        raise MemobenchError(f"found episodes={runs} and seed={seed}; expected whole numbers, and at least one episode")
    return Grid(tasks, runs, min(asked.batch_size or 1, runs), seed - environment.seed_base)


# --- the benchmark's defaults ---


def with_device(asked: EvaluationSettings, options: RunOptions) -> EvaluationSettings:
    """Return settings whose policy runs on the CPU where this machine has nothing else.

    Where parts run elsewhere, that machine decides: this one may be a login node without a GPU, or with the only one.
    """
    import torch

    if options.shards or "device" in asked.policy or torch.cuda.is_available() or torch.backends.mps.is_available():
        return asked
    return replace(asked, policy={**asked.policy, "device": "cpu"})


def with_protocol(asked: EvaluationSettings, options: RunOptions, policy: PreTrainedConfig) -> EvaluationSettings:
    """Return settings with the protocol's seed and episodes, the policy's inputs, and videos."""
    if asked.seed is None:
        seed = EVALUATION_SEED if options.split is None else SPLITS[options.split].start
        asked = replace(asked, seed=seed)
    if asked.episodes is None:
        asked = replace(asked, episodes=EVIDENCE_EPISODES if asked.env.get("evidence") else EVALUATION_EPISODES)
    asked = asked.env_default("seed_base", asked.seed)  # episodes are counted from the first
    if obs_type_of(policy) not in (None, PIXELS):
        asked = asked.env_default("obs_type", obs_type_of(policy))
    if policy.type in SCRIPTED:
        asked = asked.env_default(SCRIPTED[policy.type], True)
    return asked.env_default("videos", 0 if asked.env.get("obs_type") == OBJECTS else VIDEO_EPISODES)


def with_batch_size(
    asked: EvaluationSettings, options: RunOptions, log: Path, policy: PreTrainedConfig
) -> EvaluationSettings:
    """Return settings with the number of environments that run at once.

    A policy that observes objects and runs on a CPU gets `OBJECT_BATCH` in one process; otherwise as many processes as
    suit the cores and divide the episodes. Going on keeps the number of the earlier run, because a policy's samples may
    depend on it. Parts run one at a time: by cores, each machine would cut the evaluation differently.
    """
    given, episodes = asked.batch_size or 0, asked.episodes or 1
    if given < 0:
        raise MemobenchError(
            f"found batch_size={given}; expected how many episodes run at once, at least 1, or 0 for as many as suit "
            "the machine"
        )
    if given:
        return asked
    if options.resume and (earlier := earlier_batch_size(log)) is not None:
        return replace(asked, batch_size=earlier)
    if options.in_parts and asked.batch_size is None:
        return replace(asked, batch_size=1)
    # A policy may serve few environments at once, such as one for each of its servers.
    most = min(episodes, getattr(policy, "max_environments", None) or LARGEST_BATCH)
    learned = policy.type not in SCRIPTED and policy.device == "cpu"
    if learned and asked.env.get("obs_type") == OBJECTS and not asked.use_async_envs:
        return replace(asked, batch_size=min(OBJECT_BATCH, most), use_async_envs=False)
    limit = max(1, min(int(cores() * 0.7), most))
    return replace(asked, batch_size=max(size for size in range(1, limit + 1) if episodes % size == 0))


def earlier_batch_size(log: Path) -> int | None:
    """Return the batch size of the evaluation in a folder, None where there is none or it is not known."""
    starts = read_evaluation(log).get("runs") or [{}]
    size = starts[-1].get("batch_size")
    return None if size is None else int(size)


def check_inputs(asked: EvaluationSettings, policy: PreTrainedConfig, environment: MemobenchEnvConfig) -> None:
    """Refuse a policy that is to act on other inputs, or under other settings, than it was trained for.

    Raises:
        MemobenchError: it is refused.
    """
    check_obs_type(policy, environment.obs_type)
    if asked.policy_path is None:
        return
    with quiet():
        check_as_trained(asked.policy_path, policy)
    from lerobot.envs.utils import env_to_policy_features

    check_features(asked.policy_path, policy, env_to_policy_features(environment), asked.rename_map)


def read_other(given: Arguments) -> LerobotArguments:
    """Return LeRobot's arguments for an evaluation of another environment than the benchmark, checked.

    Raises:
        MemobenchError: no environment is named, something is asked for that only the benchmark has, or the checkpoint
            is not whole.
    """
    for key, _ in given.pairs:
        if key in RUN_OPTIONS:
            raise MemobenchError(f"{key}= belongs to the benchmark: name it with env=memobench")
    arguments = read_arguments("eval", given)
    if not given.wants_help and not arguments.has("env.type") and not arguments.has(CONFIG_FILE):
        raise MemobenchError("name an environment: env=memobench")
    path = arguments.get("policy.path")
    if path is not None and not given.wants_help:
        check_checkpoint(path)
    return arguments


# --- configurations of LeRobot's arguments, for training ---


def policy_config(arguments: LerobotArguments) -> PreTrainedConfig | None:
    """Return the policy's configuration; None where none is chosen, or a configuration file has a say.

    Raises:
        MemobenchError: the checkpoint is not whole. Others come from the configuration's own checks.
    """
    path = arguments.get("policy.path")
    if path is None:
        return cast("PreTrainedConfig | None", _parsed(arguments, "policy"))
    check_checkpoint(path)
    return _loaded(path, arguments) if _is_known(arguments, "policy") else None


def _loaded(path: str, arguments: LerobotArguments) -> PreTrainedConfig:
    from lerobot.configs.policies import PreTrainedConfig

    with quiet():
        return PreTrainedConfig.from_pretrained(path, cli_overrides=overrides("policy", arguments.for_parser))


def env_config(arguments: LerobotArguments) -> EnvConfig | None:
    """Return the environment's configuration; None where none is chosen, or a configuration file has a say."""
    return cast("EnvConfig | None", _parsed(arguments, "env"))


def _is_known(arguments: LerobotArguments, key: str) -> bool:
    return key in arguments.chosen and not arguments.has(CONFIG_FILE)


def _parsed(arguments: LerobotArguments, key: str) -> Any:
    import draccus
    import yaml

    if not _is_known(arguments, key):
        return None
    try:
        with quiet():
            return draccus.parse(arguments.chosen[key], args=overrides(key, arguments.for_parser))
    except yaml.YAMLError as error:  # LeRobot reads every value as YAML
        problem = " ".join(str(error).split())
        raise MemobenchError(f"a value of {key}. cannot be read ({problem}); put it in quotes within quotes") from None


def check_observations(policy: PreTrainedConfig | None, environment: EnvConfig | None) -> None:
    """Refuse an environment that lacks the policy's inputs.

    Raises:
        MemobenchError: pictures or objects would be missing.
    """
    if environment is not None and environment.type == ENVIRONMENT:
        check_obs_type(policy, cast("MemobenchEnvConfig", environment).obs_type)


def check_memory_reads(policy: Any) -> None:
    """Refuse ``memory_reads`` for a policy that does not report its reads.

    Args:
        policy: it, or its configuration.

    Raises:
        MemobenchError: the policy has no memory that reports its reads.
    """
    config = getattr(policy, "config", policy)
    if not hasattr(config, "check_memory_reads"):
        raise MemobenchError(
            f"memory_reads=true asks how much each remembered frame is read, which {config.type} does not tell; leave "
            "it out, or evaluate memobench_mem"
        )
    config.check_memory_reads()


# --- how it is run: resume=, shard=, shards=, workers=, slurm= … ---


@dataclass(frozen=True)
class RunOptions:
    """How an evaluation is run, as opposed to what is evaluated.

    Attributes:
        split: whose seeds are run, one of `EVALUATED`; None: those that `seed=` says.
        memory_reads: write how much each chunk reads of each remembered frame next to the log.
        resume: go on with the evaluation in the output folder.
        shard: run this part alone.
        shards: run so many parts as jobs of their own, ``workers`` at a time, and merge them; 0: no parts.
        workers: 0: as many as shards.
        slurm: options of sbatch for jobs on Slurm; None: they run here.
    """

    split: str | None = None
    memory_reads: bool = False
    resume: bool = False
    shard: Shard | None = None
    shards: int = 0
    workers: int = 0
    slurm: tuple[str, ...] | None = None

    @property
    def in_parts(self) -> bool:
        """Whether a part is run, or all of them as parts."""
        return self.shard is not None or self.shards > 0


def take_run_options(given: Arguments) -> tuple[RunOptions, Arguments]:
    """Return the run options of a command line, and the arguments without them.

    Raises:
        MemobenchError: one that cannot be obeyed.
    """
    found: dict[str, list[str]] = {}
    for key, value in given.pairs:
        if key in RUN_OPTIONS:
            found.setdefault(key, []).append(value)
    last = {key: values[-1] for key, values in found.items()}
    options = RunOptions(
        split=last.get("split"),
        memory_reads=is_true("memory_reads", last.get("memory_reads")),
        resume=is_true("resume", last.get("resume")),
        shard=Shard.parse(last["shard"]) if "shard" in last else None,
        shards=_count("shards", last.get("shards")),
        workers=_count("workers", last.get("workers")),
        slurm=read_options(last["slurm"]) if "slurm" in last else None,
    )
    if options.shards and options.shard is not None:
        raise MemobenchError(
            f"both shard={options.shard} and shards={options.shards} are given; shard= runs one part, shards= all of "
            "them"
        )
    idle = [key for key in ("workers", "slurm") if key in found]
    if idle and not options.shards:
        raise MemobenchError(
            f"{idle[0]}= says how parts of an evaluation are run; say how many parts, such as shards=8"
        )
    return options, replace(given, pairs=[pair for pair in given.pairs if pair[0] not in RUN_OPTIONS])


def _count(key: str, text: str | None) -> int:
    if text is None:
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise MemobenchError(f"found {key}={text}; expected a whole number from 1 on")
    return int(text)


# --- all episodes, in the batches in which they are run, and which of them a part or a run has left ---


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 1 on) of ``count``."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read ``2/8``."""
        number, slash, count = text.partition("/")
        if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise MemobenchError(
                f"found shard={text}; expected i/n with i from 1 to n, such as shard=1/8 for the first of 8"
            )
        return cls(int(number), int(count))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @property
    def folder(self) -> str:
        """Name of its folder in that of the evaluation."""
        return f"shard-{self.number}-of-{self.count}"

    def of(self, length: int) -> slice:
        """Return which of ``length`` things are its: contiguous, the parts' sizes at most one apart."""
        return slice((self.number - 1) * length // self.count, self.number * length // self.count)


@dataclass(frozen=True)
class PlannedTask:
    """A task of an evaluation: LeRobot's suite and number of it, and its folder."""

    suite: str
    number: int
    folder: Path

    @property
    def key(self) -> tuple[str, int]:
        """What LeRobot calls the task."""
        return self.suite, self.number

    @property
    def name(self) -> str:
        """What we call it."""
        return self.folder.name


Cell = tuple[PlannedTask, int]
"""A batch: task, and number of the batch of that task."""


@dataclass(frozen=True)
class Grid:
    """All that an evaluation is to run.

    Attributes:
        tasks: in the order in which they are run.
        runs: how many of each.
        batch: environments at once; run k belongs to batch k // ``batch`` of its task.
        first: episode of run 0 (0 in the benchmark's protocol).
    """

    tasks: tuple[PlannedTask, ...]
    runs: int
    batch: int
    first: int = 0

    def cells(self, shard: Shard | None = None) -> list[Cell]:
        """Return the batches of a shard, or all. They are not taken apart: a policy sees whole ones."""
        found = [(task, number) for task in self.tasks for number in range(-(-self.runs // self.batch))]
        return found if shard is None else found[shard.of(len(found))]

    def runs_of(self, number: int) -> range:
        """Return the runs of a task's batch."""
        return range(number * self.batch, min((number + 1) * self.batch, self.runs))

    def episodes(self, cell: Cell) -> list[tuple[str, int]]:
        """Return (task name, episode) of the runs in a batch."""
        task, number = cell
        return [(task.name, self.first + run) for run in self.runs_of(number)]

    def missing(self, done: Collection[tuple[str, int]], shard: Shard | None = None) -> list[Cell]:
        """Return the batches that hold an episode that is not in ``done``."""
        return [cell for cell in self.cells(shard) if not set(self.episodes(cell)) <= set(done)]
