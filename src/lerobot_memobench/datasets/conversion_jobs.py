"""The work of a conversion: a job per demonstration of a file, its problems, and its differences to the catalogue."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.hdf5.reading import Problem, PublishedDemo, PublishedFile, Unusable, usable_or_named
from lerobot_memobench.datasets.hdf5.restore import NO_SEED, restore, task_of, unlike_the_catalogue, world_of
from lerobot_memobench.datasets.lerobot_format.layout import EpisodeRecord
from lerobot_memobench.datasets.staging import EpisodeStage, StagedJob, episode_info, stage_failure
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.worlds import KINDS
from lerobot_memobench.tasks.task import World


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


@dataclass
class Plan:
    """The work of a conversion, file after file.

    Attributes:
        folder: where episodes are staged.
        upside_down: whether pictures are stored bottom row first.
        jobs: one per demonstration that looks as it should.
        problems: files and groups that cannot be used, and why.
        notes: differences of the others to what this package writes.
        image_size, world: (height, width) and world of the first demonstration, which all have.
    """

    folder: Path
    upside_down: bool
    jobs: list[ConversionJob] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    notes: list[Problem] = field(default_factory=list)
    image_size: tuple[int, int] | None = None
    world: World | None = None

    def add(self, path: Path) -> None:
        """Look through a file.

        Raises:
            MemobenchError: its world's files are not installed.
        """
        try:
            with PublishedFile(path) as file, usable_or_named():
                self.problems += _miscounted(file)
                for group in file.groups():
                    self._add_group(file, group)
        except Unusable as error:
            self.problems.append(Problem(str(path), "", str(error)))
        self.notes = list({(note.file, note.reason): note for note in self.notes}.values())

    def _add_group(self, file: PublishedFile, group: str) -> None:
        try:
            demo = file.read(group)
            self._check_world(demo)
            self.add_job(file.path, group, demo.image_size, len(demo.states))
            self.notes += _notes(file, demo)
        except Unusable as error:
            self.problems.append(Problem(str(file.path), f"data/{group}", str(error)))

    def _check_world(self, demo: PublishedDemo) -> None:
        world = world_of(demo)
        self.world = self.world or world
        if world != self.world:
            raise Unusable(f"its scenes are of world={world}, those before of {self.world}; convert each by itself")
        KINDS[world].check()

    def add_job(self, path: Path, group: str, image_size: tuple[int, int], frames: int) -> None:
        """Add a demonstration; its job refuses pictures that have not the size of the first one's."""
        self.image_size = self.image_size or image_size
        folder = self.folder / f"{len(self.jobs):06d}"
        self.jobs.append(ConversionJob(path, group, folder, self.image_size, frames, self.upside_down))


def _notes(file: PublishedFile, demo: PublishedDemo) -> list[Problem]:
    """Return how a demonstration differs from this package's; nothing where it makes no task or scene."""
    try:
        task = task_of(file, demo).variant(0)
        reasons = [unlike_the_catalogue(task)]
    except MemobenchError:  # named when it is converted
        return []
    if file.lacks_its_text:
        reasons.append(f"bddl_file_content is no text: the task is the catalogue's {task.name}")
    return [Problem(str(file.path), "", reason) for reason in reasons if reason]


def _miscounted(file: PublishedFile) -> list[Problem]:
    announced, count = file.announced(), len(file.groups())
    reasons = []
    if announced is not None and announced != count:
        reasons.append(f"it says that it has {announced} demonstrations, but there are {count}")
    if not count:
        reasons.append("it has no demonstrations")
    return [Problem(str(file.path), "data", reason) for reason in reasons]
