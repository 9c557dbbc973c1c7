"""The plan of an evaluation: its settings, complete and typed. A plan is made once and never changed.

Making it checks arguments, folders and configurations, so that a mistake ends the command before anything runs.
Settings that a user names are kept; the others get the benchmark's defaults.
"""

from __future__ import annotations

import datetime as dt
import itertools
import secrets
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from lerobot_memobench.commands.command_line import RUN_OPTIONS, as_command_line, parse_words, value_of, without
from lerobot_memobench.constants import (
    EVALUATION_EPISODES,
    EVALUATION_SEED,
    EVIDENCE_EPISODES,
    PAPER,
    SEALED,
    SPLITS,
    VALIDATION,
)
from lerobot_memobench.envs.evaluation_file import has_evaluation, read_evaluation
from lerobot_memobench.envs.observations import check_obs_type, obs_type_of
from lerobot_memobench.envs.settings import INTACT, OBJECTS, PIXELS, SWAP
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import check_as_trained, check_checkpoint, check_device, quiet, trained_names
from lerobot_memobench.policies.compatibility import check_features, chosen_convention
from lerobot_memobench.sim.convention import MIRRORED
from lerobot_memobench.tasks.catalogue import NUM_STATES, check_states
from lerobot_memobench.tasks.task import LIBERO_SUITES, PUBLISHED

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
    from lerobot_memobench.rollouts.settings import EvaluationSettings

SCRIPTED = {"memobench_expert": "expert_action", "memobench_blind": "blind_action"}
"""Policies whose actions the environment offers -> the setting by which it does."""
LARGEST_BATCH = 64  # LeRobot's own limit
OBJECT_BATCH = 10
"""Environments at once, in one process, of a policy that observes objects and runs on a CPU: a control step of one
episode took 3.8 ms, against 6.1 ms with one environment."""
VIDEO_EPISODES = 10
"""Episodes of each task that are recorded as videos, as many as LeRobot renders; none where only objects are observed,
without images."""
EVALUATED = (PAPER, VALIDATION, SEALED)
"""Splits that ``split=`` names."""


@dataclass(frozen=True)
class EvaluationPlan:
    """An evaluation that is ready to run.

    Attributes:
        settings: complete settings, equal to those of the card.
        grid: episodes of each task, in batches.
        output: folder of the evaluation, or of its part (``shard=``).
        log: folder of the episode log, the report and the card.
        command: the typed command line, for the card.
    """

    settings: EvaluationSettings
    policy: PreTrainedConfig
    environment: MemobenchEnvConfig
    grid: Grid
    output: Path
    log: Path
    options: RunOptions
    command: tuple[str, ...]

    @property
    def policy_path(self) -> str | None:
        """The model checkpoint or repository that is evaluated, None for a policy without weights."""
        return self.settings.policy_path

    @property
    def seed(self) -> int:
        """Seed of the run, and of the first episode of each task."""
        return self.environment.seed_base + self.grid.first

    @property
    def batch(self) -> int:
        """Environments at once."""
        return self.settings.batch_size or 1

    @property
    def split(self) -> str | None:
        """The split of `constants.SPLITS` that holds the seeds of all its scenes, None without one."""
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

        tasks = {task.name: load_task(task.folder).at(self.environment.difficulty) for task in self.grid.tasks}
        return {name: len(task.random_variants) for name, task in tasks.items()}

    @property
    def resuming_command(self) -> str:
        """The command line that resumes it, ready to be typed."""
        folder = self.output if self.options.shard is None else self.output.parent
        return shlex.join([*self.command[:2], *with_changes(self.command[2:], resume="true", output_dir=folder)])


def with_changes(line: Sequence[str], **changes: object) -> list[str]:
    """Return a command line in which these keys have other values; None removes one."""
    values = {key: str(value) for key, value in changes.items() if value is not None}
    return as_command_line(without(parse_words(line), *changes) | values)


# --- making it ---


def plan_line(line: Sequence[str]) -> EvaluationPlan:
    """Return the plan of the benchmark's evaluation that ``lerobot eval <line>`` asks for."""
    return plan_words(parse_words(line))


