"""The plan of an evaluation: its settings, complete and typed. A plan is made once and never changed.

Making it checks arguments, folders and configurations, so that a mistake ends the command before anything runs.
Settings that a user names are kept; the others get the benchmark's defaults.
"""

from __future__ import annotations

import datetime as dt
import itertools
import secrets
import shlex
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs.utils import env_to_policy_features

from lerobot_memobench.commands.command_line import (
    RUN_OPTIONS,
    TYPE,
    as_command_line,
    build_config,
    chosen_class,
    field_types,
    given_values,
    parse_words,
    read_words,
    value_of,
    without,
)
from lerobot_memobench.constants import (
    EVALUATION_EPISODES,
    EVALUATION_SEED,
    EVIDENCE_EPISODES,
    PAPER,
    SEALED,
    SPLITS,
    VALIDATION,
    split_of,
)
from lerobot_memobench.envs.evaluation_file import has_evaluation, read_evaluation
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.observations import check_obs_type, obs_type_of
from lerobot_memobench.envs.settings import INTACT, OBJECTS, PIXELS, SETTINGS, SWAP, EnvSettings
from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import (
    check_as_trained,
    check_checkpoint,
    check_device,
    portable_path,
    quiet,
    trained_names,
)
from lerobot_memobench.policies.compatibility import check_features, chosen_convention
from lerobot_memobench.sim.convention import MIRRORED
from lerobot_memobench.sim.files import check_assets
from lerobot_memobench.tasks.catalogue import NUM_STATES, check_states, lerobots_choice, load_task
from lerobot_memobench.tasks.task import LIBERO_SUITES, PUBLISHED

EXPERT = "memobench_expert"
SCRIPTED = {EXPERT: "expert_action", "memobench_blind": "blind_action"}
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
OWN = ("task", "task_ids", "tasks", "task_dir", "log_dir", "resume")
"""Fields of `MemobenchEnvConfig` that do not belong to `EnvSettings`."""
ENVIRONMENT: dict[str, Any] = {
    name: kind
    for name, kind in typing.get_type_hints(MemobenchEnvConfig).items()
    if name in (*OWN, *(setting.name for setting in fields(EnvSettings)))
}
"""Setting of the environment -> its type."""
OTHERS = {
    **{name: name for name in ("seed", "rename_map", "output_dir")},
    **{"eval.n_episodes": "episodes", "eval.batch_size": "batch_size", "eval.use_async_envs": "use_async_envs"},
}
"""LeRobot's key -> field of `EvaluationSettings`."""
WITHOUT_EFFECT = (f"env.{TYPE}", "job_name", "trust_remote_code")
"""LeRobot's keys without an effect on an evaluation of the benchmark."""


@dataclass(frozen=True)
class EvaluationPlan:
    """An evaluation that is ready to run."""

    settings: EvaluationSettings  # complete, equal to those of the card
    policy: PreTrainedConfig
    environment: MemobenchEnvConfig
    grid: Grid
    output: Path  # folder of the evaluation, or of its part (``shard=``)
    log: Path  # folder of the episode log, the report and the card
    options: RunOptions
    command: tuple[str, ...]  # as typed, for the card

    @property
    def policy_path(self) -> str | None:
        """The model checkpoint or repository that is evaluated, None for a policy without weights."""
        return self.settings.policy.get("path")

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
        return split_of(self.seeds)

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
        tasks = {task.name: load_task(task).at(self.environment.difficulty) for task in self.grid.tasks}
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


# --- settings, from a command line, a configuration file or a result card ---


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation. None: the benchmark's default."""

    env: Mapping[str, Any] = field(default_factory=dict)  # fields of `MemobenchEnvConfig`
    policy: Mapping[str, Any] = field(default_factory=dict)  # ``path`` or ``type``, and settings of its configuration
    seed: int | None = None  # of the first episode of each task
    episodes: int | None = None  # of each task
    batch_size: int | None = None  # environments at once
    use_async_envs: bool | None = None  # whether each environment has a process of its own
    rename_map: Mapping[str, str] = field(default_factory=dict)  # the environment's observations -> the policy's
    output_dir: str | None = None  # not part of the card

    @property
    def portable(self) -> dict[str, Any]:
        """The settings for the card, as far as its protocol does not hold them; `card_settings` reads them back.

        They leave out the folders that are written. The package's own policies go by name, other paths are absolute.
        """
        env, policy = without(self.env, *SETTINGS, "log_dir", "resume"), {**self.policy}
        for section, name in ((policy, "path"), (env, "task_dir")):
            if (path := section.get(name)) is not None and Path(path).expanduser().exists():
                portable = portable_path(path) if section is policy else path
                section[name] = str(Path(path).expanduser().absolute()) if portable == path else portable
        loop = {name: getattr(self, name) for name in ("batch_size", "use_async_envs")}
        return {"env": env, "policy": policy, **loop, "rename_map": dict(self.rename_map)}


