"""Convert files in the published HDF5 layout to a LeRobotDataset.

Each file is inspected, then its demonstrations are staged like generated ones (see `stage`). A file of a zip archive
is unpacked before and removed afterwards: 340 GiB need not be unpacked at once. A file or group that cannot be used is
reported with its reason. The same command continues a killed conversion and does not inspect finished files again.

::

    <staging>/episodes/                 finished episodes, see `stage`
              files/00003.json          `Findings` of the third file
              unpacked/<name>           the file of an archive that is being converted
"""

from __future__ import annotations

import shutil
import zipfile
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from lerobot_memobench.constants import CAMERAS, IMAGE_SIZE
from lerobot_memobench.datasets.episodes import ConversionNote, DemonstrationRecord
from lerobot_memobench.datasets.generate import check_room, run_size, versions_of_numbers
from lerobot_memobench.datasets.hdf5 import NO_SEED, PublishedFile, demo_number, first_line
from lerobot_memobench.datasets.layout import DEFAULT_REPO_ID, STAGING
from lerobot_memobench.datasets.restore import ORIENTATIONS, orientation_of, restore, task_of, unlike_the_catalogue
from lerobot_memobench.datasets.stage import (
    EpisodeStage,
    StagedJob,
    episodes_folder,
    finished_manifest,
    stage_failure,
)
from lerobot_memobench.datasets.write import assemble
from lerobot_memobench.errors import MemobenchError, check_choice, count_of
from lerobot_memobench.io import (
    draft_of,
    explaining_disk_errors,
    file_name,
    files_below,
    free_bytes,
    in_words,
    write_file,
)
from lerobot_memobench.jobs.processes import Advance, ProgressCallback, run_jobs
from lerobot_memobench.sim.convention import CONVENTIONS, UPRIGHT
from lerobot_memobench.sim.files import check_assets
from lerobot_memobench.untrusted import Count, check_fetched, read_json, refusing

SUFFIXES = (".hdf5", ".h5")
UNPACKED_FRAME = len(CAMERAS) * 3 * IMAGE_SIZE**2
"""Bytes of a frame's images in the published files, which are not compressed."""


@dataclass(frozen=True)
class ConversionSummary:
    """Outcome of a conversion: the dataset, None if no demonstration could be converted, and its number of episodes.

    ``problems`` are the files and groups that were left out, ``notes`` differences of their tasks to the catalogue's.
    """

    folder: Path | None
    episodes: int
    problems: tuple[ConversionNote, ...]
    notes: tuple[ConversionNote, ...] = ()

    @property
    def exit_status(self) -> int:
        """0 if everything was converted, else 1."""
        return 1 if self.problems or self.folder is None else 0


