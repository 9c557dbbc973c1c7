"""A command line becomes LeRobot's flags: ``lerobot train policy=memobench_mem align=contrastive`` and the like.

``key=value`` is checked against the dataclasses that LeRobot's parser (draccus) fills, so that a mistake is told in one
sentence before anything runs. Short forms stand for LeRobot's names, ``policy=``, ``env=`` and ``dataset=`` choose, and
``config=`` names a recipe. What begins with ``--`` is passed on untouched. LeRobot's parser reads the result.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import draccus
import yaml
from draccus.parsers.config_parsers import JSONParser, YAMLParser
from draccus.utils import DecodingError, is_choice_type, is_enum, is_literal, is_union

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

RECIPE, CONFIG_FILE = "config", "config_path"
"""Our key and LeRobot's for a configuration file."""
DATASET = "dataset"

COMMON: dict[str, tuple[str, ...]] = {
    **{key: (f"policy.{key}",) for key in ("align", "size", "perception", "detector", "visual_encoder", "device")},
    **{key: (f"env.{key}",) for key in ("tasks", "obs_type", "suite", "world", "referent")},
    "replan": ("policy.n_action_steps", "env.replan_steps"),
}
SHORT_FORMS: dict[str, dict[str, tuple[str, ...]]] = {
    "eval": {
        **COMMON,
        **{key: (f"policy.{key}",) for key in ("host", "port", "dialect")},
        **{
            key: (f"env.{key}",)
            for key in (
                *("protocol", "demonstration_prompt", "prompt_in", "horizon"),
                *("pause_steps", "speed", "evidence", "videos"),
            )
        },
        "episodes": ("eval.n_episodes",),
        "batch_size": ("eval.batch_size",),
    },
    "train": {**COMMON, "episodes": ("dataset.episodes",)},
}
"""Command -> short form -> the fields it sets, of which those that exist are set. `cli/lerobot_<command>.txt` explains
them."""
RUN_OPTIONS = (
    *("split", "memory_reads", "resume"),
    *("shard", "shards", "workers", "slurm"),
)
"""Keys of `lerobot eval env=memobench` that are none of LeRobot's (`plan.RunOptions`)."""
TRAINING_OPTIONS = ("prompt_frames", "obs_type")
"""Keys of `lerobot train` that are none of LeRobot's (`training.take_training_options`)."""
OPTIONS = {"eval": RUN_OPTIONS, "train": TRAINING_OPTIONS}


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
        flags: LeRobot's, as they are typed: ``--key=value``, or ``--key`` alone.
        config: the command's configuration class; None for a command that has none (plain argparse).
        chosen: fields such as ``policy`` and ``env`` -> the class chosen for them, on the line or in a file.
    """

    flags: tuple[str, ...]
    config: type | None = None
    chosen: Mapping[str, type] = field(default_factory=dict)

    @property
    def for_parser(self) -> tuple[str, ...]:
        """The flags for LeRobot's parser: texts that it would read as YAML or JSON values are quoted."""
        known = {} if self.config is None else dict(settings(self.config, self.chosen))
        return tuple(for_parser(flag, known) for flag in self.flags)

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
        """Return arguments that choose the registered type ``name`` for a field such as ``policy``."""
        assert self.config is not None
        chosen = {**self.chosen, key: registries(self.config)[key][name]}
        return replace(self.changed(f"{key}.type", name), chosen=chosen)


def for_parser(flag: str, known: Mapping[str, Any]) -> str:
    """Return a flag for LeRobot's parser: a text that it would read as a YAML or JSON value is quoted.

    Args:
        known: dotted key -> type of each setting.
    """
    key, _, text = flag.removeprefix("--").partition("=")
    kind = without_none(known.get(key))
    if kind not in (str, Path) or key.rpartition(".")[2] in CHOICE_KEYS or text in NO_VALUE:
        return flag
    if text.startswith(INCLUDE):
        if kind is not Path and not key.endswith(("root", "_dir")):
            raise MemobenchError(
                f"found {key}={text}; LeRobot's parser takes text that begins with {INCLUDE} for a file"
            )
        text = f"./{text}"
    try:
        is_plain = all(parser.parse_string(text) == text for parser in (YAMLParser, JSONParser))
    except yaml.YAMLError:
        is_plain = False
    return f"--{key}={text if is_plain else json.dumps(text, ensure_ascii=False)}"