def card_settings(card: Mapping[str, Any]) -> EvaluationSettings:
    """Return the settings of a card, see `EvaluationSettings.portable`; their values are not checked."""
    protocol, stored = card["protocol"], card["settings"]
    env = {name: protocol[name] for name in SETTINGS if name in protocol} | stored.get("env", {})
    own = {"env": env, "seed": card["policy"].get("seed"), "episodes": protocol["episodes"]}
    return EvaluationSettings(**stored | own)


def read_settings(words: Mapping[str, str]) -> EvaluationSettings:
    """Return the settings of a command line and its configuration file; refuse unknown keys and values.

    The scripted expert is evaluated where no policy is named.
    """
    nested = read_words("eval", words).settings
    sections: dict[str, dict[str, Any]] = {}
    for name in ("env", "policy", "eval"):
        section = nested.get(name)
        if not isinstance(section, Mapping | None):
            raise MemobenchError(f"found {name}={section}; expected settings, such as {name}.<name>=")
        sections[name] = {**(section or {})}
    given = without(nested, *sections)
    given |= {f"{name}.{key}": value for name in ("eval", "env") for key, value in sections[name].items()}
    loop = field_types(EvalPipelineConfig)
    loop |= {f"eval.{name}": kind for name, kind in field_types(loop["eval"]).items()}
    kinds = {key: loop[key] for key in OTHERS} | {f"env.{name}": kind for name, kind in ENVIRONMENT.items()}
    env, others = dict[str, Any](), dict[str, Any]()
    for key, value in given.items():
        if key in WITHOUT_EFFECT:
            continue
        if key not in kinds:
            raise MemobenchError(f"an evaluation of the benchmark has no setting {key!r}, {nearest(key, kinds)}")
        known, name = (others, OTHERS[key]) if key in OTHERS else (env, key.removeprefix("env."))
        known[name] = value_of(key, kinds[key], value)
    if {"task", "task_ids"} & {*env}:  # LeRobot's names
        task, ids = env.pop("task", None), env.pop("task_ids", None)
        suites, env["tasks"] = lerobots_choice(task, ids, env.get("suite", PUBLISHED), env.get("tasks", "all"))
        if len(suites) > 1:
            raise MemobenchError(f"task={task} names {len(suites)} suites; an evaluation is of one: run each by itself")
        env["suite"] = suites[0]
    policy = sections["policy"]
    if not {"type", "path"} & {*policy}:
        policy["type"] = EXPERT
    policy |= given_values(chosen_class(PreTrainedConfig, "policy", policy), policy, "policy.")
    return EvaluationSettings(env, policy, **others)


# --- how it is run: resume=, shard=, shards=, workers= … ---


@dataclass(frozen=True)
class RunOptions:
    """Options of how an evaluation is run; they change no result."""

    split: str | None = None  # the split whose seeds are run; None: by ``seed=``
    memory_reads: bool = False  # whether the weights of remembered frames are written next to the log
    resume: bool = False
    shard: Shard | None = None  # the part that is run alone
    shards: int = 0  # number of parts that are run as jobs of their own, and merged
    workers: int = 0  # parts at a time; 0: all


def take_run_options(words: Mapping[str, str]) -> tuple[RunOptions, dict[str, str]]:
    """Return the run options of a command line, and the other words; raise for options that exclude each other."""
    counts = {key: words[key] for key in ("shards", "workers") if key in words}
    for key, text in counts.items():
        if not text.isdecimal() or int(text) < 1:
            raise MemobenchError(f"found {key}={text}; expected a whole number, at least 1")
    options = RunOptions(
        split=words.get("split"),
        memory_reads=value_of("memory_reads", bool, words.get("memory_reads", "false")),
        resume=value_of("resume", bool, words.get("resume", "false")),
        shard=Shard.parse(words["shard"]) if "shard" in words else None,
        **{key: int(text) for key, text in counts.items()},
    )
    if options.shards and options.shard is not None:
        raise MemobenchError(f"found shard={options.shard} and shards={options.shards}; give one of them")
    if options.workers and not options.shards:
        raise MemobenchError("found workers= without shards=; give the number of parts, such as shards=8")
    return options, without(words, *RUN_OPTIONS)


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


Cell = tuple[Path, int]
"""A batch: the task's folder, of its name in the catalogue, and the number of the batch of that task."""


