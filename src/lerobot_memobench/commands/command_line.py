"""Read command lines of LeRobot as typed configurations: ``lerobot train policy=memobench_mem align=contrastive``.

``key=value`` words and ``--key=value`` flags become nested settings: short forms get LeRobot's names, ``policy=``,
``env=`` and ``dataset=`` choose, and ``config=`` names a recipe, whose settings the command line overrides. Texts
become values by the types of LeRobot's configuration classes; draccus builds these from the values.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import typing
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
import yaml
from draccus.utils import DecodingError, ParsingError, is_choice_type, is_enum, is_literal, is_union

from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError, chain, cut, nearest, short
from lerobot_memobench.policies.checkpoint import (
    TRAIN_CONFIG,
    check_checkpoint,
    check_sizes,
    checkpoint_folder,
    checkpoint_settings,
    checkpoint_type,
    looks_local,
    quiet,
    shipped_policies,
)

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

Settings = dict[str, Any]
"""Nested settings: name -> text of a command line, value of a file, or the settings of a section."""

RECIPE, CONFIG_FILE = "config", "config_path"  # our key and LeRobot's for a configuration file
DATASET = "dataset"
PATH, TYPE, PACKAGES = "path", "type", "discover_packages_path"
"""Keys of a choice that LeRobot's parser reads besides its fields: ``--policy.type``."""
HELP = "help"

OF_POLICY = ("align", "size", "perception", "detector", "visual_encoder", "device")
OF_ENVIRONMENT = ("tasks", "task", "task_ids", *(setting.name for setting in fields(EnvSettings)))
COMMON: dict[str, tuple[str, ...]] = {
    **{key: (f"policy.{key}",) for key in OF_POLICY},
    **{key: (f"env.{key}",) for key in OF_ENVIRONMENT},
    "replan": ("policy.n_action_steps", "env.replan_steps"),
}
SHORT_FORMS: dict[str, dict[str, tuple[str, ...]]] = {
    "eval": {
        **COMMON,
        **{key: (f"policy.{key}",) for key in ("host", "port", "dialect")},
        **{"episodes": ("eval.n_episodes",), "batch_size": ("eval.batch_size",)},
    },
    "train": {**COMMON, "episodes": ("dataset.episodes",)},
}
"""Command -> short form -> the fields it sets, as far as they exist. `cli/lerobot.py` explains them."""
RUN_OPTIONS = ("split", "memory_reads", "resume", "shard", "shards", "workers")
"""Keys of `lerobot eval env=memobench` that LeRobot does not have (`plan.RunOptions`)."""
TRAINING_OPTIONS = ("prompt_frames", "obs_type")
"""Keys of `lerobot train` that LeRobot does not have (`training.command.TrainingOptions`)."""
OPTIONS = {"eval": RUN_OPTIONS, "train": TRAINING_OPTIONS}


# --- words ---


def parse_words(line: Sequence[str]) -> dict[str, str]:
    """Return key -> text of ``key=value``, ``--key=value`` and ``--key value``; ``--flag`` is ``true``.

    Of a repeated key the last value counts; a word of another form is refused.
    """
    words: dict[str, str] = {}
    open_flag: str | None = None  # the previous word was `--flag` without `=`: this word may be its value
    for word in line:
        key, equals, value = word.removeprefix("--").partition("=")
        if word == "-h":
            key, value = HELP, "true"
        elif word.startswith("--") and len(word) > 2:
            value = value if equals else "true"
        elif not (equals and re.fullmatch(r"[\w.-]*\w[\w.-]*", key) and not key.startswith("-")):
            if open_flag is None or re.match(r"-[^\d.]", word):
                raise MemobenchError(f"found {word!r} among the arguments; expected key=value or --flag=value")
            key, value = open_flag, word
        open_flag = key if word.startswith("--") and not equals else None
        words.pop(key, None)  # the order of keys is that of their last values
        words[key] = value
    return words


def as_command_line(words: Mapping[str, Any]) -> list[str]:
    """Return words as a command line."""
    return [f"{key}={value}" for key, value in words.items()]


