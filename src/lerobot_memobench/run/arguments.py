"""Parse a command line of LeRobot: ``lerobot train policy=memobench_mem align=contrastive`` and the like.

``key=value`` is checked against the dataclasses that LeRobot's parser (draccus) fills, so that a mistake is reported
before anything runs. Short forms are translated to LeRobot's names, ``policy=``, ``env=`` and ``dataset=`` choose, and
``config=`` names a recipe. Arguments that begin with ``--`` are passed on unchecked.
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
import yaml
from draccus.parsers.config_parsers import JSONParser, YAMLParser
from draccus.utils import DecodingError, is_choice_type, is_enum, is_literal, is_union

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.checkpoint import (
    check_checkpoint,
    check_registered,
    checkpoint_folder,
    checkpoint_type,
    looks_local,
    shipped_policies,
)
from lerobot_memobench.policies.lerobot_config import check_sizes, overrides, quiet

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig

RECIPE, CONFIG_FILE = "config", "config_path"
"""Our key and LeRobot's for a configuration file."""
DATASET = "dataset"
PREFIX = "lerobot-"

COMMON: dict[str, tuple[str, ...]] = {
    **{key: (f"policy.{key}",) for key in ("align", "size", "perception", "detector", "visual_encoder", "device")},
    **{key: (f"env.{key}",) for key in ("tasks", "obs_type", "suite", "referent")},
    "replan": ("policy.n_action_steps", "env.replan_steps"),
}
SHORT_FORMS: dict[str, dict[str, tuple[str, ...]]] = {
    "eval": {
        **COMMON,
        **{key: (f"policy.{key}",) for key in ("host", "port", "dialect")},
        **{
            key: (f"env.{key}",)
            for key in (
                *("task", "task_ids", "convention", "camera_name_mapping", "observation_height", "observation_width"),
                *("robot_state", "control_mode"),
                *("difficulty", "protocol", "demonstration_prompt", "prompt_in", "horizon"),
                *("pause_steps", "speed", "evidence", "salt", "videos"),
                *("corrupt", "corrupt_step", "reshow", "interference"),
            )
        },
        "episodes": ("eval.n_episodes",),
        "batch_size": ("eval.batch_size",),
    },
    "train": {**COMMON, "episodes": ("dataset.episodes",)},
}
"""Command -> short form -> the fields it sets, as far as they exist. `cli/lerobot_<command>.txt` explains them."""
RUN_OPTIONS = ("split", "memory_reads", "resume", "shard", "shards", "workers", "slurm")
"""Keys of `lerobot eval env=memobench` that LeRobot does not have (`plan.RunOptions`)."""
TRAINING_OPTIONS = ("prompt_frames", "obs_type")
"""Keys of `lerobot train` that LeRobot does not have (`training.take_training_options`)."""
OPTIONS = {"eval": RUN_OPTIONS, "train": TRAINING_OPTIONS}


# --- the words of a command line ---


@dataclass(frozen=True)
class Arguments:
    """A command line after ``lerobot <name>``, split.

    Attributes:
        pairs: (key, value) of every ``key=value``, in order.
        flags: every ``--…``, with its value joined to it by ``=``.
    """

    pairs: list[tuple[str, str]] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)

    @property
    def wants_help(self) -> bool:
        """Whether ``-h`` or ``--help`` is among the flags."""
        return any(flag in ("-h", "--help") for flag in self.flags)

    def value(self, key: str) -> str | None:
        """Return the last value of ``key=``, else of ``--key=``; None without either."""
        flags = dict(flag.removeprefix("--").split("=", 1) for flag in self.flags if "=" in flag)
        return dict(self.pairs).get(key, flags.get(key))

    def without(self, *keys: str) -> Arguments:
        """Return arguments without these keys, as pairs and as flags."""
        named = {f"--{key}" for key in keys}
        flags = [flag for flag in self.flags if flag.partition("=")[0] not in named]
        return Arguments([pair for pair in self.pairs if pair[0] not in keys], flags)


