"""What identifies a policy beyond its name: settings, seed, the hash of its checkpoint, what it was trained on."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from lerobot_memobench.envs.acting import ELSEWHERE, checkpoint_files, encoded, tree_hash
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, file_hash, read_json

__all__ = ["checkpoint_files", "encoded", "eyes_hash", "policy_facts", "training_facts", "tree_hash"]


class TrainedOn(TypedDict, total=False):
    """LeRobot's settings of the dataset of a training run."""

    repo_id: str | None
    revision: str | None
    root: str | None
    episodes: list[int] | None


class TrainConfig(TypedDict):
    """What is used of a checkpoint's ``train_config.json``."""

    dataset: TrainedOn
    steps: NotRequired[Count | None]


def policy_facts(settings: Mapping[str, Any], seed: int | None) -> dict[str, Any]:
    """Return what identifies a policy beside its weights: its configuration as LeRobot encodes it, the run's seed.

    Of eyes that are no part of its checkpoint also the hash.

    Raises:
        MemobenchError: there are no such eyes.
    """
    kept = {key: value for key, value in settings.items() if key not in ELSEWHERE and key != "type"}
    eyes = eyes_hash(kept)
    return {
        "type": settings.get("type"),
        "seed": seed,
        "settings": kept,
        **({} if eyes is None else {"eyes_sha256": eyes}),
    }


def eyes_hash(settings: Mapping[str, Any]) -> str | None:
    """Return the hash of the eyes that a policy finds objects with, None where it has none.

    Raises:
        MemobenchError: there are no such eyes.
    """
    if settings.get("perception") != "objects" or settings.get("eyes") is None:
        return None
    from lerobot_memobench.perception.weights import eyes_file

    return file_hash(eyes_file(settings["eyes"]))


def training_facts(folder: Path) -> dict[str, Any] | None:
    """Return what a checkpoint says about the dataset it was trained on, None where it says nothing.

    Where the dataset is on this machine, ``sha256`` is that of its meta files and its manifest, which in turn hold a
    digest of every episode that `memobench generate` made.
    """
    try:
        told = read_json(folder / "train_config.json", TrainConfig, "it is ignored")
    except (FileNotFoundError, MemobenchError):
        return None
    dataset = told["dataset"]
    found = {key: dataset.get(key) for key in ("repo_id", "revision", "root", "episodes")}
    found["steps"] = told.get("steps")
    root = Path(str(found["root"] or ""))
    if found["root"] and os.path.isdir(root / "meta"):  # pathlib's raises at names that are too long
        files = sorted(path for path in [*(root / "meta").rglob("*"), root / "manifest.json"] if path.is_file())
        found["sha256"] = tree_hash({str(path.relative_to(root)): file_hash(path) for path in files})
    return found
