"""``manifest.json``: the request of a dataset, and the hashes of its episodes and files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NotRequired, TypedDict

from pydantic import BaseModel, ConfigDict

from lerobot_memobench.datasets.lerobot_format.layout import MANIFEST_FILE
from lerobot_memobench.io import Count, Whole, read_json


class Asked(TypedDict):
    """A requested episode."""

    task_name: str
    seed: Whole
    digest: NotRequired[str | None]


class Made(Asked):
    """An episode of the dataset."""

    failure: None
    frames: Count


class Failed(Asked):
    """An episode that could not be made, and the reason."""

    failure: str


class Problem(BaseModel):
    """A part of a converted file, and the reason why it was left out, or a note on it.

    Attributes:
        group: group of the file, "" for the file as a whole.
    """

    model_config = ConfigDict(frozen=True)

    file: str
    group: str
    reason: str

    def __str__(self) -> str:
        return f"{self.file}{', ' + self.group if self.group else ''}: {self.reason}"


class Written(TypedDict):
    """Size and hash of a file when it was written."""

    bytes: Count
    sha256: str


class Manifest(TypedDict):
    """``manifest.json``: the request of a run, and the hash of every episode and file."""

    episodes: list[Made | Failed]
    request: NotRequired[dict[str, Any]]
    left_out: NotRequired[list[Problem]]
    notes: NotRequired[list[Problem]]
    files: NotRequired[dict[str, Written]]


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of the dataset in ``folder``.

    Raises:
        FileNotFoundError: there is none.
        MemobenchError: it is none of this package's.
    """
    advice = "this package did not write it like that; take the dataset from its source again"
    found: dict[str, Any] = read_json(folder / MANIFEST_FILE, Manifest, advice)
    return found