def read_arguments(command: str, given: Arguments) -> LerobotArguments:
    """Return what a command line means to LeRobot's command of that name; imports that command.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    config = config_class(load_command(command))
    register_plugins()
    load_packages(given)
    return translate(command, given, config, read_config_file(given.value(CONFIG_FILE)))


def load_packages(given: Arguments) -> None:
    """Import the packages that LeRobot is told to look for plugins in, so that what they register is known."""
    from lerobot.configs import parser

    named = [f"--{key}={value}" for key, value in given.pairs]
    for flag in (*given.flags, *named):
        key, _, value = flag.partition("=")
        if key.endswith(f".{CHOICE_KEYS[-1]}"):
            try:
                parser.load_plugin(value)
            except (parser.PluginLoadError, ImportError) as error:
                raise MemobenchError(f"{key.removeprefix('--')}={value} cannot be imported ({error})") from None


def is_of_benchmark(given: Arguments) -> bool:
    """Return whether a command line of `lerobot eval`, or its configuration file, names the benchmark."""
    section = read_config_file(given.value(CONFIG_FILE)).get("env")
    in_file = section.get("type") if isinstance(section, Mapping) else section
    return dict(given.pairs).get("env", given.value("env.type") or in_file) == "memobench"


def with_file(given: Arguments, file: Mapping[str, Any], config: type) -> Arguments:
    """Return a command line that says what a configuration file says where the line does not.

    LeRobot would read the file beneath the line, where the benchmark's defaults would hide it.
    """
    chosen = {key for key in registries(config) if dict(given.pairs).get(key) or _is_named(given, key)}
    found = [
        (key, value)
        for key, value in flattened(file, dict(settings(config, {})))
        if not (key.partition(".")[0] in chosen and key.partition(".")[2] in ("", *CHOICE_KEYS[:2]))
        and given.value(key) is None
    ]
    return replace(given, pairs=[*found, *given.pairs])


def _is_named(given: Arguments, key: str) -> bool:
    return any(given.value(f"{key}.{word}") is not None for word in CHOICE_KEYS[:2])


def flattened(file: Mapping[str, Any], known: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Yield key and value, as typed, of each setting in the content of a configuration file."""
    for name, value in file.items():
        key = f"{before}{name}"
        kind = without_none(known.get(key, Any))
        if isinstance(value, Mapping) and dataclasses.is_dataclass(kind):
            yield from flattened(value, known, f"{key}.")
        else:
            yield key, value if isinstance(value, str) else json.dumps(value)


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
    choices = registries(config)
    choosing = {*choices, *({DATASET} & field_types(config).keys())}
    others = [pair for pair in given.pairs if pair[0] not in choosing]
    flags = list(given.flags)
    for key, value in given.pairs:
        flags += choice_flags(config, key, value) if key in choosing else []
    for key in choosing:
        _check_named_once(key, given.pairs, flags)
    # Fields of the policy and the environment are known once these are, wherever they stand in the line.
    explicit = [*flags, *(f"--{key}={value}" for key, value in others)]
    found = {key: chosen_class(config, key, explicit, file) for key in choices}
    chosen = {key: choice for key, choice in found.items() if choice is not None}
    known, short = dict(settings(config, chosen)), SHORT_FORMS.get(command, {})
    for key, value in others:
        # replan= sets the policy's interval and tells the environment, which writes it down; either may be missing.
        fields = [each for each in short.get(key, ()) if each in known]
        if key in short and not fields:
            raise _nothing_to_set(key, short[key][0], chosen)
        try:
            flags += [f"--{each}={checked_value(key, setting_type(known, each), value)}" for each in fields or [key]]
        except KeyError:
            keys = [*known, *short, *OPTIONS.get(command, ())]
            raise MemobenchError(f"lerobot {command} has no setting {key!r}, {nearest(key, keys)}") from None
    # LeRobot takes the first of some that are given twice and the last of others.
    once = {flag.partition("=")[0]: flag for flag in flags}
    return LerobotArguments(tuple(once.values()), config, chosen)


