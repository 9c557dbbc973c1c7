"""The plan of an evaluation: what its command line asks for, complete and typed. It is made once and never changed."""

from __future__ import annotations

import datetime as dt
import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from lerobot_memobench.envs.observations import OBJECTS, PIXELS, check_obs_type, obs_type_of
from lerobot_memobench.envs.prompting import prompt_in, quiet, read_rename_map
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import CARD_FILE, read_card
from lerobot_memobench.jobs.executors import ELSEWHERE
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import check_as_trained, check_checkpoint
from lerobot_memobench.policies.compatibility import REFUSAL, check_features
from lerobot_memobench.protocol import EVALUATION_EPISODES, EVALUATION_SEED
from lerobot_memobench.run.arguments import (
    EVALUATION_WORDS,
    LerobotSettings,
    Words,
    executor_options,
    joined_flags,
    read_settings,
    split_words,
    whole_number,
    without_flag,
)
from lerobot_memobench.tasks.catalogue import load_task

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig

    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
    from lerobot_memobench.tasks.task import Task


OUTPUT = "output_dir"
LOG = "env.log_dir"
GOES_ON = ("resume=", f"{OUTPUT}=")
"""Beginnings of words that say whether, and with what, an evaluation goes on."""
PATHS = ("policy.path", "env.task_dir", "config_path")
"""Settings that name what is read."""


@dataclass(frozen=True)
class EvaluationPlan:
    """What is evaluated and how.

    Attributes:
        settings: LeRobot's, complete but for the folders that are written.
        policy, environment: their configurations; None when a configuration file (``config_path``) holds them.
        grid: the episodes it consists of; None when the environment is.
        output: folder of LeRobot's own files.
        log: folder of the episode log, the report and the card.
        seed: of the run; that of the first episode of each task too.
        batch: environments at once.
        orders: how it is run.
        command: the command line as it was given, for the card.
    """

    settings: LerobotSettings
    policy: PreTrainedConfig | None
    environment: MemobenchEnvConfig | None
    grid: Grid | None
    output: Path
    log: Path
    seed: int | None
    batch: int
    orders: Orders
    command: tuple[str, ...]

    @property
    def policy_path(self) -> str | None:
        """The checkpoint or repository that is evaluated, None for a policy that is not loaded."""
        return self.settings.get("policy.path")

    @property
    def draws(self) -> bool:
        """Whether pictures are drawn, as far as is known."""
        return self.environment is None or self.environment.draws

    @property
    def going_on(self) -> str:
        """The command line that goes on with it, ready to be typed."""
        folder = self.output if self.orders.shard is None else self.output.parent
        words = without_flag([word for word in self.command if not word.startswith(GOES_ON)], OUTPUT)
        return shlex.join([*words, "resume=true", f"{OUTPUT}={folder}"])

    @property
    def lerobot_flags(self) -> list[str]:
        """What ``lerobot-eval`` is called with."""
        return [*self.settings.flags, f"--{OUTPUT}={self.output}", f"--{LOG}={self.log}"]

    @property
    def portable_flags(self) -> list[str]:
        """LeRobot's flags without the folders that are written, those that are read absolute: for cards and parts."""
        settings = self.settings
        for key in PATHS:
            path = Path(settings.get(key) or "").expanduser()
            if settings.has(key) and path.exists():
                settings = settings.changed(key, path.absolute())
        return joined_flags(settings.flags)


# ==== orders.py
# How an evaluation is run, beside what is evaluated: resume=, shard=, shards=, workers=, executor= …

PROCESSES = "processes"


@dataclass(frozen=True)
class Orders:
    """How an evaluation is run, as opposed to what is evaluated.

    Attributes:
        verbose: LeRobot's own messages are shown, too.
        resume: go on with the evaluation in the output folder.
        shard: run this part alone.
        shards: run so many parts as jobs of their own, ``workers`` at a time, and merge them; 0: no parts.
        workers: 0: as many as shards.
        executor, executor_options: see `jobs.running.run_jobs`.
    """

    verbose: bool = False
    resume: bool = False
    shard: Shard | None = None
    shards: int = 0
    workers: int = 0
    executor: str = PROCESSES
    executor_options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def any(self) -> bool:
        """Whether something is asked for that only the benchmark's evaluation can do."""
        return self.resume or self.in_parts

    @property
    def in_parts(self) -> bool:
        """Whether a part is run, or all of them as parts."""
        return self.shard is not None or self.shards > 0


