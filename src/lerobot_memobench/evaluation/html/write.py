"""Write the report: find each rollout's video, fill the template, make the folder.

Everything but the videos is inside ``index.html``, because a browser lets a page from disk read no other file. Its
content security policy allows only this style, this script and videos in its own folder, so the page cannot reach the
network.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.video import LAST_FRAMES
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.html.data import episode_id, page_data, task_source
from lerobot_memobench.evaluation.metrics import Record
from lerobot_memobench.evaluation.records import Run, read_runs
from lerobot_memobench.io import draft_of, file_name, refuse_links, write_file
from lerobot_memobench.jobs.processes import locked
from lerobot_memobench.policies.memory_reads import Chunk, find_reads

PAGE = "index.html"
VIDEOS, VIDEO = "videos", ".mp4"
SCRIPTS = (
    *("dom", "address", "filter", "overview", "list", "lanes", "reads", "timeline", "player", "panel", "detail"),
    *("pair", "main"),
)
"""Parts of the one script, in ``script/``; a later part uses earlier ones."""
MARK = "memobench html"
"""Value of the page's ``generator``, by which a folder is recognised as a report."""
UNFINISHED = f'''<!doctype html><meta charset="utf-8"><meta name="generator" content="{MARK}"><title>Unfinished</title>
<p>This report was not finished; run <code>memobench report --html</code> again.'''


@dataclass(frozen=True)
class HtmlReport:
    """A written report: the page, its rollouts, how many of them have a video, and notes on the logs."""

    page: Path
    rollouts: int
    videos: int
    notes: list[str]


def write_html(folders: Sequence[str | Path], out: str | Path, task_dir: str | Path | None = None) -> HtmlReport:
    """Write the report of one or several evaluations into ``out``; an earlier report there is replaced.

    Args:
        folders: of evaluations, or ``NAME=FOLDER``.
        task_dir: task folders in the published format whose texts are shown, in addition to the catalogue.

    Raises:
        MemobenchError: a folder holds no log, ``out`` holds something that is no report, or a folder of its videos is a
            link.
    """
    out = Path(out)
    _check_target(out)
    runs: list[Run] = []
    chosen: dict[Path, Path] = {}
    addresses: list[dict[int, str]] = []
    reads: list[dict[int, list[Chunk]]] = []
    evaluations = read_runs(folders)
    for run, slug in zip(evaluations, _slugs([run.name for run in evaluations]), strict=True):
        videos, chunks, notes, first = dict[int, Path](), dict[int, list[Chunk]](), list[str](), 0
        for each in run.evaluations:
            own_videos, misfits = find_videos(each.folder, each.records)
            own_reads, others = find_reads(each.folder, each.records, each.protocol)
            videos |= {first + k: video for k, video in own_videos.items()}
            chunks |= {first + k: read for k, read in own_reads.items()}
            notes += [*misfits, *others]
            first += len(each.records)
        names = {k: f"{VIDEOS}/{slug}/{episode_id(run.records[k])}{VIDEO}" for k in videos}
        chosen |= {out / name: videos[k] for k, name in names.items()}
        addresses.append(names)
        reads.append(chunks)
        runs.append(replace(run, notes=(*run.notes, *notes)))
    refuse_links(out / VIDEOS, *(target.parent for target in chosen))
    known = task_source({record["task"] for run in runs for record in run.records}, task_dir)
    text = page(page_data(runs, addresses, known, reads), title=", ".join(run.name for run in runs))
    out.mkdir(parents=True, exist_ok=True)
    with locked(out, out):
        if not (out / PAGE).exists():
            write_file(out / PAGE, UNFINISHED)  # marks the folder as a report
        place_videos(chosen)
        write_file(out / PAGE, text)
        linked = _remove_other_videos(out, chosen)
    return HtmlReport(
        page=out / PAGE,
        rollouts=sum(len(run.records) for run in runs),
        videos=len(chosen),
        notes=[*linked, *(f"{run.name}: {note}" for run in runs for note in run.notes)],
    )


def _slugs(names: Sequence[str]) -> list[str]:
    """Return for each name that of a folder: plain characters, all distinct."""
    slugs: dict[str, str] = {}  # in lower case, since some file systems ignore case
    for name in names:
        base = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "run"
        candidates = (base if k == 1 else f"{base}_{k}" for k in itertools.count(1))
        slug = next(each for each in candidates if each.lower() not in slugs)
        slugs[slug.lower()] = slug
    return [*slugs.values()]