def split_arguments(line: Sequence[str]) -> Arguments:
    """Split a command line.

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
    open_flag = False  # the previous word was `--flag` without `=`: this word may be its value
    for word in line:
        is_flag = word.startswith("-") and word != "-"
        if open_flag and not is_flag:
            found[-1] += f"={word}"
        else:
            found.append(word)
        open_flag = is_flag and word.startswith("--") and "=" not in word
    return found


def whole_number(text: str | None) -> int | None:
    """Return a text as a whole number, None where it is not one."""
    try:
        return int(text) if text is not None else None
    except ValueError:
        return None


def is_of_benchmark(given: Arguments) -> bool:
    """Return whether a command line of `lerobot eval`, or its configuration file, names the benchmark."""
    section = read_config_file(given.value(CONFIG_FILE)).get("env")
    in_file = section.get("type") if isinstance(section, Mapping) else section
    return dict(given.pairs).get("env", given.value("env.type") or in_file) == "memobench"


# --- LeRobot's commands ---


def lerobot_commands() -> dict[str, metadata.EntryPoint]:
    """Return name -> entry point of every command of the installed LeRobot (``eval``: ``lerobot-eval``)."""
    return {
        entry.name.removeprefix(PREFIX): entry
        for entry in metadata.distribution("lerobot").entry_points
        if entry.group == "console_scripts" and entry.name.startswith(PREFIX)
    }


def load_command(name: str) -> Callable[[], Any]:
    """Return the main function of a LeRobot command, which reads ``sys.argv``. The import takes many seconds.

    Raises:
        MemobenchError: LeRobot was installed without the extra that the command needs.
    """
    try:
        entry: Callable[[], Any] = lerobot_commands()[name].load()
    except ImportError as error:
        raise MemobenchError(f"{PREFIX}{name} needs a package that is not installed: {error}") from error
    return entry


def call_lerobot(command: str, flags: Sequence[str]) -> int:
    """Run ``lerobot-<command>`` with these flags; return its exit status. Its main function reads ``sys.argv``."""
    entry = load_command(command)
    before = sys.argv
    sys.argv = [f"{PREFIX}{command}", *flags]
    try:
        status = entry()
    except SystemExit as stop:
        status = stop.code
    finally:
        sys.argv = before
    if status is None or isinstance(status, int):
        return status or 0
    print(status, file=sys.stderr)  # as Python does with such a status
    return 1


@cache
def register_plugins() -> None:
    """Let LeRobot find its plugins as its own commands do, once per process, without its log lines."""
    from lerobot.utils.import_utils import register_third_party_plugins

    with quiet():
        register_third_party_plugins()


def load_plugins(given: Arguments) -> None:
    """Register LeRobot's plugins, and import the packages that ``…discover_packages_path`` names."""
    import lerobot.envs
    import lerobot.policies
    import lerobot.rewards  # noqa: F401 - they register LeRobot's own types
    from lerobot.configs import parser

    register_plugins()
    for flag in (*given.flags, *(f"--{key}={value}" for key, value in given.pairs)):
        key, _, value = flag.removeprefix("--").partition("=")
        if key.endswith(f".{CHOICE_KEYS[-1]}"):
            try:
                parser.load_plugin(value)
            except Exception as error:  # a plug-in may raise anything
                raise MemobenchError(f"{key}={value} cannot be imported as a package ({error})") from None


@dataclass(frozen=True)
class LerobotArguments:
    """The arguments of one of LeRobot's commands. Changes return another object.

    Attributes:
        values: LeRobot's full name of each setting -> its text; None for a flag without a value.
        config: the command's configuration class; None for a command whose arguments are passed on.
        chosen: fields such as ``policy`` and ``env`` -> the class chosen for them, on the line or in a file.
        others: arguments passed on as they were typed.
    """

    values: Mapping[str, str | None]
    config: type | None = None
    chosen: Mapping[str, type] = field(default_factory=dict)
    others: tuple[str, ...] = ()

    @property
    def for_parser(self) -> tuple[str, ...]:
        """The arguments for LeRobot's parser: texts that it would read as YAML or JSON values are quoted."""
        known = {} if self.config is None else setting_types(self.config, self.chosen)
        flags = (f"--{k}" if v is None else f"--{k}={quoted(k, v, known)}" for k, v in self.values.items())
        return (*self.others, *flags)

    def get(self, key: str) -> str | None:
        """Return the value of a setting, None without one."""
        return self.values.get(key)

    def has(self, key: str) -> bool:
        """Return whether a setting is given, with or without a value."""
        return key in self.values

    def default(self, key: str, value: object) -> LerobotArguments:
        """Return arguments with a setting, unless it is given."""
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return replace(self, values={key: text, **self.values})

    def changed(self, key: str, value: object) -> LerobotArguments:
        """Return arguments with a setting in place of a given one."""
        return self.without(key).default(key, value)

    def without(self, *keys: str) -> LerobotArguments:
        """Return arguments without these settings."""
        return replace(self, values={key: text for key, text in self.values.items() if key not in keys})

    def configuration(self, key: str) -> Any:
        """Return the configuration of a choice such as ``policy``.

        None where none is chosen, it is not on this machine, or a configuration file sets parts of it.

        Raises:
            MemobenchError: a value is no YAML. Others come from the configuration's own checks.
        """
        from lerobot.configs import PreTrainedConfig

        if key not in self.chosen or self.has(CONFIG_FILE):
            return None
        path, changes = self.get(f"{key}.path"), overrides(key, self.for_parser)
        try:
            with quiet():
                if path is not None:
                    return PreTrainedConfig.from_pretrained(path, cli_overrides=changes)
                return draccus.parse(self.chosen[key], args=changes)
        except yaml.YAMLError as error:  # LeRobot reads every value as YAML
            problem = " ".join(str(error).split())
            raise MemobenchError(
                f"a value of {key}. cannot be read ({problem}); put it in quotes within quotes"
            ) from None


