"""The report: what is written beside a log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.evaluation.report import evaluation_markdown, table, write_report
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
    _, notes = write_report(logged(tmp_path))
    assert not notes
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 8
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["average"] == {"n": 8, "SR": 87.5, "MSR": 100.0, "MUR": 87.5, "MCR": None}
    assert (tmp_path / "report.md").read_text().startswith("# Evaluation report")
    assert not list(tmp_path.glob("*.part"))


def test_reporting_again_changes_nothing(tmp_path: Path) -> None:
    write_report(logged(tmp_path))
    before = (tmp_path / "report.json").read_bytes(), (tmp_path / "episodes.jsonl").read_bytes()
    write_report(tmp_path)
    assert before == ((tmp_path / "report.json").read_bytes(), (tmp_path / "episodes.jsonl").read_bytes())


def test_surplus_episodes_of_the_last_batch_are_left_out(tmp_path: Path) -> None:
    summary, _ = write_report(logged(tmp_path, episodes=4), episodes=3)
    assert summary.tasks["first"]["SR"].n == 3


def test_unreadable_lines_become_notes(tmp_path: Path) -> None:
    logged(tmp_path)
    path = next((tmp_path / "episodes").glob("first.*"))
    path.write_bytes(path.read_bytes() + b'{"task": "fir')
    _, notes = write_report(tmp_path)
    assert len(notes) == 1
    assert notes[0] in (tmp_path / "report.md").read_text()


def test_markdown_has_intervals_and_dashes(tmp_path: Path) -> None:
    summary, _ = write_report(logged(tmp_path))
    text = evaluation_markdown(summary, [record("first", "temporal", 0, True)])
    assert "| `first` | 4 | 75.0 [30.1, 95.4] | 100.0 [51.0, 100.0] | 75.0 [30.1, 95.4] | – |" in text
    assert "stale memory | 1" in text


def test_terminal_table(tmp_path: Path) -> None:
    summary, _ = write_report(logged(tmp_path))
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(table(summary))
    text = console.export_text()
    assert "average of memory types" in text
    assert "87.5" in text
    assert failure_line(summary) == "failed rollouts: 1 stale memory"
