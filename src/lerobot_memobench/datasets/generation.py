"""Demonstrations made by the scripted experts, and the dataset that they become.

A run can be killed at any moment and goes on when the same command is given again: finished episodes wait in
``DIR/.staging`` (see ``staging``), the dataset is assembled from them at the end. Each episode is a function
of task, seed and settings, so neither interruptions nor the number of workers change the result.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.lerobot_format import (
    DEFAULT_REPO_ID,
    MANIFEST_FILE,
    STAGING,
    assemble,
    check_destination,
    is_dataset,
)
from lerobot_memobench.datasets.staging import (
    StagedEpisode,
    clean_temporaries,
    read_staged,
    stage_demonstration,
    stage_failure,
    write_json,
)
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import NO_OP
from lerobot_memobench.tasks.task import Task

FIRST_SEED = 10_000
"""Demonstrations use the seeds 10,000 + i; evaluation uses 7 + i (paper, section 5.1)."""

HOLD_FRAMES = 10
"""Frames kept after success, without motion: the last event has a frame, and a policy learns to stop."""

REQUEST_FILE = "request.json"
LOCK_FILE = "lock"


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
        folder: the dataset, or None when no episode succeeded.
        tasks: one entry per task, in the order asked for.
    """

    folder: Path | None
    tasks: tuple[TaskSummary, ...]

    @property
    def failures(self) -> tuple[Failure, ...]:
        return tuple(failure for task in self.tasks for failure in task.failures)

    @property
    def exit_status(self) -> int:
        """0 when every seed asked for was solved, else 1."""
        return 1 if self.failures else 0


@dataclass(frozen=True)
class Advance:
    """Told to the progress callback after each episode: how many are there, and the newest one's identity."""

    done: int
    total: int
    task_name: str
    seed: int
    failure: str | None


ProgressCallback = Callable[[Advance], None]


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


def _record(episode: Episode, seed: int, settings: RecordingSettings) -> Demonstration:
    if settings.hold_frames < 1:
        raise MemobenchError(
            f"hold_frames is {settings.hold_frames}; the last event shows only with at least 1 frame after success"
        )
    episode.reset(seed)
    fixture_poses = episode.sim.fixture_poses()
    states, actions, proprio, satisfied = [], [], [], []
    images: dict[str, list[Any]] = {}
    reached = False
    held = 0
    while held < settings.hold_frames:
        states.append(episode.sim.state())
        proprio.append(episode.sim.proprio())
        satisfied.append(episode.progress.satisfied)
        if settings.images:
            for name, frame in episode.images().items():
                images.setdefault(name, []).append(frame)
        reached = reached or episode.success
        over = reached or episode.done
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
        images={name: np.stack(images.pop(name)) for name in list(images)} if settings.images else None,
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
        return f"goal not reached in {episode.horizon} steps ({index} of {count} checkpoints completed)"
    return None


# --- many demonstrations ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Job:
    task: Task
    seed: int
    settings: RecordingSettings
    folder: Path


