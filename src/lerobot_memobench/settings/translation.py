"""From ``key=value`` to LeRobot's flags: ``policy=memobench_mem align=contrastive`` and the like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_memobench.cli import fields
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.checkpoint import checkpoint_folder, checkpoint_type, looks_local

#: Short form -> the fields it sets, of which those that exist are set. ``policy``, ``env`` and ``dataset``
#: are special.
SHORT_FORMS: dict[str, dict[str, tuple[str, ...]]] = {
    "eval": {
        "align": ("policy.align",),
        "size": ("policy.size",),
        "device": ("policy.device",),
        "replan": ("policy.n_action_steps", "env.replan_steps"),
        "host": ("policy.host",),
        "port": ("policy.port",),
        "dialect": ("policy.dialect",),
        "tasks": ("env.tasks",),
        "referent": ("env.referent",),
        "prompt_video": ("env.prompt_video",),
        "horizon": ("env.horizon",),
        "episodes": ("eval.n_episodes",),
        "batch_size": ("eval.batch_size",),
    },
    "train": {
        "align": ("policy.align",),
        "size": ("policy.size",),
        "device": ("policy.device",),
        "replan": ("policy.n_action_steps", "env.replan_steps"),
        "tasks": ("env.tasks",),
        "referent": ("env.referent",),
        "episodes": ("dataset.episodes",),
    },
}

#: Short forms that choose something rather than set a field.
CHOOSING = ("policy", "env", "dataset")

#: Words of `lerobot eval env=memobench` that are no settings of LeRobot's: how it is run (see `orders`).
EVALUATION_WORDS = ("resume", "shard", "shards", "workers", "executor", "executor_option")


@dataclass
class Words:
    """A command line after ``lerobot <name>``, taken apart.

    Attributes:
        settings: (key, value) of every ``key=value``, in order.
        flags: everything from ``--…`` on, untouched, values in words of their own included.
    """

    settings: list[tuple[str, str]] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)

    @property
    def wants_help(self) -> bool:
        return any(flag in ("-h", "--help") for flag in self.flags)


def split_words(words: Sequence[str]) -> Words:
    """Take a command line apart; a word that is neither ``key=value`` nor a flag nor a flag's value is an
    error.
    """
    result = Words()
    after_flag = False  # the word before was `--flag` without `=`: this one may be its value
    for word in words:
        if word.startswith("-") and word != "-":
            result.flags.append(word)
            after_flag = word.startswith("--") and "=" not in word
            continue
        key, equals, value = word.partition("=")
        if after_flag:
            result.flags.append(word)
        elif equals and key.replace("_", "").replace(".", "").replace("-", "").isalnum():
            result.settings.append((key, value))
        else:
            raise MemobenchError(f"found {word!r} among the arguments; expected key=value or --flag=value")
        after_flag = False
    return result


def flag_value(flags: Sequence[str], key: str) -> str | None:
    """Return the value of ``--key`` among flags, in either spelling; the last one counts."""
    found = None
    for k, flag in enumerate(flags):
        if flag.startswith(f"--{key}="):
            found = flag.split("=", 1)[1]
        elif flag == f"--{key}" and k + 1 < len(flags) and not flags[k + 1].startswith("--"):
            found = flags[k + 1]
    return found


def has_flag(flags: Sequence[str], key: str) -> bool:
    """Return whether ``--key`` is given, with or without a value."""
    return any(flag == f"--{key}" or flag.startswith(f"--{key}=") for flag in flags)


def without_flag(flags: Sequence[str], key: str) -> list[str]:
    """Return the flags without ``--key`` and its value, in either spelling."""
    kept, value_follows = [], False
    for flag in flags:
        if value_follows and not flag.startswith("--"):
            value_follows = False
            continue
        value_follows = flag == f"--{key}"
        if not value_follows and not flag.startswith(f"--{key}="):
            kept.append(flag)
    return kept


@dataclass
class Translation:
    """LeRobot's flags for a command line, and what it chooses.

    Attributes:
        flags: what LeRobot's command is called with.
        config: the command's configuration class; None for a command that has none (plain argparse).
        chosen: ``policy`` and ``env`` -> the class chosen for them.
    """

    flags: list[str]
    config: type | None = None
    chosen: dict[str, type] = field(default_factory=dict)

    def get(self, key: str) -> str | None:
        return flag_value(self.flags, key)

    def has(self, key: str) -> bool:
        return has_flag(self.flags, key)

    def add(self, key: str, value: object) -> None:
        """Set a field that the user has not set."""
        if not self.has(key):
            text = str(value).lower() if isinstance(value, bool) else str(value)
            self.flags.append(f"--{key}={text}")

    def set(self, key: str, value: object) -> None:
        """Set a field, whatever the user has set."""
        self.flags = without_flag(self.flags, key)
        self.add(key, value)


def translate(command: str, words: Words, config: type | None, file: Mapping[str, Any]) -> Translation:
    """Turn a command line into LeRobot's flags.

    Args:
        command: LeRobot's command without ``lerobot-``. config: the configuration class of the command, None
            when it has none. file: content of the file named by ``config_path``, {} without one; it may hold
            the policy and the environment.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    result = Translation(list(words.flags), config)
    if config is None:
        result.flags += [f"--{key}={value}" for key, value in words.settings]
        return result
    choosing = [(key, value) for key, value in words.settings if key in CHOOSING and _has(config, key)]
    others = [(key, value) for key, value in words.settings if (key, value) not in choosing]
    for key, value in choosing:
        result.flags += _choose(config, key, value)
    # Fields of the policy and the environment are known once these are, wherever they stand in the line.
    explicit = [*result.flags, *(f"--{key}={value}" for key, value in others)]
    for key in ("policy", "env"):
        if _has(config, key):
            choice = _chosen_class(config, key, explicit, file)
            if choice is not None:
                result.chosen[key] = choice
    for key, value in others:
        result.flags += _set(command, result, key, value)
    return result


