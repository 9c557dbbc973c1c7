"""The plan of an evaluation: what its command line asks for, complete and typed. It is made once and never changed.

Everything that a look at arguments, folders and configurations can tell is told here, before anything is run: a mistake
costs a sentence and not a run. What a user sets stays; what is left open gets the benchmark's default.
"""

from __future__ import annotations

import datetime as dt
import itertools
import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from lerobot_memobench.envs.command_line import overrides, quiet, read_rename_map
from lerobot_memobench.envs.observations import OBJECTS, PIXELS, check_obs_type, obs_type_of, prompt_in
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.evaluation.records import CARD_FILE, read_card
from lerobot_memobench.jobs.slurm import read_options
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import check_as_trained, check_checkpoint
from lerobot_memobench.policies.compatibility import REFUSAL, check_features
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
    whole_number,
    without_flags,
)

if TYPE_CHECKING:
    from lerobot.configs.default import EvalConfig
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig

    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig

ENVIRONMENT = "memobench"
EXPERT = "memobench_expert"
SCRIPTED = {EXPERT: "env.expert_action", "memobench_blind": "env.blind_action"}
"""Policies whose actions the environment offers, and by which setting it does."""
OUTPUT, LOG = "output_dir", "env.log_dir"
PATHS = ("policy.path", "env.task_dir")
"""Settings that name what is read."""
LARGEST_BATCH = 64
VIDEO_EPISODES = 10
"""Episodes of each task that are recorded as videos, as many as LeRobot renders of an environment without videos of its
own; none where only objects are observed, so that nothing is drawn unasked."""
EVALUATED = (PAPER, VALIDATION, SEALED)
"""Splits that ``split=`` names."""


@dataclass(frozen=True)
class EvaluationPlan:
    """What is evaluated and how.

    Attributes:
        arguments: LeRobot's, complete but for the folders that are written.
        policy: its configuration. environment: its configuration.
        eval_settings: LeRobot's section ``eval``.
        grid: the episodes it consists of.
        output: folder of LeRobot's own files.
        log: folder of the episode log, the report and the card.
        seed: of the run; that of the first episode of each task too.
        batch: environments at once.
        options: how it is run.
        command: the command line as it was given, for the card.
    """

    arguments: LerobotArguments
    policy: PreTrainedConfig
    environment: MemobenchEnvConfig
    eval_settings: EvalConfig
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
        return self.arguments.get("policy.path")

    @property
    def split(self) -> str | None:
        """What the seeds of its scenes are for, None for none of `protocol.SPLITS` in particular."""
        seeds = self.seeds
        return next((name for name, split in SPLITS.items() if seeds[0] in split and seeds[-1] in split), None)

    @property
    def seeds(self) -> range:
        """Seeds of the scenes; where each is run with each variant, those of all tasks, whose numbers of it differ."""
        base, first, last = self.environment.seed_base, self.grid.first, self.grid.first + self.grid.runs - 1
        if self.environment.evidence:
            variants = self.variants.values()
            first, last = first // max(variants), last // min(variants)
        return range(base + first, base + last + 1)

    @property
    def variants(self) -> dict[str, int]:
        """Task -> with how many variants each of its scenes is run where evidence is asked."""
        from lerobot_memobench.tasks.catalogue import load_task

        return {task.name: len(load_task(task.folder).random_variants) for task in self.grid.tasks}

    @property
    def going_on(self) -> str:
        """The command line that goes on with it, ready to be typed."""
        folder = self.output if self.options.shard is None else self.output.parent
        kept = [word for word in joined(self.command) if not word.startswith(("resume=", f"{OUTPUT}="))]
        return shlex.join([*without_flags(kept, OUTPUT), "resume=true", f"{OUTPUT}={folder}"])

    @property
    def portable_flags(self) -> list[str]:
        """LeRobot's flags without the folders that are written, those that are read absolute: for cards and parts."""
        arguments = self.arguments
        for key in PATHS:
            path = Path(arguments.get(key) or "").expanduser()
            if arguments.has(key) and path.exists():
                arguments = arguments.changed(key, path.absolute())
        return list(arguments.flags)


