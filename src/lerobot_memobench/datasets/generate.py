"""Generate demonstrations with the scripted experts, and assemble them to a dataset.

A run that was killed is continued when the same command is given again: finished episodes are kept in ``DIR/.staging``
(see `stage`), and the dataset is assembled from them at the end. Each episode is a function of task, seed and
settings, so neither interruptions nor the number of workers change the result.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import DEMONSTRATION_SEED, EXECUTION, GUARDED, IMAGE_SIZE, LIBERO, SPLITS, WORLD
from lerobot_memobench.datasets.card import SCRIPTED
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.layout import DEFAULT_REPO_ID, STAGING, is_dataset
from lerobot_memobench.datasets.stage import (
    FINISHED_EARLY,
    EpisodeStage,
    StagedJob,
    episodes_folder,
    finished_manifest,
    stage_failure,
)
from lerobot_memobench.datasets.write import assemble
from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.io import explaining_disk_errors, free_bytes, in_words
from lerobot_memobench.jobs.processes import ProgressCallback, run_jobs
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.sim.convention import CONVENTIONS, UPRIGHT
from lerobot_memobench.sim.files import check_assets
from lerobot_memobench.sim.simulation import RenderSettings
from lerobot_memobench.tasks.task import STRICT, Task, referent_text

HOLD_FRAMES = 10
"""Frames recorded after success: the last event has a frame, and the expert completes its motion, so that a less exact
policy does not stop before it."""
PERTURBATION = 4  # stream of the episode's random numbers that draws perturbations
PATIENCE = 40
"""Steps, without held ones, that an episode continues after the expert has finished its plan: falling or sliding
objects, and formulas that must hold for some steps, may still reach the goal. Then it is given up, long before the
horizon."""

FRAMES = {
    "published": {"temporal": 390, "spatial": 570, "object": 320, "procedural": 730},
    "strict": {"temporal": 530, "spatial": 860, "object": 330, "procedural": 750},
}
"""Mean frames of a demonstration, prompt included, in the full runs (results/demonstrations.md), without rest and
held frames."""
HELD = {"temporal": 3_900, "spatial": 600, "object": 600, "procedural": 600}
"""Mean held frames of a strict demonstration. Only their images take time and room."""
FRAME_BYTES, IMAGES_BYTES, HELD_BYTES = 800, 5_400, 2_300
"""Bytes of a frame without images, and of both cameras' videos per frame and held frame at 256 × 256."""
FRAME_SECONDS, IMAGES_SECONDS, HELD_SECONDS = 0.0045, 0.011, 0.002
"""Seconds of one core to make a frame, to draw and encode both cameras at 256 × 256, and to encode them in a hold."""


