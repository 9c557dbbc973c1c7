"""Labelled pictures on disk: a file per task and seed, written whole, read where it lies."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of, read_json, write_file
from lerobot_memobench.jobs.executors import run_jobs
from lerobot_memobench.jobs.processes import Advance
from lerobot_memobench.perception.crowd import crowded, widened
from lerobot_memobench.perception.kinds import kinds
from lerobot_memobench.perception.labels import PICTURE, Labeller, Rows
from lerobot_memobench.perception.scatter import Scatter
from lerobot_memobench.perception.walk import Moment, walk
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_index

SCENES = ("as it was", "things elsewhere", "things elsewhere, arm above one")
"""How moments come about: the expert's own; the same with all things put elsewhere and more of other classes beside
them; and with the arm too."""
PER_MOMENT = len(SCENES) * len(MJCF_CAMERAS)
"""Pictures of one moment."""
TRIES = 4
"""How often a moment is stirred anew because the arm stood in something."""
STREAM = 6
"""Of an episode's random numbers: where things are put."""
NAMES = "kinds.json"


@dataclass(frozen=True)
class Shard:
    """The pictures of one episode, a job.

    Attributes:
        name: of the task. seed: of the episode. folder: the file. moments: how many of the episode are taken.
    """

    name: str
    seed: int
    folder: Path
    moments: int

    @property
    def task_name(self) -> str:
        """The task's name."""
        return self.name

    def finished(self) -> bool:
        """Whether the file is there."""
        return self.folder.is_file()

    def failure(self) -> str | None:
        """No reason: pictures of an episode that fails are as good."""

    def run(self) -> None:
        """Make the file."""
        episode = _episode(self.name)
        rng = generator(episode.published, self.seed, STREAM)
        moments = walk(episode, self.seed, self.moments)
        stage = _Stage(episode.sim, rng)
        rows = [row for moment in moments for row in stage.rows(moment)]
        with draft_of(self.folder) as draft:
            np.save(draft, np.array(rows, PICTURE))


@lru_cache(maxsize=1)
def _episode(name: str) -> Episode:
    return Episode(get_task(name), referent="random")


class _Stage:
    """One episode's scene, as it is and with more things in it."""

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        self._sim, self._crowd = sim, crowded(sim, rng)
        self._fixed = sim.fixture_poses()
        self._plain, self._full = Labeller(sim), Labeller(self._crowd)
        self._scatter = Scatter(self._crowd, rng)

    def rows(self, moment: Moment) -> Iterable[Rows]:
        """Yield the pictures of one moment, of both cameras."""
        sim, crowd = self._sim, self._crowd
        sim.set_state(moment.state, self._fixed)
        sim.highlights = moment.highlights
        yield from (self._plain.look(camera) for camera in MJCF_CAMERAS)
        for scene in range(1, len(SCENES)):
            for _ in range(TRIES):
                crowd.set_state(widened(moment.state, sim, crowd), self._fixed)
                if self._scatter.stir(reach=scene == len(SCENES) - 1):
                    crowd.highlights = self._scatter.marks()
                    yield from (self._full.look(camera, scene) for camera in MJCF_CAMERAS)
                    break


def make_pictures(
    folder: Path,
    names: Sequence[str],
    seeds: Iterable[int],
    moments: int,
    *,
    workers: int = 1,
    progress: Callable[[Advance], None] | None = None,
) -> Pictures:
    """Make the pictures of tasks and seeds that are not in a folder yet, and return all that it holds.

    Args:
        folder: where they are kept. names: of tasks of the catalogue. moments: of each episode; `PER_MOMENT` pictures
            each. workers: processes. progress: told of every episode.

    Raises:
        MemobenchError: the folder was begun with other kinds of things.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / NAMES).is_file():
        write_file(folder / NAMES, json.dumps(kinds()))
    _check_kinds(folder)
    jobs = [
        Shard(name, seed, folder / f"{task_index(name):02d}-{seed}-{moments}.npy", moments)
        for name in names
        for seed in seeds
    ]
    run_jobs(jobs, workers=workers, progress=progress, logs=folder / "logs")
    return Pictures([job.folder for job in jobs])


def _check_kinds(folder: Path) -> None:
    advice = "remove the folder; pictures are made anew"
    if tuple(read_json(folder / NAMES, list[str], advice)) != kinds():
        raise MemobenchError(f"{folder} holds pictures of other kinds of things than there are now; {advice}")


class Pictures:
    """Pictures of several files as one, read from the disk as they are asked for.

    Raises:
        MemobenchError: a file holds no pictures of this version.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = [_read(file) for file in files]
        self._starts = np.cumsum([0, *(len(rows) for rows in self._files)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def rows(self, indices: Sequence[int] | np.ndarray) -> Rows:
        """Return pictures (n,) by their numbers."""
        found = np.empty(len(indices), PICTURE)
        files = np.searchsorted(self._starts, indices, side="right") - 1
        for place, (file, index) in enumerate(zip(files, indices, strict=True)):
            found[place] = self._files[file][index - self._starts[file]]
        return found


def _read(file: Path) -> Rows:
    try:
        rows = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise MemobenchError(f"{file} cannot be read as pictures ({error}); remove it and make it anew") from None
    if rows.dtype != PICTURE:
        raise MemobenchError(f"{file} holds no pictures of this version; remove it and make it anew")
    return np.asarray(rows) if not len(rows) else rows