def take_orders(words: Words) -> tuple[Orders, Words]:
    """Return the orders in a command line, and the words without them.

    Raises:
        MemobenchError: one that cannot be obeyed.
    """
    given: dict[str, list[str]] = {}
    for key, value in words.settings:
        if key in EVALUATION_WORDS:
            given.setdefault(key, []).append(value)
    rest = [(key, value) for key, value in words.settings if key not in EVALUATION_WORDS]
    last = {key: values[-1] for key, values in given.items()}
    orders = Orders(
        verbose=_boolean("verbose", last.get("verbose", "false")),
        resume=_boolean("resume", last.get("resume", "false")),
        shard=parse_shard(last["shard"]) if "shard" in last else None,
        shards=_count("shards", last.get("shards")),
        workers=_count("workers", last.get("workers")),
        executor=last.get("executor", PROCESSES),
        executor_options=executor_options(given.get("executor_option", [])),
    )
    _check(orders, given)
    return orders, replace(words, settings=rest)


def _check(orders: Orders, given: Mapping[str, Any]) -> None:
    if orders.shards and orders.shard is not None:
        raise MemobenchError(
            f"both shard={orders.shard} and shards={orders.shards} are given; shard= runs one part, shards= all of them"
        )
    idle = [key for key in ("workers", "executor", "executor_option") if key in given]
    if idle and not orders.shards:
        raise MemobenchError(
            f"{idle[0]}= says how parts of an evaluation are run; say how many parts, such as shards=8"
        )


def _count(key: str, text: str | None) -> int:
    if text is None:
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise MemobenchError(f"found {key}={text}; expected a whole number from 1 on")
    return int(text)