def run_job(job: _Job) -> None:
    """Make one episode and stage it. Runs in any process; the folder is all that it leaves behind."""
    where = f"{job.task.name}, seed {job.seed}"
    try:
        episode = _episode(job.task, job.settings)
        demo = _record(episode, job.seed, job.settings)
        reason = _failure_reason(demo, episode)
    except MemobenchError as error:
        raise MemobenchError(f"{where}: {error}") from error
    except Exception as error:
        error.add_note(f"while recording {where}")
        raise
    if reason is None:
        stage_demonstration(demo, job.folder)
        return
    info = {
        "task_name": job.task.name,
        "memory_type": job.task.memory_type,
        "seed": job.seed,
        "referent": job.settings.referent,
        "variant": demo.variant,
        "success": False,
        "frames": len(demo),
        "scene_hash": demo.scene_hash,
    }
    stage_failure(info, reason, job.folder)


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
    workers: int = 1,
    resume: bool = True,
    repo_id: str = DEFAULT_REPO_ID,
    progress: ProgressCallback | None = None,
) -> GenerationSummary:
    """Make ``episodes`` demonstrations of each task into a LeRobotDataset in the folder ``out``.

    The seeds are ``seed_base`` + i. An unfinished run of the same request in ``out`` is continued
    (``resume=False`` starts anew), a finished one is only reported. Failed episodes are in no dataset, but in
    the summary, the manifest and the card.

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
    settings = RecordingSettings(referent, images, image_size, prompt_video, hold_frames)
    request = {
        "tasks": names,
        "episodes": episodes,
        "seed_base": seed_base,
        **asdict(settings),
        "task_files": [_task_hash(task) for task in tasks],
        "versions": _versions(),
    }
    if is_dataset(out):
        return _finished(out, request, tasks)
    check_destination(out)
    staging = out / STAGING
    staging.mkdir(parents=True, exist_ok=True)
    with _locked(staging / LOCK_FILE, out):
        if not resume:
            shutil.rmtree(staging / "episodes", ignore_errors=True)
            (staging / REQUEST_FILE).unlink(missing_ok=True)
        _check_request(staging / REQUEST_FILE, request, out)
        folder = staging / "episodes"
        folder.mkdir(exist_ok=True)
        clean_temporaries(folder)
        jobs = [
            _Job(task, seed_base + i, settings, folder / f"{number * episodes + i:06d}")
            for number, task in enumerate(tasks)
            for i in range(episodes)
        ]
        _run(jobs, workers, progress)
        staged = [_staged(job) for job in jobs]
        summary = _summarise([_row(episode) for episode in staged], tasks, out)
        if summary.folder is not None:
            made_by = f"`memobench generate`, {episodes} seeds per task from {seed_base} on, referent {referent}."
            assemble(staged, out, repo_id=repo_id, made_by=made_by, manifest={"request": request})
            shutil.rmtree(staging)
    return summary


def _run(jobs: Sequence[_Job], workers: int, progress: ProgressCallback | None) -> None:
    """Run the jobs that are not staged yet; tell ``progress`` of every one, old or new."""
    done = 0

    def tell(job: _Job) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(Advance(done, len(jobs), job.task.name, job.seed, _staged(job).failure))

    waiting = []
    for job in jobs:
        if read_staged(job.folder) is None:
            waiting.append(job)
        else:
            tell(job)
    if workers == 1 or len(waiting) <= 1:
        for job in waiting:
            run_job(job)
            tell(job)
        return
    # Processes are spawned: a forked child would share GL contexts and threads with its parent.
    pool = ProcessPoolExecutor(
        min(workers, len(waiting)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin_worker,
    )
    try:
        futures: dict[Future[None], _Job] = {pool.submit(run_job, job): job for job in waiting}
        for future in as_completed(futures):
            future.result()
            tell(futures[future])
    except BrokenProcessPool:
        raise MemobenchError(
            f"one of {workers} worker processes was killed, perhaps because memory ran out; run the same command "
            "again to go on from here, with fewer workers"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """End this worker when the process that started it is gone, however it went; else it would wait on.

    Ctrl-C is the parent's to handle: the episode being made is finished, so that nothing is lost.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _staged(job: _Job) -> StagedEpisode:
    staged = read_staged(job.folder)
    if staged is None:
        raise MemobenchError(f"{job.folder} has vanished while the run was going on; run the command again")
    return staged


@contextlib.contextmanager
def _locked(path: Path, out: Path) -> Iterator[None]:
    """Let one run at a time write to ``out``. The lock is the kernel's and ends with the process."""
    import fcntl

    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise MemobenchError(
                f"another run is writing to {out}; wait for it to end or name another folder"
            ) from None
        yield


def _check_request(path: Path, request: dict[str, Any], out: Path) -> None:
    try:
        earlier = json.loads(path.read_text())
    except FileNotFoundError:
        write_json(request, path)
        return
    _compare(
        earlier,
        request,
        f"{out} holds an unfinished run",
        "pass resume=false to start anew or name another folder",
    )


def _compare(earlier: dict[str, Any], request: dict[str, Any], what: str, advice: str) -> None:
    for key, value in request.items():
        if earlier.get(key) != value:
            raise MemobenchError(f"{what} with {key}={earlier.get(key)!r}, now {value!r} was asked for; {advice}")


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
    _compare(earlier, request, f"{out} already holds a finished dataset", "name another folder")
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


def _task_hash(task: Task) -> str:
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
