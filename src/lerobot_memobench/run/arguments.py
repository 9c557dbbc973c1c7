"""A command line becomes LeRobot's flags: ``lerobot train policy=memobench_mem align=contrastive`` and the like.

``key=value`` is checked against the dataclasses that LeRobot's parser (draccus) fills, so that a mistake is told in one
sentence before anything runs. Short forms stand for LeRobot's names, ``policy=``, ``env=`` and ``dataset=`` choose, and
``config=`` names a recipe. What begins with ``--`` is passed on untouched. LeRobot's parser reads the result.
"""

from __future__ import annotations

import dataclasses
import enum
import logging
import textwrap
import types
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple, Union

import draccus
import yaml

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.checkpoint import (
    checkpoint_folder,
    checkpoint_type,
    folder_with_checkpoint,
    looks_local,
    shipped_policies,
)
from lerobot_memobench.run.lerobot_commands import config_class, load_command, register_plugins
from lerobot_memobench.tasks.catalogue import check_suite, resolve_tasks
from lerobot_memobench.tasks.task import PUBLISHED

logger = logging.getLogger(__name__)

CHOOSING = ("policy", "env", "dataset")
"""Keys that choose something rather than set a field."""
RECIPE, CONFIG_FILE = "config", "config_path"
"""Our key and LeRobot's for a configuration file."""

COMMON: dict[str, tuple[str, ...]] = {
    "align": ("policy.align",),
    "size": ("policy.size",),
    "perception": ("policy.perception",),
    "detector": ("policy.detector",),
    "device": ("policy.device",),
    "replan": ("policy.n_action_steps", "env.replan_steps"),
    "tasks": ("env.tasks",),
    "obs_type": ("env.obs_type",),
    "suite": ("env.suite",),
    "referent": ("env.referent",),
}
SHORT_FORMS: dict[str, dict[str, tuple[str, ...]]] = {
    "eval": {
        **COMMON,
        **{key: (f"policy.{key}",) for key in ("host", "port", "dialect")},
        **{key: (f"env.{key}",) for key in ("demonstration_prompt", "prompt_in", "horizon", "videos")},
        "episodes": ("eval.n_episodes",),
        "batch_size": ("eval.batch_size",),
    },
    "train": {**COMMON, "episodes": ("dataset.episodes",)},
}
"""Command -> short form -> the fields it sets, of which those that exist are set."""
RUN_OPTIONS = ("verbose", "resume", "shard", "shards", "workers", "executor", "executor_option")
"""Keys of `lerobot eval env=memobench` that say how it is run, not what (`plan.RunOptions`)."""
TRAINING_OPTIONS = ("prompt_frames", "obs_type")
"""Keys of `lerobot train` that are none of LeRobot's (`training.take_training_options`)."""


class HelpRow(NamedTuple):
    """A row of the help: what is typed, what it sets, and what holds without it ("" where nothing is said)."""

    typed: str
    sets: str
    default: str = ""