@dataclass(frozen=True)
class Grid:
    """The episodes of an evaluation. Run k is in batch k // ``batch`` of its task."""

    tasks: tuple[Path, ...]  # their folders, in the order in which they are run
    runs: int  # episodes of each task
    batch: int  # environments at once
    first: int = 0  # episode of run 0

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


# --- making a plan ---


def plan_line(line: Sequence[str]) -> EvaluationPlan:
    """Return the plan of the benchmark's evaluation that ``lerobot eval <line>`` asks for."""
    words = parse_words(line)
    options, setting_words = take_run_options(words)
    return make_plan(read_settings(setting_words), options, ("lerobot", "eval", *as_command_line(words)))


def make_plan(settings: EvaluationSettings, options: RunOptions, command: Sequence[str]) -> EvaluationPlan:
    """Complete the settings of the benchmark's evaluation and check them; raise if it cannot be run."""
    if options.resume and settings.output_dir is None:
        raise MemobenchError("resume=true needs the folder of the evaluation to resume: output_dir=<folder>")
    if options.split is not None:
        check_choice("split", options.split, EVALUATED)
    if not options.shards:  # parts decide on their own machine: this one may be a login node
        check_device(settings.policy.get("device"))
        if not (torch.cuda.is_available() or torch.backends.mps.is_available()):
            settings = replace(settings, policy={"device": "cpu", **settings.policy})
    policy: PreTrainedConfig = build_config(PreTrainedConfig, settings.policy, "policy")
    policy.pretrained_path = None  # the configuration does not depend on the place of the checkpoint
    if policy.type in SCRIPTED and (suite := settings.env.get("suite")) in LIBERO_SUITES:
        raise MemobenchError(
            f"found suite={suite} with policy={policy.type}; LIBERO's tasks have no scripted expert: name a policy, "
            "policy=<checkpoint>"
        )
    if (options.shards or options.shard is not None) and settings.env.get("log_dir") is not None:
        raise MemobenchError(
            f"found log_dir={settings.env['log_dir']} of an evaluation in parts, each of which has a log of its own in "
            "output_dir=; leave it out"
        )
    output = _output(settings, options, policy)
    log = Path(settings.env.get("log_dir") or output)
    settings = with_batch_size(with_defaults(settings, options, policy), options, log, policy)
    if options.split == SEALED and "salt" not in settings.env:
        settings = replace(settings, env={**settings.env, "salt": _salt(options, log)})
    environment = MemobenchEnvConfig(**{**settings.env, "log_dir": None, "resume": False})
    for name, value in vars(environment.settings_for(policy)).items():
        setattr(environment, name, value)
    settings = with_names(replace(settings, env={**settings.env, **environment.gym_kwargs}), environment)
    runs, seed = settings.episodes or 0, settings.seed or 0
    if runs < 1:
        raise MemobenchError(f"found episodes={runs}; expected at least one episode")
    tasks = tuple(folder for _, _, folder in environment.selected())
    grid = Grid(tasks, runs, min(settings.batch_size or 1, runs), seed - environment.seed_base)
    plan = EvaluationPlan(settings, policy, environment, grid, output, log, options, tuple(command))
    for check in (check_policy_fits, check_corruption, check_split, check_scenes):
        check(plan)
    check_assets()
    return plan


def _output(settings: EvaluationSettings, options: RunOptions, policy: PreTrainedConfig) -> Path:
    """Return the folder of the evaluation or of its part; by default a new dated folder."""
    if options.shard is not None and settings.output_dir is None:
        raise MemobenchError(f"found shard={options.shard} without output_dir=; name the folder that all parts share")
    if settings.output_dir is not None:
        checkpoint = settings.policy.get("path")
        if checkpoint is not None and Path(settings.output_dir).resolve() == Path(checkpoint).resolve():
            raise MemobenchError(f"output_dir={settings.output_dir} is also the policy; name another folder")
        return Path(settings.output_dir) / (options.shard.folder if options.shard is not None else "")
    base = Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_memobench_{policy.type}"
    numbered = (base.with_name(f"{base.name}_{k}") for k in itertools.count(2))
    return next(folder for folder in itertools.chain([base], numbered) if not folder.exists())  # of the same second


# --- the benchmark's defaults ---


