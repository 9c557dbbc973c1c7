"""What stands beside a dataset of this package, its request and the hash of every episode: checked when it is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NotRequired, TypedDict

from lerobot_memobench.datasets.lerobot_format.layout import MANIFEST_FILE
from lerobot_memobench.io import Count, Whole, read_json

ADVICE = "it is no manifest that this package wrote; take the dataset from its source again"


class Asked(TypedDict):
    """An episode that was asked for."""

    task_name: str
    seed: Whole
    digest: NotRequired[str | None]


class Made(Asked):
    """An episode that is there."""

    failure: None
    frames: Count


class Failed(Asked):
    """One that is not, and why."""

    failure: str


class LeftOut(TypedDict):
    """A `Problem` of a conversion."""

    file: str
    group: str
    reason: str


class Manifest(TypedDict):
    """What all manifests hold, and what those of `generate` and of `convert` do."""

    episodes: list[Made | Failed]
    request: NotRequired[dict[str, Any]]
    left_out: NotRequired[list[LeftOut]]
    notes: NotRequired[list[LeftOut]]


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of the dataset in ``folder``.

    Raises:
        FileNotFoundError: there is none.
        MemobenchError: it is none of this package's.
    """
    found: dict[str, Any] = read_json(folder / MANIFEST_FILE, Manifest, ADVICE)
    return found