def without[T](words: Mapping[str, T], *keys: str) -> dict[str, T]:
    """Return words without these keys."""
    return {key: value for key, value in words.items() if key not in keys}


def check_names(command: str, words: Collection[str]) -> None:
    """Refuse mistyped names without a dot, also before LeRobot is imported, which takes eight seconds.

    LeRobot's own names are read from the source of its configuration. The error names the nearest known one.
    """
    source = Path(str(metadata.distribution("lerobot").locate_file(f"lerobot/configs/{command}.py")))
    if source.is_file():
        names = re.findall(r"^    (\w+):", source.read_text(encoding="utf-8"), re.MULTILINE)
        known = [*SHORT_FORMS[command], *OPTIONS[command], RECIPE, CONFIG_FILE, HELP, *names]
        for key in words:
            if "." not in key and key not in known:
                raise MemobenchError(f"lerobot {command} has no setting {short(key)}, {nearest(key, known)}")


def is_of_benchmark(words: Mapping[str, str]) -> bool:
    """Return whether a command line of `lerobot eval`, or its configuration file, names the benchmark."""
    section = read_config_file(words.get(CONFIG_FILE)).get("env")
    in_file = section.get(TYPE) if isinstance(section, Mapping) else section
    return words.get("env", words.get(f"env.{TYPE}") or in_file) == "memobench"


# --- from words to settings ---


@dataclass(frozen=True)
class CommandSettings:
    """The settings of one of LeRobot's commands, as a command line and its configuration file ask for them."""

    config: type  # the command's configuration class
    words: Mapping[str, Any]  # LeRobot's full name of each setting on the command line -> its text or value
    file: Settings = field(default_factory=dict)  # settings of the configuration file
    config_path: str | None = None  # path or repository of that file
    begun: Any = None  # configuration of the training whose checkpoint the file is

    @cached_property
    def settings(self) -> Settings:
        """All settings; the command line overrides the file."""
        return merged(self.file, nested(self.words))

    def get(self, key: str) -> Any:
        """Return the text or value of a setting, None without one."""
        value: Any = self.settings
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value

    def default(self, key: str, value: object) -> CommandSettings:
        """Return settings with a value, unless one is given."""
        return replace(self, file=merged(nested({key: value}), self.file))

    def build(self) -> Any:
        """Return the configuration; download that of a checkpoint in a repository. Errors as of `build_config`."""
        return build_config(self.config, self.settings)

    def build_field(self, name: str) -> Any:
        """Return the value of a field of the configuration, None where it is not given. Errors as of `build_config`."""
        value = self.settings.get(name)
        return None if value is None else build_config(field_types(self.config)[name], value, name)


def read_words(command: str, words: Mapping[str, str]) -> CommandSettings:
    """Return the settings that the words of ``lerobot eval`` or ``lerobot train`` ask for."""
    from lerobot.configs.eval import EvalPipelineConfig
    from lerobot.configs.train import TrainPipelineConfig

    load_plugins(words)
    config = EvalPipelineConfig if command == "eval" else TrainPipelineConfig
    choices = registries(config)
    config_path = words.get(CONFIG_FILE)
    begun = _begun_training(config, config_path)
    file = read_config_file(config_path) if begun is None else draccus.encode(begun)
    resolved: dict[str, Any] = {}
    for key in choices:  # `policy: act` in a file is `policy=act`
        if isinstance(file.get(key), str):
            file[key] = nested(choice_settings(config, key, file[key]))[key]
    for key, value in words.items():
        if key in choices or (key == DATASET and DATASET in field_types(config)):
            resolved = without(resolved, f"{key}.{TYPE}", f"{key}.{PATH}") | choice_settings(config, key, value)
        elif not key.endswith(f".{PACKAGES}") and key not in (CONFIG_FILE, HELP):
            resolved[key] = value
    for key in choices:
        choice = {name: resolved[option] for name in (TYPE, PATH) if (option := f"{key}.{name}") in resolved}
        stored = file.get(key)
        if choice and isinstance(stored, Mapping) and {TYPE, PATH} & {*stored} and not choice.items() <= stored.items():
            del file[key]  # settings of another choice
    if "dataset.repo_id" in resolved and isinstance(file.get(DATASET), Mapping):
        file[DATASET] = without(file[DATASET], "root", "repo_id")
    check_names(command, resolved)
    requested, short = CommandSettings(config, resolved, file, config_path, begun), SHORT_FORMS[command]
    full: dict[str, Any] = {}
    for key, value in resolved.items():
        if key not in short or key in field_types(config):
            full[key] = value
            continue
        # replan= sets the policy's interval and the environment's, for the log; either may not exist.
        kinds = {name: kind for name in short[key] if (kind := setting_kind(requested, name)) is not None}
        if not kinds:
            section, _, name = short[key][0].partition(".")
            if (chosen := class_of_section(requested, section)) is None:
                raise MemobenchError(f"{key}= sets {name} of the {section}: name one with {section}=")
            raise MemobenchError(f"{key}= sets {section}.{name}, and {chosen.__name__} has no such field")
        full |= {name: value_of(key, kind, value) for name, kind in kinds.items()}
    return replace(requested, words=full)


