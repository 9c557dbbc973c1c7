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
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lerobot_memobench.constants import DEMONSTRATION_SEED, GUARDED, IMAGE_SIZE, LIBERO, SPLITS, WORLD
from lerobot_memobench.datasets.card import SCRIPTED
from lerobot_memobench.datasets.layout import DEFAULT_REPO_ID, STAGING, is_dataset
from lerobot_memobench.datasets.record import HOLD_FRAMES, RecordingJob, RecordingSettings
from lerobot_memobench.datasets.stage import FINISHED_EARLY, check_destination, episodes_folder, finished_manifest
from lerobot_memobench.datasets.write import assemble
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.io import explaining_disk_errors, free_bytes, in_words
from lerobot_memobench.jobs.processes import ProgressCallback, run_jobs
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.sim.convention import CONVENTIONS, UPRIGHT
from lerobot_memobench.sim.files import check_assets
from lerobot_memobench.tasks.task import STRICT, Task, referent_text

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
        "versions": _versions(),
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
        check_destination(out)
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
            shutil.rmtree(out / STAGING)
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


def _versions() -> dict[str, str]:
    versions = {}
    for name in ("lerobot_policy_memobench", "mujoco", "numpy", "av"):  # an episode's numbers depend on them
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "unknown"
    return versions


# --- size and time ---


def run_size(frames: int, image_size: int | None, held_frames: int = 0) -> int:
    """Return the approximate bytes of numbers of frames and held frames; ``image_size`` is None without images."""
    area = 0.0 if image_size is None else (image_size / IMAGE_SIZE) ** 2
    return round(frames * FRAME_BYTES + (frames * IMAGES_BYTES + held_frames * HELD_BYTES) * area)


def check_room(out: Path, size: int, staged: int, notify: Callable[[str], None], work: str, extra: int = 0) -> None:
    """Report the disk space that a run needs, and refuse a run of which not even one copy has room.

    Finished episodes are kept until the dataset is complete, so at its end a run needs twice its size.

    ``size`` is the dataset's, approximately, ``staged`` of it exists already, ``extra`` is that of temporary files, all
    in bytes; ``work`` begins the message.
    """
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
