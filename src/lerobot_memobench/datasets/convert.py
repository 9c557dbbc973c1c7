"""Convert files in the published HDF5 layout, this package's or others', to a LeRobotDataset.

Groups that cannot be used are named with file, group and reason. Episodes go through the same staging as
generated ones, so a killed conversion is continued by the same command, and a folder without ``meta/info.json`` is no
dataset to anybody.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.generation import check_room, run_size
from lerobot_memobench.datasets.hdf5.reading import (
    Problem,
    PublishedDemo,
    PublishedFile,
    Unusable,
    find_files,
    usable_or_named,
)
from lerobot_memobench.datasets.hdf5.restore import NO_SEED, restore, task_of, unlike_the_catalogue
from lerobot_memobench.datasets.lerobot_format.assembling import assemble
from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    EpisodeRecord,
    check_destination,
    check_whole,
    is_dataset,
    read_manifest,
)
from lerobot_memobench.datasets.staging import (
    LEROBOT,
    STAGING,
    EpisodeStage,
    StagedJob,
    compare_requests,
    episode_info,
    episodes_folder,
    remove_staging,
    stage_failure,
    staged,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import telling_of_the_disk
from lerobot_memobench.jobs.executors import run_jobs
from lerobot_memobench.jobs.processes import ProgressCallback


@dataclass(frozen=True)
class ConversionSummary:
    """Outcome of a conversion.

    Attributes:
        folder: the dataset, or None when nothing could be converted.
        episodes: how many episodes it has.
        problems: what was left out, and why.
        notes: what was converted and is another task than the catalogue's of its name.
    """

    folder: Path | None
    episodes: int
    problems: tuple[Problem, ...]
    notes: tuple[Problem, ...] = ()

    @property
    def exit_status(self) -> int:
        """0 when everything was converted, else 1."""
        return 1 if self.problems or self.folder is None else 0


@dataclass(frozen=True)
class ConversionJob(StagedJob):
    """One group of one file, to be staged in ``folder``. ``task_name`` is the file's name, for the progress."""

    file: Path
    group: str
    folder: Path
    image_size: tuple[int, int]
    frames: int
    upside_down: bool = False

    @property
    def task_name(self) -> str:
        """The file's name."""
        return self.file.name

    @property
    def seed(self) -> int:
        """The group's number."""
        return int(self.group.removeprefix("demo_"))

    def run(self) -> None:
        """Stage the episode, or why it cannot be used."""
        try:
            with PublishedFile(self.file) as file:
                demo = self._restored(file)
                with EpisodeStage(self.folder) as stage:
                    for images in file.images(self.group, upside_down=self.upside_down):
                        stage.add_images(images)
                    stage.publish(demo)
        except MemobenchError as error:
            info = {"task_name": self.task_name, "seed": NO_SEED, "group": self.group}
            stage_failure(info, " ".join(str(error).split()), self.folder)
        except Exception as error:
            error.add_note(f"while converting {self.file}, {self.group}")
            raise

    def _restored(self, file: PublishedFile) -> Demonstration:
        with usable_or_named():
            found = file.read(self.group)
            if found.image_size != self.image_size:
                raise Unusable(
                    f"its images are {found.image_size[0]}×{found.image_size[1]} pixels, those of the first "
                    f"demonstration {self.image_size[0]}×{self.image_size[1]}"
                )
            demo = restore(task_of(file, found), found)
            EpisodeRecord.model_validate(episode_info(demo))  # here it ends one episode, when the tables are made all
            return demo