def generate(
    tasks: Sequence[Task],
    episodes: int,
    out: Path | str,
    *,
    prompted_episodes: int | None = None,
    seed_base: int = DEMONSTRATION_SEED,
    referent: str = "fixed",
    images: bool = True,
    image_size: int = IMAGE_SIZE,
    demonstration_prompt: bool = True,
    perturb: bool = False,
    convention: str = UPRIGHT,
    workers: int = 1,
    repo_id: str = DEFAULT_REPO_ID,
    finish: bool = False,
    progress: ProgressCallback | None = None,
    notify: Callable[[str], None] = lambda _: None,
) -> GenerationSummary:
    """Make ``episodes`` demonstrations of each task (with a prompt: ``prompted_episodes``) into the folder ``out``.

    Failed episodes are not in the dataset, but in the summary, the manifest and the card. An unfinished run of the same
    request in ``out`` is continued; a finished one is reported again.

    Args:
        seed_base: episode i has the scene of seed ``seed_base`` + i.
        finish: assemble the dataset of an unfinished run's episodes, and make no further episode.
        notify: called before the first episode with the approximate size and duration.
        referent, images, image_size, demonstration_prompt, perturb, convention: see `RecordingSettings`.

    Raises:
        MemobenchError: invalid arguments, seeds of a guarded split, ``out`` holds something else or a damaged dataset,
            another run is writing there, its disk has no room (finished episodes stay), or an episode could not be run
            at all, which no later run would change.
    """
    _check_request(tasks, episodes, prompted_episodes, seed_base, demonstration_prompt, workers)
    out, referent = Path(out), referent_text(referent, drawn=all(task.drawn for task in tasks))
    check_choice("convention", convention, [*CONVENTIONS])
    settings = RecordingSettings(referent, images, image_size, demonstration_prompt, perturb, convention)
    request = {
        "tasks": [task.name for task in tasks],
        "episodes": episodes,
        "prompted_episodes": prompted_episodes,
        "seed_base": seed_base,
        WORLD: LIBERO,
        "hold_frames": HOLD_FRAMES,
        **asdict(settings),
        "task_files": [task_hash(task) for task in tasks],
        "versions": versions_of_numbers(),
    }
    prompts = "" if demonstration_prompt else ", demonstration prompts left out"
    more = "" if prompted_episodes is None else f" ({prompted_episodes} of those with a prompt)"
    moved = ", the arm disturbed at random in two thirds of them" if perturb else ""
    seeds = f"{episodes} seeds per task{more} from {seed_base} on"
    made_by = f"`memobench generate`, {seeds}, referent {referent}{prompts}{moved}. {SCRIPTED}"
    if not finish:
        check_assets()
        manifest = finished_manifest(out, request)
        if manifest is not None:
            return _summary(manifest["episodes"], tasks, out)
    elif is_dataset(out) or not (out / STAGING).is_dir():
        raise MemobenchError(f"{out} holds no unfinished run; leave --finish out to begin one or to see its outcome")
    continues = "" if finish else ", and the same command continues"
    with explaining_disk_errors(out, f"finished episodes stay{continues}"), episodes_folder(out, request) as folder:
        jobs: list[RecordingJob] = []
        for task in tasks:
            for i in range(episodes_of(task, episodes, prompted_episodes)):
                jobs.append(RecordingJob(task, seed_base + i, settings, folder / f"{len(jobs):06d}"))
        if finish:
            finished = [job for job in jobs if job.finished()]
            made_by += f" The run was finished early: {len(finished)} of {len(jobs)} seeds were run."
            request[FINISHED_EARLY] = len(finished) < len(jobs)
            jobs = finished
        else:
            _report_size(jobs, settings, out, workers, notify)
            run_jobs(jobs, workers=workers, progress=progress)
        staged = [job.episode() for job in jobs]
        summary = _summary([{**episode.info, "failure": episode.failure} for episode in staged], tasks, out)
        if summary.folder is not None:
            assemble(staged, out, repo_id=repo_id, made_by=made_by, manifest={"request": request})
            shutil.rmtree(out / STAGING, ignore_errors=True)
        return summary


def _check_request(
    tasks: Sequence[Task],
    episodes: int,
    prompted_episodes: int | None,
    seed_base: int,
    demonstration_prompt: bool,
    workers: int,
) -> None:
    most = episodes if prompted_episodes is None else prompted_episodes
    if not tasks or min(episodes, most, workers) < 1:
        raise MemobenchError(
            f"{len(tasks)} tasks, {episodes} episodes ({most} with a prompt), {workers} workers were asked for; each "
            "must be at least 1"
        )
    names = [task.name for task in tasks]
    if len(set(names)) < len(names):
        raise MemobenchError(f"a task was named twice among {', '.join(names)}; name each once")
    last_seed = seed_base + max(episodes_of(task, episodes, prompted_episodes) for task in tasks) - 1
    for name in GUARDED:
        split = SPLITS[name]
        if seed_base <= split[-1] and last_seed >= split[0]:
            raise MemobenchError(
                f"seeds {seed_base} to {last_seed} reach into the split '{name}' ({split[0]} to {split[-1]}), on which "
                f"no policy is trained; ask for seeds within {DEMONSTRATION_SEED} to {SPLITS['demonstrations'][-1]}, "
                f"such as --seed-base {DEMONSTRATION_SEED}; evaluate policy=memobench_expert to measure the expert"
            )
    hiding = next((task for task in tasks if task.prompt is not None and not task.prompt.restores), None)
    if hiding is not None and not demonstration_prompt:
        raise MemobenchError(
            f"demonstrations of {hiding.name} were asked for without its demonstration prompt, which hides the object "
            "to find; leave out --no-demonstration-prompt"
        )


def episodes_of(task: Task, episodes: int, prompted_episodes: int | None) -> int:
    """Return the number of demonstrations of a task that `generate` makes."""
    return episodes if task.prompt is None or prompted_episodes is None else prompted_episodes