def convert(
    source: Path | str,
    out: Path | str,
    *,
    repo_id: str = DEFAULT_REPO_ID,
    convention: str = UPRIGHT,
    workers: int = 1,
    progress: ProgressCallback | None = None,
    notify: Callable[[str], None] = lambda _: None,
) -> ConversionSummary:
    """Convert a file in the published layout, or all in a folder or a zip archive, to a LeRobotDataset in ``out``.

    The first images of each file, compared with those drawn of their state, show how all of them are stored.

    Args:
        out: absent, empty, or an unfinished conversion of the same files.
        convention: of the images in the dataset (`sim.convention`).
        progress: called after each episode; its ``task_name`` is the file's name, its ``seed`` the group's number,
            and its ``total`` is estimated from the files so far.
        notify: called with the size of the dataset before the first episode, and with each file of an archive.

    Raises:
        MemobenchError: there is no file to convert, ``out`` holds something else, its disk has no room (finished
            episodes stay), or LIBERO's assets are not installed.
    """
    check_choice("convention", convention, [*CONVENTIONS])
    check_assets()
    source, out = Path(source).absolute(), Path(out)
    staging = out / STAGING
    files, problems = find_files(source, staging.absolute() / "unpacked")
    request = {"files": [file.identity for file in files], "convention": convention}
    manifest = finished_manifest(out, request)
    if manifest is not None:
        earlier = (map(ConversionNote.model_validate, manifest.get(key, [])) for key in ("left_out", "notes"))
        return ConversionSummary(out, len(manifest["episodes"]), *map(tuple, earlier))
    with (
        explaining_disk_errors(out, "finished episodes stay, and the same command continues"),
        episodes_folder(out, {**request, "versions": versions_of_numbers()}) as folder,
    ):
        _report_size(files, folder, out, notify)
        shutil.rmtree(staging / "unpacked", ignore_errors=True)  # a killed run may have left a part
        (staging / "files").mkdir(exist_ok=True)
        conversion = _Conversion(source, staging, folder, convention, workers, progress, notify, files)
        for number, file in enumerate(files, 1):
            conversion.add(number, file)
        problems, notes = [*conversion.problems, *problems], conversion.notes
        episodes = [job.episode() for job in conversion.jobs if job.failure() is None]
        if episodes:
            made_by = (
                f"Converted by `memobench convert` from {len(files)} HDF5 files in the published layout; columns that "
                "they do not hold were computed from their states in the simulator."
            )
            content = {"request": request, "left_out": [problem.model_dump() for problem in problems]}
            if notes:
                content["notes"] = [note.model_dump() for note in notes]
            assemble(
                episodes,
                out,
                repo_id=repo_id,
                made_by=made_by + "".join(f" {note}." for note in notes),
                manifest=content,
                left_out=[str(problem) for problem in problems],
            )
        shutil.rmtree(staging, ignore_errors=True)
    if not any(out.iterdir()):
        out.rmdir()
    return ConversionSummary(out if episodes else None, len(episodes), tuple(problems), tuple(notes))


# --- the files ---


@dataclass(frozen=True)
class SourceFile:
    """A file to convert; ``identity`` distinguishes it from another file of the same name."""

    name: str  # path within the source
    size: int  # bytes, unpacked
    path: Path
    identity: list[Any]
    member: zipfile.ZipInfo | None = None  # entry of an archive, from which it is unpacked to ``path``


def find_files(source: Path, unpacked: Path) -> tuple[list[SourceFile], list[ConversionNote]]:
    """Return the HDF5 files of a path, sorted by name, and those of an archive whose names are refused.

    The others of an archive will be unpacked below ``unpacked``.
    """
    if not source.exists():
        raise MemobenchError(f"{source} does not exist; name an HDF5 file, a folder of them, or a zip archive")
    files, refused = [], []
    if source.is_file() and source.suffix.lower() == ".zip":
        for info in _entries(source):
            try:  # a part such as `..` would lead to another folder
                name = "/".join(file_name(part, "a part of its name") for part in info.filename.split("/"))
            except MemobenchError as error:
                printable = "".join(letter if letter.isprintable() else "?" for letter in info.filename)[:200]
                refused.append(ConversionNote(file=printable, group="", reason=str(error)))
            else:
                identity = [name, info.file_size, info.CRC]
                files.append(SourceFile(name, info.file_size, unpacked / name, identity, info))
    else:
        for path in files_below(source, *SUFFIXES) if source.is_dir() else [source]:
            name, stat = path.name if path == source else path.relative_to(source).as_posix(), path.stat()
            files.append(SourceFile(name, stat.st_size, path, [name, stat.st_size, stat.st_mtime_ns]))
    if not files and not refused:
        raise MemobenchError(
            f"found no HDF5 file ({', '.join(SUFFIXES)}) in {source}; name a file, a folder of them, or a zip archive"
        )
    return files, refused


def _entries(archive: Path) -> list[zipfile.ZipInfo]:
    check_fetched(archive)
    try:
        with zipfile.ZipFile(archive) as file:
            entries = file.infolist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise MemobenchError(
            f"{archive} is no zip archive, or was not downloaded completely ({first_line(error)}); download it again"
        ) from None
    # macOS adds a folder with a fork of each file to archives.
    chosen = [e for e in entries if e.filename.lower().endswith(SUFFIXES) and not e.filename.startswith("__MACOSX")]
    return sorted(chosen, key=lambda entry: entry.filename)