def setting_kind(requested: CommandSettings, key: str) -> Any:
    """Return the type of a setting of this full name, None where the choices that are made have none."""
    section, _, name = key.partition(".")
    chosen = class_of_section(requested, section)
    return None if chosen is None else field_types(chosen).get(name)


def class_of_section(requested: CommandSettings, section: str) -> type | None:
    """Return the class of a section's settings, None where its choice is not made."""
    kind: Any = without_none(field_types(requested.config)[section])
    return chosen_class(kind, section, requested.get(section) or {}) if is_choice_type(kind) else kind


def nested(words: Mapping[str, Any]) -> Settings:
    """Return ``policy.align`` -> value as ``{"policy": {"align": value}}``; refuse values of a section itself."""
    settings: Settings = {}
    for key, value in words.items():
        *sections, last = key.split(".")
        node = settings
        for part in sections:
            node = node.setdefault(part, {})
            if not isinstance(node, dict):
                raise MemobenchError(f"found {key}= and {part}={words.get(part, '')}; give one of them")
        if isinstance(node.get(last), dict):
            raise MemobenchError(f"found {key}={str(value)[:80]} and {key}.{next(iter(node[last]))}=; give one of them")
        node[last] = value
    return settings


def merged(*layers: Mapping[str, Any]) -> Settings:
    """Return nested settings of several layers; of a setting in several of them the last one counts."""
    settings: Settings = {}
    for layer in layers:
        if not isinstance(layer, Mapping):
            raise MemobenchError(f"found {short(layer)} in the place of settings; expected name=value")
        for key, value in layer.items():
            both = isinstance(value, Mapping) and isinstance(settings.get(key), Mapping)
            settings[key] = merged(settings[key], value) if both else value
    return settings


# --- values of policy=, env=, dataset= …: a registered type, a checkpoint, a repository, a folder ---


def choice_settings(config: type, key: str, value: str) -> dict[str, str]:
    """Return the settings for a choice such as ``policy=``; the error of an unknown one has near names."""
    if not value:
        raise MemobenchError(f"{key}= is empty; expected a name")
    if key == DATASET:
        return dataset_settings(value)
    known = registries(config)[key]
    path = checkpoint_of(value, known) if key == "policy" else None
    if path is not None:
        return {f"policy.{PATH}": path}
    if value not in known:
        shipped = shipped_policies() if key == "policy" else {}
        raise MemobenchError(f"there is no {key} {value!r}, {nearest(value, [*known, *shipped])}")
    return {f"{key}.{TYPE}": value}


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


def chosen_class(kind: Any, name: str, section: Mapping[str, Any]) -> type | None:
    """Return the class that the settings of a choice name, by ``path`` or ``type``; None without one.

    ``kind`` is the base class, ``name`` that of the choice in messages. An unregistered type is refused.
    """
    known = registered(kind)
    chosen = section.get(TYPE)
    if (path := section.get(PATH)) is not None:
        if not isinstance(path, str):
            raise MemobenchError(f"found {name}.{PATH}={str(path)[:80]}; expected a name")
        chosen = checkpoint_type(path)
        if chosen not in known:
            raise MemobenchError(
                f"the checkpoint {path} is of policy type {short(chosen)}, which no installed package registers; "
                "install the package that trained it"
            )
    if chosen is None:
        return None
    if not isinstance(chosen, str):
        raise MemobenchError(f"found {name}.{TYPE}={str(chosen)[:80]}; expected a name")
    if chosen not in known:
        raise MemobenchError(f"there is no {name} {short(chosen)}, {nearest(chosen, known)}")
    return known[chosen]