# --- making it ---


def plan_line(line: Sequence[str]) -> EvaluationPlan:
    """Return the plan of the benchmark's evaluation that ``lerobot eval <line>`` asks for."""
    options, given = take_run_options(split_arguments(line))
    return make_plan(read_arguments("eval", given), options, ("lerobot", "eval", *line))


def is_benchmark(arguments: LerobotArguments, options: RunOptions) -> bool:
    """Return whether an evaluation is the benchmark's; another one gets no defaults, and is checked here.

    Raises:
        MemobenchError: no environment is named, or what only the benchmark has is asked of another one.
    """
    if not arguments.has("env.type") and not arguments.has(CONFIG_FILE):
        raise MemobenchError("name an environment: env=memobench")
    if arguments.get("env.type") == ENVIRONMENT:
        return True
    if options.any:
        raise MemobenchError(
            "split=, memory_reads=, resume=, shard= and shards= belong to the benchmark: name it with env=memobench"
        )
    path = arguments.get("policy.path")
    if path is not None:
        check_checkpoint(path)
    return False


def make_plan(arguments: LerobotArguments, options: RunOptions, command: Sequence[str]) -> EvaluationPlan:
    """Complete the arguments of the benchmark's evaluation and find out what they ask for.

    Raises:
        MemobenchError: it cannot be run as asked.
    """
    if options.resume and not arguments.has(OUTPUT):
        raise MemobenchError("resume=true needs the folder of the evaluation to go on with: output_dir=<folder>")
    arguments = with_policy(arguments)
    if options.split is not None:
        check_choice("split", options.split, EVALUATED)
        arguments = arguments.default("seed", SPLITS[options.split].start)
    policy = evaluated_policy(arguments)
    output = _output(arguments, options)
    log = Path(arguments.get(LOG) or output)
    arguments = arguments.changed(OUTPUT, output).changed(LOG, log)
    if obs_type_of(policy) not in (None, PIXELS):
        arguments = arguments.default("env.obs_type", obs_type_of(policy))
    arguments = with_protocol(arguments, options, log, policy)
    arguments = arguments.default("env.prompt_in", prompt_in(policy))
    environment = cast("MemobenchEnvConfig", env_config(arguments))
    check_observations(policy, environment)
    check_as_checkpoint(arguments, policy, environment)
    if options.memory_reads:
        check_memory_reads(policy)
    grid = make_grid(arguments, environment)
    plan = EvaluationPlan(
        arguments=arguments.without(OUTPUT, LOG),
        policy=policy,
        environment=environment,
        eval_settings=eval_settings(arguments),
        grid=grid,
        output=output,
        log=log,
        seed=environment.seed_base + grid.first,
        batch=whole_number(arguments.get("eval.batch_size")) or 1,
        options=options,
        command=tuple(command),
    )
    check_split(plan)
    check_scenes(plan)
    if options.slurm is None:  # there, each part checks its own machine
        _check_simulator(environment)
    return plan


