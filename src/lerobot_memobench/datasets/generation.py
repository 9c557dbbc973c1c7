"""Demonstrations made by the scripted experts, and the dataset that they become.

A run can be killed at any moment and goes on when the same command is given again: finished episodes wait in
``DIR/.staging`` (see ``staging``), the dataset is assembled from them at the end. Each episode is a function
of task, seed and settings, so neither interruptions nor the number of workers change the result.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR

from lerobot_memobench.datasets.hdf5.reading import SUFFIX, PublishedFile, Unusable
from lerobot_memobench.datasets.lerobot_format.assembling import assemble
from lerobot_memobench.datasets.lerobot_format.card import SCRIPTED
from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    HDF5_FOLDER,
    check_destination,
    check_whole,
    is_dataset,
    read_manifest,
)
from lerobot_memobench.datasets.recording import HOLD_FRAMES, RecordingJob, RecordingSettings
from lerobot_memobench.datasets.staging import (
    FINISHED_EARLY,
    FORMATS,
    HDF5,
    LEROBOT,
    STAGING,
    compare_requests,
    episodes_folder,
    remove_staging,
    staged,
)
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.io import file_hash, file_name, free_bytes, in_words, telling_of_the_disk
from lerobot_memobench.jobs.executors import ELSEWHERE, Needs, check_executor, options_text, run_jobs
from lerobot_memobench.jobs.processes import ProgressCallback
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.protocol import DEMONSTRATION_SEED, GUARDED, IMAGE_SIZE, SPLITS
from lerobot_memobench.sim.worlds import KINDS
from lerobot_memobench.tasks.task import MEMOBENCH, Task, referent_text

WEIGHTS = "model.safetensors"
NEEDS = Needs(cores=1, memory_gb=4)
"""Of one job on Slurm, which makes one episode after another."""
FRAMES = {
    "published": {"temporal": 390, "spatial": 570, "object": 320, "procedural": 730},
    "strict": {"temporal": 530, "spatial": 860, "object": 330, "procedural": 750},
}
"""Frames of a demonstration, prompt included, on average over the full runs (docs/research/demonstration_runs.md).
Those in which a robot idles take next to no time and room."""
FRAME_BYTES, PICTURES_BYTES, HDF5_BYTES = 800, 5_400, 130_000
"""Of a frame in a LeRobotDataset without pictures; of both cameras' videos and of lossless pictures, at 256 × 256."""
FRAME_SECONDS, PICTURES_SECONDS = 0.0045, 0.011
"""Of one core: to make a frame, and to draw and encode both cameras at 256 × 256."""


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
    policy: str | None = None,
    formats: Collection[str] = (LEROBOT,),
    workers: int = 1,
    executor: str = "processes",
    executor_options: Mapping[str, Any] | None = None,
    repo_id: str = DEFAULT_REPO_ID,
    finish: bool = False,
    progress: ProgressCallback | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> GenerationSummary:
    """Make ``episodes`` demonstrations of each task (with a prompt: ``prompted_episodes``) into the folder ``out``.

    Failed episodes are in no dataset, but in the summary, the manifest and the card. An unfinished run of the same
    request in ``out`` is continued, a finished one only reported.

    Args:
        tasks: to demonstrate. episodes, prompted_episodes: of each, without and with a prompt. out: destination.
        seed_base: episode i has the scene of seed ``seed_base`` + i.
        formats: ``lerobot``, a LeRobotDataset in ``out``; ``hdf5``, a file per task in the published layout in
            ``out``/hdf5; or both.
        workers: episodes made at a time. executor, executor_options: where (`jobs.executors`); the result is the same.
            On Slurm the call returns when the jobs are submitted, the last of which writes the dataset.
        finish: make the dataset of an unfinished run's episodes, and no other episode.
        tell: called, before the first episode, with about how large the dataset will be and how long it will take.
        referent, images, image_size, demonstration_prompt, perturb, policy: see `recording.RecordingSettings`.

    Raises:
        MemobenchError: nothing to do, seeds of a guarded split, ``out`` holds something else or a damaged dataset,
            another run is writing there, its disk has no room (what is finished stays), or an episode could not be run
            at all (which no later run would change).
    """
    most = episodes if prompted_episodes is None else prompted_episodes
    if not tasks or min(episodes, most, workers) < 1:
        raise MemobenchError(
            f"{len(tasks)} tasks, {episodes} episodes ({most} with a prompt), {workers} workers were asked for; each "
            "must be at least 1"
        )
    most = max(episodes_of(task, episodes, prompted_episodes) for task in tasks)
    _check_seeds(range(seed_base, seed_base + most))
    check_executor(executor, executor_options)
    hiding = next((task for task in tasks if task.prompt is not None and not task.prompt.restores), None)
    if hiding is not None and not demonstration_prompt:
        raise MemobenchError(
            f"demonstrations of {hiding.name} were asked for without its demonstration prompt, which hides what is to "
            "be found; leave out --no-demonstration-prompt"
        )
    referent = referent_text(referent, drawn=all(task.drawn for task in tasks))
    if perturb and policy is not None:
        raise MemobenchError("the arm is to be moved both at random and by a policy; leave out --perturb or --policy")
    settings = RecordingSettings(referent, images, image_size, demonstration_prompt, perturb, policy)
    formats = _checked_formats(formats, settings, tasks)
    plan = _Plan(tuple(tasks), episodes, prompted_episodes, seed_base, settings, formats, repo_id)
    options = options_text(executor, executor_options or {}, NEEDS)
    if finish:
        return _finish_early(plan, Path(out))
    if executor not in ELSEWHERE:  # there, each part finds out
        KINDS[plan.world].check()
    return _carry_out(plan, Path(out), workers, executor=executor, options=options, progress=progress, tell=tell)


