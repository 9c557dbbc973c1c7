"""Labelled images of the scripted expert's episodes, with domain randomisation: a file per episode."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import SPLITS
from lerobot_memobench.datasets.generate import Perturbation
from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of, write_file
from lerobot_memobench.jobs.processes import Advance, run_jobs
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_index
from lerobot_memobench.untrusted import read_json
from mujoco_raster.highlights import Highlight
from research.detector.labels import PICTURE, Labeller, Rows, kinds
from research.detector.randomisation import NEAR, DomainRandomisation, widened, with_distractors

TRAINED, TESTED = SPLITS["detector"], SPLITS["detector test"]
"""Seeds of training and of tests; other parts of the benchmark do not use them. (The shipped detector was trained on
20,000 to 20,007.)"""
SCENES = ("as it was", "things elsewhere", "things elsewhere, arm above one")
"""Scenes of a frame: the expert's own; the same with objects put elsewhere and distractors; and with the arm too."""
PER_FRAME = len(SCENES) * len(MJCF_CAMERAS)
"""Images of one frame."""
TRIES = 4
"""How often a frame is randomised again if the arm penetrates something."""
EVERY = 3
"""Steps between the expert's candidate states."""
NEAR_WEIGHT = 3.0
"""Relative probability of a state with the hand near an object."""
STATE_STREAM, SCENE_STREAM = 5, 6
"""Of an episode's random numbers: perturbations and choice of states; randomisation of scenes."""
KINDS_FILE = "kinds.json"


class Pictures:
    """Labelled images of several files as one, read from the disk as they are asked for."""

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = [_read(file) for file in files]
        self._starts = np.cumsum([0, *(len(rows) for rows in self._files)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def rows(self, indices: Sequence[int] | np.ndarray) -> Rows:
        """Return labelled images (n,) by their indices."""
        found = np.empty(len(indices), PICTURE)
        files = np.searchsorted(self._starts, indices, side="right") - 1
        for place, (file, index) in enumerate(zip(files, indices, strict=True)):
            found[place] = self._files[file][index - self._starts[file]]
        return found


def _read(file: Path) -> Rows:
    try:
        rows = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise MemobenchError(f"{file} cannot be read as pictures ({error}); remove it and repeat the command") from None
    if rows.dtype != PICTURE:
        raise MemobenchError(f"{file} holds no pictures of this version; remove it and repeat the command")
    return np.asarray(rows) if not len(rows) else rows


@dataclass(frozen=True)
class DetectorData:
    """Images to make: ``frames`` of each episode, `PER_FRAME` images each, by so many ``workers``."""

    names: Sequence[str]
    first_seed: int
    episodes: int
    frames: int
    workers: int = 1

    def pictures(self, folder: Path, allowed: range, progress: Callable[[Advance], None] | None = None) -> Pictures:
        """Make the images that a folder lacks, and return all of them."""
        seeds = range(self.first_seed, self.first_seed + self.episodes)
        if seeds[0] not in allowed or seeds[-1] not in allowed:
            raise MemobenchError(
                f"found seeds {seeds[0]} to {seeds[-1]}; expected {allowed[0]} to {allowed[-1]}, so that training and "
                "test scenes differ"
            )
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / KINDS_FILE).is_file():
            write_file(folder / KINDS_FILE, json.dumps(kinds()))
        advice = "remove the folder and repeat the command"
        if tuple(read_json(folder / KINDS_FILE, list[str], advice)) != kinds():
            raise MemobenchError(f"{folder} holds pictures of other kinds of objects than this version has; {advice}")
        jobs = [
            EpisodeImages(name, seed, folder / f"{task_index(name):02d}-{seed}-{self.frames}.npy", self.frames)
            for name in self.names
            for seed in seeds
        ]
        run_jobs(jobs, workers=self.workers, progress=progress)
        return Pictures([job.folder for job in jobs])


@dataclass(frozen=True)
class EpisodeImages:
    """The labelled images of so many ``frames`` of one episode of the task ``name``, a job."""

    name: str
    seed: int
    folder: Path
    frames: int

    @property
    def task_name(self) -> str:
        """The task's name."""
        return self.name

    def finished(self) -> bool:
        """Whether the file is there."""
        return self.folder.is_file()

    def failure(self) -> str | None:
        """No reason: images of an episode that fails are as good."""

    def run(self) -> None:
        """Make the file."""
        episode = _episode(self.name)
        rng = generator(episode.published, self.seed, SCENE_STREAM)
        states = expert_states(episode, self.seed, self.frames)
        scenes = Scenes(episode.sim, rng)
        rows = [row for state in states for row in scenes.images(state)]
        with draft_of(self.folder) as draft:
            np.save(draft, np.array(rows, PICTURE))


@lru_cache(maxsize=1)
def _episode(name: str) -> Episode:
    return Episode(get_task(name), referent="random")


@dataclass(frozen=True)
class ExpertState:
    """A state of an episode. ``state``: as `Simulation.state` gives it. ``near``: the hand is near an object."""

    state: NDArray[np.float64]
    highlights: tuple[Highlight, ...]
    near: bool


def expert_states(episode: Episode, seed: int, count: int) -> list[ExpertState]:
    """Play the perturbed expert in the episode of a seed, prompt and all; return at most ``count`` states."""
    rng = generator(episode.published, seed, STATE_STREAM)
    episode.reset(seed)
    perturbation, states = Perturbation(rng), []
    while not (episode.done or episode.expert_done):
        if episode.step_index % EVERY == 0 and not episode.at_rest:
            states.append(_state(episode))
        episode.step(perturbation.executed(episode.expert_action()))
    weights = np.array([NEAR_WEIGHT if state.near else 1.0 for state in states])
    chosen = rng.choice(len(states), min(count, len(states)), replace=False, p=weights / weights.sum())
    return [states[index] for index in sorted(chosen)]


def _state(episode: Episode) -> ExpertState:
    sim = episode.sim
    hand = sim.eef_pose()[0]
    places = [sim.body_pose(name)[0] for name, asset in sim.assets.items() if asset.kind == "object"]
    places += [sim.site_pose(part.handle_site)[0] for a in sim.assets.values() for part in a.articulations.values()]
    near = min(float(np.linalg.norm(place - hand)) for place in places) < NEAR
    return ExpertState(sim.state(), sim.highlights, near)


class Scenes:
    """Make the scenes of states of one episode."""

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        self._sim, self._crowd = sim, with_distractors(sim, rng)
        self._fixed = sim.fixture_poses()
        self._plain, self._full = Labeller(sim), Labeller(self._crowd)
        self._randomisation = DomainRandomisation(self._crowd, rng)

    def images(self, state: ExpertState) -> Iterable[Rows]:
        """Yield the labelled images of one state, of both cameras in each of `SCENES`."""
        sim, crowd = self._sim, self._crowd
        sim.set_state(state.state, self._fixed)
        sim.highlights = state.highlights
        yield from (self._plain.take(camera) for camera in MJCF_CAMERAS)
        for scene in range(1, len(SCENES)):
            for _ in range(TRIES):
                crowd.set_state(widened(state.state, sim, crowd), self._fixed)
                try:
                    free = self._randomisation.apply(reach=scene == len(SCENES) - 1)
                except mujoco.FatalError:  # two equal boxes may overlap with more contacts than MuJoCo allows
                    mujoco.mj_resetData(crowd.model, crowd.data)
                    continue
                if free:
                    crowd.highlights = self._randomisation.highlights()
                    yield from (self._full.take(camera, scene) for camera in MJCF_CAMERAS)
                    break