def plan_words(words: Mapping[str, str]) -> EvaluationPlan:
    """Return the plan of the benchmark's evaluation for the words of a command line."""
    from lerobot_memobench.rollouts.settings import read_settings

    options, setting_words = take_run_options(words)
    return make_plan(read_settings(setting_words), options, ("lerobot", "eval", *as_command_line(words)))


def make_plan(settings: EvaluationSettings, options: RunOptions, command: Sequence[str]) -> EvaluationPlan:
    """Complete the settings of the benchmark's evaluation and check them; raise if it cannot be run."""
    from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
    from lerobot_memobench.rollouts.settings import policy_of, with_policy
    from lerobot_memobench.sim.files import check_assets

    if options.resume and settings.output_dir is None:
        raise MemobenchError("resume=true needs the folder of the evaluation to resume: output_dir=<folder>")
    if options.split is not None:
        check_choice("split", options.split, EVALUATED)
    settings = with_device(with_policy(settings), options)
    policy = policy_of(settings)
    check_expert(policy, settings.env.get("suite", PUBLISHED))
    requested = settings.env.get("convention") or (MIRRORED if settings.env.get("camera_name_mapping") else None)
    convention = chosen_convention(settings.policy_path, policy, requested, settings.rename_map)
    settings = settings if convention is None else replace(settings, env={**settings.env, "convention": convention})
    output = _output(settings, options, policy)
    log = Path(settings.env.get("log_dir") or output)
    settings = with_salt(with_batch_size(with_protocol(settings, options, policy), options, log, policy), options, log)
    environment = MemobenchEnvConfig(**{**settings.env, "log_dir": None, "resume": False})
    for name, value in vars(environment.settings_for(policy)).items():
        setattr(environment, name, value)
    settings = with_names(replace(settings, env={**settings.env, **environment.gym_kwargs}), environment)
    grid = make_grid(settings, environment)
    plan = EvaluationPlan(settings, policy, environment, grid, output, log, options, tuple(command))
    check_policy_fits(plan)
    check_corruption(plan)
    check_split(plan)
    check_scenes(plan)
    check_assets()
    return plan


def make_grid(settings: EvaluationSettings, environment: MemobenchEnvConfig) -> Grid:
    """Return the episodes of an evaluation; raise for unknown tasks, or without episodes."""
    tasks = tuple(PlannedTask(*chosen) for chosen in environment.selected())
    runs, seed = settings.episodes, settings.seed
    if runs is None or seed is None or runs < 1:
        raise MemobenchError(f"found episodes={runs} and seed={seed}; expected whole numbers, and at least one episode")
    return Grid(tasks, runs, min(settings.batch_size or 1, runs), seed - environment.seed_base)


def _output(settings: EvaluationSettings, options: RunOptions, policy: PreTrainedConfig) -> Path:
    """Return the folder of the evaluation or of its part; by default a new dated folder."""
    if settings.output_dir is not None:
        return Path(settings.output_dir) / (options.shard.folder if options.shard is not None else "")
    base = Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_memobench_{policy.type}"
    # Two commands may begin in the same second.
    numbered = (base.with_name(f"{base.name}_{k}") for k in itertools.count(2))
    return next(folder for folder in itertools.chain([base], numbered) if not folder.exists())


# --- checks of a plan ---


def check_policy_fits(plan: EvaluationPlan) -> None:
    """Refuse a policy whose inputs, settings or memory reads do not suit the evaluation.

    A damaged checkpoint is refused, and one that was trained under other settings.
    """
    policy, path = plan.policy, plan.policy_path
    if path is not None:
        check_checkpoint(path)
    check_obs_type(policy, plan.environment.obs_type, plan.environment.suite)
    if path is not None:
        with quiet():
            check_as_trained(path, policy)
        from lerobot.envs.utils import env_to_policy_features

        check_features(path, policy, env_to_policy_features(plan.environment), plan.settings.rename_map)
    if plan.options.memory_reads:
        check: Any = getattr(policy, "check_memory_reads", None)
        if check is None:
            raise MemobenchError(
                f"memory_reads=true needs a policy that reports its memory reads, and {policy.type} does not; leave it "
                "out, or evaluate memobench_mem"
            )
        check()


