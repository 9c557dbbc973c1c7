"""The report: what is written beside a log."""

from __future__ import annotations

import gzip
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import EpisodeLog, read_episodes, write_episodes
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, write_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import outcome
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.evaluation.report import build, evaluation_markdown, render, table, write_report
from lerobot_memobench.evaluation.report_tables import failure_line
from tests.support import logs


def record(task: str, memory_type: str, episode: int, success: bool, **changes: Any) -> dict[str, Any]:
    marks = [("S", 3, 3), ("U", 5 if success else None, 5 if success else None)]
    own = {"memory_type": memory_type, "success": success, "failure": None if success else "stale_memory"}
    return logs.record(task, episode, marks, **own | changes)


def logged(folder: Path, episodes: int = 4) -> Path:
    log = EpisodeLog(folder)
    for k in range(episodes):
        log.append(record("first", "temporal", k, k != 0))
        log.append(record("second", "procedural", k, True))
    return folder


def test_files_are_written_beside_the_log(tmp_path: Path) -> None:
    notes = write_report(logged(tmp_path)).notes
    assert not notes
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 8
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["average"] == {"n": 8, "SR": 87.5, "MSR": 100.0, "MUR": 87.5, "MCR": None}
    first = "policy not recorded: published suite, referent fixed, seeds 7 to 10, 4 episodes of each of 2 tasks"
    assert (tmp_path / "report.md").read_text().startswith(f"# {first}, replan interval 5; inputs: not recorded\n")
    assert not list(tmp_path.glob("*.part"))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert write_report(tmp_path, episodes=3).summary.tasks["first"]["SR"].n == 3, "a last batch may hold more"
    write_report(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(table(read_runs([tmp_path])[0].summary))
    assert "average of memory types" in console.export_text()
    assert failure_line(read_runs([tmp_path])[0].summary) == "failed rollouts: 1 stale memory"


@pytest.mark.parametrize("workers", [False, True])
def test_a_report_keeps_every_line_of_the_log(tmp_path: Path, workers: bool) -> None:
    lines = [json.dumps(record("first", "object", k, True)) for k in range(6)]
    lines[1], lines[2] = lines[1].replace("true", "tru"), json.dumps(json.loads(lines[2]) | {"failure": 7})
    merged = tmp_path / "episodes.jsonl"
    merged.write_text("\n".join(lines))
    (tmp_path / "card.json").write_text(json.dumps({"protocol": {"episodes": 4}}))
    if workers:  # they hold what is damaged above, and one episode more
        for k in (1, 7):
            EpisodeLog(tmp_path).append(record("first", "object", k, True))
    notes = [write_report(tmp_path).notes for _ in range(2)]
    assert notes[0] == notes[1]
    assert sum("line" in note for note in notes[0]) == 2
    assert any(note.startswith(f"{2 + workers} rollouts beyond the 4") for note in notes[0])
    kept = merged.read_text().splitlines()
    assert kept[:6] == lines
    assert [json.loads(line)["episode"] for line in kept[6:]] == ([1, 7] if workers else [])


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (
            lambda lines: [{**lines[0], "success": False}, *lines[1:]],
            "success is True on the card and False in the log",
        ),
        (lambda lines: lines[1:], "is on the card and not in the log"),
        (lambda lines: [*lines, {**lines[0], "episode": 2, "seed": 9}], "is in the log and not on the card"),
    ],
)
def test_a_report_names_where_log_and_card_disagree(tmp_path: Path, edit: Any, named: str) -> None:
    lines = [record("first", "object", k, True) for k in range(2)]
    card = {"protocol": {"episodes": 5}, "episodes": [outcome(each) for each in lines]}
    (tmp_path / "card.json").write_text(json.dumps(card))
    for each in edit(lines):  # the workers' files, and so the merged file
        EpisodeLog(tmp_path).append(each)
    assert [named in note for note in write_report(tmp_path).notes] == [True]
    assert named in read_runs([tmp_path])[0].notes[0]


def test_markdown_has_intervals_and_dashes(tmp_path: Path) -> None:
    text = evaluation_markdown(write_report(logged(tmp_path)))
    assert "| `first` | 4 | 75.0 [30.1, 95.4] | 100.0 [51.0, 100.0] | 75.0 [30.1, 95.4] | – |" in text
    assert "stale memory | 1" in text


# --- the first line ---


def prompted(folder: Path, policy: dict[str, Any], checkpoint: dict[str, Any] | None = None, **changes: Any) -> Path:
    """An evaluation whose prompt was seen by ``policy``, with a card where there is a ``checkpoint``."""
    settings = {**logs.SETTINGS, "replan_steps": 5, "prompt_in": "steps", "policy": policy, **changes}
    write_protocol(folder, settings)
    log = EpisodeLog(folder)
    for k in range(2):
        log.append(record("first", "object", k, True, prompt_steps=30, inputs="pixels", suite="strict"))
    if checkpoint is not None:
        card = {"protocol": {**settings, "episodes": 2}, "policy": policy, "checkpoint": checkpoint}
        (folder / EVALUATION_FILE).write_text(json.dumps(card))
    return folder