@cache
def register_plugins() -> None:
    """Let LeRobot find its plugins as its own commands do, once per process, without its log lines."""
    from lerobot.utils.import_utils import register_third_party_plugins

    with quiet():
        register_third_party_plugins()


def load_plugins(words: Mapping[str, str] | None = None) -> None:
    """Register LeRobot's plugins, and import the packages that ``…discover_packages_path`` names."""
    import lerobot.envs
    import lerobot.policies
    import lerobot.rewards  # noqa: F401 - they register LeRobot's own types
    from lerobot.configs import parser

    register_plugins()
    for key, value in (words or {}).items():
        if key.endswith(f".{PACKAGES}"):
            try:
                parser.load_plugin(value)
            except Exception as error:  # a plug-in may raise anything
                raise MemobenchError(f"{key}={value} cannot be imported as a package ({error})") from None


# --- recipes and configuration files ---


def recipes() -> dict[str, Path]:
    """Return name -> file of every shipped recipe."""
    folder = Path(str(resources.files("lerobot_memobench") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def recipe_file(value: str) -> Path:
    """Return the existing file of a recipe: a shipped one by its name, else YAML or JSON; ``./name`` is a file."""
    known = recipes()
    path = Path(value).expanduser()
    if value in known:
        return known[value]
    if path.is_file():
        return path
    if "/" in value or path.suffix:
        raise MemobenchError(f"{RECIPE}={value}: there is no such file; name a shipped recipe or a YAML file")
    raise MemobenchError(f"there is no recipe {value!r}, {nearest(value, known)}")


def resolve_recipe(words: Mapping[str, str]) -> dict[str, str]:
    """Replace ``config=<recipe>`` by LeRobot's ``config_path=<file>``."""
    if RECIPE not in words:
        return dict(words)
    if CONFIG_FILE in words:
        raise MemobenchError(f"{RECIPE}={words[RECIPE]}: name one recipe, either by {RECIPE}= or by {CONFIG_FILE}=")
    return {CONFIG_FILE: str(recipe_file(words[RECIPE])), **without(words, RECIPE)}


def read_config_file(config_path: str | None) -> Settings:
    """Return the content of the local file ``config_path``, {} without one; refuse other content than settings."""
    if config_path is None:
        return {}
    path = Path(config_path).expanduser()
    if path.is_dir():
        path = path / TRAIN_CONFIG
    if not path.is_file():
        if looks_local(config_path) or path.suffix in (".yaml", ".yml", ".json"):
            raise MemobenchError(f"{CONFIG_FILE}={config_path}: there is no such file")
        return {}  # a repository: LeRobot fetches it
    try:
        content = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise MemobenchError(f"{CONFIG_FILE}={config_path} cannot be read ({error.strerror or error})") from None
    except (yaml.YAMLError, ValueError, TypeError, KeyError, RecursionError, AttributeError) as error:
        # PyYAML also raises errors of dates, numbers and keys.
        problem = " ".join(str(error).split())
        raise MemobenchError(f"{CONFIG_FILE}={config_path} is neither YAML nor JSON: {problem}") from None
    if not isinstance(content, dict):
        raise MemobenchError(f"{CONFIG_FILE}={config_path} holds no settings; expected a mapping such as 'policy: …'")
    return content


def _begun_training(config: Any, config_path: str | None) -> Any:
    """Return the configuration of the training whose checkpoint a ``config_path`` names, None where it names none."""
    if config_path is None or not hasattr(config, "from_pretrained"):
        return None
    path = Path(config_path).expanduser()
    if path.is_file() and path.name != TRAIN_CONFIG:
        return None
    read_config_file(config_path)  # its errors name the file
    with quiet():  # LeRobot converts settings of its earlier versions
        return config.from_pretrained(path if path.exists() else config_path)


# --- values of the fields of a configuration class ---

PLAIN = {bool: "true or false", int: "a whole number", float: "a number"}
NULLS = ("null", "~")  # texts that stand for no value, as in YAML; for a number or a truth value also `none`


def build_config(annotation: Any, settings: Any, key: str = "") -> Any:
    """Return the configuration of a class with these settings, or the value of a field.

    ``key`` names field or section in messages, "" a command. Errors are those of `value_of` and the configuration's.
    """
    value = value_of(key, annotation, settings)
    try:
        with quiet():
            return draccus.decode(annotation, value)
    except (DecodingError, ParsingError) as error:
        raise _explained(error, key) from error


def _explained(error: Exception, key: str) -> MemobenchError:
    # draccus wraps reasons in reasons: the innermost is the mistake. The configurations' own errors stay as they are.
    reasons = [reason for reason in chain(error) if not isinstance(reason, DecodingError | ParsingError)]
    own = next((reason for reason in reasons if isinstance(reason, MemobenchError)), None)
    if own is not None:
        return own
    for reason in reversed([*chain(error)]):
        if isinstance(reason, DecodingError):
            name = ".".join(part for part in (key, *reason.key_path) if part)
            return MemobenchError(f"{name}: {' '.join(str(reason.message).split())}".removeprefix(": "))
    return MemobenchError(" ".join(str(reasons[-1] if reasons else error).split()))


def typed(kind: Any, settings: Mapping[str, Any], before: str = "") -> Settings:
    """Return nested settings with values of the types of a class's fields instead of texts.

    A choice's ``path`` is replaced by the settings of that checkpoint, which the given ones override. An unknown name
    (the error has the nearest one) and an impossible value are refused.
    """
    beneath: Settings = {}
    if is_choice_type(kind):
        name = before.rstrip(".")
        chosen = chosen_class(kind, name, settings)
        if chosen is None:
            first = short(next(iter(settings), ""))
            raise MemobenchError(f"{before}{first} needs {name}=: name one before its settings")
        beneath[TYPE] = next(key for key, value in registered(kind).items() if value is chosen)
        if (path := settings.get(PATH)) is not None:
            beneath |= {**checkpoint_settings(path), "pretrained_path": path}
        kind = chosen
    return merged(beneath, given_values(kind, settings, before))


def given_values(kind: Any, settings: Mapping[str, Any], before: str) -> Settings:
    """Return the values of settings of a class's fields, without ``path`` and ``type``. Errors as of `typed`."""
    known, values = field_types(kind), {}
    for name, value in settings.items():
        if name in known:
            values[name] = value_of(before + name, known[name], value)
        elif name not in (PATH, TYPE):
            keys = [f"{before}{key}" for key in known]
            given = f"{before}{name}"  # in a file, a name may be null or a number
            raise MemobenchError(f"there is no setting {short(given)}, {nearest(cut(given), keys)}")
    return values


def value_of(key: str, annotation: Any, value: Any) -> Any:
    """Return a value of a field's type for a text, or refuse it; the values of files stay as they are."""
    kind = without_none(annotation)
    is_section = dataclasses.is_dataclass(kind) or is_choice_type(kind)
    if is_section and value in NULLS:
        return None
    if isinstance(value, Mapping):
        if is_section:
            return typed(kind, value, f"{key}." if key else "")
        inner = typing.get_args(kind)[1:] if typing.get_origin(kind) is dict else ()
        if {*inner} & {*PLAIN, str} and any(isinstance(item, Mapping) for item in value.values()):
            name = next(iter(value))
            raise MemobenchError(f"found {key}.{name}=; {key} is one mapping: give {key}='{{\"{name}\": …}}'")
        if kind in (*PLAIN, str, Path) or is_literal(kind) or is_enum(kind):
            inner_key = short(f"{key}.{next(iter(value), '')}")
            raise MemobenchError(f"there is no setting {inner_key}; {key} holds one value")
        return value
    if is_section and value is not None:
        fields = field_types(kind) if dataclasses.is_dataclass(kind) else {TYPE: str}
        raise MemobenchError(
            f"{key}={str(value)[:80]}: {key} holds settings; expected one of them, such as {key}.{next(iter(fields))}="
        )
    text = value.lower() if isinstance(value, str) else value
    is_null = value is None or value in NULLS or (kind in PLAIN and text == "none")  # `align=none` is a text
    if is_null and type(None) in typing.get_args(annotation):
        return None
    if kind in PLAIN:
        if isinstance(value, bool) and kind is not bool:
            raise MemobenchError(f"{key}={value}: expected {PLAIN[kind]}")
        try:
            return draccus.decode(kind, text)
        except (DecodingError, TypeError):
            raise MemobenchError(f"{key}={str(value)[:80]}: expected {PLAIN[kind]}") from None
    if not isinstance(value, str):
        return str(value) if kind is str and type(value) in (int, float) else value
    if is_literal(kind) or is_enum(kind):
        names = [str(choice) for choice in typing.get_args(kind)] or [*kind.__members__]
        if value not in (*names, *(() if is_literal(kind) else (str(member.value) for member in kind))):
            raise MemobenchError(f"{key}={value}: {nearest(value, names)}")
        return value
    if kind in (str, Path):
        return value
    try:
        content = yaml.safe_load(value)
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        content = value
        if value[:1] in "[{" and typing.get_origin(kind) is not dict:
            raise MemobenchError(f"{key}={value[:80]} cannot be read ({problem})") from None
    if typing.get_origin(kind) is dict and not isinstance(content, dict):
        raise MemobenchError(f'{key}={value[:80]}: expected a mapping, such as {key}=\'{{"name": "other"}}\'')
    return value if isinstance(content, str) else content


def field_types(kind: Any) -> dict[str, Any]:
    """Return field name -> annotation of a configuration class."""
    hints = typing.get_type_hints(kind)
    return {item.name: hints[item.name] for item in dataclasses.fields(kind)}


def without_none(annotation: Any) -> Any:
    """Return ``int`` for ``int | None``."""
    parts = [part for part in typing.get_args(annotation) if part is not type(None)]
    return parts[0] if is_union(annotation) and len(parts) == 1 else annotation


def registered(kind: Any) -> dict[str, type]:
    """Return name -> class of the types that are registered for a choice."""
    return {str(name): choice for name, choice in kind.get_known_choices().items()}


def registries(config: type) -> dict[str, dict[str, type]]:
    """Return field -> name -> class of the types that may be chosen for it, such as for ``policy``."""
    kinds = {name: without_none(annotation) for name, annotation in field_types(config).items()}
    return {name: registered(kind) for name, kind in kinds.items() if is_choice_type(kind)}


# --- the policy ---


def policy_config(requested: CommandSettings) -> PreTrainedConfig | None:
    """Return the configuration of the policy, None without one; refuse an incomplete checkpoint."""
    if (path := requested.get(f"policy.{PATH}")) is not None:
        check_checkpoint(path)
    config: PreTrainedConfig | None = requested.build_field("policy")
    if config is not None:
        check_sizes(config)
    return config


# --- LeRobot's own commands ---

COMMAND_PREFIX = "lerobot-"


def lerobot_commands() -> dict[str, metadata.EntryPoint]:
    """Return name -> entry point of every command of the installed LeRobot (``eval``: ``lerobot-eval``)."""
    return {
        entry.name.removeprefix(COMMAND_PREFIX): entry
        for entry in metadata.distribution("lerobot").entry_points
        if entry.group == "console_scripts" and entry.name.startswith(COMMAND_PREFIX)
    }


def call_lerobot(command: str, flags: Sequence[str]) -> int:
    """Run ``lerobot-<command>`` with these flags; return its exit status. Its main function reads ``sys.argv``."""
    try:
        entry = lerobot_commands()[command].load()  # takes many seconds
    except ImportError as error:  # LeRobot was installed without an extra
        raise MemobenchError(f"{COMMAND_PREFIX}{command} needs a package that is not installed: {error}") from error
    before = sys.argv
    sys.argv = [f"{COMMAND_PREFIX}{command}", *flags]
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