def check_corruption(plan: EvaluationPlan) -> None:
    """Refuse ``corrupt`` for a policy that does not offer its memory, and a swap without another row."""
    how, policy = plan.environment.corrupt, plan.policy
    if how == INTACT:
        return
    from lerobot.policies.factory import get_policy_class

    # The configuration of memobench_mem names its memory; the class offers the method.
    if getattr(policy, "memory", None) == "none" or not hasattr(get_policy_class(policy.type), "corrupt_memory"):
        raise MemobenchError(
            f"corrupt={how} needs a policy with a memory and a method corrupt_memory(how, rows), and {policy.type} "
            "has none; leave corrupt= out, or evaluate memobench_mem with a memory"
        )
    sizes = {len(plan.grid.runs_of(number)) for _, number in plan.grid.cells()}
    if how == SWAP and min(sizes) < 2:
        raise MemobenchError(
            f"corrupt={how} exchanges the memories of a batch, and found a batch of one episode (batch_size="
            f"{plan.batch}, episodes={plan.grid.runs}); choose a batch size without such a remainder"
        )


def check_split(plan: EvaluationPlan) -> None:
    """Refuse seeds outside the split that was named, and the sealed seeds or a salt where it was not."""
    split, seeds, sealed = plan.options.split, plan.seeds, SPLITS[SEALED]
    if plan.environment.suite in LIBERO_SUITES and split not in (None, PAPER):
        raise MemobenchError(
            f"split={split} is of memory tasks; tasks of {plan.environment.suite} have {NUM_STATES} initial states, of "
            "which episode i has the i-th: leave split= out"
        )
    if split is not None and plan.split != split:
        known = SPLITS[split]
        raise MemobenchError(
            f"split={split} has the seeds {known[0]} to {known[-1]}, and {seeds[0]} to {seeds[-1]} were asked for; "
            f"leave seed= out, and ask for at most {len(known)} episodes"
        )
    if plan.environment.salt and split != SEALED:
        raise MemobenchError("found salt=, which is of the sealed test; leave it out, or run `memobench test-sealed`")
    if split is None and seeds[0] <= sealed[-1] and seeds[-1] >= sealed[0]:
        raise MemobenchError(
            f"found seeds {seeds[0]} to {seeds[-1]}; {sealed[0]} to {sealed[-1]} are sealed: run them once per release "
            "by `memobench test-sealed policy=…`, and choose settings by split=validation"
        )


def check_expert(policy: PreTrainedConfig, suite: str) -> None:
    """Refuse the scripted policies in LIBERO's suites."""
    if policy.type in SCRIPTED and suite in LIBERO_SUITES:
        raise MemobenchError(
            f"found suite={suite} with policy={policy.type}; LIBERO's tasks have no scripted expert: name a policy, "
            "policy=<checkpoint>"
        )


def check_scenes(plan: EvaluationPlan) -> None:
    """Refuse fewer episodes than a task has variants, with evidence, and more than it has initial states in LIBERO.

    Raises:
        MemobenchError: no scene would be complete, or one would be run twice.
    """
    grid = plan.grid
    if plan.environment.suite in LIBERO_SUITES:
        check_states(plan.environment.suite, grid.first, grid.runs)
    if not plan.environment.evidence:
        return
    variants = plan.variants
    name = max(variants, key=lambda name: variants[name])
    if variants[name] > plan.grid.runs:
        raise MemobenchError(
            f"found episodes={plan.grid.runs} with evidence=true; {name} runs each scene with {variants[name]} "
            f"variants: ask for at least episodes={variants[name]}, or for other tasks"
        )


# --- the benchmark's defaults ---


def with_device(settings: EvaluationSettings, options: RunOptions) -> EvaluationSettings:
    """Return settings with the CPU as the policy's device where the machine has no other.

    Parts decide on their own machine: this machine may be a login node. A named device that is missing raises.
    """
    import torch

    if not options.shards:
        check_device(settings.policy.get("device"))
    if options.shards or "device" in settings.policy or torch.cuda.is_available() or torch.backends.mps.is_available():
        return settings
    return replace(settings, policy={**settings.policy, "device": "cpu"})