def _boolean(key: str, text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise MemobenchError(f"found {key}={text}; expected true or false")
    return text.lower() == "true"


# ==== planning.py
# From the words of ``lerobot eval env=memobench`` to the plan: defaults, and what cannot be asked for.
#
# Everything that a look at settings, folders and configurations can tell is told here, before anything is run: a mistake
# costs a sentence and not a run.


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


# ==== defaults.py
# The benchmark's defaults: what an evaluation is where its user leaves it open. What a user sets stays.

ENVIRONMENT = "memobench"
EXPERT = "memobench_expert"
SCRIPTED = {EXPERT: "env.expert_action", "memobench_blind": "env.blind_action"}
"""Policies whose actions the environment offers, and by which setting it does."""
LARGEST_BATCH = 64
VIDEO_EPISODES = 10
"""Episodes of each task that are recorded as videos, as many as LeRobot renders of an environment without videos of its
own; none where only objects are observed, so that nothing is drawn unasked."""


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


def earlier_batch_size(log: Path) -> int | None:
    """Return the batch size of the evaluation in a folder, None where there is none or nobody knows."""
    path = log / CARD_FILE
    if not path.is_file():
        return None
    starts = read_card(path).get("runs") or [{}]
    size = starts[-1].get("batch_size")
    return None if size is None else int(size)


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
    """Return settings with the protocol's seed and episodes, a batch, a device, the policy's replan interval, videos.

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
    return settings.default("env.videos", 0 if settings.get("env.obs_type") == OBJECTS else VIDEO_EPISODES)


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


# ==== configurations.py
# The configurations of the policy and the environment that a command line chooses, as LeRobot will build them.


def policy_config(settings: LerobotSettings) -> PreTrainedConfig | None:
    """Return the policy's configuration; None where none is chosen, or a configuration file has a say.

    Its own checks run here: an unknown ``policy.align`` is told before anything starts.

    Raises:
        MemobenchError: the checkpoint is not whole. Others come from the configuration's own checks.
    """
    path = settings.get("policy.path")
    if path is None:
        return cast("PreTrainedConfig | None", _parsed(settings, "policy"))
    check_checkpoint(path)
    if not _is_known(settings, "policy"):
        return None
    from lerobot.configs.policies import PreTrainedConfig

    with quiet():
        return PreTrainedConfig.from_pretrained(path, cli_overrides=_overrides(settings, "policy"))


def env_config(settings: LerobotSettings) -> EnvConfig | None:
    """Return the environment's configuration; None where none is chosen, or a configuration file has a say."""
    return cast("EnvConfig | None", _parsed(settings, "env"))


def check_sight(policy: PreTrainedConfig | None, environment: EnvConfig | None) -> None:
    """Refuse an environment that does not show what the policy sees, or not at each step at which it remembers it.

    Raises:
        MemobenchError: pictures or objects would be missing, or one step's picture remembered as another's.
    """
    if environment is not None and environment.type == "memobench":
        check_obs_type(policy, environment.obs_type)
    remembers_pictures = getattr(policy, "watches", False) and obs_type_of(policy) != OBJECTS
    if remembers_pictures and getattr(environment, "render_every", 1) > 1:
        raise MemobenchError(f"env.render_every is {getattr(environment, 'render_every', 1)}; {REFUSAL}")


def check_shown(settings: LerobotSettings, policy: PreTrainedConfig | None, environment: EnvConfig | None) -> None:
    """Refuse a checkpoint that is to act under other settings than it was trained for, or that sees something else.

    Raises:
        MemobenchError: it is refused.
    """
    path = settings.get("policy.path")
    if path is None or policy is None:
        return
    with quiet():
        check_as_trained(path, policy)
    if environment is None:
        return
    from lerobot.envs.utils import env_to_policy_features

    renamed = read_rename_map(settings.get("rename_map"))
    check_features(path, policy, env_to_policy_features(environment), renamed)


def _is_known(settings: LerobotSettings, key: str) -> bool:
    return key in settings.chosen and not settings.has("config_path")


def _parsed(settings: LerobotSettings, key: str) -> Any:
    import draccus
    import yaml

    if not _is_known(settings, key):
        return None
    try:
        with quiet():
            return draccus.parse(settings.chosen[key], args=_overrides(settings, key))
    except yaml.YAMLError as error:  # LeRobot reads every value as YAML
        problem = " ".join(str(error).split())
        raise MemobenchError(f"a value of {key}. cannot be read ({problem}); put it in quotes within quotes") from None


def _overrides(settings: LerobotSettings, key: str) -> list[str]:
    from lerobot.configs import parser

    return parser.get_cli_overrides(key, list(settings.flags)) or []


# ==== grid.py
# All episodes of an evaluation, in the batches in which they are run, and which of them a part or a run has left.

Range = tuple[int, int]
"""First run of a task and how many: run k is LeRobot's k-th, of the seed ``seed`` + k."""


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 1 on) of ``count``."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @property
    def folder(self) -> str:
        """Name of its folder in that of the evaluation."""
        return f"shard-{self.number}-of-{self.count}"

    def of(self, length: int) -> slice:
        """Return which of ``length`` things are its: contiguous, the parts' sizes at most one apart."""
        return slice((self.number - 1) * length // self.count, self.number * length // self.count)


def parse_shard(text: str) -> Shard:
    """Read ``2/8``: parts are counted from 1."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise MemobenchError(
            f"found shard={text}; expected i/n with i from 1 to n, such as shard=1/8 for the first of 8"
        )
    return Shard(int(number), int(count))


@dataclass(frozen=True)
class Place:
    """A task of an evaluation and what LeRobot calls it: suite and number."""

    suite: str
    number: int
    task: Task

    @property
    def key(self) -> tuple[str, int]:
        """What LeRobot calls the task."""
        return self.suite, self.number


@dataclass(frozen=True)
class Grid:
    """All that an evaluation is to run.

    Attributes:
        places: the tasks, in the order in which they are run.
        runs: how many of each.
        batch: environments at once; run k belongs to batch k // ``batch`` of its task.
        first: episode of run 0 (0 in the benchmark's protocol).
    """

    places: tuple[Place, ...]
    runs: int
    batch: int
    first: int = 0

    @property
    def batches(self) -> int:
        """How many batches of each task there are."""
        return -(-self.runs // self.batch)

    def cells(self, shard: Shard | None = None) -> list[tuple[Place, int]]:
        """Return (task, batch) of a shard, or all. Batches are not taken apart: a policy sees whole ones."""
        found = [(place, number) for place in self.places for number in range(self.batches)]
        return found if shard is None else found[shard.of(len(found))]

    def episodes(self, cell: tuple[Place, int]) -> list[tuple[str, int]]:
        """Return (task name, episode) of the runs in a batch."""
        place, number = cell
        runs = range(number * self.batch, min((number + 1) * self.batch, self.runs))
        return [(place.task.name, self.first + run) for run in runs]

    def missing(self, done: Collection[tuple[str, int]], shard: Shard | None = None) -> list[tuple[Place, int]]:
        """Return the batches that hold an episode that is not in ``done``."""
        return [cell for cell in self.cells(shard) if not set(self.episodes(cell)) <= set(done)]

    def ranges(self, cells: Iterable[tuple[Place, int]]) -> dict[tuple[str, int], list[Range]]:
        """Return the runs of these batches, neighbours joined, by LeRobot's name of the task."""
        found: dict[tuple[str, int], list[Range]] = {}
        for place, number in cells:
            start = number * self.batch
            count = min(self.batch, self.runs - start)
            mine = found.setdefault(place.key, [])
            if mine and sum(mine[-1]) == start:
                mine[-1] = (mine[-1][0], mine[-1][1] + count)
            else:
                mine.append((start, count))
        return found


def task_names(places: Sequence[Place], keys: Collection[tuple[str, int]]) -> list[str]:
    """Return the names of the tasks that LeRobot calls by these keys."""
    return [place.task.name for place in places if place.key in keys]