def _check_named_once(key: str, pairs: Sequence[tuple[str, str]], flags: Sequence[str]) -> None:
    named = {f"{key}={value}" for name, value in pairs if name == key}
    if len(named) < 2:
        named = {flag for flag in flags if flag.startswith((f"--{key}.type=", f"--{key}.path="))}
    if len(named) > 1:
        raise MemobenchError(f"there are two answers to which {key} is meant, {' and '.join(sorted(named))}; name one")


def _nothing_to_set(key: str, target: str, chosen: Mapping[str, type]) -> MemobenchError:
    owner, _, name = target.partition(".")
    if owner in chosen:
        kind = chosen[owner].__name__
        return MemobenchError(f"{key}= sets {target}, which this {owner} ({kind}) does not have")
    return MemobenchError(f"{key}= sets {name} of the {owner}: name one with {owner}=")


# --- what policy=, env=, dataset= … choose: a registered type, a checkpoint, a repository, a folder ---


def choice_flags(config: type, key: str, value: str) -> list[str]:
    """Return the flags for what chooses, such as ``policy=``, of a command with this configuration.

    Raises:
        MemobenchError: there is no such thing, with what is near.
    """
    if not value:
        raise MemobenchError(f"{key}= is empty; expected a name")
    if key == DATASET:
        return dataset_flags(value)
    known = registries(config)[key]
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
    """Return the class that flags or a configuration file choose for a field such as ``policy``.

    None when nothing is chosen, or when it is not known here.
    """
    known = registries(config)[key]
    path = flag_value(flags, f"{key}.path")
    name = flag_value(flags, f"{key}.type")
    section = file.get(key)
    if not path and not name and isinstance(section, Mapping):
        path, name = (_text(key, section, word) for word in ("path", "type"))
    if path:
        name = checkpoint_type(path)
    elif name and name not in known and not any(".discover_packages_path=" in flag for flag in flags):
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
        if looks_local(given) or path.suffix in (".yaml", ".yml", ".json"):
            raise MemobenchError(f"{CONFIG_FILE}={given}: there is no such file")
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


# --- the settings of a command and the values that they take: read from its dataclasses, as draccus does ---

CHOICE_KEYS = ("type", "path", "discover_packages_path")
"""What LeRobot's parser understands beside the fields of a choice: ``--policy.type``."""
NO_VALUE = ("", "null", "~")
"""Texts that LeRobot's parser reads as an empty text or as None."""
INCLUDE = "include"
"""Beginning of a text that draccus replaces by the content of a file."""
PLAIN = {bool: "true or false", int: "a whole number", float: "a number"}


def field_types(cls: type) -> dict[str, Any]:
    """Return field name -> annotation, for the fields that can be set."""
    hints = typing.get_type_hints(cls)
    return {each.name: hints[each.name] for each in dataclasses.fields(cls) if each.init}


def without_none(annotation: Any) -> Any:
    """Return ``int`` for ``int | None``."""
    parts = [part for part in typing.get_args(annotation) if part is not type(None)]
    return parts[0] if is_union(annotation) and len(parts) == 1 else annotation


def registries(config: type) -> dict[str, dict[str, type]]:
    """Return field -> name -> class of what may be chosen for it, such as for ``policy``."""
    return {
        key: {str(name): choice for name, choice in kind.get_known_choices().items()}
        for key, kind in ((name, without_none(annotation)) for name, annotation in field_types(config).items())
        if is_choice_type(kind)
    }