@dataclass(frozen=True)
class _Plan:
    """Episodes and formats that a run is asked for, wherever and however they are made."""

    tasks: tuple[Task, ...]
    episodes: int
    prompted_episodes: int | None
    seed_base: int
    settings: RecordingSettings
    formats: tuple[str, ...]
    repo_id: str

    def __post_init__(self) -> None:
        names = [task.name for task in self.tasks]
        if len(set(names)) < len(names):
            raise MemobenchError(f"a task was named twice among {', '.join(names)}; name each once")
        if len({task.world for task in self.tasks}) > 1:
            raise MemobenchError("tasks of two worlds were asked for; make a dataset of each world by itself")

    @property
    def world(self) -> str:
        """Of all its scenes."""
        return self.tasks[0].world

    @property
    def request(self) -> dict[str, Any]:
        """Settings that must agree for two runs to be one."""
        return {
            "tasks": [task.name for task in self.tasks],
            "formats": list(self.formats),
            "episodes": self.episodes,
            "prompted_episodes": self.prompted_episodes,
            "seed_base": self.seed_base,
            **({} if self.world == MEMOBENCH else {"world": self.world}),
            "hold_frames": HOLD_FRAMES,
            **asdict(self.settings),
            "policy": self.settings.policy and policy_text(self.settings.policy),
            "task_files": [task_hash(task) for task in self.tasks],
            "versions": _versions(),
        }

    @property
    def made_by(self) -> str:
        """A sentence for the card."""
        prompts = "" if self.settings.demonstration_prompt else ", demonstration prompts left out"
        more = "" if self.prompted_episodes is None else f" ({self.prompted_episodes} of those with a prompt)"
        seeds = f"{self.episodes} seeds per task{more} from {self.seed_base} on"
        seeds += "" if self.world == MEMOBENCH else f", world {self.world}"
        moved = ", the arm moved off its way at random in two thirds of them" if self.settings.perturb else ""
        if self.settings.policy is not None:
            moved = f", the arm moved by the policy {policy_text(self.settings.policy)} for some steps at a time"
        return f"`memobench generate`, {seeds}, referent {self.settings.referent}{prompts}{moved}. {SCRIPTED}"

    def jobs(self, folder: Path) -> list[RecordingJob]:
        """Return one job per seed of each task, each with a folder of its own in ``folder``."""
        seeds = [
            (task, self.seed_base + i)
            for task in self.tasks
            for i in range(episodes_of(task, self.episodes, self.prompted_episodes))
        ]
        return [
            RecordingJob(task, seed, self.settings, folder / f"{number:06d}", self.formats)
            for number, (task, seed) in enumerate(seeds)
        ]


