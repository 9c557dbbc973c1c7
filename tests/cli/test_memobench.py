"""The command ``memobench``: help, mistakes, and the output of its commands."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from pathlib import Path

import pytest

from lerobot_memobench.cli.memobench import COMMANDS, main
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.support import logs

TASK = "turn_on_the_stove_and_turn_it_off"


# --- help and mistakes ---


@pytest.mark.parametrize("columns", ["80", "200"])
def test_help_lists_every_command_in_its_group(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, columns: str
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    places = [out.index(f"─ {group} ") for group in COMMANDS]
    assert places == sorted(places)
    for (group, commands), begin, end in zip(COMMANDS.items(), places, [*places[1:], len(out)], strict=True):
        for command in commands:
            name = command.__name__.replace("_", "-")
            assert re.search(rf"^│ {name} ", out[begin:end], re.MULTILINE), (group, name)
    assert max(len(line) for line in out.splitlines()) <= int(columns)
    assert main([]) == 0


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert re.fullmatch(r"memobench \d+\.\d+\S* \(LeRobot \d+\.\d+\S*\)\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["tasks", "--dir", "nowhere"], "is not a folder"),
        (["tasks", "--dir", "."], "found no"),
        (["report"], "Missing argument"),
        (["generate", "--tasks", "stov", "--out", "x"], "'stov'"),
        (["generate", "--episodes", "0", "--out", "x"], "episodes"),
        (["cache", "nowhere"], "nowhere"),
        (["recipe", "train_papr"], "'train_paper'"),
        (["frobnicate"], "No such command"),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], named: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert named in err
    assert err.startswith("memobench: ")
    assert err.count("\n") == 1
    assert out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# --- tasks ---


def test_tasks_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tasks"]) == 0
    out = capsys.readouterr().out
    assert f"{len(task_names())} tasks" in out
    assert TASK in out
    shutil.copytree(get_task(TASK).folder, tmp_path / "temporal" / TASK)  # a folder of own tasks
    for folder in (tmp_path, tmp_path / "temporal" / TASK):
        assert main(["tasks", "--dir", str(folder), "--json"]) == 0
        (task,) = json.loads(capsys.readouterr().out)
        assert set(task) == {
            "name", "memory_type", "family", "language", "objects", "fixtures", "goal", "checkpoints", "gaps",
            "state_dim",
        }  # fmt: skip
        assert task["name"] == TASK
        assert task["state_dim"] > 30  # of the compiled model
    shutil.copytree(get_task(TASK).folder, tmp_path / "lacking")
    (tmp_path / "lacking" / "task_config.meta.json").unlink()
    assert main(["tasks", "--dir", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0].strip() == "1 task", "the tasks of a user's folder are of no suite"
    assert "lacking/task_config.meta.json is missing" in printed.err
    file = tmp_path / "temporal" / TASK / "task_config.bddl"
    file.write_text(file.read_text().replace("flat_stove_1 - flat_stove", "flat_stove_1 - flat_oven"))
    assert main(["tasks", "--dir", str(file.parent), "--json"]) == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out) == []
    assert f"{file.parent}: " in printed.err


# --- generate ---


@pytest.mark.parametrize("solved", [2, 0])
def test_generate_reports_every_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], solved: int
) -> None:
    from lerobot_memobench.datasets import generate as generation
    from lerobot_memobench.datasets.generate import EpisodeOutcome, GenerationSummary
    from lerobot_memobench.jobs.processes import Advance

    asked: dict[str, object] = {}

    def generate(tasks, episodes, out, *, progress, **settings):  # type: ignore[no-untyped-def]
        asked.update(settings, tasks=[task.name for task in tasks], episodes=episodes, out=out)
        failures = [None if k < solved else "it slipped" for k in range(episodes)]
        for k, failure in enumerate(failures):
            progress(Advance(k + 1, episodes, TASK, 10_000 + k, failure))
        outcomes = tuple(EpisodeOutcome(TASK, 10_000 + k, 100, failure) for k, failure in enumerate(failures))
        return GenerationSummary(out if solved else None, (TASK,), outcomes)

    monkeypatch.setattr(generation, "generate", generate)
    out = tmp_path / "demos"
    words = ["generate", "--tasks", TASK, "--episodes", "2", "--out", str(out), "--no-images", "--referent", "random"]
    assert main(words) == (0 if solved == 2 else 1)
    given = {"tasks": [TASK], "episodes": 2, "out": out, "referent": "random", "images": False, "seed_base": 10_000}
    assert {key: asked[key] for key in given} == given
    printed = capsys.readouterr().out
    assert ("no dataset was written" in printed) == (solved == 0)
    assert ("it slipped" in printed) == (solved < 2)


# --- report and compare ---


@pytest.mark.parametrize(("option", "number"), [("--out", errno.ENOSPC), ("--html", errno.EROFS)])
def test_a_disk_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, option: str, number: int
) -> None:
    """The error is one line, and existing files are whole."""
    a, out = str(logs.evaluation(tmp_path / "a")), tmp_path / "out"
    assert main(["report", a, option, str(out)]) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert before
    inner = Path.write_bytes

    def refuse(path: Path, content: bytes) -> int:
        if out in path.parents:
            raise OSError(number, os.strerror(number), str(path))
        return inner(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", refuse)
        capsys.readouterr()
        assert main(["report", a, option, str(out)]) == 2
    err = capsys.readouterr().err
    assert f"cannot be written ({os.strerror(number)})" in err
    assert err.count("\n") == 1
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
