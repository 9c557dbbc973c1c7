"""The report for the browser: one page with its script, style and data inside, and a folder of videos.

`metrics` computes all rates; the page (``page/``) only draws and filters. Everything but the videos is inside
``index.html``, because a browser lets a page from disk read no other file. Its content security policy allows only this
style, this script and videos in its own folder, so the page cannot reach the network.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import os
import re
import shlex
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from lerobot_memobench import __version__
from lerobot_memobench.constants import CONTROL_HZ
from lerobot_memobench.envs.video import LAST_FRAMES, OPERATION_COLOURS
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.evaluation.comparison import comparison_phrase, controls_among
from lerobot_memobench.evaluation.evidence import evidence_phrase
from lerobot_memobench.evaluation.metrics import SUITE, Rate, Record, Row, by_task, failure_of, operations, percent
from lerobot_memobench.evaluation.records import Run, headline, read_runs, unlike
from lerobot_memobench.evaluation.report import evaluation_report, outcomes
from lerobot_memobench.evaluation.tables import OPERATION_NAMES, csv_tables
from lerobot_memobench.io import draft_of, file_name, refuse_links, write_file
from lerobot_memobench.jobs.processes import locked
from lerobot_memobench.policies.memory_reads import Chunk, find_reads
from lerobot_memobench.tasks.catalogue import GROUPS, find_tasks, get_task, libero_id, load_task, suite_of
from lerobot_memobench.tasks.formula import format_formula
from lerobot_memobench.tasks.task import LEVELS, Task

PAGE = "index.html"
VIDEOS, VIDEO = "videos", ".mp4"
SCRIPTS = (
    *("dom", "address", "filter", "overview", "list", "lanes", "reads", "timeline", "player", "panel", "detail"),
    *("pair", "main"),
)
"""Parts of the one script, in ``script/``; a later part uses earlier ones."""
MARK = "memobench html"  # value of the page's ``generator``, by which a folder is recognised as a report
UNFINISHED = f'''<!doctype html><meta charset="utf-8"><meta name="generator" content="{MARK}"><title>Unfinished</title>
<p>This report was not finished; run <code>memobench report --html</code> again.'''


class HtmlReport(NamedTuple):
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
        names, chunks, notes, first = dict[int, str](), dict[int, list[Chunk]](), list[str](), 0
        for evaluation in run.evaluations:
            own_videos, video_notes = find_videos(evaluation.folder, evaluation.records)
            own_reads, read_notes = find_reads(evaluation.folder, evaluation.records, evaluation.protocol)
            for k, video in own_videos.items():
                names[first + k] = f"{VIDEOS}/{slug}/{episode_id(evaluation.records[k])}{VIDEO}"
                chosen[out / names[first + k]] = video
            chunks |= {first + k: read for k, read in own_reads.items()}
            notes += [*video_notes, *read_notes]
            first += len(evaluation.records)
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
        write_file(out / PAGE, text)  # after its videos, so that a killed command leaves no links to missing ones
        linked = _remove_other_videos(out, chosen)
    return HtmlReport(
        page=out / PAGE,
        rollouts=sum(len(run.records) for run in runs),
        videos=len(chosen),
        notes=[*linked, *(f"{run.name}: {note}" for run in runs for note in run.notes)],
    )


def _slugs(names: Sequence[str]) -> list[str]:
    slugs: dict[str, str] = {}  # in lower case, since some file systems ignore case
    for name in names:
        base = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "run"
        candidates = (base if k == 1 else f"{base}_{k}" for k in itertools.count(1))
        slug = next(candidate for candidate in candidates if candidate.lower() not in slugs)
        slugs[slug.lower()] = slug
    return [*slugs.values()]


def _check_target(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"--out {out} is a file; name a folder")
    if not out.is_dir() or not any(out.iterdir()):
        return
    head = ""
    if (out / PAGE).is_file():
        with (out / PAGE).open(encoding="utf-8", errors="replace") as file:
            head = file.read(2000)  # the mark is before style and data
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
    """Return position of a rollout in ``records`` -> its video, and a note on videos that do not fit theirs."""
    videos: dict[int, Path] = {}
    misfits: list[str] = []
    for k, record in enumerate(records):
        with suppress(MemobenchError):  # a log is only text, which must not lead out of these folders
            file_name(episode_id(record), "a rollout's name")
            video = folder / VIDEOS / f"{record['task']}.{record['episode']}.mp4"
            if video.is_file():
                # A timeline under another rollout's video would mislead. A video has a frame of the start, one per
                # control step, and the last one held.
                frames, steps = frame_count(video), record.get("steps")
                whole = int(record.get("prompt_steps") or 0) + int(steps or 0) + LAST_FRAMES + 1
                if frames is None or (steps is not None and frames != whole):
                    misfits.append(video.name)
                else:
                    videos[k] = video
    if not misfits:
        return videos, []
    listed = ", ".join(misfits[:3]) + (f" and {len(misfits) - 3} more" if len(misfits) > 3 else "")
    return videos, [f"Videos that do not clearly belong to a logged rollout were left out: {listed}."]


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
        if target.exists():
            source_stat, target_stat = source.stat(), target.stat()
            copied = (source_stat.st_size, source_stat.st_mtime_ns) == (target_stat.st_size, target_stat.st_mtime_ns)
            if os.path.samestat(source_stat, target_stat) or copied:
                continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(target) as draft:
            try:
                os.link(source.resolve(), draft)
            except OSError:  # another file system, or one without hard links
                shutil.copy2(source, draft)


# --- data of the page, as JSON values ---


def task_source(names: Iterable[str], task_dir: str | Path | None = None) -> dict[str, Task]:
    """Return the tasks whose texts are known: the named ones of the catalogue, and those of a folder of tasks."""
    own = {} if task_dir is None else {folder.name: load_task(folder) for folder in find_tasks(task_dir)}
    return {name: get_task(name) for name in names if suite_of(name) is not None} | own


def page_data(
    runs: Sequence[Run],
    videos: Sequence[Mapping[int, str]],
    known: Mapping[str, Task],
    reads: Sequence[Mapping[int, Sequence[Chunk]]] | None = None,
) -> dict[str, Any]:
    """Return all data of the page.

    Args:
        videos: per run, position of a rollout in its records -> address of its video, relative to the page.
        known: task name -> task, for language and checkpoint texts.
        reads: per run, position of a rollout -> memory reads of its chunks; None: not recorded.
    """
    controls: dict[str, list[str]] = {run.name: [] for run in runs}
    for comparison in controls_among(runs):
        controls[comparison.runs[1].name].append(comparison_phrase(comparison))
    return {
        "version": __version__,
        "notices": unlike(runs),
        "fps": CONTROL_HZ,
        "levels": list(LEVELS),
        "memory_types": list(GROUPS),
        "suite": runs[0].summary.grouping == SUITE,
        "metrics": list(runs[0].summary.average),
        "operations": {
            key: {"name": OPERATION_NAMES[key], "colour": "#" + bytes(colour).hex()}
            for key, colour in OPERATION_COLOURS.items()
        },
        "failures": list(dict.fromkeys(name for run in runs for name in run.summary.failures)),
        "tasks": tasks_data([record for run in runs for record in run.records], known),
        "runs": [
            evaluation_on_page(run, addresses, of_run, controls[run.name])
            for run, addresses, of_run in zip(runs, videos, reads or [{}] * len(runs), strict=True)
        ],
    }


def tasks_data(records: Sequence[Record], known: Mapping[str, Task]) -> dict[str, Any]:
    """Return per task of the rollouts, by memory type and name, its language, and the texts of each variant."""
    last = {record["task"]: record for record in records}
    result: dict[str, Any] = {}
    for name, (record,) in by_task(last.values()).items():
        task = known.get(name)
        variants = sorted({int(r.get("variant") or 0) for r in records if r["task"] == name})
        if task is None or task.operations != operations(record):
            variants = []
        result[name] = {
            "memory_type": record["memory_type"],
            "id": libero_id(name),
            "language": task.title if task else name.replace("_", " "),
            "variants": {
                str(k): {
                    "goal": format_formula(variant.goal),
                    "checkpoints": [
                        {"goal": format_formula(checkpoint.goal), "texts": list(checkpoint.language)}
                        for checkpoint in variant.checkpoints
                    ],
                }
                for k in variants
                if task and k < task.num_variants
                for variant in [task.variant(k)]
            },
        }
    return result


def evaluation_on_page(
    run: Run, videos: Mapping[int, str], reads: Mapping[int, Sequence[Chunk]], controls: Sequence[str]
) -> dict[str, Any]:
    """Return one evaluation: protocol, rates, failures and rollouts."""
    summary = run.summary
    starts = [start for evaluation in run.evaluations for start in evaluation.card.get("runs", [])]
    return {
        "name": run.name,
        "headline": headline([run]),
        "facts": [*facts(run), *controls],
        "commands": [shlex.join(start["command"]) for start in starts if start.get("command")],
        "notes": list(run.notes),
        "csv": csv_tables(evaluation_report([run])),
        "average": row_data(summary.average) if summary.means else None,
        "memory_types": {name: row_data(row) for name, row in summary.memory_types.items()},
        "tasks": {
            name: {
                "rates": row_data(task.rates),
                "operations": task.operations,
                "prefix": [rate_data(rate) for rate in task.prefix],
                "ordered_prefix": [rate_data(rate) for rate in task.ordered_prefix],
                "outcomes": outcomes(summary, [name]),
            }
            for name, task in summary.tasks.items()
        },
        "episodes": [episode_data(record, videos.get(k), reads.get(k, ())) for k, record in enumerate(run.records)],
    }


def facts(run: Run) -> list[str]:
    """Return the number of rollouts, their horizon, and how often choices follow the evidence."""
    horizons = dict.fromkeys(evaluation.protocol.get("horizon") for evaluation in run.evaluations)
    evidence = [] if run.evidence is None else evidence_phrase(run.evidence)
    return [count_of(len(run.records), "rollout"), *(f"horizon {steps}" for steps in horizons if steps), *evidence]


def row_data(row: Row) -> dict[str, Any]:
    """Return metric -> `rate_data`."""
    return {metric: rate_data(rate) for metric, rate in row.items()}


def rate_data(rate: Rate) -> list[float | int | None] | None:
    """Return [per cent, lower, upper bound of Wilson's 95 % interval, n]; None where not applicable."""
    if rate.interval is None:
        return None
    low, high = rate.interval
    return [percent(rate.value), percent(low), percent(high), rate.n]


def episode_data(record: Record, video: str | None, reads: Sequence[Chunk] = ()) -> dict[str, Any]:
    """Return one rollout. Execution steps count from 1; chunks of reads count frames of the timeline."""
    last = max([1, *(c["first_step"] for c in record["checkpoints"] if c["first_step"] is not None)])
    return {
        "id": episode_id(record),
        "task": record["task"],
        "episode": record["episode"],
        "seed": record.get("seed"),
        "referent": record.get("referent", "fixed"),
        "variant": int(record.get("variant") or 0),
        "prompt": int(record.get("prompt_steps") or 0),
        "steps": int(record.get("steps") or last),  # some logs have no lengths
        "checkpoints": [[c["operation"], c["first_step"], c.get("ordered_step")] for c in record["checkpoints"]],
        "outcome": failure_of(record) or "success",
        "fault": record.get("fault"),
        "scene": record.get("scene_hash"),
        "video": video,
        "reads": [[chunk["step"], chunk["entries"], chunk["weights"]] for chunk in reads],
    }


def episode_id(record: Record) -> str:
    """Return a name that is the same in every run: task, episode, and the referent where it is not the published."""
    referent = record.get("referent", "fixed")
    return f"{record['task']}.{record['episode']}" + ("" if referent == "fixed" else f".{referent}")


# --- the page ---


def page(data: Mapping[str, Any], title: str) -> str:
    """Return the page that shows ``data``, of `page_data`."""
    style, scripts = _read("style.css"), "\n".join(_read(f"script/{name}.js") for name in SCRIPTS)
    constant = 'const DATA = JSON.parse(document.getElementById("data").textContent);\n'
    script = '"use strict";\n(() => {\n' + constant + scripts + "})();\n"
    parts = {
        "title": escape(title),
        "generator": escape(f"{MARK} {data['version']}"),
        "policy": escape(
            f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}; media-src 'self'; img-src data:"
        ),
        "style": style,
        "script": script,
        "data": inline_json(data),
    }
    # In one pass, so that inserted text is never taken for a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _read(PAGE))


def inline_json(value: Any) -> str:
    """Return JSON for the inside of ``<script type="application/json">``, which no text can end."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _read(name: str) -> str:
    return resources.files(__package__).joinpath("page", name).read_text(encoding="utf-8")
