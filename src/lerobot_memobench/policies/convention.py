"""Choose the convention of pictures (`sim.convention`) for a checkpoint: that of its training; refuse any other.

The names of the cameras in its training data decide, then the dataset on this machine, then its repository. They do not
depend on the ``rename_map`` of an evaluation.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from lerobot.utils.constants import OBS_IMAGES

from lerobot_memobench.datasets.episodes import read_info
from lerobot_memobench.datasets.layout import INFO_FILE
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.policies.checkpoint import statistics_shapes, trained_names, training_of
from lerobot_memobench.policies.compatibility import cameras_read
from lerobot_memobench.sim.convention import MIRRORED, UPRIGHT, WRIST, convention_of

logger = logging.getLogger(__name__)

OF_LIBERO = ("lerobot/", "HuggingFaceVLA/", "physical-intelligence/")
"""Owners of LIBERO's data on the hub. Other datasets of that name may be of this package."""


def trained_convention(path: str, policy: Any) -> tuple[str | None, str]:
    """Return the convention of a checkpoint (folder or repository), None if it is unclear, and what shows it."""
    in_data = {new: old for old, new in trained_names(path).items()}
    cameras = [in_data.get(name, name) for name in cameras_read(policy, statistics_shapes(path))]
    has = {convention: f"{OBS_IMAGES}.{wrist}" in cameras for convention, wrist in WRIST.items()}
    given = training_of(path).get("dataset") or {}
    root, name = given.get("root") or "", given.get("repo_id") or ""
    why = f"cameras {', '.join(cameras)}; dataset {name or 'unknown'}"
    if has[MIRRORED]:
        return MIRRORED, why
    if root and os.path.isfile(os.path.join(root, INFO_FILE)):  # pathlib raises at names that are too long
        with suppress(MemobenchError):
            if (stated := convention_of(read_info(Path(root))["features"])) is not None:
                return stated, why
    if "libero" in name.lower():
        return (None if has[UPRIGHT] and not name.startswith(OF_LIBERO) else MIRRORED), why
    return (UPRIGHT if has[UPRIGHT] else None), why


def chosen_convention(
    path: str | None, policy: Any, asked: str | None, rename_map: Mapping[str, str] | None = None
) -> str | None:
    """Return the convention of the pictures for a policy: the one that was asked for, else that of its training.

    None if none was and the policy reads no pictures, or has no checkpoint.

    Args:
        path: folder or repository of its checkpoint, or None. policy: its configuration.
        asked: the convention that was named, None if none was.
        rename_map: of the evaluation. It may name the wrist camera of a convention, but it does not mirror pictures.

    Raises:
        MemobenchError: another one than the policy's was asked for, or none was and the policy's is unclear; it names
            the commands that run it.
    """
    if asked is not None:
        check_choice("convention", asked, [*WRIST])
    found: str | None = UPRIGHT
    if getattr(policy, "uses_detector", False):
        why = "its detector reads them"
    elif path is None or not policy.image_features:
        return asked
    else:
        found, why = trained_convention(path, policy)
    name = path or policy.type
    command = f"lerobot eval env=memobench policy={name} convention="
    if found is None and asked is None:
        raise MemobenchError(
            f"the policy {name} may expect upright pictures or mirrored ones as LIBERO's ({why}); run "
            f"`{command}{UPRIGHT}` or `{command}{MIRRORED}`, with lerobot-eval --env.convention="
        )
    mapped = [convention for convention, wrist in WRIST.items() if f"{OBS_IMAGES}.{wrist}" in (rename_map or {})]
    for other in (asked, *mapped):
        if found is not None and other not in (None, found):
            where = "" if other == asked else " in rename_map, which does not mirror pictures"
            raise MemobenchError(
                f"the policy {name} expects pictures of convention={found} ({why}), and found {other}{where}; run "
                f"`{command}{found}`, or `lerobot-eval --env.type=memobench --policy.path={name} "
                f"--env.convention={found}`"
            )
    if asked is None and found != UPRIGHT:
        logger.warning("pictures have convention=%s, as in the training of %s (%s)", found, name, why)
    return asked or found