HELP: dict[str, tuple[HelpRow, ...]] = {
    "eval": (
        HelpRow(
            "policy=",
            "a checkpoint folder (or a training run's), a repository user/name, a policy of the package, or a policy "
            "type; a folder that is named like one of these is named by a path, ./act",
            "the scripted expert",
        ),
        HelpRow(
            "host=, port=, dialect=",
            "with policy=remote: the policy server that acts",
            "127.0.0.1, by dialect, openpi",
        ),
        HelpRow("suite=", "published, or strict: thirty tasks made to need a memory", "published"),
        HelpRow(
            "tasks=",
            "of that suite all, memory types (temporal, spatial, object, procedural), task names, or numbers and "
            "ranges of memobench tasks (12, 3-7), separated by commas",
            "all",
        ),
        HelpRow("episodes=", "episodes per task; episode i uses the seed 7 + i, or that of seed= + i", "50"),
        HelpRow(
            "replan=",
            "the policy executes so many actions of each prediction; also noted in the log",
            "the policy's own",
        ),
        HelpRow(
            "obs_type=",
            "what is observed: pixels_agent_pos, environment_state_agent_pos or both",
            "what the policy was trained on, else pictures",
        ),
        HelpRow(
            "detector=",
            "with a policy that reads objects: package or a file, the detector that finds them in pictures",
            "none: the environment gives them",
        ),
        HelpRow(
            "referent=",
            "fixed: the published goals; random: the seed decides what the demonstration prompt shows; strict tasks "
            "are always drawn",
            "fixed",
        ),
        HelpRow("demonstration_prompt=", "false leaves the prompt out", "true"),
        HelpRow(
            "prompt_in=",
            "steps: the policy observes the prompt; reset: it plays before the first observation",
            "by the policy",
        ),
        HelpRow("horizon=", "execution steps per episode", "1200"),
        HelpRow(
            "videos=",
            "episodes of each task that are recorded as videos, from the first; −1 all",
            "10, without pictures in the observations 0",
        ),
        HelpRow(
            "batch_size=",
            "environments at once, each in a process of its own",
            "by cores, dividing the episodes",
        ),
        HelpRow("device=", "where the policy runs: cpu, cuda, …", "the checkpoint's, else by machine"),
        HelpRow("output_dir=", "where everything goes", "outputs/eval/<date>/<time>_…"),
        HelpRow("verbose=", "true: LeRobot's own messages too, its configuration and progress", "false"),
        HelpRow("resume=", "true: go on with the evaluation in output_dir=", "false"),
        HelpRow("shard=", "run this part alone, such as 1/8; memobench merge joins the parts", "all of it"),
        HelpRow("shards=", "run so many parts as jobs and merge them", "no parts"),
        HelpRow(
            "workers=, executor=, executor_option=",
            "with shards=: how many jobs at once; processes, local, slurm or ray; what that one takes, key=value",
            "all at once, processes",
        ),
        HelpRow(
            "align=, size=, perception=, visual_encoder=",
            "of a policy named by its type, as in lerobot train; a checkpoint keeps its own, and others are refused",
            "the type's",
        ),
    ),
    "train": (
        HelpRow("policy=", "a policy type, or a checkpoint to start from"),
        HelpRow("config=", "a recipe of memobench recipe, or a YAML file of your own"),
        HelpRow("align=", "how memory is aligned with checkpoint language: none, semantic, contrastive, framewise"),
        HelpRow("dataset=", "a folder that memobench generate wrote, or a repository user/name"),
        HelpRow("size=", "small and tiny: a few million parameters, from scratch, on a CPU; pi05: 3.2 billion"),
        HelpRow(
            "perception=",
            "pixels: pictures, through a frozen tower, at size=small a visual encoder; objects: their poses as numbers",
        ),
        HelpRow(
            "detector=",
            "with perception=objects: package or a file, the detector that finds them in pictures",
        ),
        HelpRow("visual_encoder=", "with perception=pixels at size=small: package, a file, or random"),
        HelpRow("replan=", "actions executed per prediction at evaluation"),
        HelpRow(
            "obs_type=",
            "inputs of a policy of LeRobot's: pixels_agent_pos, environment_state_agent_pos or both; left out: "
            "pictures where the dataset has them, else objects",
        ),
        HelpRow("prompt_frames=", "false: no frame of a prompt is trained on; true: all are; left out: by the policy"),
        HelpRow("episodes=", "of the dataset, those of these numbers: [0, 1, 2]"),
        HelpRow("device=", "where it is trained: cpu, cuda, …"),
        HelpRow("output_dir=", "where everything goes; with resume=true, the training that is gone on with"),
        HelpRow("resume=", "true: go on with the last checkpoint in output_dir="),
        HelpRow("steps=", "updates of the weights, with resume=true those before included", "100000"),
        HelpRow("batch_size=", "frames per update", "8, of objects or through a visual encoder 72"),
        HelpRow("save_freq=", "updates from one checkpoint to the next; the last update always makes one", "20000"),
        HelpRow("env=", "memobench: evaluate within the training, every env_eval_freq= updates", "no evaluation"),
        HelpRow("tasks=", "with env=: those evaluated on, as in lerobot eval", "all"),
        HelpRow("suite=", "with env=: theirs, published or strict", "published"),
        HelpRow("referent=", "with env=: fixed, the published goals; random, the seed decides", "fixed"),
    ),
}
"""Command -> what `lerobot <command> --help` says of its arguments; docs/evaluate.md and docs/train.md have the same
rows."""