def unpack_member(archive: Path, file: SourceFile) -> None:
    """Write a file of an archive to its path, or raise."""
    assert file.member is not None
    file.path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with draft_of(file.path) as draft:
            with zipfile.ZipFile(archive) as opened, opened.open(file.member) as packed, draft.open("wb") as unpacked:
                shutil.copyfileobj(packed, unpacked, 2**22)
            if draft.stat().st_size != file.size:
                raise MemobenchError(f"it is {draft.stat().st_size} bytes long, expected {file.size}")
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as error:
        raise MemobenchError(f"it cannot be unpacked ({first_line(error)}); download the archive again") from None


def _report_size(files: Sequence[SourceFile], folder: Path, out: Path, notify: Callable[[str], None]) -> None:
    total, unpacked = sum(file.size for file in files), max((file.size for file in files if file.member), default=0)
    size = run_size(total // UNPACKED_FRAME, IMAGE_SIZE)
    staged_size = sum(path.stat().st_size for path in files_below(folder))
    one_by_one = f", unpacked one by one (up to {in_words(unpacked)})" if unpacked else ""
    work = f"{count_of(len(files), 'file')} of {in_words(total)}{one_by_one}"
    check_room(out, size, min(staged_size, size), notify, work, extra=unpacked)


# --- inspection of a file ---


def _unusable(why: str) -> MemobenchError:
    return MemobenchError(f"its content cannot be used ({why})")


class Findings(BaseModel):
    """Groups of a file, size and orientation of their images, problems of the file as a whole, and notes."""

    groups: list[str]
    image_size: list[Count] = []  # height and width, of the first sound group
    problems: list[ConversionNote] = []
    notes: list[ConversionNote] = []
    orientation: str | None = None


def inspect(file: SourceFile) -> Findings:
    """Return the findings of a file; the conversion of a group reports why it cannot be used."""
    findings = Findings(groups=[])

    def leave_out(group: str, reason: object) -> None:
        findings.problems.append(ConversionNote(file=file.name, group=group, reason=str(reason)))

    def note(reason: str) -> None:
        entry = ConversionNote(file=file.name, group="", reason=reason)
        findings.notes += [entry] * (entry not in findings.notes)

    try:
        with PublishedFile(file.path) as opened, refusing(_unusable):
            findings.groups = opened.groups()
            if opened.announced not in (None, len(findings.groups)):
                count = len(findings.groups)
                leave_out("data", f"its num_demos is {opened.announced}, but there are {count} demonstrations")
            if not findings.groups:
                leave_out("data", "it has no demonstrations")
            for group in findings.groups:
                with suppress(MemobenchError):
                    demo = opened.read(group)
                    findings.orientation = findings.orientation or orientation_of(opened, demo)
                    findings.image_size = findings.image_size or [*demo.image_size]
                    task = task_of(opened, demo).variant(0)
                    if differences := unlike_the_catalogue(task):
                        note(differences)
                    if opened.lacks_its_text:
                        note(f"bddl_file_content is no text: the task is the catalogue's {task.name}")
    except MemobenchError as error:
        leave_out("", error)
    if findings.image_size and findings.orientation is None:
        note("whether its images are upright is not clear, as its state shows none like them: they are not turned")
    elif findings.image_size and findings.orientation != UPRIGHT:
        note(f"its images are {findings.orientation}: they are turned")
    return findings


# --- conversion ---


@dataclass
class _Conversion:
    """Stage the episodes of one file after another."""

    source: Path
    staging: Path
    folder: Path
    convention: str
    workers: int
    progress: ProgressCallback | None
    notify: Callable[[str], None]
    files: Sequence[SourceFile]
    jobs: list[ConversionJob] = field(default_factory=list)
    problems: list[ConversionNote] = field(default_factory=list)
    notes: list[ConversionNote] = field(default_factory=list)
    image_size: tuple[int, ...] = ()  # of the first demonstration, which all must have
    resumed: int = 0  # episodes of an earlier run

    def add(self, number: int, file: SourceFile) -> None:
        """Inspect a file and stage its demonstrations; ``number`` counts from 1."""
        path = self.staging / "files" / f"{number:05d}.json"
        findings: Findings | None = None
        if path.exists():
            findings = read_json(path, Findings, "delete it to inspect the file again")
        if file.member is not None and not (findings and all(job.finished() for job in self._jobs_of(file, findings))):
            self.notify(f"file {number} of {len(self.files)}: {file.name}, {in_words(file.size)}")
            findings = self._unpack(file, findings)
        if findings is None:
            findings = inspect(file)
        write_file(path, findings.model_dump_json(), durable=True)
        jobs = self._jobs_of(file, findings)
        run_jobs(jobs, workers=self.workers, progress=self.progress and self._counting(number, len(jobs)))
        self.jobs += jobs
        if file.member is not None:
            file.path.unlink(missing_ok=True)
        self.notes += findings.notes
        self.problems += findings.problems
        for job in jobs:
            if (reason := job.failure()) is not None:
                self.problems.append(ConversionNote(file=file.name, group=f"data/{job.group}", reason=reason))

    def _unpack(self, file: SourceFile, findings: Findings | None) -> Findings | None:
        if (free := free_bytes(self.staging)) < file.size:
            raise MemobenchError(
                f"{file.name} takes {in_words(file.size)} unpacked, but {in_words(free)} are free in {self.staging}; "
                "make room, then repeat the command to continue"
            )
        try:
            unpack_member(self.source, file)
        except MemobenchError as error:
            if findings is not None:  # an earlier run found its demonstrations
                raise MemobenchError(f"{self.source}, {file.name}: {error}") from None
            return Findings(groups=[], problems=[ConversionNote(file=file.name, group="", reason=str(error))])
        return findings

    def _jobs_of(self, file: SourceFile, findings: Findings) -> list[ConversionJob]:
        self.image_size = self.image_size or tuple(findings.image_size)
        shared = (self.image_size, ORIENTATIONS[findings.orientation or UPRIGHT], self.convention)
        return [
            ConversionJob(file.path, group, self.folder / f"{number:06d}", *shared)
            for number, group in enumerate(findings.groups, len(self.jobs))
        ]

    def _counting(self, number: int, jobs: int) -> ProgressCallback:
        """Return the callback of a file's jobs; later files are assumed to have as many episodes per byte."""
        before, resumed = len(self.jobs), self.resumed
        read, size = (sum(file.size for file in files) for files in (self.files[:number], self.files))
        total = round((before + jobs) * size / max(read, 1))

        def advance(news: Advance) -> None:
            self.resumed = resumed + news.found
            assert self.progress is not None
            self.progress(replace(news, done=before + news.done, total=total, found=self.resumed))

        return advance


@dataclass(frozen=True)
class ConversionJob(StagedJob):
    """One group of one file, to be staged in ``folder``."""

    file: Path
    group: str
    folder: Path
    image_size: tuple[int, ...]
    turn: tuple[int, int]
    convention: str

    @property
    def task_name(self) -> str:
        """The file's name, for the progress."""
        return self.file.name

    @property
    def seed(self) -> int:
        """The group's number."""
        return demo_number(self.group) or 0

    def run(self) -> None:
        """Stage the episode, or the reason why it cannot be used."""
        try:
            with PublishedFile(self.file) as file:
                with refusing(_unusable):
                    published = file.read(self.group)
                    if self.image_size not in ((), published.image_size):
                        sizes = ["×".join(map(str, size)) for size in (published.image_size, self.image_size)]
                        raise MemobenchError(
                            f"its images are {sizes[0]} pixels, those of the first demonstration {sizes[1]}"
                        )
                    demo = restore(task_of(file, published), published)
                    DemonstrationRecord.of(demo)  # a bad value ends this episode, not the assembly of all
                with EpisodeStage(self.folder, self.convention) as stage:
                    for images in file.images(self.group, *self.turn):
                        stage.add_images(images)
                    stage.publish(demo)
        except MemobenchError as error:
            info = {"task_name": self.task_name, "seed": NO_SEED, "group": self.group}
            stage_failure(info, " ".join(str(error).split()), self.folder)
        except Exception as error:
            error.add_note(f"while converting {self.file}, {self.group}")
            raise