def policy_config(arguments: LerobotArguments) -> PreTrainedConfig | None:
    """Return the policy's configuration, see `LerobotArguments.configuration`.

    Raises:
        MemobenchError: the checkpoint is not complete.
    """
    if (path := arguments.get("policy.path")) is not None:
        check_checkpoint(path)
        check_registered(path)
    found: PreTrainedConfig | None = arguments.configuration("policy")
    if found is not None:
        check_sizes(found)
    return found


def env_config(arguments: LerobotArguments) -> EnvConfig | None:
    """Return the environment's configuration, see `LerobotArguments.configuration`."""
    found: EnvConfig | None = arguments.configuration("env")
    return found


def quoted(key: str, text: str, known: Mapping[str, Any]) -> str:
    """Return a value for LeRobot's parser: a text that it would read as a YAML or JSON value is quoted.

    Args:
        known: type of each setting.
    """
    kind = without_none(known.get(key))
    if kind not in (str, Path) or key.rpartition(".")[2] in CHOICE_KEYS or text in NO_VALUE:
        return text
    if text.startswith(INCLUDE):
        if kind is not Path and not key.endswith(("root", "_dir")):
            raise MemobenchError(f"found {key}={text}; LeRobot's parser reads {INCLUDE}… as the name of a file")
        text = f"./{text}"
    try:
        is_plain = all(parser.parse_string(text) == text for parser in (YAMLParser, JSONParser))
    except yaml.YAMLError:
        is_plain = False
    return text if is_plain else json.dumps(text, ensure_ascii=False)


# --- from words to settings ---


def check_names(command: str, given: Arguments) -> None:
    """Refuse mistyped names without a dot before LeRobot is imported, which takes eight seconds.

    LeRobot's own names are read from the source of its configuration, together with some that `translate` refuses.
    """
    source = Path(str(metadata.distribution("lerobot").locate_file(f"lerobot/configs/{command}.py")))
    if source.is_file():
        names = re.findall(r"^    (\w+):", source.read_text(encoding="utf-8"), re.MULTILINE)
        known = [*SHORT_FORMS[command], *OPTIONS[command], RECIPE, CONFIG_FILE, *names]
        for key, _ in given.pairs:
            if "." not in key and key not in known:
                raise MemobenchError(f"lerobot {command} has no setting {key!r}, {nearest(key, known)}")


def read_arguments(command: str, given: Arguments) -> LerobotArguments:
    """Return the arguments of LeRobot's command of that name for a command line.

    Those of ``eval`` and ``train`` are checked; those of other commands are passed on.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    if command not in SHORT_FORMS:
        return LerobotArguments({}, others=(*given.flags, *(f"--{key}={value}" for key, value in given.pairs)))
    from lerobot.configs.eval import EvalPipelineConfig
    from lerobot.configs.train import TrainPipelineConfig

    load_plugins(given)
    config = EvalPipelineConfig if command == "eval" else TrainPipelineConfig
    return translate(command, given, config, read_config_file(given.value(CONFIG_FILE)))


def translate(command: str, given: Arguments, config: type, file: Mapping[str, Any]) -> LerobotArguments:
    """Turn a command line into LeRobot's arguments. Of a repeated key the last value counts.

    Args:
        command: ``eval`` or ``train``.
        config: the configuration class of the command.
        file: content of the file named by ``config_path``; it may hold the policy and the environment.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    values: dict[str, str | None] = {}
    for flag in given.flags:
        key, equals, value = flag.partition("=")
        if key.startswith("--") and flag != "--help":
            values[key.removeprefix("--")] = value if equals else None
    choices = registries(config)
    choosing = {*choices, *({DATASET} & field_types(config).keys())}
    for key, value in given.pairs:
        section, _, name = key.rpartition(".")
        if key in choosing:
            for one in CHOICE_KEYS[:2]:
                values.pop(f"{key}.{one}", None)
            values |= choice_settings(config, key, value)
        elif section in choices and name in CHOICE_KEYS:
            values[key] = value
    # The fields of the policy and the environment are known once these are, wherever they appear in the line.
    found = {key: chosen_class(config, key, values, file) for key in choices}
    chosen = {key: choice for key, choice in found.items() if choice is not None}
    known, short = setting_types(config, chosen), SHORT_FORMS[command]
    for key, value in given.pairs:
        if key in choosing or (key in values and key.rpartition(".")[2] in CHOICE_KEYS):
            continue
        # replan= sets the policy's interval and the environment's, for the log; either may not exist.
        fields = [each for each in short.get(key, ()) if each in known]
        if key in short and not fields:
            owner, _, name = short[key][0].partition(".")
            if owner in chosen:
                raise MemobenchError(f"{key}= sets {owner}.{name}, and {chosen[owner].__name__} has no such field")
            raise MemobenchError(f"{key}= sets {name} of the {owner}: name one with {owner}=")
        try:
            values |= {each: checked_value(key, setting_type(known, each), value) for each in fields or [key]}
        except KeyError:
            keys = [*known, *short, *OPTIONS[command]]
            raise MemobenchError(f"lerobot {command} has no setting {key!r}, {nearest(key, keys)}") from None
    others = tuple(flag for flag in given.flags if flag == "--help" or not flag.startswith("--"))
    return LerobotArguments(values, config, chosen, others)