# --- the run ---


def _carry_out(
    plan: _Plan,
    out: Path,
    workers: int = 1,
    *,
    executor: str = "processes",
    options: Mapping[str, Any] | None = None,
    progress: ProgressCallback | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> GenerationSummary:
    """Make what is missing, then the dataset; on Slurm that is done by a last job, which calls this again."""
    if is_finished(out):
        return _finished(out, plan)
    check_destination(out)
    with (
        telling_of_the_disk(out, "what is finished stays, and the same command goes on from there"),
        episodes_folder(out, plan.request) as folder,
    ):
        jobs = plan.jobs(folder)
        _tell_of_the_run(plan, jobs, out, workers, tell)
        complete = run_jobs(
            jobs,
            workers=workers,
            progress=progress,
            executor=executor,
            options=options,
            logs=_logs(out, executor),
            finish=partial(_carry_out, plan, out.absolute()),
        )
        if not complete:
            return GenerationSummary(None, summarise([], plan.tasks, out).tasks, submitted=True)
        return _assembled(plan, jobs, out, plan.request, plan.made_by)


def _finish_early(plan: _Plan, out: Path) -> GenerationSummary:
    """Make the dataset of the episodes that an unfinished run has left."""
    if is_dataset(out) or not (out / STAGING).is_dir():
        raise MemobenchError(f"{out} holds no unfinished run; leave --finish out to begin one or to see what it made")
    with telling_of_the_disk(out, "what is finished stays"), episodes_folder(out, plan.request) as folder:
        jobs = plan.jobs(folder)
        there = [job for job in jobs if job.finished()]
        made_by = f"{plan.made_by} The run was finished early: {len(there)} of {len(jobs)} seeds were run."
        return _assembled(plan, there, out, {**plan.request, FINISHED_EARLY: len(there) < len(jobs)}, made_by)


def _assembled(
    plan: _Plan, jobs: Sequence[RecordingJob], out: Path, request: Mapping[str, Any], made_by: str
) -> GenerationSummary:
    """Make the dataset of finished jobs, if one of them has an episode, and remove what it was made of."""
    episodes = [staged(job) for job in jobs]
    summary = summarise([{**episode.info, "failure": episode.failure} for episode in episodes], plan.tasks, out)
    if summary.folder is not None:
        manifest = {"request": request}
        assemble(episodes, out, formats=plan.formats, repo_id=plan.repo_id, made_by=made_by, manifest=manifest)
        shutil.rmtree(out / STAGING)
    return summary


def episodes_of(task: Task, episodes: int, prompted_episodes: int | None) -> int:
    """Return how many demonstrations of a task `generate` is asked for."""
    return episodes if task.prompt is None or prompted_episodes is None else prompted_episodes


def _check_seeds(seeds: range) -> None:
    """Refuse demonstrations of scenes on which policies are chosen or measured (`protocol.GUARDED`)."""
    for name in GUARDED:
        split = SPLITS[name]
        if seeds[0] <= split[-1] and seeds[-1] >= split[0]:
            raise MemobenchError(
                f"seeds {seeds[0]} to {seeds[-1]} reach into the split '{name}' ({split[0]} to {split[-1]}), on which "
                f"no policy is trained; ask for seeds within {DEMONSTRATION_SEED} to {SPLITS['demonstrations'][-1]}, "
                f"such as --seed-base {DEMONSTRATION_SEED}; evaluate policy=memobench_expert to measure the expert"
            )


def _checked_formats(formats: Collection[str], settings: RecordingSettings, tasks: Sequence[Task]) -> tuple[str, ...]:
    """Return the formats in their order, each once."""
    given = [formats] if isinstance(formats, str) else list(formats)
    for name in given:
        if name not in FORMATS:
            raise MemobenchError(f"found format {name!r}, {nearest(name, FORMATS)}")
    if not given:
        raise MemobenchError(f"no format was asked for; name {' or '.join(FORMATS)}, or both")
    if HDF5 in given and (settings.perturb or settings.policy is not None):
        raise MemobenchError(
            "format 'hdf5' was asked for with the arm moved off its way, but its layout has one action per frame, and "
            "needs two: what is to be done and what was; write format lerobot alone"
        )
    if HDF5 in given and not settings.images:
        raise MemobenchError("format 'hdf5' was asked for without images, which its layout holds; record them as well")
    if HDF5 in given and any(task.world != MEMOBENCH for task in tasks):
        raise MemobenchError(
            f"format 'hdf5' was asked for with world={tasks[0].world}, but it holds scenes of world={MEMOBENCH} "
            "alone; write format lerobot"
        )
    return tuple(name for name in FORMATS if name in given)


def _logs(out: Path, executor: str) -> Path:
    """Slurm's logs outlive the run, and its last job still writes to them when the staging folder is gone."""
    out = out.absolute()
    return out.with_name(f"{out.name}_slurm") if executor == "slurm" else out / STAGING / "logs"


def is_finished(out: Path) -> bool:
    """Whether ``out`` holds everything that a run had to make: its manifest comes last, or the dataset after it."""
    if is_dataset(out):
        return True
    try:
        formats = read_manifest(out).get("request", {}).get("formats")
    except (FileNotFoundError, MemobenchError):
        return False
    return isinstance(formats, list) and LEROBOT not in formats and (out / HDF5_FOLDER).is_dir()


def _finished(out: Path, plan: _Plan) -> GenerationSummary:
    """Report a dataset that is finished already; remove what a kill in the last moment left beside it."""
    try:
        manifest = read_manifest(out)
        earlier = manifest["request"]
    except (FileNotFoundError, KeyError):
        raise MemobenchError(
            f"{out} already holds a dataset that this command did not make; name another folder"
        ) from None
    request = {**plan.request, FINISHED_EARLY: False}
    earlier = {**earlier, "versions": request["versions"]}  # a finished dataset stays valid under newer versions
    compare_requests(earlier, request, f"{out} already holds a finished dataset", "name another folder")
    if LEROBOT in plan.formats:
        check_whole(out)
    if HDF5 in plan.formats:
        _check_hdf5(out, Counter(row["task_name"] for row in manifest["episodes"] if row["failure"] is None))
    remove_staging(out)
    return summarise(manifest["episodes"], plan.tasks, out)


def _check_hdf5(out: Path, made: Mapping[str, int]) -> None:
    """Raise where a file has not as many demonstrations as were made of its task."""
    for name, count in made.items():
        path = out / HDF5_FOLDER / f"{file_name(name, 'a task in the manifest')}{SUFFIX}"
        try:
            with PublishedFile(path) as file:
                there = len(file.groups())
        except Unusable as error:
            raise MemobenchError(f"{path}: {error}; delete {out} and generate again") from None
        if there != count:
            raise MemobenchError(
                f"{path} has {there} demonstrations, the manifest {count}; delete {out} and generate again"
            )


def policy_text(checkpoint: str) -> str:
    """Return a checkpoint's name, or its training run's, and the hash of its weights: another one is another run."""
    weights = Path(checkpoint) / WEIGHTS
    if not weights.is_file():
        raise MemobenchError(f"{checkpoint} holds no {WEIGHTS}; name the folder of a policy's checkpoint")
    parts = [part for part in Path(checkpoint).parts if part != PRETRAINED_MODEL_DIR]
    name = parts[parts.index(CHECKPOINTS_DIR) - 1] if CHECKPOINTS_DIR in parts[1:] else parts[-1]
    return f"{name} {file_hash(weights)[:16]}"


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


# --- size and time ---


def run_size(frames: int, formats: Collection[str], image_size: int | None) -> int:
    """Return about how many bytes so many frames take; ``image_size`` is None without pictures."""
    area = 0.0 if image_size is None else (image_size / IMAGE_SIZE) ** 2
    lerobot = (FRAME_BYTES + PICTURES_BYTES * area) * (LEROBOT in formats)
    return round(frames * (lerobot + HDF5_BYTES * area * (HDF5 in formats)))


def check_room(out: Path, size: int, there: int, tell: Callable[[str], None], what: str, work: int = 0) -> None:
    """Tell what a run will take of the disk, and refuse one that cannot fit.

    Finished episodes stand beside the dataset that is made of them until it is whole, so at its end a run needs twice
    its size.

    Args:
        out: its destination. size: of the dataset, about. there: bytes of it that are staged already.
        what: begins the sentence: how much will be made. work: further bytes that are needed meanwhile.

    Raises:
        MemobenchError: not even one copy has room.
    """
    free, most = free_bytes(out), max(2 * size - there, 0) + work
    told = f"about {in_words(size)} in {out}, {in_words(most)} until it is finished; {in_words(free)} are free there"
    if free < size - there + work:
        raise MemobenchError(f"{what} would take {told}: make room, name a folder on another disk, or ask for less")
    warning = "; THAT MAY NOT BE ENOUGH: a full disk ends the run, and the same command then goes on" * (free < most)
    tell(f"{what}: {told}{warning}")


def _tell_of_the_run(
    plan: _Plan, jobs: Sequence[RecordingJob], out: Path, workers: int, tell: Callable[[str], None]
) -> None:
    """Tell size and time of what is to be made, before it is."""
    missing = [job for job in jobs if not job.folder.exists()]
    if not missing:
        return
    pictures = plan.settings.image_size if plan.settings.images else None
    frames, left = (
        sum(FRAMES[job.task.suite].get(job.task.memory_type, 600) for job in some) for some in (jobs, missing)
    )
    seconds = left * (FRAME_SECONDS + PICTURES_SECONDS * ((pictures or 0) / IMAGE_SIZE) ** 2)
    minutes = seconds / 60 / max(min(workers, cores()), 1)
    time = f"{minutes / 60:.1f} hours" if minutes > 90 else f"{max(round(minutes), 1)} min"
    size = run_size(frames, plan.formats, pictures)
    what = f"{len(missing)} demonstrations of some {left:,} frames, in about {time} with {workers} at a time"
    check_room(out, size, size - run_size(left, plan.formats, pictures), tell, what)


# --- the outcome ---


@dataclass(frozen=True)
class Failure:
    """A seed without a demonstration, and why."""

    task_name: str
    seed: int
    reason: str


@dataclass(frozen=True)
class TaskSummary:
    """Outcome of one task: ``frames`` are those of its successful episodes, holding frames included."""

    name: str
    memory_type: str
    episodes: int
    solved: int
    frames: tuple[int, ...]
    failures: tuple[Failure, ...]


@dataclass(frozen=True)
class GenerationSummary:
    """Outcome of a run.

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
        """All seeds without a demonstration."""
        return tuple(failure for task in self.tasks for failure in task.failures)

    @property
    def exit_status(self) -> int:
        """0 when every seed asked for was solved, else 1."""
        return 1 if self.failures else 0


def summarise(rows: Sequence[dict[str, Any]], tasks: Sequence[Task], out: Path) -> GenerationSummary:
    """Return the outcome of each task, from the rows of the manifest."""
    summaries = tuple(_summary(task, [row for row in rows if row["task_name"] == task.name]) for task in tasks)
    made = any(summary.solved for summary in summaries)
    return GenerationSummary(out if made else None, summaries)


def _summary(task: Task, rows: Sequence[dict[str, Any]]) -> TaskSummary:
    frames = tuple(int(row["frames"]) for row in rows if row["failure"] is None)
    failures = tuple(Failure(task.name, row["seed"], row["failure"]) for row in rows if row["failure"] is not None)
    return TaskSummary(task.name, task.memory_type, len(rows), len(frames), frames, failures)
