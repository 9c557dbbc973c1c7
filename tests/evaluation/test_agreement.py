"""A result never covers more, or other settings, than its log: missing episodes are named, contradictions refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import compare_evaluations
from lerobot_memobench.evaluation.html import write_html
from lerobot_memobench.evaluation.records import headline, read_runs
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.evaluation.tables import WRITERS
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.support.logs import MISSING, card

Line = dict[str, Any]


def line(name: str, episode: int, **changes: Any) -> Line:
    """A successful rollout, as this version logs it."""
    task = get_task(name)
    marks = [{"operation": c.operation, "first_step": 9, "ordered_step": 9} for c in task.checkpoints]
    return {
        **{"task": name, "memory_type": task.memory_type, "episode": episode, "seed": 7 + episode, "variant": 0},
        **{"prompt_steps": 0, "prompt_shown": None, "steps": 9, "success": True, "checkpoints": marks},
        **{"failure": None, "stand_ins": [], "scene_hash": f"{name[:20]}-{episode}", "wall_s": 1.0, **changes},
    }


def evaluation(folder: Path, lines: list[Line], episodes: int = 50, tasks: int = 30, **settings: Any) -> Path:
    """The folder of an evaluation that was asked for so many episodes of so many tasks, with some lines."""
    names = sorted(task_names()[:tasks])
    protocol = {
        **{"tasks": names, "episodes": episodes, "inputs": "pixels"},
        **EnvSettings(replan_steps=6, prompt_in="steps", **settings).protocol_block,
    }
    write_evaluation(folder, card(protocol, {"type": "act", "seed": 7, "settings": {}, "sha256": "0" * 64}))
    write_episodes(folder, lines)
    return folder


# --- extent ---


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation of 30 tasks that was killed after two rollouts of the first."""
    name = min(task_names())
    return evaluation(tmp_path_factory.mktemp("killed") / "half", [line(name, episode) for episode in range(2)])


def test_missing_episodes_are_named_everywhere(killed: Path, tmp_path: Path) -> None:
    note = f"missing: 1,498 of 1,500 episodes, with all of 29 tasks, the first is {min(task_names())}, episode 2"
    (run,) = read_runs([killed])
    assert str(run.missing).startswith(note)
    assert headline([run]).split(", ")[3:5] == ["2 episodes of check_all_three_drawers_of_the_cabinet", "incomplete"]
    assert note in write_report(killed).notes[0]
    assert note in (killed / "report.md").read_text()
    assert json.loads((killed / "report.json").read_text())["missing"] == run.missing
    other = shutil.copytree(killed, tmp_path / "other")
    compared = compare_evaluations(*read_runs([killed, other]), permutations=100)
    assert [name.split(":")[0] for name in compared.notes if note in name] == ["half", "other"]
    assert note in write_html([killed], tmp_path / "page").page.read_text()
    for words in (["report", killed], ["report", killed, other], ["compare", killed, other]):
        for kind in WRITERS:
            out = tmp_path / f"{words[0]}_{len(words)}_{kind}"
            assert main([*map(str, words), "--format", kind, "--out", str(out)]) == 0
            (file,) = out.iterdir()
            assert "1,498 of 1,500 episodes" in " ".join(file.read_text().split()), (words, kind)


FIXED_GOALS = "a routine without a memory solves published goals"


def test_a_complete_run_is_not_called_incomplete(tmp_path: Path) -> None:
    lines = [line(name, episode) for name in task_names() for episode in range(50)]
    (run,) = read_runs([evaluation(tmp_path / "whole", lines)])
    assert run.missing is None
    assert [note.split(" with ")[0] for note in run.notes] == [FIXED_GOALS]
    assert "incomplete" not in headline([run])


# --- settings ---


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lines = [line(name, episode) for name in sorted(task_names()[:2]) for episode in range(4)]
    folder = evaluation(tmp_path_factory.mktemp("small") / "a", lines, episodes=4, tasks=2)
    assert len(read_runs([folder])[0].notes) == 1  # on fixed goals
    return folder


OF_OTHER_SETTINGS: dict[str, Any] = {
    "seed": 1007,
    "memory_type": "spatial",
    "variant": 1,
    "steps": 1201,
    "paused_steps": 100,
    "held_steps": 9,
    "lost": False,
    "corrupted": True,
    "choice": 1,
    "variants": 3,
}


@pytest.mark.parametrize("name", OF_OTHER_SETTINGS)
def test_lines_of_other_settings_are_refused(small: Path, tmp_path: Path, name: str) -> None:
    """Such as lines that were copied from another evaluation."""
    folder = shutil.copytree(small, tmp_path / "b")
    log = folder / "episodes.jsonl"
    first, *others = log.read_text().splitlines(keepends=True)
    log.write_text(json.dumps({**json.loads(first), name: OF_OTHER_SETTINGS[name]}) + "\n" + "".join(others))
    with pytest.raises(MemobenchError, match="contradicts"):
        read_runs([folder])


@pytest.mark.parametrize(
    ("setting", "value"), [("seed_base", 1007), ("horizon", 8), ("evidence", True), ("pause_steps", 5)]
)
def test_another_setting_of_the_file_is_refused(small: Path, tmp_path: Path, setting: str, value: Any) -> None:
    folder = shutil.copytree(small, tmp_path / "b")
    content = json.loads((folder / "evaluation.json").read_text())
    content["protocol"][setting] = value
    write_evaluation(folder, content)
    with pytest.raises(MemobenchError, match="contradicts"):
        read_runs([folder])


def test_lines_that_are_gone_are_noted(small: Path, tmp_path: Path) -> None:
    """Half of a task's lines."""
    folder = shutil.copytree(small, tmp_path / "b")
    log = folder / "episodes.jsonl"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:6]))
    (run,) = read_runs([folder])
    assert str(run.missing).startswith(MISSING.format(2, 8, sorted(task_names()[:2])[1], 2))
    assert run.missing in run.notes


def test_a_log_without_its_file_is_refused(small: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(small, tmp_path / "b")
    (folder / "evaluation.json").unlink()
    with pytest.raises(MemobenchError, match=r"evaluation\.json .*missing"):
        read_runs([folder])