def check_split(plan: EvaluationPlan) -> None:
    """Refuse seeds outside the split that was named, and the sealed ones where it was not.

    Raises:
        MemobenchError: they are, with what to say instead.
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
    from lerobot_memobench.sim.worlds import KINDS

    robosuite_version()
    KINDS[environment.world].check()


def _output(arguments: LerobotArguments, options: RunOptions) -> Path:
    """Return the folder that was asked for, that of the part in it, or one that no evaluation has used."""
    given = arguments.get(OUTPUT)
    if given is not None:
        return Path(given) / options.shard.folder if options.shard is not None else Path(given)
    chosen = arguments.chosen.get("policy")
    name = arguments.get("policy.type") or (chosen.get_choice_name(chosen) if chosen else "policy")  # type: ignore[attr-defined]
    now = dt.datetime.now()
    base = Path("outputs/eval") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{ENVIRONMENT}_{name}"
    others = (base.with_name(f"{base.name}_{k}") for k in itertools.count(2))
    return next(folder for folder in itertools.chain([base], others) if not folder.exists())


def make_grid(arguments: LerobotArguments, environment: MemobenchEnvConfig) -> Grid:
    """Return the episodes that an evaluation consists of.

    Raises:
        MemobenchError: unknown tasks, or no episodes.
    """
    tasks = tuple(PlannedTask(*chosen) for chosen in environment.selected())
    runs, seed = whole_number(arguments.get("eval.n_episodes")), whole_number(arguments.get("seed"))
    if runs is None or seed is None or runs < 1:
        raise MemobenchError(
            f"found episodes={arguments.get('eval.n_episodes')} and seed={arguments.get('seed')}; expected whole "
            "numbers, and at least one episode"
        )
    batch = min(whole_number(arguments.get("eval.batch_size")) or 1, runs)
    return Grid(tasks, runs, batch, seed - environment.seed_base)


# --- the benchmark's defaults ---


def with_policy(arguments: LerobotArguments) -> LerobotArguments:
    """Return arguments with the scripted expert where no policy is named; a scripted policy is offered its action."""
    if not any(arguments.has(f"policy.{word}") for word in ("type", "path")):
        arguments = arguments.choosing("policy", EXPERT)
    chosen: Any = arguments.chosen.get("policy")
    offered = None if chosen is None else SCRIPTED.get(chosen.get_choice_name(chosen))
    return arguments if offered is None else arguments.default(offered, True)


def with_protocol(
    arguments: LerobotArguments, options: RunOptions, log: Path, policy: PreTrainedConfig
) -> LerobotArguments:
    """Return arguments with the protocol's seed and episodes, a batch, a device, the replan interval, videos."""
    import torch

    evidence = is_true("env.evidence", arguments.get("env.evidence"))
    episodes = EVIDENCE_EPISODES if evidence else EVALUATION_EPISODES
    arguments = arguments.default("seed", EVALUATION_SEED).default("eval.n_episodes", episodes)
    if whole_number(arguments.get("seed")) is not None:
        arguments = arguments.default("env.seed_base", arguments.get("seed"))  # episodes are counted from the first
    # A policy may serve few environments at once, such as one for each of its servers.
    arguments = with_batch_size(arguments, options, log, getattr(policy, "max_environments", None) or LARGEST_BATCH)
    # Where parts run elsewhere, that machine decides: this one may be a login node without a GPU, or with the only one.
    if not options.shards and not torch.cuda.is_available() and not torch.backends.mps.is_available():
        arguments = arguments.default("policy.device", "cpu")
    if (n_action_steps := getattr(policy, "n_action_steps", None)) is not None:
        arguments = arguments.default("env.replan_steps", n_action_steps)
    return arguments.default("env.videos", 0 if arguments.get("env.obs_type") == OBJECTS else VIDEO_EPISODES)


def with_batch_size(arguments: LerobotArguments, options: RunOptions, log: Path, most: int) -> LerobotArguments:
    """Return arguments with the largest batch that LeRobot would choose and that divides the episodes.

    LeRobot runs whole batches and throws the surplus of the last one away, after simulating it. Going on keeps the
    number of the earlier run: what a policy samples may depend on it. Parts run one at a time: by cores, each machine
    would cut the evaluation differently.
    """
    given = whole_number(arguments.get("eval.batch_size")) or 0
    if given < 0:
        raise MemobenchError(
            f"found batch_size={given}; expected how many episodes run at once, at least 1, or 0 for as many as suit "
            "the machine"
        )
    if given:
        return arguments
    earlier = earlier_batch_size(log) if options.resume else None
    if earlier is not None:
        return arguments.changed("eval.batch_size", earlier)
    if options.in_parts and not arguments.has("eval.batch_size"):
        return arguments.default("eval.batch_size", 1)
    episodes = whole_number(arguments.get("eval.n_episodes")) or 1
    limit = max(1, min(int(cores() * 0.7), episodes, most))
    return arguments.changed("eval.batch_size", max(size for size in range(1, limit + 1) if episodes % size == 0))


