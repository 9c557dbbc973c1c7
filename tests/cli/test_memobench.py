"""The command ``memobench``."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_memobench.cli.memobench import COMMANDS, ELSEWHERE, main
from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.tasks.catalogue import task_names

TASK = "turn_on_the_stove_and_turn_it_off"


@pytest.fixture
def task_folder(tmp_path: Path) -> Path:
    """A copy of one task, as a user's own folder."""
    from lerobot_memobench.tasks.catalogue import get_task

    folder = tmp_path / "mine" / TASK
    folder.mkdir(parents=True)
    for file in get_task(TASK).folder.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


def log_episode(folder: Path, **changes: object) -> None:
    EpisodeLog(folder).append(
        {
            "task": TASK,
            "memory_type": "temporal",
            "episode": 0,
            "seed": 7,
            "success": True,
            "checkpoints": [{"operation": "S", "first_step": 1, "ordered_step": 1}],
            **changes,
        }
    )


def test_tasks_as_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tasks"]) == 0
    out = capsys.readouterr().out
    assert f"{len(task_names())} tasks" in out
    assert TASK in out


@pytest.mark.parametrize("up", [0, 1])
def test_tasks_of_a_folder_as_json(task_folder: Path, capsys: pytest.CaptureFixture[str], up: int) -> None:
    folder = [task_folder, task_folder.parent][up]
    assert main(["tasks", "--dir", str(folder), "--json"]) == 0
    (task,) = json.loads(capsys.readouterr().out)
    assert set(task) == {
        "name", "memory_type", "family", "language", "objects", "fixtures", "goal", "checkpoints", "state_dim",
    }  # fmt: skip
    assert task["name"] == TASK
    assert task["state_dim"] == 51 or task["state_dim"] > 30  # the compiled model's own
    assert all(len(checkpoint["language"]) == 3 for checkpoint in task["checkpoints"])


def test_report_prints_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        log_episode(tmp_path / name)
    assert main(["report", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    out = capsys.readouterr().out
    assert out.count("average of memory types") == 2
    assert str(tmp_path / "b") in out.replace("\n", "")
    assert json.loads((tmp_path / "a" / "report.json").read_text())["average"]["SR"] == 100.0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["tasks", "--dir", "nowhere"], "is not a folder"),
        (["tasks", "--dir", "."], "found no"),
        (["report", "nowhere"], "is not a folder"),
        (["report", "."], "no episode log"),
        (["report"], "Missing argument"),
        (["generate", "--tasks", "stov", "--out", "x"], "found 'stov' among the tasks"),
        (["generate", "--episodes", "0", "--out", "x"], "episodes"),
        (["generate"], "--out"),
        (["generate", "--referent", "rnd", "--out", "x"], "random"),
        (["cache", "nowhere"], "nowhere"),
        (["cache", ".", "--size", "huge"], "tiny"),
        (["frobnicate"], "No such command"),
    ],
)
def test_mistakes_are_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert err.startswith("memobench: ")
    assert err.count("\n") == 1
    assert out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    for command in ("tasks", "generate", "cache", "report", "doctor"):
        assert command in out


def test_help_lists_every_command_once_in_its_group(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    names = [one if isinstance(one, str) else one.__name__.replace("_", "-") for one in _names()]
    sections = [line for line in out.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert sections == ["Options:", *(f"{group}:" for group in COMMANDS)]
    listed = [line.split()[0] for line in out[out.index("Look around:") :].splitlines() if line.startswith("  ")]
    assert [name for name in listed if name in names] == names
    assert main([]) == 0
    assert capsys.readouterr().out == out


def test_help_cuts_no_description(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert "..." not in out[out.index("Look around:") :]
    assert max(len(line) for line in out.splitlines()) <= 80


def _names() -> list[object]:
    return [one for group in COMMANDS.values() for one in group]


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert re.fullmatch(r"memobench \d+\.\d+\S* \(LeRobot \d+\.\d+\S*\)\n", capsys.readouterr().out)


@pytest.mark.parametrize("words", [[], ["env=memobench", "--seed=3"], ["--help"]])
@pytest.mark.parametrize("command", ELSEWHERE)
def test_moved_commands_name_the_command_to_give(
    command: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, *words]) == 2
    message = capsys.readouterr().err
    assert f"{command!r}; give: {ELSEWHERE[command]}" in " ".join(message.split())
    assert message.count("\n") == 1


def test_commands_without_lerobot_do_not_import_it() -> None:
    code = (
        "import sys; from lerobot_memobench.cli.memobench import main; status = main(['tasks']); "
        "heavy = {'lerobot', 'torch', 'mujoco'} & set(sys.modules); print(sorted(heavy), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize("solved", [2, 1, 0])
def test_generate_tells_what_became_of_every_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], solved: int
) -> None:
    from lerobot_memobench.datasets import generation
    from lerobot_memobench.datasets.generation import Failure, GenerationSummary, TaskSummary
    from lerobot_memobench.jobs.processes import Advance

    asked: dict[str, object] = {}

    def generate(tasks, episodes, out, *, progress, **settings):  # type: ignore[no-untyped-def]
        asked.update(settings, tasks=[task.name for task in tasks], episodes=episodes, out=out)
        failures = tuple(Failure(TASK, 10_000 + k, "it slipped") for k in range(solved, episodes))
        for k in range(episodes):
            progress(Advance(k + 1, episodes, TASK, 10_000 + k, None if k < solved else "it slipped"))
        row = TaskSummary(TASK, "temporal", episodes, solved, (100,) * solved, failures)
        return GenerationSummary(out if solved else None, (row,))

    monkeypatch.setattr(generation, "generate", generate)
    out = tmp_path / "demos"
    words = ["generate", "--tasks", TASK, "--episodes", "2", "--out", str(out), "--no-images", "--referent", "random"]
    words += ["--slurm", "--partition=cpu --time=8:00:00"]
    assert main(words) == (0 if solved == 2 else 1)
    assert callable(asked.pop("notify"))
    assert asked == {
        "tasks": [TASK],
        "episodes": 2,
        "prompted_episodes": None,
        "out": out,
        "seed_base": 10_000,
        "referent": "random",
        "images": False,
        "image_size": 256,
        "demonstration_prompt": True,
        "perturb": False,
        "workers": 1,
        "finish": False,
        "slurm": generation.slurm_of(out, ("--partition=cpu", "--time=8:00:00")),
    }
    printed = capsys.readouterr().out
    assert ("no dataset was written" in printed) == (solved == 0)
    assert ("it slipped" in printed) == (solved < 2)


def test_a_tree_of_tasks_lists_what_loads_and_names_what_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    from lerobot_memobench.tasks.catalogue import get_task

    whole = get_task(TASK).folder
    shutil.copytree(whole, tmp_path / "temporal" / TASK)
    shutil.copytree(whole, tmp_path / "temporal" / "lacking")
    (tmp_path / "temporal" / "lacking" / "task_config.meta.json").unlink()
    assert main(["tasks", "--dir", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert printed.out.startswith("1 task of")
    assert printed.err.count("\n") == 1
    assert "lacking/task_config.meta.json is missing" in printed.err
