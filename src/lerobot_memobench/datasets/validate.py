"""Validate a folder: replay every episode, read every file to its end, and name what is not as it was recorded.

The folder may hold a LeRobotDataset, HDF5 files of this package in the published layout, or both.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.frames import FrameReader, frame_reader
from lerobot_memobench.datasets.hdf5.reading import PublishedFile, Unusable, find_files, usable_or_named
from lerobot_memobench.datasets.hdf5.restore import restore, task_of
from lerobot_memobench.datasets.lerobot_format.files import (
    NO_HASHES,
    check_file,
    check_manifest,
    dataset_files,
)
from lerobot_memobench.datasets.lerobot_format.layout import (
    ADVICE,
    INFO_FILE,
    MANIFEST_FILE,
    STATS_FILE,
    check_clock,
    check_whole,
    episode_count,
    image_key,
    is_dataset,
    read_info,
    read_manifest,
)
from lerobot_memobench.datasets.lerobot_format.reading import EpisodePlace, check_idling, list_episodes, read_episode
from lerobot_memobench.datasets.replay import Pictures, replay
from lerobot_memobench.datasets.statistics import check_statistics, measured
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import refusing
from lerobot_memobench.jobs.processes import process_pool
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.tasks.task import Task


@dataclass(frozen=True)
class Verdict:
    """Outcome of replaying one episode, or of checking a file.

    Attributes:
        subject: ``episode 3`` of the dataset, a file and its group, or a file.
        disagreement: the first one, as a sentence; None when everything agrees.
        note: on a file, what is no disagreement.
        of_file: whether the subject is a file.
    """

    subject: str
    disagreement: str | None
    note: str | None = None
    of_file: bool = False


@dataclass(frozen=True)
class _Check:
    """An episode to be replayed, in any process: of a dataset (``index``), or of an HDF5 file (``group``; "" stands
    for a file without any that can be read, and replaying it says why).
    """

    path: Path
    name: str
    index: int | None = None
    group: str = ""
    tasks: Mapping[str, Task] | None = None

    def run(self) -> Verdict:
        """Replay it."""
        try:
            with refusing(lambda why: MemobenchError(f"it cannot be read ({why}); {ADVICE}")):
                return Verdict(self.name, self._replay())
        except MemobenchError as error:  # whatever one episode says, the others are replayed
            return Verdict(self.name, str(error))

    def _replay(self) -> str | None:
        if self.index is not None:
            episode = read_episode(self.path, self.index)
            if episode.seed < 0:
                return "it has no seed, so its scene cannot be made again"
            task, pictures = (self.tasks or {}).get(episode.task_name), _pictures(self.path, self.index)
            found = replay(episode, task=task, pictures=pictures)
            return None if found is None else str(found)
        with PublishedFile(self.path) as file:
            published = file.read(self.group)
            for _ in file.images(self.group):
                pass  # each picture is decoded, and eight of them are drawn again
            if "seed" not in published.extras or int(published.extras["seed"]) < 0:
                return "it has no seed, so its scene cannot be made again"
            restored = restore(task_of(file, published), published)
            found = replay(restored, pictures=lambda frames: file.pictures(self.group, frames))
            return None if found is None else str(found)


@dataclass(frozen=True)
class _FileCheck:
    """A file of the dataset in ``folder``, or what it says, to be checked in any process."""

    folder: Path
    name: str
    check: Callable[[], str | None]

    def run(self) -> Verdict:
        """Check it."""
        try:
            with refusing(lambda why: MemobenchError(f"it cannot be read ({why}); {ADVICE}"), self.folder / self.name):
                return Verdict(self.name, None, self.check(), of_file=True)
        except MemobenchError as error:
            return Verdict(self.name, str(error), of_file=True)


ValidationProgress = Callable[[int, int, Verdict], None]
"""Called with how many are done, of how many, and the newest verdict."""


def validate(
    folder: Path | str,
    *,
    workers: int = 1,
    tasks: Mapping[str, Task] | None = None,
    progress: ValidationProgress | None = None,
) -> list[Verdict]:
    """Replay the episodes of a folder (or of an HDF5 file) and check its files.

    States, success, instruction, numbering, every checkpoint column, subgoal texts, language rows, key frames and the
    scene must come out exactly; some frames of each camera must be near to what the simulator draws. Every file is read
    to its end and compared with its hash, statistics with those of the frames, the manifest with the episodes.

    Returns:
        A verdict for each episode, in their order, then one for each file that disagrees or of which there is a note.

    Args:
        folder: what to check.
        workers: processes.
        tasks: tasks by name that are not those of the catalogue.
        progress: called after each episode and file.

    Raises:
        MemobenchError: there is nothing to check.
    """
    folder = Path(folder).absolute()
    if workers < 1:
        raise MemobenchError(f"{workers} workers were asked for; it must be at least 1")
    checks: list[_Check | _FileCheck] = [*_checks(folder, tasks), *_file_checks(folder)]
    verdicts: dict[int, Verdict] = {}

    def note(number: int, verdict: Verdict) -> None:
        verdicts[number] = verdict
        if progress is not None:
            progress(len(verdicts), len(checks), verdict)

    if workers == 1 or len(checks) == 1:
        for number, check in enumerate(checks):
            note(number, check.run())
    else:
        with process_pool(min(workers, len(checks))) as pool:
            futures = {pool.submit(check.run): number for number, check in enumerate(checks)}
            for future in as_completed(futures):
                note(futures[future], future.result())
    found = [verdicts[number] for number in range(len(checks))]
    return [verdict for verdict in found if not verdict.of_file or verdict.disagreement or verdict.note]


def _pictures(folder: Path, episode: int) -> Pictures | None:
    """Return what reads the pictures of an episode of a dataset; None where it has none of ours."""
    cameras = [camera for camera in CAMERAS if image_key(camera) in read_info(folder)["features"]]

    def read(frames: Sequence[int]) -> dict[str, NDArray[np.uint8]]:
        found = {camera: _reader(folder, image_key(camera))(episode, list(frames)) for camera in cameras}
        return {
            camera: (shown * 255).round().clamp(0, 255).byte().permute(0, 2, 3, 1).numpy()
            for camera, shown in found.items()
        }

    return read if cameras else None


@lru_cache(maxsize=len(CAMERAS))
def _reader(folder: Path, camera: str) -> FrameReader:
    return frame_reader(folder, camera)


def exit_status(verdicts: Sequence[Verdict]) -> int:
    """Return 0 when everything agreed, else 1."""
    return 1 if any(verdict.disagreement is not None for verdict in verdicts) else 0


def _file_checks(folder: Path) -> Iterator[_FileCheck]:
    """Yield a check of each file of a dataset, or of those HDF5 files of one that ``folder`` names."""
    root = next((place for place in (folder, *folder.parents[:2]) if (place / MANIFEST_FILE).is_file()), folder)
    written = None
    with contextlib.suppress(MemobenchError, FileNotFoundError):  # `check_manifest` names its damage
        written = read_manifest(root).get("files")
    for name in sorted({*dataset_files(root), *(written or {})}):
        if (root / name).is_relative_to(folder):
            yield _FileCheck(root, name, partial(check_file, root / name, (written or {}).get(name)))
    if not is_dataset(folder):
        return
    if written is None:
        yield _FileCheck(folder, MANIFEST_FILE, partial(str, NO_HASHES))
    yield _FileCheck(folder, INFO_FILE.as_posix(), partial(check_whole, folder))
    names = measured(read_info(folder)["features"])
    cameras = [name for name in names if name.startswith(image_key(""))]
    for chosen in ([name for name in names if name not in cameras], *([camera] for camera in cameras)):
        yield _FileCheck(folder, STATS_FILE.as_posix(), partial(check_statistics, folder, chosen))
    if (folder / MANIFEST_FILE).exists():
        yield _FileCheck(folder, MANIFEST_FILE, partial(check_manifest, folder))


def _checks(folder: Path, tasks: Mapping[str, Task] | None) -> list[_Check]:
    checks: list[_Check] = []
    if is_dataset(folder):
        check_clock(read_info(folder)["features"], folder)
        places: Sequence[EpisodePlace] = ()
        with contextlib.suppress(MemobenchError):  # a damaged file: each episode tells it below
            places = list_episodes(folder)
        check_idling(folder, places)
        total = range(episode_count(folder))
        checks += [_Check(folder, f"episode {index}", index=index, tasks=tasks) for index in total]
    has_files = folder.is_file() or any(path.suffix in (".hdf5", ".h5") for path in folder.rglob("*"))
    if not checks and not has_files:
        raise MemobenchError(
            f"{folder} holds neither a dataset (meta/info.json) nor HDF5 files; name the folder of generated ones"
        )
    for path in find_files(folder) if has_files else ():
        name = path.name if path == folder else path.relative_to(folder).as_posix()
        try:
            with PublishedFile(path) as file, usable_or_named():
                checks += [_Check(path, f"{name}, {group}", group=group) for group in file.groups()]
        except Unusable:
            checks.append(_Check(path, name))
    return checks
