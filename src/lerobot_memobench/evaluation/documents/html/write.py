"""Make the report's folder: videos first, the page last, so that an interrupted run leaves the earlier page whole."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.html.collect import Run, page_data, read_runs, task_source
from lerobot_memobench.evaluation.documents.html.page import MARK, page
from lerobot_memobench.evaluation.documents.html.videos import VIDEOS, episode_id, find_videos, place_videos
from lerobot_memobench.io import write_file

PAGE = "index.html"
UNFINISHED = f'''<!doctype html><meta charset="utf-8"><meta name="generator" content="{MARK}"><title>Unfinished</title>
<p>This report was not finished; run <code>memobench html</code> again.'''


@dataclass(frozen=True)
class Written:
    """What a report holds: the page, its rollouts, how many of them have a video, and notes on the logs."""

    page: Path
    rollouts: int
    videos: int
    notes: list[str]


def write_html(
    folders: Sequence[str | Path], out: str | Path, *, link: bool = False, task_dir: str | Path | None = None
) -> Written:
    """Write the report of one or several evaluations into ``out``; an earlier report there is replaced.

    Args:
        folders: what evaluations have written. link: let videos be symbolic links to where they are, which saves space
            on another file system but ties the report to this machine. task_dir: task folders in the published format
            whose texts are to be shown, beside the catalogue.

    Raises:
        MemobenchError: a folder holds no log, or ``out`` holds something that is no report.
    """
    out = Path(out)
    _check_target(out)
    runs: list[Run] = []
    chosen: dict[Path, Path] = {}
    addresses: list[dict[int, str]] = []
    for run, slug in zip(*_with_slugs(read_runs(folders)), strict=True):
        found, notes = find_videos(run.folder, run.records)
        names = {k: f"{VIDEOS}/{slug}/{episode_id(run.records[k])}.mp4" for k in found}
        chosen |= {out / name: found[k] for k, name in names.items()}
        addresses.append(names)
        runs.append(replace(run, notes=run.notes + notes))
    text = page(page_data(runs, addresses, task_source(task_dir)), title=", ".join(run.name for run in runs))
    out.mkdir(parents=True, exist_ok=True)
    if not (out / PAGE).exists():
        write_file(out / PAGE, UNFINISHED)  # the folder is known as ours from now on
    place_videos(chosen, link)
    write_file(out / PAGE, text)
    _remove_others(out / VIDEOS, chosen)
    return Written(
        page=out / PAGE,
        rollouts=sum(len(run.records) for run in runs),
        videos=len(chosen),
        notes=[f"{run.name}: {note}" for run in runs for note in run.notes],
    )


def _with_slugs(runs: list[Run]) -> tuple[list[Run], list[str]]:
    """Return the runs, and for each a folder name made of plain characters that no other run has."""
    slugs: list[str] = []
    for run in runs:
        base = re.sub(r"[^A-Za-z0-9._-]+", "_", run.name).strip("._") or "run"
        slug, k = base, 1
        while slug.lower() in (other.lower() for other in slugs):  # file systems may not tell A from a
            k += 1
            slug = f"{base}_{k}"
        slugs.append(slug)
    return runs, slugs


def _check_target(out: Path) -> None:
    """Refuse to write among files that are not a report's."""
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


def _remove_others(folder: Path, kept: Collection[Path]) -> None:
    """Remove videos of an earlier report in this place, and folders that this leaves empty."""
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()):
                path.rmdir()
        elif path not in kept:
            path.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
