"""Convert files in the published HDF5 layout to a LeRobotDataset.

File after file is looked through, and its demonstrations are staged as generated ones are (see `staging`). A file of a
zip archive is unpacked before and removed afterwards. A file or group that cannot be used is named with its reason. The
same command continues a killed conversion; it reads the findings on a file instead of looking through it again.

::

    <staging>/episodes/                 finished episodes, see `staging`
              files/00003.json          findings on the third file
              unpacked/<name>           the file of an archive that is being converted
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.generation import check_room, run_size
from lerobot_memobench.datasets.hdf5.archive import Archive, Member, is_archive
from lerobot_memobench.datasets.hdf5.reading import (
    NO_SEED,
    Problem,
    PublishedDemo,
    PublishedFile,
    Unusable,
    find_files,
    usable_or_named,
)
from lerobot_memobench.datasets.hdf5.restore import restore, task_of, unlike_the_catalogue, world_of
from lerobot_memobench.datasets.lerobot_format.assembling import assemble
from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    STAGING,
    check_destination,
    check_whole,
    is_dataset,
    read_manifest,
)
from lerobot_memobench.datasets.lerobot_format.record import EpisodeRecord
from lerobot_memobench.datasets.staging import (
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
from lerobot_memobench.io import Count, count_of, free_bytes, in_words, read_json, telling_of_the_disk, write_file
from lerobot_memobench.jobs.processes import Advance, ProgressCallback
from lerobot_memobench.jobs.running import run_jobs
from lerobot_memobench.protocol import CAMERAS, IMAGE_SIZE
from lerobot_memobench.sim.worlds import WORLDS
from lerobot_memobench.tasks.task import World

UNPACKED_FRAME = len(CAMERAS) * 3 * IMAGE_SIZE**2
"""Bytes of a frame's pictures in the published files, which do not compress them."""


@dataclass(frozen=True)
class ConversionSummary:
    """Outcome of a conversion.

    Attributes:
        folder: the dataset, or None when nothing could be converted.
        episodes: how many episodes it has.
        problems: what was left out, and why.
        notes: differences of what was converted to the catalogue's task of its name.
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
        progress: called after each episode; its ``task_name`` is the file's name, its ``seed`` the group's number,
            and its ``total`` is estimated from the files so far.
        tell: called with the size of the dataset before the first episode, and with each file of an archive.

    Raises:
        MemobenchError: there is nothing to convert, ``out`` holds something else, its disk has no room (what is
            finished stays), or LIBERO's assets are not installed, which files of its scenes need.
    """
    source, out = Path(source).absolute(), Path(out)
    if not source.exists():
        raise MemobenchError(f"{source} does not exist; name an HDF5 file, a folder of them, or a zip archive")
    staging = out / STAGING
    archive = Archive(source) if is_archive(source) else None
    files = _files(source) if archive is None else _members(archive, staging.absolute() / "unpacked")
    request = {"files": [file.identity for file in files], "upside_down": upside_down}
    if is_dataset(out):
        return _finished(out, request)
    check_destination(out)
    with (
        telling_of_the_disk(out, "what is finished stays, and the same command goes on from there"),
        episodes_folder(out, request) as folder,
    ):
        _tell_size(files, folder, out, tell)
        conversion = _Conversion(staging, folder, upside_down, workers, progress, sum(file.size for file in files))
        for number, file in enumerate(files, 1):
            conversion.add(file, staging / "files" / f"{number:05d}.json", archive, f"{number} of {len(files)}", tell)
        problems = [*conversion.problems, *(archive.problems if archive is not None else ())]
        good = [episode for episode in map(staged, conversion.jobs) if episode.failure is None]
        if good:
            notes = conversion.notes
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
    return ConversionSummary(out if good else None, len(good), tuple(problems), tuple(conversion.notes))


def _finished(out: Path, request: dict[str, Any]) -> ConversionSummary:
    """Report a conversion that is finished already."""
    try:
        manifest = read_manifest(out)
        earlier, left_out = manifest["request"], manifest["left_out"]
    except (FileNotFoundError, KeyError):
        raise MemobenchError(
            f"{out} already holds a dataset that this command did not make; name another folder"
        ) from None
    compare_requests(earlier, request, f"{out} already holds a finished conversion", "name another folder")
    check_whole(out)
    remove_staging(out)
    problems, notes = (tuple(Problem(**each) for each in part) for part in (left_out, manifest.get("notes", [])))
    return ConversionSummary(out, len(manifest["episodes"]), problems, notes)


