"""Demonstrations made by the scripted experts, and the dataset that they become.

A run can be killed at any moment and goes on when the same command is given again: finished episodes wait in
``DIR/.staging`` (see ``staging``), the dataset is assembled from them at the end. Each episode is a function
of task, seed and settings, so neither interruptions nor the number of workers change the result.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.card import SCRIPTED
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.lerobot_format import (
    DEFAULT_REPO_ID,
    HDF5_FOLDER,
    MANIFEST_FILE,
    STAGING,
    assemble,
    check_destination,
    is_dataset,
)
from lerobot_memobench.datasets.mjcf import model_file
from lerobot_memobench.datasets.staging import (
    FORMATS,
    HDF5,
    LEROBOT,
    EpisodeStage,
    StagedEpisode,
    StagedJob,
    clean_temporaries,
    stage_failure,
    staged,
)
from lerobot_memobench.datasets.unfinished import REQUEST_FILE, check_request, compare_requests
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.jobs.executors import check_executor
from lerobot_memobench.jobs.job import ProgressCallback
from lerobot_memobench.jobs.locking import locked
from lerobot_memobench.jobs.running import run_jobs
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import NO_OP
from lerobot_memobench.tasks.task import Task

FIRST_SEED = 10_000
"""Demonstrations use the seeds 10,000 + i; evaluation uses 7 + i (paper, section 5.1)."""

HOLD_FRAMES = 10
"""Frames kept after success, without motion: the last event has a frame, and a policy learns to stop."""

PATIENCE = 40
"""Steps that an episode goes on after the expert is through with its plan: what still falls, slides or has to hold for
some steps may yet reach the goal. Then it is given up, long before the horizon."""


@dataclass(frozen=True)
class RecordingSettings:
    """What one demonstration depends on besides task and seed."""

    referent: str = "fixed"
    images: bool = True
    image_size: int = 256
    prompt_video: bool = True
    hold_frames: int = HOLD_FRAMES


@dataclass(frozen=True)
class Failure:
    """A seed without a demonstration, and why."""

    task_name: str
    seed: int
    reason: str


@dataclass(frozen=True)
class TaskSummary:
    """What became of one task: ``frames`` are those of its successful episodes, holding frames included."""

    name: str
    memory_type: str
    episodes: int
    solved: int
    frames: tuple[int, ...]
    failures: tuple[Failure, ...]


@dataclass(frozen=True)
class GenerationSummary:
    """What a run made.

    Attributes:
        folder: what was made, or None when no episode succeeded, or none is there yet.
        tasks: one entry per task, in the order asked for.
        submitted: the episodes are being made on Slurm, whose last job will write the dataset.
    """

    folder: Path | None
    tasks: tuple[TaskSummary, ...]
    submitted: bool = False

    @property
    def failures(self) -> tuple[Failure, ...]:
        return tuple(failure for task in self.tasks for failure in task.failures)

    @property
    def exit_status(self) -> int:
        """0 when every seed asked for was solved, else 1."""
        return 1 if self.failures else 0


# --- one demonstration --------------------------------------------------------------------------------------


def record_demonstration(
    task: Task,
    seed: int,
    *,
    referent: str = "fixed",
    variant: int = 0,
    images: bool = True,
    prompt_video: bool = True,
    hold_frames: int = HOLD_FRAMES,
    image_size: int = 256,
) -> Demonstration:
    """Let the scripted expert carry out a task from a seed.

    The result may be a failure (``success`` is False): it is then cut off at the horizon. With
    ``referent="random"`` the seed decides the variant; ``variant`` picks one when the referent is fixed.
    """
    if variant and referent != "fixed":
        raise MemobenchError(
            f"variant {variant} was asked for together with referent={referent!r}; choose variants with 'fixed' only"
        )
    settings = RecordingSettings(referent, images, image_size, prompt_video, hold_frames)
    return _record(_episode(task.variant(variant), settings), seed, settings)


@lru_cache(maxsize=1)
def _episode(task: Task, settings: RecordingSettings) -> Episode:
    """The last task's scene stays compiled: a worker meets a task's seeds one after another."""
    size = settings.image_size
    return Episode(
        task,
        referent=settings.referent,
        prompt_video=settings.prompt_video,
        render=replace(RenderSettings(), width=size, height=size),
    )


def _record(
    episode: Episode,
    seed: int,
    settings: RecordingSettings,
    show: Callable[[dict[str, NDArray[np.uint8]]], None] | None = None,
) -> Demonstration:
    """Record an episode. Images go to ``show``, frame by frame, or without it into the demonstration."""
    if settings.hold_frames < 1:
        raise MemobenchError(
            f"hold_frames is {settings.hold_frames}; the last event shows only with at least 1 frame after success"
        )
    episode.reset(seed)
    fixture_poses = episode.sim.fixture_poses()
    states, actions, proprio, satisfied = [], [], [], []
    images: dict[str, list[Any]] = {}
    reached = False
    held = idle = 0
    while held < settings.hold_frames:
        states.append(episode.sim.state())
        proprio.append(episode.sim.proprio())
        satisfied.append(episode.progress.satisfied)
        if settings.images:
            seen = episode.images()
            if show is not None:
                show(seen)
            else:
                for name, frame in seen.items():
                    images.setdefault(name, []).append(frame)
        reached = reached or episode.success
        idle += getattr(episode, "expert_done", False)
        over = reached or episode.done or idle > PATIENCE
        held += over
        episode.step(np.asarray(NO_OP, dtype=np.float32) if over else episode.expert_action())
        actions.append(episode.applied_action)
    assert episode.exec_start is not None
    return Demonstration(
        task=episode.task,
        seed=seed,
        referent=settings.referent,
        variant=episode.task.variant_index,
        states=np.array(states, dtype=np.float64),
        actions=np.array(actions, dtype=np.float32),
        proprio=np.array(proprio, dtype=np.float32),
        images={name: np.stack(images.pop(name)) for name in list(images)} if images else None,
        exec_start=episode.exec_start,
        satisfied=np.array(satisfied, dtype=np.bool_).reshape(len(states), len(episode.task.checkpoints)),
        success=reached and episode.prompt_shown is not False,
        fixture_poses=fixture_poses,
        scene_hash=episode.scene_hash,
    )


def _failure_reason(demo: Demonstration, episode: Episode) -> str | None:
    if episode.prompt_shown is False:
        return "the prompt video did not show what it had to"
    if not demo.success:
        index, count = episode.progress.index, len(demo.task.checkpoints)
        steps = episode.progress.steps
        how = f"in {episode.horizon} steps" if steps >= episode.horizon else f"by step {steps}, the expert's plan over"
        return f"goal not reached {how} ({index} of {count} checkpoints completed)"
    return None


# --- many demonstrations ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RecordingJob(StagedJob):
    """One seed of one task, to be recorded and staged in ``folder``."""

    task: Task
    seed: int
    settings: RecordingSettings
    folder: Path
    formats: tuple[str, ...] = (LEROBOT,)

    @property
    def task_name(self) -> str:
        return self.task.name

    def run(self) -> None:
        """Make the episode. Runs in any process; the folder is all that it leaves behind."""
        where = f"{self.task.name}, seed {self.seed}"
        try:
            episode = _episode(self.task, self.settings)
            with EpisodeStage(self.folder, self.formats) as stage:
                demo = _record(episode, self.seed, self.settings, stage.add_images)
                reason = _failure_reason(demo, episode)
                if reason is None:
                    if HDF5 in self.formats:
                        demo = replace(demo, model_xml=model_file(self.task, demo.fixture_poses))
                    stage.publish(demo)
                    return
        except MemobenchError as error:
            raise MemobenchError(f"{where}: {error}") from error
        except Exception as error:
            error.add_note(f"while recording {where}")
            raise
        info = {
            "task_name": self.task.name,
            "memory_type": self.task.memory_type,
            "seed": self.seed,
            "referent": self.settings.referent,
            "variant": demo.variant,
            "success": False,
            "frames": len(demo),
            "scene_hash": demo.scene_hash,
        }
        stage_failure(info, reason, self.folder)


def generate(
    tasks: Sequence[Task],
    episodes: int,
    out: Path | str,
    *,
    seed_base: int = FIRST_SEED,
    referent: str = "fixed",
    images: bool = True,
    image_size: int = 256,
    prompt_video: bool = True,
    hold_frames: int = HOLD_FRAMES,
    formats: Collection[str] = (LEROBOT,),
    workers: int = 1,
    executor: str = "processes",
    executor_options: Mapping[str, Any] | None = None,
    resume: bool = True,
    repo_id: str = DEFAULT_REPO_ID,
    progress: ProgressCallback | None = None,
) -> GenerationSummary:
    """Make ``episodes`` demonstrations of each task into the folder ``out``.

    ``formats`` says what becomes of them: ``lerobot`` is a LeRobotDataset in ``out``, ``hdf5`` a file per task in
    the published layout in ``out``/hdf5. The seeds are ``seed_base`` + i. An unfinished run of the same request in
    ``out`` is continued (``resume=False`` starts anew), a finished one is only reported. Failed episodes are in no
    dataset, but in the summary, the manifest and the card.

    ``executor`` says where ``workers`` episodes at a time are made (``jobs.executors.EXECUTORS``); it changes nothing of
    the result. On Slurm the call returns when the jobs are submitted, the last of which writes the dataset.

    Raises:
        MemobenchError: nothing to do, ``out`` holds something else, another run is writing there, or an
            episode could not be run at all (which no later run would change).
    """
    out = Path(out)
    if not tasks or episodes < 1 or workers < 1:
        raise MemobenchError(
            f"{len(tasks)} tasks, {episodes} episodes, {workers} workers were asked for; each must be at least 1"
        )
    names = [task.name for task in tasks]
    if len(set(names)) < len(names):
        raise MemobenchError(f"a task was named twice among {', '.join(names)}; name each once")
    formats = _checked_formats(formats, images)
    check_executor(executor, executor_options)
    settings = RecordingSettings(referent, images, image_size, prompt_video, hold_frames)
    request = {
        "tasks": names,
        "formats": list(formats),
        "episodes": episodes,
        "seed_base": seed_base,
        **asdict(settings),
        "task_files": [task_hash(task) for task in tasks],
        "versions": _versions(),
    }
    if is_finished(out):
        return _finished(out, request, tasks)
    check_destination(out)
    staging = out / STAGING
    staging.mkdir(parents=True, exist_ok=True)
    with locked(staging, out):
        if not resume:
            shutil.rmtree(staging / "episodes", ignore_errors=True)
            (staging / REQUEST_FILE).unlink(missing_ok=True)
        check_request(staging, request, out, "pass resume=false to start anew or name another folder")
        folder = staging / "episodes"
        folder.mkdir(exist_ok=True)
        clean_temporaries(folder)
        jobs = [
            RecordingJob(task, seed_base + i, settings, folder.absolute() / f"{number * episodes + i:06d}", formats)
            for number, task in enumerate(tasks)
            for i in range(episodes)
        ]
        again = partial(
            generate,
            tasks,
            episodes,
            out.absolute(),
            seed_base=seed_base,
            **asdict(settings),
            formats=formats,
            repo_id=repo_id,
        )
        complete = run_jobs(
            jobs,
            workers=workers,
            progress=progress,
            executor=executor,
            options=executor_options,
            # Slurm's logs outlive the run, and its last job still writes to them when the staging folder is gone.
            logs=out.absolute().with_name(f"{out.absolute().name}_slurm") if executor == "slurm" else staging / "logs",
            finish=again,
        )
        if not complete:
            return GenerationSummary(None, _summarise([], tasks, out).tasks, submitted=True)
        episodes_staged = [staged(job) for job in jobs]
        summary = _summarise([_row(episode) for episode in episodes_staged], tasks, out)
        if summary.folder is not None:
            prompts = "" if prompt_video else ", prompt videos left out"
            made_by = f"`memobench generate`, {episodes} seeds per task from {seed_base} on, referent {referent}"
            assemble(
                episodes_staged,
                out,
                formats=formats,
                repo_id=repo_id,
                made_by=f"{made_by}{prompts}. {SCRIPTED}",
                manifest={"request": request},
            )
            shutil.rmtree(staging)
    return summary


def is_finished(out: Path) -> bool:
    """Whether ``out`` holds everything that a run had to make: its manifest comes last, or the dataset after it."""
    if is_dataset(out):
        return True
    try:
        manifest = json.loads((out / MANIFEST_FILE).read_text())
        return LEROBOT not in manifest["request"]["formats"] and (out / HDF5_FOLDER).is_dir()
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _checked_formats(formats: Collection[str], images: bool) -> tuple[str, ...]:
    """Return the formats in their order, each once."""
    given = [formats] if isinstance(formats, str) else list(formats)
    for name in given:
        if name not in FORMATS:
            raise MemobenchError(f"found format {name!r}, {nearest(name, FORMATS)}")
    if not given:
        raise MemobenchError(f"no format was asked for; name {' or '.join(FORMATS)}, or both")
    if HDF5 in given and not images:
        raise MemobenchError("format 'hdf5' was asked for without images, which its layout holds; record them as well")
    return tuple(name for name in FORMATS if name in given)


def _finished(out: Path, request: dict[str, Any], tasks: Sequence[Task]) -> GenerationSummary:
    """Report a dataset that is finished already; remove what a kill in the last moment left beside it."""
    try:
        manifest = json.loads((out / MANIFEST_FILE).read_text())
        earlier = manifest["request"]
    except (FileNotFoundError, KeyError, json.JSONDecodeError):
        raise MemobenchError(
            f"{out} already holds a dataset that this command did not make; name another folder"
        ) from None
    earlier = {
        **earlier,
        "versions": request["versions"],
    }  # a finished dataset stays valid under newer versions
    compare_requests(earlier, request, f"{out} already holds a finished dataset", "name another folder")
    shutil.rmtree(out / STAGING, ignore_errors=True)
    return _summarise(manifest["episodes"], tasks, out)


def _row(episode: StagedEpisode) -> dict[str, Any]:
    return {**episode.info, "failure": episode.failure}


def _summarise(rows: Sequence[dict[str, Any]], tasks: Sequence[Task], out: Path) -> GenerationSummary:
    summaries = []
    for task in tasks:
        chosen = [row for row in rows if row["task_name"] == task.name]
        solved = [row for row in chosen if row["failure"] is None]
        failed = [row for row in chosen if row["failure"] is not None]
        failures = tuple(Failure(task.name, row["seed"], row["failure"]) for row in failed)
        frames = tuple(int(row["frames"]) for row in solved)
        summaries.append(TaskSummary(task.name, task.memory_type, len(chosen), len(solved), frames, failures))
    made = any(summary.solved for summary in summaries)
    return GenerationSummary(out if made else None, tuple(summaries))


def task_hash(task: Task) -> str:
    """Hash of a task's files: a run must not be continued with an edited task."""
    text = task.bddl_text + json.dumps(task.metadata, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _versions() -> dict[str, str]:
    """Versions on which an episode's numbers depend."""
    found = {}
    for name in ("lerobot_policy_memobench", "mujoco", "numpy", "av"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
