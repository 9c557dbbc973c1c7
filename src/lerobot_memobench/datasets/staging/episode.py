"""A finished episode's folder, read back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray

from lerobot_memobench.datasets.language import LanguageRow
from lerobot_memobench.datasets.statistics import Stats
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Malformed, Number, Whole, checked, file_hash, file_name, read_json

RECORD_FILE = "episode.json"
ARRAYS_FILE = "arrays.npz"
HDF5_FILE = "demonstration.hdf5"

LEROBOT, HDF5 = "lerobot", "hdf5"
FORMATS = (LEROBOT, HDF5)
"""What a run can make of its episodes."""

ADVICE = "it is damaged; delete the folder that it is in and run the command again"


class Info(TypedDict):
    """What meta/episodes, manifest and card say of an episode (see ``episode_info``)."""

    task_name: str
    memory_type: str
    family: str
    language: str
    operations: str
    seed: Whole
    referent: str
    variant: Count
    success: bool
    frames: Count
    exec_start_index: Count
    key_frames: list[Whole]
    scene_hash: str
    fixture_poses: dict[str, list[Number]]
    digest: str


class Identity(TypedDict):
    """What is known of an episode that could not be made."""

    task_name: str
    seed: Whole


class Row(TypedDict, total=False):
    """One of LeRobot's persistent language rows; `datasets.language` writes them."""

    role: str
    content: str | None
    style: str | None
    timestamp: Number


Frames = Annotated[list[Count], Len(1, 1)]
"""Over how many frames a statistic is, (1,)."""
Pixels = Annotated[list[Annotated[list[Annotated[list[Number], Len(1, 1)]], Len(1, 1)]], Len(3, 3)]
"""A statistic of a camera's channels, (3, 1, 1)."""


class Record(TypedDict):
    """``episode.json``."""

    failure: str | None
    info: Identity
    language_persistent: list[Row]
    image_stats: dict[str, dict[str, Pixels | Frames]]
    files: dict[str, str]
    hdf5: NotRequired[dict[str, Any] | None]


@dataclass(frozen=True)
class StagedEpisode:
    """A finished episode's folder; ``record`` is its episode.json, the rest is read when asked for."""

    folder: Path
    record: dict[str, Any]

    @property
    def failure(self) -> str | None:
        """Why there is no demonstration of this seed, or None."""
        return self.record["failure"]

    @property
    def info(self) -> dict[str, Any]:
        """Identity and per-episode metadata (see ``episode_info``)."""
        return self.record["info"]

    @property
    def language_rows(self) -> list[LanguageRow]:
        """LeRobot's persistent language rows (see ``persistent_rows``)."""
        return self.record["language_persistent"]

    @property
    def has_images(self) -> bool:
        """Whether its cameras were recorded."""
        return bool(self.record["image_stats"])

    @property
    def has_objects(self) -> bool:
        """Whether what could be seen as objects was recorded."""
        with np.load(self.folder / ARRAYS_FILE, allow_pickle=False) as data:
            return "objects" in data

    @property
    def hdf5(self) -> Path:
        """The demonstration in the published layout, alone at the root of a file of its own."""
        return self.folder / HDF5_FILE

    @property
    def hdf5_attributes(self) -> dict[str, Any] | None:
        """Attributes of its task's HDF5 file; None where HDF5 was not asked for."""
        return self.record.get("hdf5")

    @property
    def video_bytes(self) -> int:
        """Size of its videos."""
        return sum(self.video(camera).stat().st_size for camera in self.record["image_stats"])

    def video(self, camera: str) -> Path:
        """Return the file of a camera's video."""
        return self.folder / f"{camera}.mp4"

    def image_stats(self, camera: str) -> Stats:
        """Return the statistics of a camera's pixels (see ``ImageHistograms``)."""
        return {name: np.array(value) for name, value in self.record["image_stats"][camera].items()}

    def arrays(self) -> dict[str, NDArray]:
        """Read states, actions, proprio and label columns; text columns are arrays of str."""
        with np.load(self.folder / ARRAYS_FILE, allow_pickle=False) as data:
            return dict(data)

    def check(self) -> None:
        """Raise a MemobenchError that names the first file whose bytes are not those that were written."""
        for name, expected in self.record["files"].items():
            path = self.folder / file_name(name, f"a file that {self.folder / RECORD_FILE} names")
            found = file_hash(path) if path.is_file() else "missing"
            if found != expected:
                raise MemobenchError(
                    f"{path} is damaged (sha256 {found[:12]}, written as {expected[:12]}); "
                    f"delete the folder {self.folder} and generate again to make this episode anew"
                )


def read_staged(folder: Path) -> StagedEpisode | None:
    """Return the finished episode in ``folder``, or None when there is none."""
    try:
        record = read_json(folder / RECORD_FILE, Record, ADVICE)
    except FileNotFoundError:
        return None
    if record["failure"] is None:
        _check_info(folder, record["info"])
    return StagedEpisode(folder, record)


def _check_info(folder: Path, info: dict[str, Any]) -> None:
    """Refuse an episode of which not all is told that a dataset says of it."""
    try:
        checked(info, Info)
    except Malformed as error:
        raise MemobenchError(f"{folder / RECORD_FILE}: {error} in info; {ADVICE}") from None


class StagedJob:
    """What jobs have in common that make one episode, complete or absent: two workers at the same one do no harm."""

    folder: Path

    def finished(self) -> bool:
        """Whether the episode, or why there is none, is in ``folder``."""
        return read_staged(self.folder) is not None

    def failure(self) -> str | None:
        """Why a finished job has no episode, or None."""
        return staged(self).failure


def staged(job: StagedJob) -> StagedEpisode:
    """Return the finished episode of a job that has been run."""
    found = read_staged(job.folder)
    if found is None:
        raise MemobenchError(f"{job.folder} has vanished while the run was going on; run the command again")
    return found