# --- the files ---


@dataclass(frozen=True)
class _File:
    """A file to convert.

    Attributes:
        name: within the source. size: bytes, unpacked.
        path: where it is read. member: its place in an archive, from which it is unpacked to ``path``.
        identity: distinguishes it from another file of the same name.
    """

    name: str
    size: int
    path: Path
    identity: list[Any]
    member: Member | None = None


def _files(source: Path) -> list[_File]:
    """Return the HDF5 files of a path, by their names below it."""
    found = []
    for path in find_files(source):
        name, stat = path.name if path == source else path.relative_to(source).as_posix(), path.stat()
        found.append(_File(name, stat.st_size, path, [name, stat.st_size, stat.st_mtime_ns]))
    return found


def _members(archive: Archive, unpacked: Path) -> list[_File]:
    """Return the HDF5 files of an archive, which are unpacked below a folder."""
    return [
        _File(member.name, member.size, unpacked / member.name, [member.name, member.size, member.checksum], member)
        for member in archive.members
    ]


def _tell_size(files: Sequence[_File], folder: Path, out: Path, tell: Callable[[str], None]) -> None:
    """Report the size of the dataset, and of the largest unpacked file, before either is made."""
    sizes = [file.size for file in files]
    total, largest = sum(sizes), max(sizes, default=0)
    size = run_size(total // UNPACKED_FRAME, IMAGE_SIZE)
    there = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    what, work = f"{count_of(len(files), 'file')} of {in_words(total)}", 0
    if any(file.member is not None for file in files):
        what, work = f"{what}, unpacked one by one (up to {in_words(largest)})", largest
    check_room(out, size, min(there, size), tell, what, work=work)


# --- findings on a file ---


class Sound(BaseModel):
    """A demonstration that can be converted: its group, height and width of all pictures, its length."""

    group: str
    height: Count
    width: Count
    frames: Count


class LeftOut(BaseModel):
    """A group that cannot be used, "" for the file as a whole."""

    group: str
    reason: str


class Findings(BaseModel):
    """Demonstrations, problems and notes of a file, and the world of its scenes; kept as JSON."""

    demonstrations: list[Sound] = []
    problems: list[LeftOut] = []
    notes: list[str] = []
    world: World | None = None


def look_through(path: Path, world: World | None) -> Findings:
    """Return the findings on a file; ``world`` is that of the files before it.

    Raises:
        MemobenchError: its world's files are not installed.
    """
    found = Findings(world=world)
    try:
        with PublishedFile(path) as file, usable_or_named():
            found.problems += [LeftOut(group="data", reason=reason) for reason in _miscounted(file)]
            for group in file.groups():
                try:
                    demo = file.read(group)
                    found.world = _checked_world(demo, found.world)
                    height, width = demo.image_size
                    found.demonstrations.append(Sound(group=group, height=height, width=width, frames=len(demo.states)))
                    found.notes += [note for note in _notes(file, demo) if note not in found.notes]
                except Unusable as error:
                    found.problems.append(LeftOut(group=f"data/{group}", reason=str(error)))
    except Unusable as error:
        found.problems.append(LeftOut(group="", reason=str(error)))
    return found


def _checked_world(demo: PublishedDemo, others: World | None) -> World:
    world = world_of(demo)
    if world != (others or world):
        raise Unusable(f"its scenes are of world={world}, those before of {others}; convert each by itself")
    WORLDS[world].check()
    return world


def _notes(file: PublishedFile, demo: PublishedDemo) -> list[str]:
    """Return how a demonstration differs from this package's; nothing where it makes no task or scene."""
    try:
        task = task_of(file, demo).variant(0)
        reasons = [unlike_the_catalogue(task)]
    except MemobenchError:  # named when it is converted
        return []
    if file.lacks_its_text:
        reasons.append(f"bddl_file_content is no text: the task is the catalogue's {task.name}")
    return [reason for reason in reasons if reason]


def _miscounted(file: PublishedFile) -> list[str]:
    announced, count = file.announced(), len(file.groups())
    reasons = []
    if announced is not None and announced != count:
        reasons.append(f"its num_demos is {announced}, but there are {count} demonstrations")
    if not count:
        reasons.append("it has no demonstrations")
    return reasons


# --- the work ---


class _Conversion:
    """The episodes of file after file.

    Attributes:
        jobs: one per demonstration that can be converted, all of them run.
        problems, notes: on the files so far, in their order.
    """

    def __init__(
        self,
        staging: Path,
        folder: Path,
        upside_down: bool,
        workers: int,
        progress: ProgressCallback | None,
        size: int,
    ) -> None:
        self.jobs: list[ConversionJob] = []
        self.problems: list[Problem] = []
        self.notes: list[Problem] = []
        self._staging, self._folder, self._upside_down = staging, folder, upside_down
        self._workers, self._progress, self._size = workers, progress, size
        self._read = self._found = 0
        self._world: World | None = None
        shutil.rmtree(staging / "unpacked", ignore_errors=True)  # a killed run may have left a part
        (staging / "files").mkdir(exist_ok=True)

    def add(self, file: _File, record: Path, archive: Archive | None, which: str, tell: Callable[[str], None]) -> None:
        """Look through a file and stage its demonstrations.

        Args:
            record: file of its findings. archive: it is a member of. which: its number, for ``tell``.
        """
        findings: Findings | None
        try:
            findings = read_json(record, Findings, "delete it to look through the file again")
        except FileNotFoundError:
            findings = None
        jobs = self._jobs_of(file, findings) if findings is not None else []
        if archive is not None and (findings is None or not all(job.finished() for job in jobs)):
            tell(f"file {which}: {file.name}, {in_words(file.size)}")
            findings = self._unpack(archive, file, findings)
        if findings is None:
            findings = look_through(file.path, self._world)
        write_file(record, findings.model_dump_json(), durable=True)
        self._world = findings.world
        jobs = self._jobs_of(file, findings)
        self._read += file.size
        run_jobs(jobs, workers=self._workers, progress=self._ahead(len(jobs)))
        self.jobs += jobs
        if file.member is not None:
            file.path.unlink(missing_ok=True)
        failed = [(job.group, staged(job).failure) for job in jobs]
        self.problems += [Problem(file.name, problem.group, problem.reason) for problem in findings.problems]
        self.problems += [Problem(file.name, f"data/{group}", reason) for group, reason in failed if reason is not None]
        self.notes += [Problem(file.name, "", note) for note in findings.notes]

    def _unpack(self, archive: Archive, file: _File, findings: Findings | None) -> Findings | None:
        """Unpack a member; return the findings on it, those that it cannot be unpacked among them."""
        assert file.member is not None
        unpacked = self._staging / "unpacked"
        if (free := free_bytes(unpacked)) < file.size:
            raise MemobenchError(
                f"{file.name} takes {in_words(file.size)} unpacked, but {in_words(free)} are free in {self._staging}; "
                "make room, and the same command goes on from there"
            )
        try:
            archive.extract(file.member, unpacked)
        except Unusable as error:
            if findings is not None:  # its demonstrations were found by an earlier run
                raise MemobenchError(f"{archive.path}, {file.name}: {error}") from None
            return Findings(problems=[LeftOut(group="", reason=str(error))], world=self._world)
        return findings

    def _jobs_of(self, file: _File, findings: Findings) -> list[ConversionJob]:
        """Return the jobs of a file; they refuse pictures of another size than the first one's."""
        first, jobs = len(self.jobs), list[ConversionJob]()
        for number, demo in enumerate(findings.demonstrations, first):
            size = next((job.image_size for job in (*self.jobs[:1], *jobs[:1])), (demo.height, demo.width))
            folder = self._folder / f"{number:06d}"
            jobs.append(ConversionJob(file.path, demo.group, folder, size, self._upside_down))
        return jobs

    def _ahead(self, here: int) -> ProgressCallback:
        """Return the callback of a file's jobs; the files after it are taken to be as full as those before."""
        before, found = len(self.jobs), self._found
        episodes = before + here
        total = episodes + round((self._size - self._read) * episodes / max(self._read, 1))

        def advance(news: Advance) -> None:
            self._found = found + news.found
            if self._progress is not None:
                self._progress(replace(news, done=before + news.done, total=total, found=self._found))

        return advance


@dataclass(frozen=True)
class ConversionJob(StagedJob):
    """One group of one file, to be staged in ``folder``."""

    file: Path
    group: str
    folder: Path
    image_size: tuple[int, int]
    upside_down: bool = False

    @property
    def task_name(self) -> str:
        """The file's name, for the progress."""
        return self.file.name

    @property
    def seed(self) -> int:
        """The group's number."""
        return int(self.group.removeprefix("demo_"))

    def run(self) -> None:
        """Stage the episode, or the reason why it cannot be used."""
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
            EpisodeRecord.model_validate(episode_info(demo))  # it ends one episode here, and all of them in assembly
            return demo
