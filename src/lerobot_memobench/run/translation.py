"""From ``key=value`` to LeRobot's flags: ``policy=memobench_mem align=contrastive`` and the like."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.run import fields
from lerobot_memobench.run.choices import choice_flags, chosen_class
from lerobot_memobench.run.flags import flag_value, has_flag, without_flag
from lerobot_memobench.run.short_forms import CHOOSING, EVALUATION_WORDS, SHORT_FORMS, TRAINING_WORDS
from lerobot_memobench.run.words import Words


@dataclass(frozen=True)
class LerobotSettings:
    """What one of LeRobot's commands is to be called with. It never changes: other settings are another object.

    Attributes:
        flags: LeRobot's, as its parser reads them.
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
        """Return whether ``--key`` is given."""
        return has_flag(self.flags, key)

    def default(self, key: str, value: object) -> LerobotSettings:
        """Return settings with ``--key=value`` where nobody has set it yet."""
        if self.has(key):
            return self
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return replace(self, flags=(*self.flags, f"--{key}={text}"))

    def changed(self, key: str, value: object) -> LerobotSettings:
        """Return settings with ``--key=value``, whatever was set before."""
        return self.without(key).default(key, value)

    def without(self, *keys: str) -> LerobotSettings:
        """Return settings that say nothing of these keys."""
        flags: list[str] = list(self.flags)
        for key in keys:
            flags = without_flag(flags, key)
        return replace(self, flags=tuple(flags))

    def choosing(self, key: str, name: str) -> LerobotSettings:
        """Return settings whose ``policy`` or ``env`` is of the registered type ``name``, where none is chosen yet."""
        if key in self.chosen or self.config is None:
            return self
        return replace(self, chosen={**self.chosen, key: fields.registry(self.config, key)[name]})


def translate(command: str, words: Words, config: type | None, file: Mapping[str, Any]) -> LerobotSettings:
    """Turn a command line into LeRobot's settings.

    Args:
        command: LeRobot's command without ``lerobot-``. config: the configuration class of the command, None
            when it has none. file: content of the file named by ``config_path``, {} without one; it may hold
            the policy and the environment.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    if config is None:
        return LerobotSettings((*words.flags, *(f"--{key}={value}" for key, value in words.settings)))
    known = fields.field_types(config)
    choosing = [(key, value) for key, value in words.settings if key in CHOOSING and key in known]
    others = [setting for setting in words.settings if setting not in choosing]
    flags = [*words.flags, *(flag for key, value in choosing for flag in choice_flags(config, key, value))]
    # Fields of the policy and the environment are known once these are, wherever they stand in the line.
    explicit = [*flags, *(f"--{key}={value}" for key, value in others)]
    found = {key: chosen_class(config, key, explicit, file) for key in ("policy", "env") if key in known}
    chosen: dict[str, type] = {key: choice for key, choice in found.items() if choice is not None}
    for key, value in others:
        flags += _field_flags(command, config, chosen, key, value)
    return LerobotSettings(tuple(flags), config, chosen)


def _field_flags(command: str, config: type, chosen: Mapping[str, type], key: str, value: str) -> list[str]:
    """Return the flags that set one field, or those that a short form stands for."""
    targets = SHORT_FORMS.get(command, {}).get(key)
    if targets is not None:
        return _short_form_flags(config, chosen, key, value, targets)
    try:
        annotation = fields.annotation_of(config, key, chosen.get)
    except KeyError:
        known = [*CHOOSING, *SHORT_FORMS.get(command, {}), *fields.all_keys(config, chosen.get)]
        known += {"eval": EVALUATION_WORDS, "train": TRAINING_WORDS}.get(command, ())
        raise MemobenchError(f"lerobot {command} has no setting {key!r}, {nearest(key, known)}") from None
    return [f"--{key}={fields.checked_value(key, annotation, value)}"]


def _short_form_flags(
    config: type, chosen: Mapping[str, type], key: str, value: str, targets: tuple[str, ...]
) -> list[str]:
    """Return the flags of those of a short form's fields that exist; at least one must."""
    found = []
    for target in targets:
        # replan= sets the policy's interval and tells the environment, which writes it down; either may be
        # missing.
        try:
            annotation = fields.annotation_of(config, target, chosen.get)
        except (KeyError, MemobenchError):
            continue
        found.append(f"--{target}={fields.checked_value(key, annotation, value)}")
    if found:
        return found
    owner, _, name = targets[0].partition(".")
    if owner in chosen:
        kind = chosen[owner].__name__
        raise MemobenchError(f"{key}= sets {targets[0]}, which this {owner} ({kind}) does not have")
    raise MemobenchError(f"{key}= sets {name} of the {owner}: name one with {owner}=")
