"""Validate a dataset: replay every episode, read every file to its end, and name the first difference of each."""

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
from lerobot_memobench.datasets.lerobot_format.layout import (
    ADVICE,
    INFO_FILE,
    MANIFEST_FILE,
    STATS_FILE,
    Written,
    check_clock,
    check_whole,
    dataset_files,
    episode_count,
    image_key,
    is_dataset,
    read_info,
    read_manifest,
    read_to_end,
)
from lerobot_memobench.datasets.lerobot_format.reading import EpisodePlace, check_idling, list_episodes, read_episode
from lerobot_memobench.datasets.replay import Pictures, replay
from lerobot_memobench.datasets.statistics import check_statistics, measured
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import check_fetched, file_hash, refusing
from lerobot_memobench.jobs.processes import process_pool
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.tasks.task import Task

COMPARED = ("task_name", "seed", "referent", "variant", "success", "scene_hash", "digest")
"""Fields of an episode in the manifest that its record has too."""
NO_HASHES = (
    "there are no hashes of files, as in datasets of earlier versions and after LeRobot's dataset tools: damage to a "
    "picture that can still be decoded and is not drawn again is not found"
)


@dataclass(frozen=True)
class Verdict:
    """Outcome of replaying one episode, or of checking a file.

    Attributes:
        subject: ``episode 3`` of the dataset, or a file.
        disagreement: the first one, as a sentence; None when everything agrees.
        note: on a file, what is no disagreement.
        of_file: whether the subject is a file.
    """

    subject: str
    disagreement: str | None
    note: str | None = None
    of_file: bool = False


@dataclass(frozen=True)
class _EpisodeCheck:
    """Episode ``index`` of the dataset in ``folder``, to be replayed in any process."""

    folder: Path
    index: int
    tasks: Mapping[str, Task] | None = None

    def run(self) -> Verdict:
        """Replay it."""
        name = f"episode {self.index}"
        try:
            with refusing(lambda why: MemobenchError(f"it cannot be read ({why}); {ADVICE}")):
                return Verdict(name, self._replay())
        except MemobenchError as error:  # the other episodes are replayed all the same
            return Verdict(name, str(error))

    def _replay(self) -> str | None:
        episode = read_episode(self.folder, self.index)
        if episode.seed < 0:
            return "it has no seed, so its scene cannot be made again"
        task, pictures = (self.tasks or {}).get(episode.task_name), _pictures(self.folder, self.index)
        found = replay(episode, task=task, pictures=pictures)
        return None if found is None else str(found)


@dataclass(frozen=True)
class _FileCheck:
    """A check of a file of the dataset in ``folder``, or of its agreement with others; runs in any process."""

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
    """Replay the episodes of a dataset and check its files.

    States, success, instruction, numbering, every checkpoint column, subgoal texts, language rows, key frames and the
    scene must come out exactly; some frames of each camera must be near to what the simulator draws. Every file is read
    to its end and compared with its hash, statistics with those of the frames, the manifest with the episodes.

    Returns:
        A verdict for each episode, in their order, then one for each file with a disagreement or a note.

    Args:
        folder: of the dataset.
        workers: processes.
        tasks: tasks by name that are not those of the catalogue.
        progress: called after each episode and file.

    Raises:
        MemobenchError: there is no dataset.
    """
    folder = Path(folder).absolute()
    if workers < 1:
        raise MemobenchError(f"{workers} workers were asked for; it must be at least 1")
    checks: list[_EpisodeCheck | _FileCheck] = [*_episode_checks(folder, tasks), *_file_checks(folder)]
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
    """Yield a check of each file of a dataset, and of the agreement between files."""
    written = None
    with contextlib.suppress(MemobenchError, FileNotFoundError):  # `check_manifest` names its damage
        written = read_manifest(folder).get("files")
    for name in sorted({*dataset_files(folder), *(written or {})}):
        yield _FileCheck(folder, name, partial(check_file, folder / name, (written or {}).get(name)))
    if written is None:
        yield _FileCheck(folder, MANIFEST_FILE, partial(str, NO_HASHES))
    yield _FileCheck(folder, INFO_FILE.as_posix(), partial(check_whole, folder))
    names = measured(read_info(folder)["features"])
    cameras = [name for name in names if name.startswith(image_key(""))]
    for chosen in ([name for name in names if name not in cameras], *([camera] for camera in cameras)):
        yield _FileCheck(folder, STATS_FILE.as_posix(), partial(check_statistics, folder, chosen))
    if (folder / MANIFEST_FILE).exists():
        yield _FileCheck(folder, MANIFEST_FILE, partial(check_manifest, folder))


def _episode_checks(folder: Path, tasks: Mapping[str, Task] | None) -> list[_EpisodeCheck]:
    if not is_dataset(folder):
        raise MemobenchError(
            f"{folder} holds no dataset (meta/info.json); name the folder of a generated one. HDF5 files are checked "
            "when `memobench convert` reads them"
        )
    check_clock(read_info(folder)["features"], folder)
    places: Sequence[EpisodePlace] = ()
    with contextlib.suppress(MemobenchError):  # a damaged file: each episode names it below
        places = list_episodes(folder)
    check_idling(folder, places)
    return [_EpisodeCheck(folder, index, tasks) for index in range(episode_count(folder))]


# --- files ---


def check_file(path: Path, written: Written | None) -> str | None:
    """Read a file to its end and compare it with what was written; return a note where it was written again.

    Other bytes in a file of the same size are damage; a tool that encodes or writes again leaves another size.

    Raises:
        MemobenchError: it is missing or damaged.
    """
    if not path.is_file():
        raise MemobenchError(f"the file is missing; {ADVICE}")
    check_fetched(path)
    if path.suffix in (".parquet", ".mp4"):
        read_to_end(path)
    if written is None or file_hash(path) == written["sha256"]:
        return None
    if path.stat().st_size == written["bytes"]:
        raise MemobenchError(
            f"its size is that in {MANIFEST_FILE}, and its bytes are not: it was damaged or edited; take the dataset "
            "from its source again, or generate it"
        )
    return f"encoded or written again since {MANIFEST_FILE} was: its content is checked, its bytes are not"


def check_manifest(folder: Path) -> None:
    """Compare seeds, hashes and lengths in the manifest of the dataset in ``folder`` with its episodes.

    Raises:
        MemobenchError: naming the first episode and field that differ.
    """
    rows = {row.get("episode_index"): row for row in read_manifest(folder)["episodes"] if row["failure"] is None}
    for place in list_episodes(folder) if None not in rows else ():  # a manifest of an earlier version
        row = rows.pop(place.index, {})
        held = {key: getattr(place.record, key) for key in COMPARED} if place.record is not None else {}
        for key, value in {"frames": place.length, **held}.items():
            if row.get(key) != value and value is not None:
                raise MemobenchError(f"episode {place.index} has {key}={value!r}, {MANIFEST_FILE} {row.get(key)!r}")
    if rows:
        raise MemobenchError(f"it names episode {next(iter(rows))}, and the dataset has none of that number")