def _has(config: type, key: str) -> bool:
    return key in fields.field_types(config)


def _choose(config: type, key: str, value: str) -> list[str]:
    """Return the flags for ``policy=``, ``env=`` or ``dataset=``."""
    if not value:
        raise MemobenchError(f"{key}= is empty; name a {key}")
    if key == "dataset":
        return dataset_flags(value)
    known = fields.registry(config, key)
    if key == "policy":
        folder = checkpoint_folder(value)
        if folder is not None:
            return [f"--policy.path={folder}"]
        if value not in known and (looks_local(value) or Path(value).is_dir()):
            what = "holds no checkpoint (no config.json)" if Path(value).is_dir() else "does not exist"
            raise MemobenchError(
                f"policy={value}: this folder {what}; expected a checkpoint such as "
                "outputs/train/<run>/checkpoints/last/pretrained_model, or a policy type"
            )
        if "/" in value:
            return [f"--policy.path={value}"]
    if value not in known:
        raise MemobenchError(f"there is no {key} {value!r}, {nearest(value, known)}")
    return [f"--{key}.type={value}"]


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


def _chosen_class(config: type, key: str, flags: Sequence[str], file: Mapping[str, Any]) -> type | None:
    """Return the class that is chosen for ``policy`` or ``env``, None when none is or when it is not known
    here.
    """
    known = fields.registry(config, key)
    path = flag_value(flags, f"{key}.{fields.PATH_KEY}")
    name = flag_value(flags, f"{key}.type")
    section = file.get(key)
    if not path and not name and isinstance(section, Mapping):
        path, name = section.get("path"), section.get("type")
    if path:
        name = checkpoint_type(path)
    elif name and name not in known:
        raise MemobenchError(f"there is no {key} {name!r}, {nearest(name, known)}")
    return known.get(name) if name else None


def _set(command: str, so_far: Translation, key: str, value: str) -> list[str]:
    """Return the flags that set one field."""
    config = so_far.config
    assert config is not None
    chosen = so_far.chosen.get
    targets = SHORT_FORMS.get(command, {}).get(key)
    if targets is None:
        try:
            annotation = fields.annotation_of(config, key, chosen)
        except KeyError:
            known = [*CHOOSING, *SHORT_FORMS.get(command, {}), *fields.all_keys(config, chosen)]
            known += EVALUATION_WORDS if command == "eval" else ()
            raise MemobenchError(f"lerobot {command} has no setting {key!r}, {nearest(key, known)}") from None
        return [f"--{key}={fields.checked_value(key, annotation, value)}"]
    found = []
    for target in targets:
        # replan= sets the policy's interval and tells the environment, which writes it down; either may be
        # missing.
        try:
            annotation = fields.annotation_of(config, target, chosen)
        except (KeyError, MemobenchError):
            continue
        found.append(f"--{target}={fields.checked_value(key, annotation, value)}")
    if found:
        return found
    owner, _, name = targets[0].partition(".")
    if owner in so_far.chosen:
        kind = so_far.chosen[owner]
        raise MemobenchError(f"{key}= sets {targets[0]}, which this {owner} ({kind.__name__}) does not have")
    raise MemobenchError(f"{key}= sets {name} of the {owner}: name one with {owner}=")