def with_file(given: Arguments, file: Mapping[str, Any], config: type) -> Arguments:
    """Return a command line with the settings of a configuration file that it does not set itself.

    LeRobot would read the file beneath the line, where the benchmark's defaults would hide it.
    """
    named = {key for key in registries(config) if any(given.value(k) for k in (key, f"{key}.type", f"{key}.path"))}
    hidden = {name for key in named for name in (key, f"{key}.type", f"{key}.path")}
    found = flattened(file, setting_types(config, {}))
    pairs = [(key, value) for key, value in found if key not in hidden and given.value(key) is None]
    return replace(given, pairs=[*pairs, *given.pairs])


def flattened(file: Mapping[str, Any], known: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Yield key and value, as typed, of each setting in the content of a configuration file."""
    for name, value in file.items():
        key = f"{before}{name}"
        kind = without_none(known.get(key, Any))
        if isinstance(value, Mapping) and dataclasses.is_dataclass(kind):
            yield from flattened(value, known, f"{key}.")
        else:
            yield key, value if isinstance(value, str) else json.dumps(value)


# --- values of policy=, env=, dataset= …: a registered type, a checkpoint, a repository, a folder ---


def choice_settings(config: type, key: str, value: str) -> dict[str, str]:
    """Return the settings for a choice such as ``policy=``, of a command with this configuration.

    Raises:
        MemobenchError: it does not exist, with near names.
    """
    if not value:
        raise MemobenchError(f"{key}= is empty; expected a name")
    if key == DATASET:
        return dataset_settings(value)
    known = registries(config)[key]
    path = checkpoint_of(value, known) if key == "policy" else None
    if path is not None:
        return {"policy.path": path}
    if value not in known:
        others = shipped_policies() if key == "policy" else {}
        raise MemobenchError(f"there is no {key} {value!r}, {nearest(value, [*known, *others])}")
    return {f"{key}.type": value}


def checkpoint_of(value: str, known: Collection[str]) -> str | None:
    """Return the checkpoint folder or the repository that ``policy=`` names; None where it names a type.

    A known name has precedence over a folder of that name, which a path such as ``./act`` names.
    """
    folder = None if value in known else checkpoint_folder(value)
    if folder is not None:
        return str(folder)
    if value not in known and (looks_local(value) or Path(value).is_dir()):
        problem = "holds no checkpoint (no config.json)" if Path(value).is_dir() else "does not exist"
        raise MemobenchError(
            f"policy={value}: this folder {problem}; expected a checkpoint such as "
            "outputs/train/<run>/checkpoints/last/pretrained_model, or a policy type"
        )
    return value if "/" in value else None


def dataset_settings(value: str) -> dict[str, str]:
    """Return the settings for ``dataset=``: a folder here, or a repository's id."""
    path = Path(value).expanduser()
    if path.is_dir():
        return {"dataset.repo_id": f"local/{path.resolve().name}", "dataset.root": str(path)}
    if looks_local(value) or "/" not in value:
        raise MemobenchError(
            f"dataset={value}: there is no such folder; expected one that `memobench generate` wrote, "
            "or a repository such as user/name"
        )
    return {"dataset.repo_id": value}


def chosen_class(config: type, key: str, values: Mapping[str, str | None], file: Mapping[str, Any]) -> type | None:
    """Return the class that settings or a configuration file choose for a field such as ``policy``.

    None without a choice, or when a repository is not on this machine.
    """
    known = registries(config)[key]
    path, name = values.get(f"{key}.path"), values.get(f"{key}.type")
    section = file.get(key)
    if not path and not name and isinstance(section, Mapping):
        for word in ("path", "type"):
            if not isinstance(section.get(word), str | None):
                raise MemobenchError(f"found {key}.{word}: {str(section[word])[:80]} in {CONFIG_FILE}; expected a name")
        path, name = section.get("path"), section.get("type")
    if path:
        name = checkpoint_type(path)
    elif name and name not in known:
        raise MemobenchError(f"there is no {key} {name!r}, {nearest(name, known)}")
    return known.get(name) if name else None


# --- recipes and configuration files ---


def recipes() -> dict[str, Path]:
    """Return name -> file of every shipped recipe."""
    folder = Path(str(resources.files("lerobot_memobench") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def recipe_file(value: str) -> Path:
    """Return the file of a recipe: a shipped recipe by its name, or a YAML or JSON file; ``./name`` is a file.

    Raises:
        MemobenchError: it does not exist.
    """
    known = recipes()
    path = Path(value).expanduser()
    if value in known:
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
        # PyYAML also raises errors of dates, numbers and keys.
        problem = " ".join(str(error).split())
        raise MemobenchError(f"{CONFIG_FILE}={given} is neither YAML nor JSON: {problem}") from None
    if not isinstance(content, dict):
        raise MemobenchError(f"{CONFIG_FILE}={given} holds no settings; expected a mapping such as 'policy: …'")
    return content


# --- names, types and values of settings, read from dataclasses as draccus does ---

CHOICE_KEYS = ("type", "path", "discover_packages_path")
"""Keys of a choice that LeRobot's parser reads besides its fields: ``--policy.type``."""
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
    """Return field -> name -> class of the types that may be chosen for it, such as for ``policy``."""
    return {
        key: {str(name): choice for name, choice in kind.get_known_choices().items()}
        for key, kind in ((name, without_none(annotation)) for name, annotation in field_types(config).items())
        if is_choice_type(kind)
    }


def setting_types(config: type, chosen: Mapping[str, type], before: str = "") -> dict[str, Any]:
    """Return dotted key -> type of each setting, sections and choices among them.

    Args:
        chosen: dotted key of a choice (``policy``) -> the class chosen for it.
    """
    found: dict[str, Any] = {}
    for name, annotation in field_types(config).items():
        key, kind = before + name, without_none(annotation)
        if is_choice_type(kind):
            found |= {f"{key}.{word}": str for word in CHOICE_KEYS}
            annotation = kind = chosen.get(key, kind)
        found[key] = annotation
        if has_settings(kind):
            found |= setting_types(kind, chosen, key + ".")
    return found


def has_settings(kind: Any) -> bool:
    """Return whether a type is a section: a dataclass whose fields are settings of their own."""
    return dataclasses.is_dataclass(kind) and not is_choice_type(kind)


def setting_type(known: Mapping[str, Any], key: str) -> Any:
    """Return the type of one of the `setting_types`; ``Any`` where LeRobot's parser alone decides.

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
        inner = key.removeprefix(owner)[1:]
        raise MemobenchError(f"found {key}=; {owner} is one mapping: give {owner}='{{\"{inner}\": …}}'")
    if has_settings(kind) or kind in (*PLAIN, str) or is_literal(kind) or is_enum(kind):
        raise KeyError(key)
    return Any


def checked_value(key: str, annotation: Any, text: str) -> str:
    """Return ``text`` as LeRobot's parser reads it, after a check against the field's type.

    Raises:
        MemobenchError: the field cannot have this value.
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
        first = next(iter(field_types(kind)))
        raise MemobenchError(f"{key}={text[:80]}: {key} holds settings; expected one of them, such as {key}.{first}=")
    if typing.get_origin(kind) is dict:
        try:
            found = yaml.safe_load(text)
        except yaml.YAMLError:
            found = None
        if not isinstance(found, dict):
            raise MemobenchError(f'{key}={text[:80]}: expected a mapping, such as {key}=\'{{"name": "other"}}\'')
        return json.dumps(found, default=str)  # next to a checkpoint LeRobot reads JSON only
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
    """Return the truth value of an option; false where it is not given."""
    return text is not None and checked_value(key, bool, text) == "true"