def _check_target(out: Path) -> None:
    """Refuse a folder that holds other files than a report's."""
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"--out {out} is a file; name a folder")
    if not out.is_dir() or not any(out.iterdir()):
        return
    head = ""
    if (out / PAGE).is_file():
        with (out / PAGE).open(encoding="utf-8", errors="replace") as file:
            head = file.read(2000)
    if f'content="{MARK}' not in head:
        raise MemobenchError(f"--out {out} holds files that are no earlier report; name a new or an empty folder")


def _remove_other_videos(out: Path, placed: Collection[Path]) -> list[str]:
    """Remove videos of an earlier report and folders that this leaves empty; return notes on links, which stay."""
    notes = []
    for folder in sorted((out / VIDEOS).glob("*/")):
        if folder.is_symlink():
            notes.append(f"{folder} is a link to a folder; it and the files behind it were left as they are")
            continue
        for path in folder.glob(f"*{VIDEO}"):
            if path not in placed:
                path.unlink()
        if not any(folder.iterdir()):
            folder.rmdir()
    if (out / VIDEOS).is_dir() and not any((out / VIDEOS).iterdir()):
        (out / VIDEOS).rmdir()
    return notes


# --- videos ---


def find_videos(folder: Path, records: Sequence[Record]) -> tuple[dict[int, Path], list[str]]:
    """Return position of a rollout in ``records`` -> its video, and a note on videos that do not fit theirs.

    A video counts only when it is as long as its rollout: a timeline under another rollout's video would mislead.
    """
    videos: dict[int, Path] = {}
    misfits: list[str] = []
    for k, record in enumerate(records):
        with suppress(MemobenchError):  # a log is only text, which must not lead out of these folders
            file_name(episode_id(record), "a rollout's name")
            video = folder / VIDEOS / f"{record['task']}.{record['episode']}.mp4"
            if video.is_file():
                if _fits(frame_count(video), record):
                    videos[k] = video
                else:
                    misfits.append(video.name)
    # A video's name does not hold the referent: where both settings are in one log, it could be of either.
    claims = Counter(videos.values())
    misfits += [video.name for video, count in claims.items() if count > 1]
    videos = {k: video for k, video in videos.items() if claims[video] == 1}
    if not misfits:
        return videos, []
    listed = ", ".join(misfits[:3]) + (f" and {len(misfits) - 3} more" if len(misfits) > 3 else "")
    return videos, [f"Videos that do not clearly belong to a logged rollout were left out: {listed}."]


def _fits(frames: int | None, record: Record) -> bool:
    """Return whether a video has a frame of the start, one per control step, and its last one held.

    Logs without lengths take any.
    """
    if frames is None or record.get("steps") is None:
        return frames is not None
    return frames == int(record.get("prompt_steps") or 0) + int(record["steps"]) + LAST_FRAMES + 1


def frame_count(path: Path) -> int | None:
    """Return the number of frames in a video's header; None when it is no whole video."""
    import av

    try:
        with av.open(str(path)) as container:
            return int(container.streams.video[0].frames)
    except (av.FFmpegError, IndexError, OSError):
        return None


def place_videos(chosen: Mapping[Path, Path]) -> None:
    """Bring videos into the report, target -> source: as hard links, or copies on another file system.

    A target that is there and unchanged is left alone; each appears under its name only when it is whole.
    """
    for target, source in chosen.items():
        if _is_same(source, target):
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(target) as draft:
            try:
                os.link(source.resolve(), draft)
            except OSError:  # another file system, or one without hard links
                shutil.copy2(source, draft)


def _is_same(source: Path, target: Path) -> bool:
    if not target.exists():
        return False
    here, there = source.stat(), target.stat()
    return os.path.samestat(here, there) or (here.st_size, here.st_mtime_ns) == (there.st_size, there.st_mtime_ns)


# --- the page ---


def page(data: Mapping[str, Any], title: str) -> str:
    """Return the page that shows ``data`` (see `data.page_data`)."""
    style, script = _read("style.css"), _script()
    parts = {
        "title": escape(title),
        "generator": escape(f"{MARK} {data['version']}"),
        "policy": escape(content_policy(style, script)),
        "style": style,
        "script": script,
        "data": inline_json(data),
    }
    # In one pass, so that inserted text is never taken for a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _read(PAGE))


def inline_json(value: Any) -> str:
    """Return JSON for the inside of ``<script type="application/json">``.

    ``<``, ``>`` and ``&`` are escaped, so the text cannot end the element or open a comment.
    """
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def content_policy(style: str, script: str) -> str:
    """Return the content security policy for a page with this style and this script."""
    return f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}; media-src 'self'; img-src data:"


def _script() -> str:
    data = 'const DATA = JSON.parse(document.getElementById("data").textContent);\n'
    parts = [_read(f"script/{name}.js") for name in SCRIPTS]
    return '"use strict";\n(() => {\n' + data + "\n".join(parts) + "})();\n"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _read(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