def with_protocol(settings: EvaluationSettings, options: RunOptions, policy: PreTrainedConfig) -> EvaluationSettings:
    """Return settings with the protocol's seed and episodes, the policy's inputs, and videos."""
    if settings.seed is None:
        seed = EVALUATION_SEED if options.split is None else SPLITS[options.split].start
        settings = replace(settings, seed=seed)
    if settings.episodes is None:
        episodes = EVIDENCE_EPISODES if settings.env.get("evidence") else EVALUATION_EPISODES
        settings = replace(settings, episodes=episodes)
    settings = settings.env_default(seed_base=settings.seed)  # episodes are counted from the first
    if (observed := obs_type_of(policy)) not in (None, PIXELS) and settings.env.get("suite") not in LIBERO_SUITES:
        settings = settings.env_default(obs_type=observed)
    if policy.type in SCRIPTED:
        settings = settings.env_default(**{SCRIPTED[policy.type]: True})
    return settings.env_default(videos=0 if settings.env.get("obs_type") == OBJECTS else VIDEO_EPISODES)


def with_names(settings: EvaluationSettings, environment: MemobenchEnvConfig) -> EvaluationSettings:
    """Return settings with the ``rename_map`` of the policy's training, as far as the environment has its names."""
    if settings.policy_path is None or settings.rename_map:
        return settings
    observed = environment.features_map.values()
    names = {old: new for old, new in trained_names(settings.policy_path).items() if old in observed}
    return replace(settings, rename_map=names)


def with_salt(settings: EvaluationSettings, options: RunOptions, log: Path) -> EvaluationSettings:
    """Return settings with a random salt for a sealed evaluation; a resumed one, or a part of it, keeps its salt.

    Raises:
        MemobenchError: a part that was started by itself has no salt; it would differ from that of the other parts.
    """
    if options.split != SEALED or "salt" in settings.env:
        return settings
    if options.resume:
        for folder in (log, *sorted(log.glob(Shard.FOLDERS))):
            if has_evaluation(folder):
                return settings.env_default(salt=read_evaluation(folder)["protocol"].get("salt"))
    if options.shard is not None:
        raise MemobenchError(
            f"found shard={options.shard} of a sealed test without salt=; start all parts by shards=, or give each "
            "part the same 32 random hexadecimal digits as salt="
        )
    return settings.env_default(salt=secrets.token_hex(16))


def with_batch_size(
    settings: EvaluationSettings, options: RunOptions, log: Path, policy: PreTrainedConfig
) -> EvaluationSettings:
    """Return settings with the number of environments that run at once.

    A policy that observes objects and runs on a CPU gets `OBJECT_BATCH` in one process; any other as many processes as
    suit the cores and divide the episodes. A resumed run keeps its number, because a policy's samples may depend on it.
    Parts run one environment each: by cores, each machine would divide the evaluation differently.
    """
    requested, episodes = settings.batch_size or 0, settings.episodes or 1
    if requested < 0:
        raise MemobenchError(
            f"found batch_size={requested}; expected at least 1 environment at once, or 0 to choose by the machine"
        )
    if requested:
        return settings
    if options.resume and (earlier := earlier_batch_size(log)) is not None:
        return replace(settings, batch_size=earlier)
    if options.in_parts and settings.batch_size is None:
        return replace(settings, batch_size=1)
    # A policy may serve few environments at once, such as one for each of its servers.
    most = min(episodes, getattr(policy, "max_environments", None) or LARGEST_BATCH)
    learned = policy.type not in SCRIPTED and policy.device == "cpu"
    if learned and settings.env.get("obs_type") == OBJECTS and not settings.use_async_envs:
        return replace(settings, batch_size=min(OBJECT_BATCH, most), use_async_envs=False)
    limit = max(1, min(int(cores() * 0.7), most))  # LeRobot's share of the cores
    return replace(settings, batch_size=max(size for size in range(1, limit + 1) if episodes % size == 0))