def earlier_batch_size(log: Path) -> int | None:
    """Return the batch size of the evaluation in a folder, None where there is none or nobody knows."""
    path = log / CARD_FILE
    if not path.is_file():
        return None
    starts = read_card(path).get("runs") or [{}]
    size = starts[-1].get("batch_size")
    return None if size is None else int(size)


# --- the configurations of the policy and the environment, as LeRobot will build them ---


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


def evaluated_policy(arguments: LerobotArguments) -> PreTrainedConfig:
    """Return the configuration of the policy that is evaluated; that of a repository is downloaded.

    Raises:
        MemobenchError: the type is not known. Others as of `policy_config`.
    """
    config, path = policy_config(arguments), arguments.get("policy.path")
    if config is None and path is not None:
        config = _loaded(path, arguments)
    if config is None:
        raise MemobenchError(f"policy.type={arguments.get('policy.type')} is not known; import what registers it")
    return config


def _loaded(path: str, arguments: LerobotArguments) -> PreTrainedConfig:
    from lerobot.configs.policies import PreTrainedConfig

    with quiet():
        return PreTrainedConfig.from_pretrained(path, cli_overrides=overrides("policy", arguments.for_parser))


def env_config(arguments: LerobotArguments) -> EnvConfig | None:
    """Return the environment's configuration; None where none is chosen, or a configuration file has a say."""
    return cast("EnvConfig | None", _parsed(arguments, "env"))


def eval_settings(arguments: LerobotArguments) -> EvalConfig:
    """Return LeRobot's section ``eval``.

    Raises:
        MemobenchError: tasks were to run in threads.
    """
    import draccus
    from lerobot.configs.default import EvalConfig

    threads = arguments.get("env.max_parallel_tasks")
    if threads not in (None, "1"):
        raise MemobenchError(
            f"env.max_parallel_tasks is {threads}; the tasks run one after another here. Leave it out, and ask for "
            "processes by shards= and workers="
        )
    return draccus.parse(EvalConfig, args=overrides("eval", arguments.for_parser))


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
    """Refuse an environment that lacks the policy's inputs, or renders them only at some of the steps it remembers.

    Raises:
        MemobenchError: pictures or objects would be missing, or one step's picture remembered as another's.
    """
    if environment is not None and environment.type == ENVIRONMENT:
        check_obs_type(policy, environment.obs_type)
    remembers_pictures = getattr(policy, "needs_every_frame", False) and obs_type_of(policy) != OBJECTS
    if remembers_pictures and getattr(environment, "render_every", 1) > 1:
        raise MemobenchError(f"env.render_every is {getattr(environment, 'render_every', 1)}; {REFUSAL}")


def check_as_checkpoint(arguments: LerobotArguments, policy: PreTrainedConfig | None, environment: EnvConfig) -> None:
    """Refuse a model checkpoint that is to act under other settings than it was trained for, or on other inputs.

    Raises:
        MemobenchError: it is refused.
    """
    path = arguments.get("policy.path")
    if path is None or policy is None:
        return
    with quiet():
        check_as_trained(path, policy)
    from lerobot.envs.utils import env_to_policy_features

    renamed = read_rename_map(arguments.get("rename_map"))
    check_features(path, policy, env_to_policy_features(environment), renamed)


def check_memory_reads(policy: Any) -> None:
    """Refuse to note what a policy reads that does not tell it.

    Args:
        policy: it, or its configuration.

    Raises:
        MemobenchError: it is none of ours, or has no memory that tells it.
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
        memory_reads: how much each chunk reads of what the policy remembers is written beside the log.
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
    def any(self) -> bool:
        """Whether something is asked for that only the benchmark's evaluation can do."""
        return self.resume or self.in_parts or self.memory_reads or self.split is not None

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