EXAMPLES = {
    "eval": "lerobot eval env=memobench policy=<checkpoint> tasks=object episodes=10",
    "train": "lerobot train policy=memobench_mem align=contrastive dataset=<folder>",
}


def help_text(command: str, width: int = 100) -> str:
    """Return what `lerobot eval --help` or `lerobot train --help` says before LeRobot's own flags."""
    lines = [f"usage: {EXAMPLES[command]}", "", "short forms:"]
    for typed, sets, default in HELP[command]:
        text = sets + (f" (default: {default})" if default else "")
        lines += [f"  {typed}", *textwrap.wrap(text, width, initial_indent=" " * 8, subsequent_indent=" " * 8)]
    lines += [
        "",
        "Any other setting goes by LeRobot's full name, as key=value or --key=value; those of what env= and policy=",
        "name are among them:",
        "",
    ]
    return "\n".join(lines)


# --- what is typed ---


@dataclass(frozen=True)
class Arguments:
    """A command line after ``lerobot <name>``, taken apart.

    Attributes:
        pairs: (key, value) of every ``key=value``, in order.
        flags: everything from ``--…`` on; a value that was typed behind its flag is joined to it by ``=``.
    """

    pairs: list[tuple[str, str]] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)

    @property
    def wants_help(self) -> bool:
        """Whether ``-h`` or ``--help`` is among the flags."""
        return any(flag in ("-h", "--help") for flag in self.flags)

    def value(self, key: str) -> str | None:
        """Return what ``key=`` says last, else what ``--key`` does."""
        return dict(self.pairs).get(key, flag_value(self.flags, key))

    def without(self, *keys: str) -> Arguments:
        """Return arguments that say nothing of these keys, as a pair or a flag."""
        pairs = [(key, value) for key, value in self.pairs if key not in keys]
        return Arguments(pairs, without_flags(self.flags, *keys))


def split_arguments(line: Sequence[str]) -> Arguments:
    """Take a command line apart.

    Raises:
        MemobenchError: an argument is neither ``key=value`` nor a flag nor a flag's value.
    """
    result = Arguments()
    for word in joined(line):
        key, equals, value = word.partition("=")
        if word.startswith("-") and word != "-":
            result.flags.append(word)
        elif equals and key.replace("_", "").replace(".", "").replace("-", "").isalnum():
            result.pairs.append((key, value))
        else:
            raise MemobenchError(f"found {word!r} among the arguments; expected key=value or --flag=value")
    return result


def joined(line: Sequence[str]) -> list[str]:
    """Return a command line with ``--key value`` as ``--key=value``."""
    found: list[str] = []
    open_flag = False  # the word before was `--flag` without `=`: this one may be its value
    for word in line:
        is_flag = word.startswith("-") and word != "-"
        if open_flag and not is_flag:
            found[-1] += f"={word}"
        else:
            found.append(word)
        open_flag = is_flag and word.startswith("--") and "=" not in word
    return found


def flag_value(flags: Sequence[str], key: str) -> str | None:
    """Return the value of ``--key=value`` among flags; the last one counts."""
    found = [flag.partition("=")[2] for flag in flags if flag.startswith(f"--{key}=")]
    return found[-1] if found else None


def without_flags(flags: Sequence[str], *keys: str) -> list[str]:
    """Return the flags without ``--key`` and its value, for each of these keys."""
    named = {f"--{key}" for key in keys}
    return [flag for flag in flags if flag.partition("=")[0] not in named]


def whole_number(text: str | None) -> int | None:
    """Return the whole number that a value is, None when it is none."""
    try:
        return int(text) if text is not None else None
    except ValueError:
        return None


