"""A result never covers more, or other settings, than its log: missing episodes are named, contradictions refused."""

from __future__ import annotations

import json
import shutil
import typing
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import EpisodeRecord, write_episodes
from lerobot_memobench.envs.settings import SCENE_HASHES, EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import STATED
from lerobot_memobench.evaluation.comparison import compare_evaluations
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.html import write_html
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.evaluation.tables import WRITERS
from lerobot_memobench.run.card import new_card, run_facts, with_episodes, write_card
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.support.logs import MISSING

Line = dict[str, Any]


def line(name: str, episode: int, **changes: Any) -> Line:
    """A successful rollout, as this version logs it."""
    task = get_task(name)
    marks = [{"operation": c.operation, "first_step": 9, "ordered_step": 9} for c in task.checkpoints]
    return {
        **{"task": name, "memory_type": task.memory_type, "episode": episode, "seed": 7 + episode, "referent": "fixed"},
        **{
            "variant": 0,
            "replan_steps": 6,
            "prompt_steps": 0,
            "prompt_shown": None,
            "steps": 9,
            "success": True,
            "world": "libero",
        },
        **{"checkpoints": marks, "failure": None, "scene_hash": f"{name[:20]}-{episode}", "wall_s": 1.0},
        **{"policy": "act 0123", "run": "r", "inputs": "pixels", **changes},
    }


def evaluation(folder: Path, lines: list[Line], episodes: int = 50, tasks: int = 30, **settings: Any) -> Path:
    """The folder of an evaluation that was asked for so many episodes of so many tasks, with some lines."""
    names = sorted(task_names()[:tasks])
    card = new_card(
        protocol={
            **{"tasks": names, "episodes": episodes, "inputs": "pixels"},
            **EnvSettings(replan_steps=6, prompt_in="steps", **settings).protocol_block,
        },
        policy={"type": "act", "seed": 7, "settings": {}, "sha256": "0" * 64},
        checkpoint=None,
        trained_on=None,
        task_files={},
        settings={},
        runs=[run_facts(["lerobot", "eval"], 1)],
    )
    folder.mkdir(parents=True)
    write_episodes(folder, lines)
    write_card(folder, card)
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

RESULTS = {
    *(
        "prompt_steps",
        "prompt_shown",
        "success",
        "checkpoints",
        "failure",
        "fault",
        "scene_hash",
        "settled",
        "stand_ins",
        "wall_s",
    ),
    *("not_run", "run", "written_at"),
}
"""Fields of a line that state no setting."""
DOCTORED: dict[str, Any] = {
    **{"task": "turn_on_the_stove_and_turn_it_off", "memory_type": "spatial", "episode": 1, "seed": 1007, "variant": 1},
    **{"steps": 1201, "checkpoints": [], "difficulty": "hard", "policy": "diffusion 0123"},
    "camera_name_mapping": {"agentview_image": "front"},
}
"""Other values than `other_value` finds."""


def other_value(name: str) -> Any:
    hint = typing.get_type_hints(EpisodeRecord)[name]
    kinds = {int: 3, bool: True, str: "another", float: 0.5}
    known = line("open_and_close_the_microwave", 0).get(name)
    return DOCTORED.get(name, next((v for k, v in kinds.items() if k.__name__ in str(hint) and v != known), 3))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lines = [line(name, episode) for name in sorted(task_names()[:2]) for episode in range(4)]
    folder = evaluation(tmp_path_factory.mktemp("small") / "a", lines, episodes=4, tasks=2)
    assert len(read_runs([folder])[0].notes) == 1  # on fixed goals
    return folder


@pytest.mark.parametrize("name", sorted({*typing.get_type_hints(EpisodeRecord)} - RESULTS))
@pytest.mark.parametrize("lines", [slice(0, 1), slice(0, 8)], ids=["one line", "all lines"])
def test_lines_of_other_settings_are_refused(small: Path, tmp_path: Path, name: str, lines: slice) -> None:
    """Each field of a line that states a setting, by the type of a line: a new one is doctored too."""
    folder = shutil.copytree(small, tmp_path / "b")
    log = folder / "episodes.jsonl"
    records = [json.loads(each) for each in log.read_text().splitlines()]
    records[lines] = [{**record, name: other_value(name)} for record in records[lines]]
    log.write_text("".join(json.dumps(each) + "\n" for each in records))
    for command in (["report", str(folder)], ["compare", str(small), str(folder), "--permutations", "100"]):
        status = main([*command, "--out", str(tmp_path / "out")])
        written = "".join(file.read_text() for file in (tmp_path / "out").rglob("*.txt"))
        assert status == 2 or "missing: " in written or "log and card" in written, (command, name)


@pytest.mark.parametrize("name", sorted({*STATED, "seed"} - {"referent", "replan_steps", "inputs", "world"}))
def test_a_line_is_refused_that_omits_another_setting_of_the_file(small: Path, tmp_path: Path, name: str) -> None:
    """Lines omit usual values; those of earlier versions omitted others too."""
    folder = shutil.copytree(small, tmp_path / "b")
    card = json.loads((folder / "evaluation.json").read_text())
    card["protocol"]["seed_base" if name == "seed" else name] = 1007 if name == "seed" else other_value(name)
    (folder / "evaluation.json").write_text(json.dumps(card))
    with pytest.raises(MemobenchError, match=f"contradicts evaluation.json .*{name}"):
        read_runs([folder])
    del card["protocol"][SCENE_HASHES]
    (folder / "evaluation.json").write_text(json.dumps(card))
    if name != "seed":
        read_runs([folder])


def test_lines_that_are_gone_are_noted(small: Path, tmp_path: Path) -> None:
    """Also where the file holds no outcomes: half of a task's lines."""
    folder = shutil.copytree(small, tmp_path / "b")
    log = folder / "episodes.jsonl"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:6]))
    (run,) = read_runs([folder])
    assert str(run.missing).startswith(MISSING.format(2, 8, sorted(task_names()[:2])[1], 2))
    with_outcomes = with_episodes(json.loads((small / "evaluation.json").read_text()), read_runs([small])[0].records)
    write_card(folder, with_outcomes)
    assert [note.split(":")[0] for note in read_runs([folder])[0].notes] == [
        "log and card disagree about 2 episodes, the first",
        "missing",
        f"{FIXED_GOALS} with fixed referents; claims of memory need suite=strict",
    ]