def settings(config: type, chosen: Mapping[str, type], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and the type of each setting, sections and choices among them.

    Args:
        chosen: dotted key of a choice (``policy``) -> the class chosen for it.
    """
    for name, annotation in field_types(config).items():
        key, kind = before + name, without_none(annotation)
        if is_choice_type(kind):
            yield from ((f"{key}.{word}", str) for word in CHOICE_KEYS)
            annotation = kind = chosen.get(key, kind)
        yield key, annotation
        if has_settings(kind):
            yield from settings(kind, chosen, key + ".")


def has_settings(kind: Any) -> bool:
    """Return whether a type is a section: a dataclass whose fields are settings of their own."""
    return dataclasses.is_dataclass(kind) and not is_choice_type(kind)


def setting_type(known: Mapping[str, Any], key: str) -> Any:
    """Return the type of one of the `settings`; ``Any`` where LeRobot's parser alone decides.

    Raises:
        KeyError: there is no such setting. MemobenchError: it belongs to a choice that has not been made
            (``env.horizon`` without an environment), or is within a mapping.
    """
    if key == CONFIG_FILE:
        return str
    owner = key
    while owner not in known:
        owner = owner.rpartition(".")[0]
        if not owner:
            raise KeyError(key)
    if owner == key:
        return known[key]
    kind = without_none(known[owner])
    if is_choice_type(kind) and "." not in owner:
        raise MemobenchError(f"{key!r} needs {owner}=: name one before setting something of it")
    if typing.get_origin(kind) is dict:
        raise MemobenchError(
            f"found {key}=, and {owner} is a mapping that is given whole; say {owner}="
            f"'{{\"{key.removeprefix(owner)[1:]}\": …}}'"
        )
    if has_settings(kind) or kind in (*PLAIN, str) or is_literal(kind) or is_enum(kind):
        raise KeyError(key)
    return Any


def checked_value(key: str, annotation: Any, text: str) -> str:
    """Return ``text`` as LeRobot's parser reads it, after a check against the field's type.

    Raises:
        MemobenchError: the value cannot be one of this field.
    """
    kind = without_none(annotation)
    if text in ("null", "~") or (kind in PLAIN and text.lower() == "none"):  # for text, `align=none` is a value
        if annotation in PLAIN:
            raise MemobenchError(f"{key}={text}: expected {PLAIN[annotation]}")
        return "null"
    if kind in PLAIN:
        plain = text.lower()
        try:
            draccus.decode(kind, plain)
        except DecodingError:
            raise MemobenchError(f"{key}={text}: expected {PLAIN[kind]}") from None
        return plain
    if has_settings(kind):
        names = [f"{key}.{name}" for name in field_types(kind)]
        raise MemobenchError(f"{key}={text[:80]}: {key} holds settings; expected one of them, such as {names[0]}=")
    if typing.get_origin(kind) is dict:
        try:
            found = yaml.safe_load(text)
        except yaml.YAMLError:
            found = None
        if not isinstance(found, dict):
            raise MemobenchError(f'{key}={text[:80]}: expected a mapping, such as {key}=\'{{"name": "other"}}\'')
        return json.dumps(found, default=str)  # beside a checkpoint LeRobot reads JSON alone
    if is_literal(kind):
        known = named = [str(value) for value in typing.get_args(kind)]
    elif is_enum(kind):
        named = list(kind.__members__)
        known = [*(str(member.value) for member in kind), *named]
    else:
        return text
    if text not in known:
        raise MemobenchError(f"{key}={text}: {nearest(text, named)}")
    return text


def is_true(key: str, text: str | None) -> bool:
    """Return the truth value that an option of ours is given; not given, it is false."""
    return text is not None and checked_value(key, bool, text) == "true"