def read_executor_options(given: Sequence[str]) -> dict[str, Any]:
    """Return values of ``executor_option=``, such as ``partition=cpu``: numbers, truth values and ``none`` as such.

    In the arguments of another program (``srun_args.mpi=none``) ``none`` is a name.
    """
    plain: dict[str, bool | None] = {"true": True, "false": False}
    options: dict[str, Any] = {}
    for option in given:
        key, equals, value = option.partition("=")
        if not key or not equals:
            raise MemobenchError(f"found executor option {option!r}, expected key=value, such as partition=cpu")
        known = plain if "." in key else {**plain, "none": None, "null": None}
        options[key] = int(value) if value.isdecimal() else known.get(value.lower(), value)
    return options


def check_task_names(given: Arguments) -> None:
    """Refuse unknown task names before LeRobot's import, which takes many seconds.

    Raises:
        MemobenchError: a task that the catalogue does not have.
    """

    def either(short: str, full: str) -> str | None:
        return dict(given.pairs).get(short, given.value(full))

    own_folder, suite = given.value("env.task_dir"), either("suite", "env.suite")
    in_a_file = suite is None and given.value(CONFIG_FILE) is not None
    if either("env", "env.type") == "memobench" and not own_folder and not in_a_file:
        tasks = either("tasks", "env.tasks")
        resolve_tasks("all" if tasks is None else tasks, check_suite(suite or PUBLISHED))


# --- what LeRobot is called with ---


@dataclass(frozen=True)
class LerobotArguments:
    """The arguments of one of LeRobot's commands. They never change: others are another object.

    Attributes:
        flags: LeRobot's, as its parser reads them: ``--key=value``, or ``--key`` alone.
        config: the command's configuration class; None for a command that has none (plain argparse).
        chosen: ``policy`` and ``env`` -> the class chosen for them.
    """

    flags: tuple[str, ...]
    config: type | None = None
    chosen: Mapping[str, type] = field(default_factory=dict)

    def get(self, key: str) -> str | None:
        """Return the value of ``--key``, None without one."""
        return flag_value(self.flags, key)

    def has(self, key: str) -> bool:
        """Return whether ``--key`` is given, with or without a value."""
        return len(without_flags(self.flags, key)) < len(self.flags)

    def default(self, key: str, value: object) -> LerobotArguments:
        """Return arguments with ``--key=value`` where nobody has set it yet."""
        if self.has(key):
            return self
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return replace(self, flags=(*self.flags, f"--{key}={text}"))

    def changed(self, key: str, value: object) -> LerobotArguments:
        """Return arguments with ``--key=value``, whatever was set before."""
        return self.without(key).default(key, value)

    def without(self, *keys: str) -> LerobotArguments:
        """Return arguments that say nothing of these keys."""
        return replace(self, flags=tuple(without_flags(self.flags, *keys)))

    def choosing(self, key: str, name: str) -> LerobotArguments:
        """Return arguments whose ``policy`` or ``env`` is of the registered type ``name``, where none is chosen yet."""
        if key in self.chosen or self.config is None:
            return self
        return replace(self, chosen={**self.chosen, key: registry(self.config, key)[name]})