def task_hash(task: Task) -> str:
    """Return a hash of a task's files: a run must not be continued with an edited task."""
    text = task.bddl_text + json.dumps(task.metadata, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# --- size and time ---


def versions_of_numbers() -> dict[str, str]:
    """Return package -> version of the packages on which an episode's numbers depend."""
    return {name: version(name) for name in ("lerobot_policy_memobench", "mujoco", "numpy", "av")}


def run_size(frames: int, image_size: int | None, held_frames: int = 0) -> int:
    """Return the approximate bytes of frames and held frames; ``image_size`` is None without images."""
    area = 0.0 if image_size is None else (image_size / IMAGE_SIZE) ** 2
    return round(frames * FRAME_BYTES + (frames * IMAGES_BYTES + held_frames * HELD_BYTES) * area)


def check_room(out: Path, size: int, staged: int, notify: Callable[[str], None], work: str, extra: int = 0) -> None:
    """Report the disk space that a run needs, and refuse a run if one copy of the dataset has no room.

    ``size`` is the dataset's, ``staged`` of it exists already, ``extra`` is that of temporary files, all in bytes;
    ``work`` begins the message.
    """
    # Finished episodes are kept until the dataset is complete, so at its end a run needs twice its size.
    free, most = free_bytes(out), max(2 * size - staged, 0) + extra
    sizes = f"about {in_words(size)} in {out}, {in_words(most)} until it is finished; {in_words(free)} are free there"
    if free < size - staged + extra:
        raise MemobenchError(f"{work} would take {sizes}: make room, name a folder on another disk, or ask for less")
    warning = "; THAT MAY NOT BE ENOUGH: a full disk ends the run, and the same command then continues"
    notify(f"{work}: {sizes}{warning * (free < most)}")


def _report_size(
    jobs: Sequence[RecordingJob], settings: RecordingSettings, out: Path, workers: int, notify: Callable[[str], None]
) -> None:
    missing = [job for job in jobs if not job.folder.exists()]
    if not missing:
        return
    side = settings.image_size if settings.images else None
    frames, left = (
        sum(FRAMES[job.task.suite].get(job.task.memory_type, 600) for job in some) for some in (jobs, missing)
    )
    held_frames, held_left = (
        sum(HELD.get(job.task.memory_type, 0) for job in some if job.task.suite == STRICT) for some in (jobs, missing)
    )
    area = ((side or 0) / IMAGE_SIZE) ** 2
    seconds = left * FRAME_SECONDS + (left * IMAGES_SECONDS + held_left * HELD_SECONDS) * area
    minutes = seconds / 60 / max(min(workers, cores()), 1)
    time = f"{minutes / 60:.1f} hours" if minutes > 90 else f"{max(round(minutes), 1)} min"
    size = run_size(frames, side, held_frames)
    extent = f"{left:,} frames{f' and {held_left:,} held ones' if held_left else ''}"
    work = f"{len(missing)} demonstrations of about {extent}, in about {time} with {workers} at a time"
    check_room(out, size, size - run_size(left, side, held_left), notify, work)


# --- the outcome ---


@dataclass(frozen=True)
class EpisodeOutcome:
    """A requested seed, the frames of its episode, and the reason if there is no demonstration of it."""

    task_name: str
    seed: int
    frames: int
    failure: str | None


@dataclass(frozen=True)
class GenerationSummary:
    """Outcome of a run: its dataset, or None if no episode succeeded, the requested tasks, and the seeds in order."""

    folder: Path | None
    tasks: tuple[str, ...]
    episodes: tuple[EpisodeOutcome, ...]

    @property
    def failures(self) -> list[EpisodeOutcome]:
        """Seeds without a demonstration."""
        return [episode for episode in self.episodes if episode.failure is not None]


def _summary(rows: Sequence[dict[str, Any]], tasks: Sequence[Task], out: Path) -> GenerationSummary:
    episodes = tuple(EpisodeOutcome(row["task_name"], row["seed"], row["frames"], row["failure"]) for row in rows)
    succeeded = any(episode.failure is None for episode in episodes)
    return GenerationSummary(out if succeeded else None, tuple(task.name for task in tasks), episodes)


# --- one episode ---

Images = dict[str, NDArray[np.uint8]]  # camera to a frame, (H, W, 3)


@dataclass(frozen=True)
class RecordingSettings:
    """Settings of a demonstration besides task and seed."""

    referent: str = "fixed"  # the task's own goal, or "random": the seed's; of a strict task "drawn"
    images: bool = True
    image_size: int = IMAGE_SIZE  # height and width, pixels
    demonstration_prompt: bool = True  # whether the episode begins with the task's prompt, if it has one
    perturb: bool = False  # whether the arm is moved off its way at random (`Perturbation`)
    convention: str = UPRIGHT  # in which the images are written (`sim.convention`)


@lru_cache(maxsize=1)
def compiled_episode(task: Task, settings: RecordingSettings) -> Episode:
    """Return an episode of a task, to be reset; the last one is cached, because a task's seeds follow each other."""
    return Episode(
        task,
        suite=task.suite,
        referent=settings.referent,
        demonstration_prompt=settings.demonstration_prompt,
        render=replace(RenderSettings(), width=settings.image_size, height=settings.image_size),
    )


def record(episode: Episode, seed: int, settings: RecordingSettings, show: Callable[[Images], object]) -> Demonstration:
    """Record an episode without images; ``show`` is called with the images of each frame."""
    episode.reset(seed)
    sim, fixture_poses = episode.sim, episode.sim.fixture_poses()
    frames: list[tuple[Any, ...]] = []
    actions, executed = [], []
    disturb = Perturbation(generator(episode.published, seed, PERTURBATION)) if settings.perturb else None
    reached = rests = False
    after = idle = 0
    images: Images | None = None
    while after < HOLD_FRAMES:
        if not (episode.rested or (rests and episode.idling)):  # a scene at rest is observed once
            state, hand, seen = sim.state(), sim.proprio(), episode.objects()
            images = episode.images() if settings.images else None
        rests = episode.idling
        is_held = episode.phase == EXECUTION and not episode.action_has_effect
        frames.append((state, hand, seen, episode.progress.satisfied, is_held))
        if images is not None:
            show(images)
        reached = reached or episode.success
        idle += episode.expert_done and not is_held
        over = reached or episode.done or idle > PATIENCE
        after += over
        wanted = episode.expert_action()
        acting = disturb is not None and episode.action_has_effect
        disturbed = disturb.executed(wanted, sim.at_detent) if disturb is not None and acting and not over else wanted
        episode.step(disturbed)
        executed.append(episode.applied_action)
        actions.append(np.clip(wanted, -1.0, 1.0) if acting else episode.applied_action)
    assert episode.exec_start is not None
    states, proprio, objects, satisfied, held = map(np.array, zip(*frames, strict=True))
    labelled, applied = (np.array(column, dtype=np.float32) for column in (actions, executed))
    return Demonstration(
        task=episode.task,
        seed=episode.seed,
        referent=episode.referent,
        variant=episode.task.variant_index,
        states=states.astype(np.float64),
        actions=labelled,
        executed=None if np.array_equal(labelled, applied) else applied,
        objects=objects.astype(np.float32),
        proprio=proprio.astype(np.float32),
        images=None,
        exec_start=episode.exec_start,
        satisfied=satisfied.astype(np.bool_),
        success=reached and episode.prompt_shown is not False,
        fixture_poses=fixture_poses,
        scene_hash=episode.scene_hash,
        stand_ins=episode.stand_ins,
        held=held if held.any() else None,
    )


def _failure_reason(demo: Demonstration, episode: Episode) -> str | None:
    if episode.fault is not None:
        return episode.fault.why
    if episode.prompt_shown is False:
        return "the demonstration prompt was incomplete"
    if demo.success:
        return None
    steps = episode.progress.steps
    end = "and no longer to be" if episode.lost else "the expert's plan over"
    how = f"in {episode.settings.horizon} steps" if steps >= episode.settings.horizon else f"by step {steps}, {end}"
    completed = f"{episode.progress.index} of {len(demo.task.checkpoints)} checkpoints completed"
    return f"goal not reached {how} ({completed})"


@dataclass(frozen=True)
class RecordingJob(StagedJob):
    """Record one seed of one task and stage it in ``folder``."""

    task: Task
    seed: int
    settings: RecordingSettings
    folder: Path

    @property
    def task_name(self) -> str:
        """The task's name, for the progress."""
        return self.task.name

    def run(self) -> None:
        """Make the episode; the folder is the only output."""
        where = f"{self.task.name}, seed {self.seed}"
        try:
            episode = compiled_episode(self.task, self.settings)
            with EpisodeStage(self.folder, self.settings.convention) as stage:
                demo = record(episode, self.seed, self.settings, stage.add_images)
                reason = _failure_reason(demo, episode)
                if reason is None:
                    stage.publish(demo)
                    return
        except MemobenchError as error:
            raise MemobenchError(f"{where}: {error}") from error
        except Exception as error:
            error.add_note(f"while recording {where}")
            raise
        info = {"task_name": demo.task.name, "seed": demo.seed, "referent": demo.referent, "variant": demo.variant}
        info |= {"success": False, "frames": len(demo), "scene_hash": demo.scene_hash}
        stage_failure(info, reason, self.folder)


# --- perturbation ---
#
# Recovery data: the arm is moved off its way at random, and the closed-loop expert corrects it. The labels of a frame
# are the expert's actions; the executed ones are kept for replay.
# Pushes are standard deviations of an action's six displacements, per step (1 is 5 cm or 0.5 rad); ranges of steps
# exclude their end.

CLEAN = 1 / 3  # share of unperturbed episodes
NOISE = 0.05  # standard deviation on each displacement
PUSH_CHANCE = 0.02  # per step
PUSH, PUSH_STEPS = np.array([0.6, 0.6, 0.6, 0.1, 0.1, 0.3]), (3, 8)  # turns mostly about the vertical
MISS_CHANCE = 0.2
"""Probability that the hand is pushed away when its fingers begin to close: they close on air, and the expert returns.
A policy trained without such frames carries an empty hand to the target."""
MISS, MISS_SPREAD = np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0]), np.array([0.25, 0.25, 0.25, 0.0, 0.0, 0.0])  # upwards
MISS_STEPS = (6, 10)  # about as long as fingers take to close
TWIST_CHANCE = 0.15
"""Probability that the hand is first turned with open fingers, which then stop at another width than along a side. A
policy trained without such frames waits for them to close further."""
TWIST, TWIST_STEPS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.25]), (3, 6)
DROP_CHANCE = 0.05
DROP_AFTER, DROP_STEPS = (15, 50), 8
"""A grasped object is dropped on its way so many steps after closing, for so many steps."""
LATE_CHANCE, LATE_STEPS = 0.2, (3, 16)
"""Fingers stay closed for so many steps when they should open. A policy trained without such frames waits forever
instead of opening."""
COMING_TO_REST = 0.4  # of a displacement at the home detent with which the expert intends to rest there (2 cm)

