"""Which video belongs to which rollout, and how it comes into the report's folder.

``env.videos`` records episodes as ``<log_dir>/videos/<task>.<episode>.mp4`` (``envs.film``): one frame
at the start, one per control step of prompt and execution, the last one held. Plain ``lerobot-eval`` leaves
``videos/<memory type>_<task id>/eval_episode_<k>.mp4`` of its first ten episodes, without the last frame. In both,
frame k shows the world after k control steps.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.video import LAST_FRAMES
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.rollouts import Record
from lerobot_memobench.io import draft_of, file_name, parsed

VIDEOS = "videos"
LEROBOT_INFO = "eval_info.json"


def episode_id(record: Record) -> str:
    """Return a name that is the same in every run: task, episode, and the referent where it is not the published."""
    referent = record.get("referent", "fixed")
    return f"{record['task']}.{record['episode']}" + ("" if referent == "fixed" else f".{referent}")


def find_videos(folder: Path, records: Sequence[Record]) -> tuple[dict[int, Path], list[str]]:
    """Return position of a rollout in ``records`` -> its video, and a note on videos that do not fit theirs.

    A video counts only when it is as long as its rollout: a timeline under another rollout's video would mislead.
    """
    others = _lerobot_videos(folder, records)
    found: dict[int, Path] = {}
    misfits: list[str] = []
    for k, record in enumerate(records):
        if not _names_a_file(episode_id(record)):
            continue
        film = folder / VIDEOS / f"{record['task']}.{record['episode']}.mp4"
        if film.is_file():
            if _fits(frame_count(film), record, held=LAST_FRAMES + 1):
                found[k] = film
                continue
            misfits.append(film.name)
        other = others.get(k)
        if other is not None and _fits(frame_count(other), record, held=0):
            found[k] = other
    # A film's name does not tell the referent: where both settings are in one log, it could be of either.
    claims = Counter(found.values())
    misfits += [video.name for video, count in claims.items() if count > 1]
    found = {k: video for k, video in found.items() if claims[video] == 1}
    if not misfits:
        return found, []
    named = ", ".join(misfits[:3]) + (f" and {len(misfits) - 3} more" if len(misfits) > 3 else "")
    return found, [f"Videos that do not clearly belong to a logged rollout were left out: {named}."]


def _names_a_file(name: str) -> bool:
    """Whether a rollout's name may be a file's: a log is only text, which must not lead out of these folders."""
    try:
        return bool(file_name(name, "a rollout's name"))
    except MemobenchError:
        return False


def _fits(frames: int | None, record: Record, held: int) -> bool:
    """Whether a video has a frame per control step and ``held`` more; logs without lengths take any."""
    if frames is None:
        return False
    if record.get("steps") is None:
        return True
    return frames == int(record.get("prompt_steps") or 0) + int(record["steps"]) + held


def frame_count(path: Path) -> int | None:
    """Return the number of frames that a video's header tells; None when it is no whole video."""
    import av

    try:
        with av.open(str(path)) as container:
            return int(container.streams.video[0].frames)
    except (av.FFmpegError, IndexError, OSError):
        return None


def _lerobot_videos(folder: Path, records: Sequence[Record]) -> dict[int, Path]:
    """Return position -> LeRobot's video of it.

    LeRobot numbers its videos by the order of its run and does not write the seeds down. They are believed only where
    its list of successes is that of the task's logged rollouts, which it is not after a resumed or a sharded run.
    """
    try:
        info: Any = parsed((folder / LEROBOT_INFO).read_bytes())
        entries = [(e["task_group"], e["task_id"], e["metrics"]["successes"]) for e in info["per_task"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    by_task = _positions(records)
    found: dict[int, Path] = {}
    for group, task_id, successes in entries:
        if not _names_a_file(f"{group}_{task_id}"):
            continue
        for positions in by_task.values():
            rollouts = [records[k] for k in positions]
            if rollouts[0]["memory_type"] != group or [r["success"] for r in rollouts] != successes:
                continue
            if _task_number(str(rollouts[0]["task"])) != task_id:
                continue
            for number, k in enumerate(positions):
                video = folder / VIDEOS / f"{group}_{task_id}" / f"eval_episode_{number}.mp4"
                if video.is_file():
                    found[k] = video
    return found


def _positions(records: Sequence[Record]) -> dict[str, list[int]]:
    positions: dict[str, list[int]] = {}
    for k, record in enumerate(records):
        positions.setdefault(record["task"], []).append(k)
    for name, ks in positions.items():
        positions[name] = sorted(ks, key=lambda k: int(records[k]["episode"]))
    return positions


def _task_number(name: str) -> int | None:
    """The number under which LeRobot runs a task of the catalogue."""
    from lerobot_memobench.tasks.catalogue import task_names

    names = task_names(suite=None)
    return names.index(name) if name in names else None


def place_videos(chosen: Mapping[Path, Path], link: bool) -> None:
    """Bring videos into the report, target -> source: as hard links or copies, so that it can be moved, or as links.

    A target that is there and unchanged is left alone; each appears under its name only when it is whole.
    """
    for target, source in chosen.items():
        if _is_same(source, target, link):
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(target) as draft:
            _bring(source.resolve(), draft, link)


def _bring(source: Path, target: Path, link: bool) -> None:
    if link:
        target.symlink_to(source)
        return
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without hard links
        shutil.copy2(source, target)


def _is_same(source: Path, target: Path, link: bool) -> bool:
    if not target.exists() or target.is_symlink() != link:
        return False
    here, there = source.stat(), target.stat()
    return os.path.samestat(here, there) or (here.st_size, here.st_mtime_ns) == (there.st_size, there.st_mtime_ns)