def read_arguments(command: str, given: Arguments) -> LerobotArguments:
    """Return what a command line means to LeRobot's command of that name; imports that command.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    config = config_class(load_command(command))
    register_plugins()
    return translate(command, given, config, read_config_file(given.value(CONFIG_FILE)))


def translate(command: str, given: Arguments, config: type | None, file: Mapping[str, Any]) -> LerobotArguments:
    """Turn a command line into LeRobot's arguments.

    Args:
        command: LeRobot's command without ``lerobot-``.
        config: the configuration class of the command, None when it has none.
        file: content of the file named by ``config_path``; it may hold the policy and the environment.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    if config is None:
        return LerobotArguments((*given.flags, *(f"--{key}={value}" for key, value in given.pairs)))
    known = field_types(config)
    choosing = [(key, value) for key, value in given.pairs if key in CHOOSING and key in known]
    others = [pair for pair in given.pairs if pair not in choosing]
    flags = [*given.flags, *(flag for key, value in choosing for flag in choice_flags(config, key, value))]
    # Fields of the policy and the environment are known once these are, wherever they stand in the line.
    explicit = [*flags, *(f"--{key}={value}" for key, value in others)]
    found = {key: chosen_class(config, key, explicit, file) for key in ("policy", "env") if key in known}
    chosen: dict[str, type] = {key: choice for key, choice in found.items() if choice is not None}
    short = SHORT_FORMS.get(command, {})
    for key, value in others:
        if key in short:
            flags += _short_form_flags(config, chosen, key, value, short[key])
            continue
        try:
            annotation = annotation_of(config, key, chosen)
        except KeyError:
            options = {"eval": RUN_OPTIONS, "train": TRAINING_OPTIONS}.get(command, ())
            keys = [*CHOOSING, *short, *all_keys(config, chosen), *options]
            raise MemobenchError(f"lerobot {command} has no setting {key!r}, {nearest(key, keys)}") from None
        flags.append(f"--{key}={checked_value(key, annotation, value)}")
    return LerobotArguments(tuple(flags), config, chosen)


def _short_form_flags(
    config: type, chosen: Mapping[str, type], key: str, value: str, targets: tuple[str, ...]
) -> list[str]:
    """Return the flags of those of a short form's fields that exist; at least one must."""
    found = []
    for target in targets:
        # replan= sets the policy's interval and tells the environment, which writes it down; either may be missing.
        try:
            annotation = annotation_of(config, target, chosen)
        except (KeyError, MemobenchError):
            continue
        found.append(f"--{target}={checked_value(key, annotation, value)}")
    if found:
        return found
    owner, _, name = targets[0].partition(".")
    if owner in chosen:
        kind = chosen[owner].__name__
        raise MemobenchError(f"{key}= sets {targets[0]}, which this {owner} ({kind}) does not have")
    raise MemobenchError(f"{key}= sets {name} of the {owner}: name one with {owner}=")


# --- what policy=, env= and dataset= choose: a registered type, a checkpoint, a repository, a folder ---


def choice_flags(config: type, key: str, value: str) -> list[str]:
    """Return the flags for ``policy=``, ``env=`` or ``dataset=`` of a command with this configuration.

    Raises:
        MemobenchError: there is no such thing, with what is near.
    """
    if not value:
        raise MemobenchError(f"{key}= is empty; name a {key}")
    if key == "dataset":
        return dataset_flags(value)
    known = registry(config, key)
    path = checkpoint_of(value, known) if key == "policy" else None
    if path is not None:
        return [f"--policy.path={path}"]
    if value not in known:
        others = shipped_policies() if key == "policy" else {}
        raise MemobenchError(f"there is no {key} {value!r}, {nearest(value, [*known, *others])}")
    return [f"--{key}.type={value}"]


def checkpoint_of(value: str, known: Collection[str]) -> str | None:
    """Return the checkpoint folder or the repository that ``policy=`` means; None where it means a type.

    A known name is what has it, wherever the command is run: a folder of that name is named by a path.
    """
    if value in (*known, *shipped_policies()) and folder_with_checkpoint(value) is not None:
        what = "the policy type" if value in known else "the policy of the package"
        logger.warning("policy=%s is %s; the checkpoint in the folder of that name is policy=./%s", value, what, value)
    folder = None if value in known else checkpoint_folder(value)
    if folder is not None:
        return str(folder)
    if value not in known and (looks_local(value) or Path(value).is_dir()):
        what = "holds no checkpoint (no config.json)" if Path(value).is_dir() else "does not exist"
        raise MemobenchError(
            f"policy={value}: this folder {what}; expected a checkpoint such as "
            "outputs/train/<run>/checkpoints/last/pretrained_model, or a policy type"
        )
    return value if "/" in value else None


def dataset_flags(value: str) -> list[str]:
    """Return the flags for ``dataset=``: a folder here, or a repository's id."""
    path = Path(value).expanduser()
    if path.is_dir():
        return [f"--dataset.repo_id=local/{path.resolve().name}", f"--dataset.root={path}"]
    if looks_local(value) or "/" not in value:
        raise MemobenchError(
            f"dataset={value}: there is no such folder; expected one that `memobench generate` wrote, "
            "or a repository such as user/name"
        )
    return [f"--dataset.repo_id={value}"]


