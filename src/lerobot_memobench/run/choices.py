"""What ``policy=``, ``env=`` and ``dataset=`` choose: a registered type, a checkpoint, a repository, a folder."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.checkpoint import (
    checkpoint_folder,
    checkpoint_type,
    folder_with_checkpoint,
    looks_local,
    shipped_policies,
)
from lerobot_memobench.run import fields
from lerobot_memobench.run.flags import flag_value

logger = logging.getLogger(__name__)


def choice_flags(config: type, key: str, value: str) -> list[str]:
    """Return the flags for ``policy=``, ``env=`` or ``dataset=`` of a command with this configuration.

    Raises:
        MemobenchError: there is no such thing, with what is near.
    """
    if not value:
        raise MemobenchError(f"{key}= is empty; name a {key}")
    if key == "dataset":
        return dataset_flags(value)
    known = fields.registry(config, key)
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
    known = fields.registry(config, key)
    path = flag_value(flags, f"{key}.{fields.PATH_KEY}")
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