STRICT = "strict suite, referent fixed, seeds 7 to 8, 2 episodes of first, replan interval 5"


def test_the_first_line_of_lerobot_eval(tmp_path: Path) -> None:
    run = write_report(prompted(tmp_path, {"type": "act"}, {"path": "user/mine"}))
    assert headline([run]) == f"act (user/mine): {STRICT}; inputs: pixels, prompt in steps (observed)"
    found = build([run])
    assert render(found, [run], "markdown").splitlines()[0] == f"# {headline([run])}"
    assert " ".join(render(found, [run], "table").split()).startswith(headline([run]))
    assert render(found, [run], "latex").startswith(f"% {headline([run])}")


@pytest.mark.parametrize(
    ("changes", "ending"),
    [
        ({"prompt_in": "reset"}, "prompt in reset (not observed)"),
        ({"demonstration_prompt": False}, "no demonstration prompt"),
    ],
)
def test_the_first_line_of_plain_lerobot_eval(tmp_path: Path, changes: dict[str, Any], ending: str) -> None:
    run = write_report(prompted(tmp_path, {"type": "act", "identity": "act 0123456789ab"}, **changes))
    assert headline([run]) == f"act 0123456789ab: {STRICT}; inputs: pixels, {ending}"


def test_the_first_line_of_several(tmp_path: Path) -> None:
    for name in ("a", "b"):
        prompted(tmp_path / name, {"type": name.upper()})
    seen = "inputs: pixels, prompt in steps (observed)"
    runs = read_runs([f"one={tmp_path}/a", f"two={tmp_path}/b"])
    assert headline(runs) == f"2 evaluations, {STRICT}; one: A, {seen}; two: B, {seen}"
    short = replace(runs[1], records=runs[1].records[:1])
    other = STRICT.replace("seeds 7 to 8, 2 episodes", "seed 7, 1 episode")
    assert headline([runs[0], short]) == f"2 evaluations; one: A, {seen} ({STRICT}); two: B, {seen} ({other})"


# --- a log that is kept: compressed ---


def kept(folder: Path) -> Path:
    """Compress an evaluation as ``gzip -9n episodes.jsonl evaluation.json`` does, and leave nothing else."""
    write_report(prompted(folder, {"type": "act"}, {"path": "user/mine"}))
    for name in ("episodes.jsonl", EVALUATION_FILE):
        (folder / f"{name}.gz").write_bytes(gzip.compress((folder / name).read_bytes()))
        (folder / name).unlink()
    shutil.rmtree(folder / "episodes")
    for name in ("report.json", "report.md"):
        (folder / name).unlink()
    return folder


def test_a_compressed_evaluation_is_read_like_any(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    open_, archive = prompted(tmp_path / "a", {"type": "act"}, {"path": "user/mine"}), kept(tmp_path / "b")
    before = sorted(archive.iterdir())
    told = []
    for folder in (open_, archive):
        assert main(["report", str(folder), "--format", "csv"]) == 0
        told.append([line.partition(",")[2] for line in capsys.readouterr().out.splitlines()])  # but for its name
    assert told[0] == told[1]
    assert len(told[0]) > 10
    assert main(["compare", str(open_), str(archive)]) == 0
    assert "2 episodes in both" in capsys.readouterr().out
    assert sorted(archive.iterdir()) == before


def test_a_folder_above_a_log_or_the_log_itself_is_told_where_it_is(tmp_path: Path) -> None:
    write_episodes(tmp_path / "frames-0" / "rollouts", [])
    folder = tmp_path / "frames-0" / "rollouts"
    with pytest.raises(MemobenchError, match=f"holds no episode log; .*; there is one in {folder}$"):
        read_episodes(tmp_path)
    with pytest.raises(MemobenchError, match=f"is not a folder; .*, such as {folder}$"):
        read_episodes(folder / "episodes.jsonl")


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-12], lambda data: b"no gzip", lambda data: data[:40] + b"x" * 9]
)
def test_a_damaged_archive_is_one_sentence(
    tmp_path: Path, damage: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    file = kept(tmp_path) / "episodes.jsonl.gz"
    file.write_bytes(damage(file.read_bytes()))
    assert main(["report", str(tmp_path)]) == 2
    assert "it is no whole gzip file" in capsys.readouterr().err


def test_what_grows_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_memobench.io.LARGEST_UNPACKED", 100)
    with pytest.raises(MemobenchError, match=r"cannot be read \(it becomes larger than"):
        read_runs([kept(tmp_path)])