def chosen_class(config: type, key: str, flags: Sequence[str], file: Mapping[str, Any]) -> type | None:
    """Return the class that flags or a configuration file choose for ``policy`` or ``env``.

    None when nothing is chosen, or when it is not known here.
    """
    known = registry(config, key)
    path = flag_value(flags, f"{key}.path")
    name = flag_value(flags, f"{key}.type")
    section = file.get(key)
    if not path and not name and isinstance(section, Mapping):
        path, name = (_text(key, section, word) for word in ("path", "type"))
    if path:
        name = checkpoint_type(path)
    elif name and name not in known:
        raise MemobenchError(f"there is no {key} {name!r}, {nearest(name, known)}")
    return known.get(name) if name else None


def _text(key: str, section: Mapping[str, Any], word: str) -> str | None:
    value = section.get(word)
    if value is not None and not isinstance(value, str):
        raise MemobenchError(f"the configuration file says {key}.{word}: {str(value)[:80]}; expected a name")
    return value


# --- recipes and configuration files ---


def recipes() -> dict[str, Path]:
    """Return name -> file of every shipped recipe."""
    folder = Path(str(resources.files("lerobot_memobench") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def recipe_file(value: str) -> Path:
    """Return the file of a recipe: one shipped, by its name, or a YAML or JSON file.

    Raises:
        MemobenchError: there is none.
    """
    known = recipes()
    path = Path(value).expanduser()
    if value in known:
        if path.is_file():
            logger.warning(
                "%s=%s is the shipped recipe; the file of that name is %s=./%s", RECIPE, value, RECIPE, value
            )
        return known[value]
    if path.is_file():
        return path
    if "/" in value or path.suffix:
        raise MemobenchError(f"{RECIPE}={value}: there is no such file; name a shipped recipe or a YAML file")
    raise MemobenchError(f"there is no recipe {value!r}, {nearest(value, known)}")


def resolve_recipe(given: Arguments) -> Arguments:
    """Replace ``config=<recipe>`` by LeRobot's ``config_path=<file>``."""
    named = [value for key, value in given.pairs if key == RECIPE]
    if not named:
        return given
    rest = [(key, value) for key, value in given.pairs if key != RECIPE]
    if len(named) > 1 or given.value(CONFIG_FILE) is not None:
        raise MemobenchError(f"{RECIPE}={named[-1]}: give one recipe, either by {RECIPE}= or by {CONFIG_FILE}=")
    return replace(given, pairs=[(CONFIG_FILE, str(recipe_file(named[0]))), *rest])


def read_config_file(given: str | None) -> dict[str, Any]:
    """Return the content of the local file that ``config_path`` names, {} without one.

    Raises:
        MemobenchError: it cannot be read as settings.
    """
    if given is None:
        return {}
    path = Path(given).expanduser()
    if path.is_dir():
        path = path / "train_config.json"
    if not path.is_file():
        return {}  # a repository: LeRobot fetches it
    try:
        content = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise MemobenchError(f"{CONFIG_FILE}={given} cannot be read ({error.strerror or error})") from None
    except (yaml.YAMLError, ValueError, TypeError, KeyError, RecursionError, AttributeError) as error:
        # Beside its own errors, PyYAML lets through those of dates, numbers and keys that are none.
        problem = " ".join(str(error).split())
        raise MemobenchError(f"{CONFIG_FILE}={given} is neither YAML nor JSON: {problem}") from None
    if not isinstance(content, dict):
        raise MemobenchError(f"{CONFIG_FILE}={given} holds no settings; expected a mapping such as 'policy: …'")
    return content


# --- the settings of a command and the values that they take: read from its dataclasses ---

CHOICE_KEYS = ("type", "path", "discover_packages_path")
"""What LeRobot's parser understands beside the fields of a registry: ``--policy.type``."""

Chosen = Mapping[str, type]
"""Dotted key of a registry field (``policy``) -> the class chosen for it."""


def field_types(cls: type) -> dict[str, Any]:
    """Return field name -> annotation without its None, for the fields that can be set."""
    hints = typing.get_type_hints(cls)
    return {each.name: _without_none(hints[each.name]) for each in dataclasses.fields(cls) if each.init}


def _without_none(annotation: Any) -> Any:
    """Return the annotation without its None: ``int`` for ``int | None``."""
    if typing.get_origin(annotation) in (Union, types.UnionType):
        parts = [part for part in typing.get_args(annotation) if part is not type(None)]
        return parts[0] if len(parts) == 1 else Union[tuple(parts)]  # noqa: UP007 - built at run time
    return annotation


def registry(config: type, key: str) -> dict[str, type]:
    """Return name -> class of what may be chosen for a registry field such as ``policy``."""
    choices = field_types(config)[key].get_known_choices()
    return {str(name): choice for name, choice in choices.items()}


def _is_registry(annotation: Any) -> bool:
    """Return whether a field is chosen by ``.type`` among registered classes."""
    return isinstance(annotation, type) and issubclass(annotation, draccus.ChoiceRegistry)


def all_keys(config: type, chosen: Chosen, before: str = "") -> Iterator[str]:
    """Yield every dotted key that may be set."""
    for name, annotation in field_types(config).items():
        key = before + name
        if _is_registry(annotation):
            choice = chosen.get(key)
            yield from (f"{key}.{word}" for word in CHOICE_KEYS[:2])
            if choice is not None:
                yield from all_keys(choice, chosen, key + ".")
        elif dataclasses.is_dataclass(annotation):
            yield from all_keys(typing.cast(type, annotation), chosen, key + ".")
        else:
            yield key


def annotation_of(config: type, key: str, chosen: Chosen) -> Any:
    """Return the annotation of the field at a dotted key; ``Any`` where it cannot be known.

    Raises:
        KeyError: there is no such field. MemobenchError: the key belongs to a choice that has not been made
            (``env.horizon`` without an environment).
    """
    if key == CONFIG_FILE:
        return str
    cls = config
    parts = key.split(".")
    for k, part in enumerate(parts[:-1]):
        annotation = field_types(cls)[part]
        if _is_registry(annotation):
            if k == len(parts) - 2 and parts[-1] in CHOICE_KEYS:
                return str
            choice = chosen.get(".".join(parts[: k + 1]))
            if choice is None and k == 0:
                raise MemobenchError(f"{key!r} needs {part}=: name one before setting something of it")
            annotation = choice
        if not dataclasses.is_dataclass(annotation):
            return Any  # a dict, a union, a choice made elsewhere: LeRobot's parser decides
        cls = typing.cast(type, annotation)
    return field_types(cls)[parts[-1]]


def checked_value(key: str, annotation: Any, text: str) -> str:
    """Return ``text`` as LeRobot's parser reads it, after a check against the field's type.

    Raises:
        MemobenchError: the value cannot be one of this field.
    """
    if text in ("null", "~"):
        return text
    if annotation in (bool, int, float):
        # For text, a word such as `align=none` is a value.
        return "null" if text.lower() == "none" else _checked_plain(key, annotation, text)
    if typing.get_origin(annotation) is Literal:
        known = named = [str(value) for value in typing.get_args(annotation)]
    elif isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        named = list(annotation.__members__)
        known = [*(str(member.value) for member in annotation), *named]
    else:
        return text
    if text not in known:
        raise MemobenchError(f"{key}={text}: {nearest(text, named)}")
    return text


def _checked_plain(key: str, annotation: type, text: str) -> str:
    """Return the text of a truth value or number."""
    if annotation is bool:
        if text.lower() not in ("true", "false"):
            raise MemobenchError(f"{key}={text}: expected true or false")
        return text.lower()
    plain = text.replace("_", "") if annotation is int else text
    try:
        annotation(plain)
    except ValueError:
        word = "a whole number" if annotation is int else "a number"
        raise MemobenchError(f"{key}={text}: expected {word}") from None
    return plain