def earlier_batch_size(log: Path) -> int | None:
    """Return the batch size of the evaluation in a folder, None where it is not known."""
    starts = read_evaluation(log).get("runs") if has_evaluation(log) else None
    return int(starts[-1]["batch_size"]) if starts else None


# --- how it is run: resume=, shard=, shards=, workers= … ---


@dataclass(frozen=True)
class RunOptions:
    """Options of how an evaluation is run; they change no result.

    Attributes:
        split: the split whose seeds are run, one of `EVALUATED`; None: by `seed=`.
        memory_reads: write the weight of each remembered frame in each chunk next to the log.
        shard: run this part alone.
        shards: run this many parts as jobs of their own, ``workers`` at a time, and merge them; 0: no parts.
        workers: 0: as many as shards.
    """

    split: str | None = None
    memory_reads: bool = False
    resume: bool = False
    shard: Shard | None = None
    shards: int = 0
    workers: int = 0

    @property
    def in_parts(self) -> bool:
        """Whether a part is run, or all of them as parts."""
        return self.shard is not None or self.shards > 0


def take_run_options(words: Mapping[str, str]) -> tuple[RunOptions, dict[str, str]]:
    """Return the run options of a command line, and the other words; raise for options that exclude each other."""
    options = RunOptions(
        split=words.get("split"),
        memory_reads=value_of("memory_reads", bool, words.get("memory_reads", "false")),
        resume=value_of("resume", bool, words.get("resume", "false")),
        shard=Shard.parse(words["shard"]) if "shard" in words else None,
        shards=_count("shards", words.get("shards")),
        workers=_count("workers", words.get("workers")),
    )
    if options.shards and options.shard is not None:
        raise MemobenchError(f"found shard={options.shard} and shards={options.shards}; give one of them")
    if options.workers and not options.shards:
        raise MemobenchError("found workers= without shards=; give the number of parts, such as shards=8")
    return options, without(words, *RUN_OPTIONS)


def _count(key: str, text: str | None) -> int:
    if text is None:
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise MemobenchError(f"found {key}={text}; expected a whole number, at least 1")
    return int(text)


# --- the episodes, in the batches in which they are run ---


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 1) of ``count``."""

    number: int
    count: int
    FOLDERS: ClassVar = "shard-*-of-*"

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
        """Return its slice of ``length`` items: contiguous; the sizes of parts differ by at most one."""
        return slice((self.number - 1) * length // self.count, self.number * length // self.count)


@dataclass(frozen=True)
class PlannedTask:
    """A task of an evaluation: LeRobot's suite and number of it, and its folder."""

    suite: str
    number: int
    folder: Path

    @property
    def name(self) -> str:
        """Name in the catalogue."""
        return self.folder.name


Cell = tuple[PlannedTask, int]
"""A batch: task, and number of the batch of that task."""


@dataclass(frozen=True)
class Grid:
    """The episodes of an evaluation.

    Attributes:
        tasks: in the order in which they are run.
        runs: episodes of each task.
        batch: environments at once; run k belongs to batch k // ``batch`` of its task.
        first: episode of run 0 (0 in the benchmark's protocol).
    """

    tasks: tuple[PlannedTask, ...]
    runs: int
    batch: int
    first: int = 0

    def cells(self, shard: Shard | None = None) -> list[Cell]:
        """Return the batches of a shard, or all. A batch is never divided: the policy acts on it as a whole."""
        cells = [(task, number) for task in self.tasks for number in range(-(-self.runs // self.batch))]
        return cells if shard is None else cells[shard.of(len(cells))]

    def runs_of(self, number: int) -> range:
        """Return the runs of a task's batch."""
        return range(number * self.batch, min((number + 1) * self.batch, self.runs))

    def episodes(self, cell: Cell) -> list[tuple[str, int]]:
        """Return (task name, episode) of the runs in a batch."""
        task, number = cell
        return [(task.name, self.first + run) for run in self.runs_of(number)]

    def missing(self, done: Collection[tuple[str, int]], shard: Shard | None = None) -> list[Cell]:
        """Return the batches with an episode that is not in ``done``."""
        return [cell for cell in self.cells(shard) if not set(self.episodes(cell)) <= set(done)]