def with_defaults(settings: EvaluationSettings, options: RunOptions, policy: PreTrainedConfig) -> EvaluationSettings:
    """Return settings with the protocol's seed and episodes, the policy's inputs, and videos."""
    env, seed, episodes = {**settings.env}, settings.seed, settings.episodes
    requested = env.get("convention") or (MIRRORED if env.get("camera_name_mapping") else None)
    convention = chosen_convention(settings.policy.get("path"), policy, requested, settings.rename_map)
    env |= {} if convention is None else {"convention": convention}
    if seed is None:
        seed = EVALUATION_SEED if options.split is None else SPLITS[options.split].start
    if episodes is None:
        episodes = EVIDENCE_EPISODES if env.get("evidence") else EVALUATION_EPISODES
    env.setdefault("seed_base", seed)  # episodes are counted from the first
    if (observed := obs_type_of(policy)) not in (None, PIXELS) and env.get("suite") not in LIBERO_SUITES:
        env.setdefault("obs_type", observed)
    if policy.type in SCRIPTED:
        env.setdefault(SCRIPTED[policy.type], True)
    env.setdefault("videos", 0 if env.get("obs_type") == OBJECTS else VIDEO_EPISODES)
    return replace(settings, env=env, seed=seed, episodes=episodes)


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
    learned = policy.type not in SCRIPTED and policy.device == "cpu"
    together = learned and settings.env.get("obs_type") == OBJECTS and not settings.use_async_envs
    if options.resume and (earlier := earlier_batch_size(log)) is not None:
        return replace(settings, batch_size=earlier, use_async_envs=False if together else settings.use_async_envs)
    if (options.shards or options.shard is not None) and settings.batch_size is None:
        return replace(settings, batch_size=1)
    # A policy may serve few environments at once, such as one for each of its servers.
    most = min(episodes, getattr(policy, "max_environments", None) or LARGEST_BATCH)
    if together:
        return replace(settings, batch_size=min(OBJECT_BATCH, most), use_async_envs=False)
    limit = max(1, min(int(cores() * 0.7), most))  # LeRobot's share of the cores
    return replace(settings, batch_size=max(size for size in range(1, limit + 1) if episodes % size == 0))


def earlier_batch_size(log: Path) -> int | None:
    """Return the batch size of the evaluation in a folder or in its parts, None where it is not known."""
    for folder in begun_folders(log):
        if starts := read_evaluation(folder).get("runs"):
            return int(starts[-1]["batch_size"])
    return None


def begun_folders(log: Path) -> Iterator[Path]:
    """Yield the folder of an evaluation and those of its parts, as far as they hold a card."""
    return filter(has_evaluation, (log, *sorted(log.glob(Shard.FOLDERS))))


def _salt(options: RunOptions, log: Path) -> Any:
    """Return a random salt for a sealed evaluation; a resumed one, or a part of it, keeps its salt."""
    if options.resume:
        for folder in begun_folders(log):
            return read_evaluation(folder)["protocol"].get("salt")
    if options.shard is not None:  # its salt would differ from that of the other parts
        raise MemobenchError(
            f"found shard={options.shard} of a sealed test without salt=; start all parts by shards=, or give each "
            "part the same 32 random hexadecimal digits as salt="
        )
    return secrets.token_hex(16)


def with_names(settings: EvaluationSettings, environment: MemobenchEnvConfig) -> EvaluationSettings:
    """Return settings with the ``rename_map`` of the policy's training, as far as the environment has its names."""
    if (path := settings.policy.get("path")) is None or settings.rename_map:
        return settings
    observed = environment.features_map.values()
    names = {old: new for old, new in trained_names(path).items() if old in observed}
    return replace(settings, rename_map=names)


# --- checks of a plan ---


def check_policy_fits(plan: EvaluationPlan) -> None:
    """Refuse a damaged checkpoint, and a policy whose inputs, settings or memory reads do not suit the evaluation."""
    policy, path = plan.policy, plan.policy_path
    if path is not None:
        check_checkpoint(path)
    check_obs_type(policy, plan.environment.obs_type, plan.environment.suite)
    if path is not None:
        with quiet():
            check_as_trained(path, policy)
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


def check_scenes(plan: EvaluationPlan) -> None:
    """Refuse fewer episodes than a task has variants, with evidence, and more than it has initial states in LIBERO."""
    grid = plan.grid
    if plan.environment.suite in LIBERO_SUITES:  # an initial state would be run twice
        check_states(plan.environment.suite, grid.first, grid.runs)
    if not plan.environment.evidence:
        return
    variants = plan.variants
    name = max(variants, key=lambda name: variants[name])
    if variants[name] > grid.runs:  # no scene would be complete
        raise MemobenchError(
            f"found episodes={grid.runs} with evidence=true; {name} runs each scene with {variants[name]} "
            f"variants: ask for at least episodes={variants[name]}, or for other tasks"
        )