Array = NDArray[np.float64]


class Perturbation:
    """Perturb the actions of one episode; a function of the generator's numbers only."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._clean = rng.random() < CLEAN
        self._left = 0
        self._push: Array = np.zeros(6)
        self._closed = 0  # steps since the command to close the fingers
        self._open = range(0)  # values of _closed at which they are opened
        self._late = 0  # remaining steps in which they stay closed although they should open

    def executed(self, action: NDArray[np.float32], at_detent: bool = False) -> NDArray[np.float32]:
        """Return the action (7,) to execute instead of the expert's. Call once per step.

        ``at_detent``, in the detent at home, small actions are not perturbed: the hand would never come to rest.
        """
        if self._clean or (at_detent and np.abs(action[:6]).max() <= COMING_TO_REST):
            return action
        opens = self._closed > 0 and action[6] < 0
        self._closed = self._closed + 1 if action[6] > 0 else 0
        if opens:
            self._late = int(self._rng.integers(*LATE_STEPS)) if self._rng.random() < LATE_CHANCE else 0
        if self._closed == 1:
            self._grasp()
        elif not self._left and self._rng.random() < PUSH_CHANCE:
            self._begin(PUSH * self._rng.normal(size=6), PUSH_STEPS)
        executed = action.astype(np.float64)
        executed[:6] += NOISE * self._rng.normal(size=6)
        if self._left:
            executed[:6] += self._push
            self._left -= 1
        if self._closed in self._open:
            executed[6] = -1.0
        elif self._late and action[6] < 0:
            executed[6] = 1.0
            self._late -= 1
        return executed.astype(np.float32)

    def _grasp(self) -> None:
        self._open = range(0)
        draw = self._rng.random()
        if draw < MISS_CHANCE:
            self._begin(MISS + MISS_SPREAD * self._rng.normal(size=6), MISS_STEPS)
        elif draw < MISS_CHANCE + TWIST_CHANCE:
            self._begin(TWIST * self._rng.normal(size=6), TWIST_STEPS)
            self._open = range(1, self._left + 1)
        elif draw < MISS_CHANCE + TWIST_CHANCE + DROP_CHANCE:
            first = int(self._rng.integers(*DROP_AFTER))
            self._open = range(first, first + DROP_STEPS)

    def _begin(self, push: Array, steps: tuple[int, int]) -> None:
        self._push, self._left = push, int(self._rng.integers(*steps))
