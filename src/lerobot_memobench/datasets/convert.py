"""Convert files in the published HDF5 layout, this package's or others', to a LeRobotDataset.

Groups that cannot be used are named with file, group and reason. Episodes go through the same staging as
generated ones, so a killed conversion is continued by the same command, and a folder without ``meta/info.json`` is no
dataset to anybody. Of a zip archive one file at a time is unpacked, looked through, converted and removed again.

::

    <staging>/episodes/                 finished episodes, see `staging`
              files/00003.json          groups, problems and notes of the third file of an archive
              unpacked/<name>           the file that is being converted
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

from lerobot_memobench.datasets.conversion_jobs import ConversionJob, Plan
from lerobot_memobench.datasets.generation import check_room, run_size
from lerobot_memobench.datasets.hdf5.archive import Archive, Member, is_archive
from lerobot_memobench.datasets.hdf5.reading import Problem, Unusable, find_files
from lerobot_memobench.datasets.lerobot_format.assembling import assemble
from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    check_destination,
    check_whole,
    is_dataset,
    read_manifest,
)
from lerobot_memobench.datasets.staging import (
    LEROBOT,
    STAGING,
    compare_requests,
    episodes_folder,
    remove_staging,
    staged,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, free_bytes, in_words, read_json, telling_of_the_disk, write_file
from lerobot_memobench.jobs.executors import run_jobs
from lerobot_memobench.jobs.processes import Advance, ProgressCallback
from lerobot_memobench.protocol import CAMERAS, IMAGE_SIZE

UNPACKED_FRAME = len(CAMERAS) * 3 * IMAGE_SIZE**2
"""Bytes of a frame's pictures in the published files, which do not pack them."""


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
    """Convert a file in the published layout, or all in a folder or a zip archive, to a LeRobotDataset in ``out``.

    Args:
        source: the file, folder or archive.
        out: absent, empty, or a conversion of the same files that was not finished.
        repo_id: name of the dataset.
        upside_down: the images are stored as robosuite's renderer gives them, bottom row first: turn them up.
        workers: processes.
        progress: called after each episode; its ``task_name`` is the file's name, its ``seed`` the group's number.
            Of an archive its ``total`` is estimated from the files so far.
        tell: called, before the first episode, with the size of the dataset, and with each file of an archive.

    Raises:
        MemobenchError: there is nothing to convert, ``out`` holds something else, its disk has no room (what is
            finished stays), or LIBERO's assets are not installed, which files of its scenes need.
    """
    source, out = Path(source).absolute(), Path(out)
    if not source.exists():
        raise MemobenchError(f"{source} does not exist; name an HDF5 file, a folder of them, or a zip archive")
    archive = Archive(source) if is_archive(source) else None
    files = find_files(source) if archive is None else []
    request = {
        "files": [[_name(path, source), path.stat().st_size, path.stat().st_mtime_ns] for path in files]
        if archive is None
        else [[member.name, member.size, member.checksum] for member in archive.members],
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
        plan = Plan(folder, upside_down)
        if archive is None:
            for path in files:
                plan.add(path)
            _tell_of_the_run(plan.jobs, out, tell)
            run_jobs(plan.jobs, workers=workers, progress=progress, logs=staging / "logs")
        else:
            source = staging.absolute() / "unpacked"
            files = [source / member.name for member in archive.members]
            _tell_of_the_archive(archive, folder, out, tell)
            _convert_archive(archive, plan, staging, workers, progress, tell)
        jobs, problems, notes = plan.jobs, plan.problems, plan.notes
        episodes = [staged(job) for job in jobs]
        good = [episode for episode in episodes if episode.failure is None]
        problems += [
            Problem(str(job.file), f"data/{job.group}", episode.failure)
            for job, episode in zip(jobs, episodes, strict=True)
            if episode.failure is not None
        ]
        problems, notes = _told(problems, files, source), _told(notes, files, source)
        problems += [] if archive is None else archive.problems
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


def _tell_of_the_run(jobs: Sequence[ConversionJob], out: Path, tell: Callable[[str], None]) -> None:
    """Tell the size of what is to be made, before it is."""
    missing = [job for job in jobs if not job.folder.exists()]
    if missing:
        side = round(math.sqrt(math.prod(jobs[0].image_size)))
        size, left = (run_size(sum(job.frames for job in some), (LEROBOT,), side) for some in (jobs, missing))
        check_room(out, size, size - left, tell, f"{len(missing)} demonstrations")


# --- a zip archive ---


class Sound(TypedDict):
    """A demonstration that looks as it should: its group, height and width of all pictures, its length."""

    group: str
    height: Count
    width: Count
    frames: Count


class LeftOut(TypedDict):
    """A group that cannot be used, "" for the file as a whole."""

    group: str
    reason: str


class FileRecord(TypedDict):
    """Groups, problems and notes of a file of an archive."""

    demonstrations: list[Sound]
    problems: list[LeftOut]
    notes: list[str]


def _tell_of_the_archive(archive: Archive, folder: Path, out: Path, tell: Callable[[str], None]) -> None:
    """Report the sizes of the dataset and of the largest unpacked file, before either is made."""
    size = run_size(archive.size // UNPACKED_FRAME, (LEROBOT,), IMAGE_SIZE)
    there = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    largest = max((member.size for member in archive.members), default=0)
    what = f"{len(archive.members)} files of {in_words(archive.size)}, unpacked one by one (up to {in_words(largest)})"
    check_room(out, size, min(there, size), tell, what, work=largest)


def _convert_archive(
    archive: Archive,
    plan: Plan,
    staging: Path,
    workers: int,
    progress: ProgressCallback | None,
    tell: Callable[[str], None],
) -> None:
    """Unpack, look through, convert and remove one file after another; finished files stay packed."""
    records, unpacked = staging / "files", staging.absolute() / "unpacked"
    records.mkdir(exist_ok=True)
    shutil.rmtree(unpacked, ignore_errors=True)  # a killed run may have left a part
    ahead = _Ahead(archive.size, progress)
    for number, member in enumerate(archive.members, 1):
        path, record, first = unpacked / member.name, records / f"{number:05d}.json", len(plan.jobs)
        known = _take_up(record, path, plan)
        if not known or not all(job.finished() for job in plan.jobs[first:]):
            _check_room_for(member, unpacked)
            tell(f"file {number} of {len(archive.members)}: {member.name}, {in_words(member.size)}")
            _unpack_and_plan(archive, member, unpacked, plan, known)
            _write_down(record, path, plan)
        jobs = plan.jobs[first:]
        run_jobs(jobs, workers=workers, progress=ahead.through(member, first, len(jobs)), logs=staging / "logs")
        path.unlink(missing_ok=True)


def _check_room_for(member: Member, unpacked: Path) -> None:
    free = free_bytes(unpacked)
    if free < member.size:
        raise MemobenchError(
            f"{member.name} takes {in_words(member.size)} unpacked, but {in_words(free)} are free in "
            f"{unpacked.parent}; make room, and the same command goes on from there"
        )


def _unpack_and_plan(archive: Archive, member: Member, unpacked: Path, plan: Plan, known: bool) -> None:
    try:
        path = archive.extract(member, unpacked)
    except Unusable as error:
        if known:
            raise MemobenchError(f"{archive.path}, {member.name}: {error}") from None
        plan.problems.append(Problem(str(unpacked / member.name), "", str(error)))
    else:
        if not known:
            plan.add(path)


def _write_down(record: Path, path: Path, plan: Plan) -> None:
    """Record the groups of a file, so that it need not be unpacked to know them."""
    content: FileRecord = {
        "demonstrations": [
            {"group": job.group, "height": job.image_size[0], "width": job.image_size[1], "frames": job.frames}
            for job in plan.jobs
            if job.file == path
        ],
        "problems": [
            {"group": problem.group, "reason": problem.reason} for problem in plan.problems if problem.file == str(path)
        ],
        "notes": [note.reason for note in plan.notes if note.file == str(path)],
    }
    write_file(record, json.dumps(content), durable=True)


def _take_up(record: Path, path: Path, plan: Plan) -> bool:
    """Add the groups that an earlier run found in a file to the plan; return whether there was one."""
    try:
        found = read_json(record, FileRecord, "delete it to look through the file again")
    except FileNotFoundError:
        return False
    for demo in found["demonstrations"]:
        plan.add_job(path, demo["group"], (demo["height"], demo["width"]), demo["frames"])
    plan.problems += [Problem(str(path), each["group"], each["reason"]) for each in found["problems"]]
    plan.notes += [Problem(str(path), "", reason) for reason in found["notes"]]
    return True


class _Ahead:
    """Progress through an archive: files that are still packed are taken to be as full as those before them."""

    def __init__(self, size: int, progress: ProgressCallback | None) -> None:
        self._left, self._size, self._progress = size, size, progress
        self._found = 0

    def through(self, member: Member, before: int, here: int) -> ProgressCallback | None:
        """Return the callback of a file's jobs: so many are ``before`` them, so many ``here``."""
        self._left -= member.size
        read, episodes = self._size - self._left, before + here
        total = episodes + round(self._left * episodes / max(read, 1))
        found = self._found

        def tell(news: Advance) -> None:
            self._found = found + news.found
            if self._progress is not None:
                self._progress(replace(news, done=before + news.done, total=total, found=self._found))

        return tell


# --- the outcome ---


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