def convert(
    source: Path | str,
    out: Path | str,
    *,
    repo_id: str = DEFAULT_REPO_ID,
    upside_down: bool = False,
    workers: int = 1,
    progress: ProgressCallback | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> ConversionSummary:
    """Convert a file in the published layout, or all in a folder, to a LeRobotDataset in the folder ``out``.

    Args:
        source: the file or folder.
        out: absent, empty, or a conversion of the same files that was not finished.
        repo_id: name of the dataset.
        upside_down: the images are stored as robosuite's renderer gives them, bottom row first: turn them up.
        workers: processes.
        progress: called after each episode; its ``task_name`` is the file's name, its ``seed`` the group's number.
        tell: told, before the first episode, about how large the dataset will be.

    Raises:
        MemobenchError: there is nothing to convert, ``out`` holds something else, or its disk has no room (what is
            finished stays).
    """
    source, out = Path(source).absolute(), Path(out)
    if not source.exists():
        raise MemobenchError(f"{source} does not exist; name an HDF5 file or a folder of them")
    files = find_files(source)
    request = {
        "files": [[_name(path, source), path.stat().st_size, path.stat().st_mtime_ns] for path in files],
        "upside_down": upside_down,
    }
    if is_dataset(out):
        return _finished(out, request)
    check_destination(out)
    staging = out / STAGING
    with (
        telling_of_the_disk(out, "what is finished stays, and the same command goes on from there"),
        episodes_folder(out, request) as folder,
    ):
        jobs, problems, notes = _plan(files, folder, upside_down)
        _tell_of_the_run(jobs, out, tell)
        run_jobs(jobs, workers=workers, progress=progress, logs=staging / "logs")
        episodes = [staged(job) for job in jobs]
        good = [episode for episode in episodes if episode.failure is None]
        problems += [
            Problem(str(job.file), f"data/{job.group}", episode.failure)
            for job, episode in zip(jobs, episodes, strict=True)
            if episode.failure is not None
        ]
        problems, notes = _told(problems, files, source), _told(notes, files, source)
        if good:
            assemble(
                good,
                out,
                repo_id=repo_id,
                made_by=f"Converted by `memobench convert` from {len(files)} HDF5 files in the published layout; "
                "what they do not hold was read off their states in the simulator."
                + "".join(f" {note}." for note in notes),
                manifest={
                    "request": request,
                    "left_out": [asdict(problem) for problem in problems],
                    **({"notes": [asdict(note) for note in notes]} if notes else {}),
                },
                left_out=[str(problem) for problem in problems],
            )
        shutil.rmtree(staging, ignore_errors=True)
    if not any(out.iterdir()):
        out.rmdir()
    return ConversionSummary(out if good else None, len(good), tuple(problems), tuple(notes))


def _plan(
    files: Sequence[Path], folder: Path, upside_down: bool
) -> tuple[list[ConversionJob], list[Problem], list[Problem]]:
    """Return a job per group that looks as it should, what does not, and which tasks are not the catalogue's."""
    usable: list[tuple[Path, str, tuple[int, int], int]] = []
    problems: list[Problem] = []
    notes: list[Problem] = []
    for path in files:
        try:
            with PublishedFile(path) as file, usable_or_named():
                problems += _miscounted(file)
                for group in file.groups():
                    try:
                        demo = file.read(group)
                        usable.append((path, group, demo.image_size, len(demo.states)))
                        notes += _notes(file, demo)
                    except Unusable as error:
                        problems.append(Problem(str(path), f"data/{group}", str(error)))
        except Unusable as error:
            problems.append(Problem(str(path), "", str(error)))
    jobs = [
        ConversionJob(path, group, folder / f"{number:06d}", usable[0][2], frames, upside_down)
        for number, (path, group, _, frames) in enumerate(usable)
    ]
    return jobs, problems, list({(note.file, note.reason): note for note in notes}.values())


def _tell_of_the_run(jobs: Sequence[ConversionJob], out: Path, tell: Callable[[str], None]) -> None:
    """Tell the size of what is to be made, before it is."""
    missing = [job for job in jobs if not job.folder.exists()]
    if missing:
        side = round(math.sqrt(math.prod(jobs[0].image_size)))
        size, left = (run_size(sum(job.frames for job in some), (LEROBOT,), side) for some in (jobs, missing))
        check_room(out, size, size - left, tell, f"{len(missing)} demonstrations")


def _notes(file: PublishedFile, demo: PublishedDemo) -> list[Problem]:
    """Return how a demonstration's task was found, where its file does not hold it, and in what it is not the
    catalogue's of its name; nothing where it makes no task.
    """
    try:
        task = task_of(file, demo).variant(0)
    except MemobenchError:  # named when it is converted
        return []
    lacking = (
        f"bddl_file_content is no text, so the task is the catalogue's {task.name}" if file.lacks_its_text else None
    )
    return [Problem(str(file.path), "", reason) for reason in (lacking, unlike_the_catalogue(task)) if reason]


def _miscounted(file: PublishedFile) -> list[Problem]:
    announced, count = file.announced(), len(file.groups())
    reasons = []
    if announced is not None and announced != count:
        reasons.append(f"it says that it has {announced} demonstrations, but there are {count}")
    if not count:
        reasons.append("it has no demonstrations")
    return [Problem(str(file.path), "data", reason) for reason in reasons]


def _told(problems: Sequence[Problem], files: Sequence[Path], source: Path) -> list[Problem]:
    """Return problems in the order of their files, which are named within the source."""
    order = {str(path): number for number, path in enumerate(files)}
    ordered = sorted(problems, key=lambda problem: order[problem.file])
    return [replace(problem, file=_name(Path(problem.file), source)) for problem in ordered]


def _name(path: Path, source: Path) -> str:
    """A file's name within the source: where on a disk it was is nobody's business."""
    return path.relative_to(source).as_posix() if source in path.parents else path.name


def _finished(out: Path, request: dict[str, Any]) -> ConversionSummary:
    """Report a conversion that is finished already."""
    try:
        manifest = read_manifest(out)
        earlier, left_out = manifest["request"], manifest["left_out"]
        count, notes = len(manifest["episodes"]), manifest.get("notes", [])
    except (FileNotFoundError, KeyError):
        raise MemobenchError(
            f"{out} already holds a dataset that this command did not make; name another folder"
        ) from None
    compare_requests(earlier, request, f"{out} already holds a finished conversion", "name another folder")
    check_whole(out)
    remove_staging(out)
    told = [tuple(Problem(each["file"], each["group"], each["reason"]) for each in part) for part in (left_out, notes)]
    return ConversionSummary(out, count, *told)
