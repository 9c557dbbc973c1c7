"""The grid is read and refused, cells know what is left of them after any kill, and their commands are understood."""

from __future__ import annotations

import fcntl
import gzip
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest

from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import CARD_FILE, protocol_of_log, read_rollouts
from lerobot_memobench.jobs.threads import PROCESSES
from lerobot_memobench.policies.memobench_mem.memory import OURS
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks
from research.learning import stages
from research.learning.stages import Cost, ended
from research.memory_study import cells, figure
from research.memory_study import tables as tables_module
from research.memory_study.__main__ import GRID, STUDY, main, planned, study, tables_of
from research.memory_study.cells import Cell, Demonstrations, choose_rates, chosen_rate, tuning
from research.memory_study.figure import draw_all
from research.memory_study.grid import ROLLOUTS, SEALED, TRAINING, Grid, chosen, read_grid
from research.memory_study.tables import figures_of_rows, tables
from research.necessity.adversaries import ceiling
from research.pages import around
from tests.support.logs import rollout

FIND = "find_the_artichoke_hidden_in_one_of_the_drawers"
SMALL = """
policy: [policy=memobench_mem, size=small, perception=objects]
training: [steps=4, save_freq=2]
evaluation: [split=validation, episodes=2, videos=0]
suites: {strict: {demonstrations: [--suite, strict], evaluation: [suite=strict]}}
controls: {evidence: [evidence=true, episodes=12]}
learning_rates: [0.0005, 0.001, 0.002]
rows:
  no memory: {training: [policy.memory=none], seeds: 2}
  frames, no time: {training: [], seeds: 1, controls: [evidence]}
"""


@pytest.fixture
def grid(tmp_path: Path) -> Grid:
    (tmp_path / "grid.yaml").write_text(SMALL)
    return read_grid(tmp_path / "grid.yaml")


def test_the_study_has_every_mechanism_and_its_commands_are_understood(tmp_path: Path) -> None:
    grid = read_grid(GRID)
    words = [word for row in grid.rows.values() for word in row.training]
    assert {word.removeprefix("policy.memory=") for word in words if word.startswith("policy.memory=")} == {
        *(set(OURS) - {"frames"}),
        "none",
    }
    for place in chosen(grid, ["seed=0"]):
        Cell(grid, tmp_path, *place, sealed=True).check()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("controls: [evidence]", "controls: [evidenec]", "'evidenec'; did you mean 'evidence'"),
        ("rows:", "row:", "no study's file"),
        ("frames, no time", "no_memory", "have one folder"),
        ("seeds: 2", "seeds: 0", "'no memory' has seeds: 0"),
        ("suites: {", "suites: {}\nnone: {", "needs rows and suites|no study's file"),
        ("controls: {evidence:", "controls: {sealed:", "a control is called 'sealed'"),
        ("controls: {evidence:", "controls: {after 3: [], evidence:", "a control is called 'after 3'"),
        ("controls: {evidence:", "controls: {a b: [], a_b: [], evidence:", "controls a b, a_b have one folder"),
        ("frames, no time:", "no memory:", "'no memory' stands twice"),
        ("controls: [evidence]}", "after: [3]}", "after: 3, and no checkpoint is kept then"),
        ("controls: [evidence]}", "after: [4]}", "after: 4, and no checkpoint"),
        ("[suite=strict]}", "[suite=strict], tasks: [objects]}", "did you mean 'object'"),
        ("[suite=strict]}", "[suite=strict], ceilings: {find_it: 3.0}}", "a ceiling of find_it"),
        ("[--suite, strict]", "[--referent, random]", "learns from suite published and is rolled out on strict"),
        ("evaluation: [suite=strict]", "evaluation: []", "learns from suite strict and is rolled out on published"),
        ("[--suite, strict]", "[--suite, strict, --tasks, object]", "has --tasks in demonstrations"),
        ("training: [steps=4,", "training: [seed=1, steps=4,", "seed= is the study's to say"),
        ("training: [],", "training: [], evaluation: [episodes=1],", "episodes= is the study's to say"),
        ("frames, no time:", "frames | time:", "'frames | time', and --only or a table"),
        ("frames, no time:", "frames (privileged):", "rename it"),
        ("frames, no time:", "strict:", "'strict', and --only"),
        ("frames, no time:", "seed=1:", "'seed=1', and --only"),
    ],
)
def test_a_file_that_cannot_be_followed_is_refused(tmp_path: Path, old: str, new: str, told: str) -> None:
    (tmp_path / "grid.yaml").write_text(SMALL.replace(old, new))
    with pytest.raises(MemobenchError, match=told):
        read_grid(tmp_path / "grid.yaml")


def test_the_first_training_seed_alone_runs_controls(grid: Grid, tmp_path: Path) -> None:
    first, second = (Cell(grid, tmp_path, "strict", "frames, no time", seed) for seed in (0, 1))
    assert first.parts == [ROLLOUTS, "evidence"]
    assert second.parts == [ROLLOUTS]


def test_the_tasks_of_a_suite_alone_are_drawn_and_rolled_out(tmp_path: Path) -> None:
    some = SMALL.replace(
        "evaluation: [suite=strict]",
        f"evaluation: [suite=strict], tasks: [object, {FIND}], whole: true",
    )
    (tmp_path / "grid.yaml").write_text(some)
    cell = Cell(read_grid(tmp_path / "grid.yaml"), tmp_path, "strict", "no memory", 0)
    weights = f"policy.task_weights={{object: 1, {FIND}: 1, temporal: 0, spatial: 0, procedural: 0}}"
    assert weights in cell.training_words()
    assert f"tasks=object,{FIND}" in cell.evaluation_words(ROLLOUTS)


def test_demonstrations_are_of_the_tasks_alone_that_are_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "grid.yaml").write_text(SMALL.replace("[suite=strict]}", f"[suite=strict], tasks: [object, {FIND}]}}"))
    grid = read_grid(tmp_path / "grid.yaml")
    ran = list[list[str]]()
    monkeypatch.setattr(cells, "run_once", lambda words, *_, **__: ran.append(words))
    Demonstrations(grid, "strict", tmp_path).run()
    assert ran[0][:6] == ["memobench", "generate", "--suite", "strict", "--tasks", f"object,{FIND}"]
    words = Cell(grid, tmp_path, "strict", "no memory", 0).training_words()
    assert not any(word.startswith("policy.task_weights=") for word in words)


def test_anothers_policy_learns_the_demonstrations_of_the_same_tasks(tmp_path: Path, monkeypatch: Any) -> None:
    some = SMALL.replace(
        "evaluation: [suite=strict]",
        f"evaluation: [suite=strict], tasks: [object, {FIND}], whole: true",
    )
    (tmp_path / "grid.yaml").write_text(some.replace("no memory: {", "act: {policy: [policy=act], "))
    cell = Cell(read_grid(tmp_path / "grid.yaml"), tmp_path, "strict", "act", 0)
    Demonstrations(cell.grid, "strict", tmp_path).folder.mkdir(parents=True)
    told = [
        (FIND, "spatial"),
        ("count_it", "temporal"),
        ("bowl", "object"),
    ]
    places = [
        SimpleNamespace(index=k, record=SimpleNamespace(task_name=n, memory_type=t)) for k, (n, t) in enumerate(told)
    ]
    monkeypatch.setattr(cells, "list_episodes", lambda folder: [*places, SimpleNamespace(index=3, record=None)])
    assert "dataset.episodes=[0,2]" in cell.training_words()


def test_words_choose_cells(grid: Grid) -> None:
    assert chosen(grid, []) == [
        ("strict", "no memory", 0),
        ("strict", "frames, no time", 0),
        ("strict", "no memory", 1),
    ]
    assert chosen(grid, ["no memory", "seed=1"]) == [("strict", "no memory", 1)]
    with pytest.raises(MemobenchError, match="did you mean 'strict'"):
        chosen(grid, ["stricd"])


def test_a_killed_cell_goes_on_where_it_was(grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that die at every moment in turn; what has ended well is never run again."""
    cell, ran, dies = Cell(grid, tmp_path, "strict", "frames, no time", 0), list[str](), [True] * 3

    def fake(words: list[str], output: IO[str], environment: object) -> tuple[int, Cost]:
        ran.append(words[1] if words[1] == "eval" else "resume" if "resume=true" in words else "train")
        print("…", file=output)
        if dies and dies.pop():
            if words[1] == "train":
                _keep_checkpoint(cell.policy / "checkpoints" / "last")
            return 1, Cost(1.0, 1.0)
        return 0, Cost(1.0, 1.0)

    monkeypatch.setattr(stages, "_run", fake)
    for _ in range(3):
        assert not cell.finished()
        with pytest.raises(MemobenchError, match="ended with status 1"):
            cell.run()
    assert planned([], [], [cell], 1).endswith("1 of 1 are left")
    cell.run()
    assert cell.finished()
    assert ran == ["train", "resume", "resume", "resume", "eval", "eval"]
    cell.run()
    assert len(ran) == 6
    assert cell.costs()["training"] == Cost(4.0, 4.0)
    assert planned([], [], [cell], 1) == "0 of 1 are left"


TOLD = {"words": [], "ended": False, "wall_s": 60.0, "cpu_s": 50.0}
"""What is kept of a command."""


def _keep_checkpoint(folder: Path) -> None:
    for name in ("pretrained_model/train_config.json", "training_state/training_step.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{}")


def test_nothing_is_removed_that_may_be_gone_on_with(
    grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a training that runs, of one of another command, or of one that was killed as it moved the link."""
    cell = Cell(grid, tmp_path, "strict", "no memory", 0)
    mark = cell.policy / "mark"
    mark.parent.mkdir(parents=True)
    mark.touch()
    with cell.log("training").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(MemobenchError, match="still writes"):
            cell.run()
    cell.log("training").with_suffix(".json").write_text(json.dumps({**TOLD, "words": ["other"]}))
    with pytest.raises(MemobenchError, match="of another command"):
        cell.run()
    assert mark.exists()
    cell.log("training").with_suffix(".json").write_text(json.dumps({**TOLD, "words": cell.training_words()}))
    for updates in ("000002", "000004"):
        _keep_checkpoint(cell.policy / "checkpoints" / updates)
    (cell.policy / "checkpoints" / "000002" / "training_state" / "optimizer_param_groups.json").touch()
    ran = list[list[str]]()
    monkeypatch.setattr(stages, "_run", lambda words, *rest: (ran.append(words), (1, Cost(1.0, 1.0)))[1])
    with pytest.raises(MemobenchError, match="ended with status 1"):
        cell.run()
    assert ran[0][2].endswith("checkpoints/000002/pretrained_model/train_config.json"), "the last whole one"
    assert mark.exists()


def test_a_killed_attempt_counts_till_its_last_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, words = tmp_path / "a.log", ["memobench", "--version"]
    log.touch()
    told = {"words": words, "ended": False, "wall_s": 5.0, "cpu_s": 4.0, "began": log.stat().st_mtime - 60}
    log.with_suffix(".json").write_text(json.dumps(told))
    monkeypatch.setattr(stages, "_run", lambda *given: (0, Cost(1.0, 1.0)))
    assert stages.run_once(words, log) == Cost(66.0, 5.0)


def test_a_command_that_outlived_its_study_is_not_run_beside_itself(tmp_path: Path) -> None:
    """As when the study alone was killed: its command holds the log's lock."""
    log = tmp_path / "training.log"
    with log.open("a") as file:
        left = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stdout=file)
        fcntl.flock(file, fcntl.LOCK_EX)
    with pytest.raises(MemobenchError, match="still writes"):
        stages.run_once(["memobench", "--version"], log)
    left.communicate(b"\n")
    stages.run_once(["memobench", "--version"], log)
    assert ended(log)


BUTTER = "put_only_the_butter_picked_up_in_the_prompt_video_on_the_plate"
TINY = """
policy: [policy=memobench_mem, size=small, perception=objects]
training: [steps=8, save_freq=2]
evaluation: [split=validation, episodes=2, videos=0, env.horizon=120]
suites:
  strict:
    demonstrations: [--suite, strict, --episodes, "3", --no-images]
    evaluation: [suite=strict]
    tasks: [find_the_artichoke_hidden_in_one_of_the_drawers]
rows:
  frames: {training: [], after: [4]}
"""


@pytest.mark.slow
def test_a_study_killed_at_ten_random_moments_ends_as_one_that_was_not(tmp_path: Path) -> None:
    (tmp_path / "grid.yaml").write_text(TINY)
    command = [sys.executable, "-m", "research.memory_study", "--grid", str(tmp_path / "grid.yaml"), "--out"]
    subprocess.run([*command, str(tmp_path / "whole")], check=True, capture_output=True)
    rng, killed = random.Random(0), 0
    while True:
        study = subprocess.Popen(
            [*command, str(tmp_path / "killed")], start_new_session=True, stdout=subprocess.DEVNULL
        )
        try:
            study.wait(rng.uniform(4, 40) if killed < 10 else None)
        except subprocess.TimeoutExpired:
            os.killpg(study.pid, signal.SIGKILL)
            study.wait()
            killed += 1
            continue
        break
    assert study.returncode == 0
    assert killed >= 5, "the machine was so fast that little was killed; draw shorter times"
    whole, other = (
        Cell(read_grid(tmp_path / "grid.yaml"), tmp_path / name, "strict", "frames", 0) for name in ("whole", "killed")
    )
    assert _weights(other) == _weights(whole)
    for part in whole.parts:
        assert _outcomes(other.evaluation(part)) == _outcomes(whole.evaluation(part))


def _weights(cell: Cell) -> bytes:
    return (cell.policy / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").read_bytes()


def _outcomes(folder: Path) -> list[dict[str, Any]]:
    """Return the rollouts but for when, and how fast, they were run."""
    return [{k: v for k, v in one.items() if k not in ("wall_s", "run", "policy")} for one in read_rollouts(folder)[0]]


def test_a_learning_rate_is_chosen_once_and_then_used(grid: Grid, tmp_path: Path) -> None:
    tried = tuning(grid, tmp_path, chosen(grid, ["no memory"]))
    assert [cell.tuned for cell in tried] == [0.0005, 0.001, 0.002]
    assert [word for word in tried[0].training_words() if word.startswith("steps=")] == ["steps=3000"]
    assert "episodes=3" in tried[0].evaluation_words(ROLLOUTS)
    for cell, success in zip(tried, (40.0, 50.0, 50.0), strict=True):
        folder = cell.evaluation(ROLLOUTS)
        folder.mkdir(parents=True)
        (folder / "report.json").write_text(json.dumps({"average": {"SR": success}}))
    assert choose_rates(tried) == {("strict", "no memory"): 0.001}
    assert chosen_rate(tmp_path, "strict", "no memory") == 0.001
    cell = Cell(grid, tmp_path, "strict", "no memory", 1)
    assert "policy.optimizer_lr=0.001" in cell.training_words()
    assert not any("optimizer_lr" in w for w in Cell(grid, tmp_path, "strict", "frames, no time", 0).training_words())
    cell.folder.mkdir(parents=True)
    (cell.folder / "training.json").write_text("{}")
    (tried[2].evaluation(ROLLOUTS) / "report.json").write_text(json.dumps({"average": {"SR": 90.0}}))
    with pytest.raises(MemobenchError, match=r"was trained with the learning rate 0.001, and tuning chooses 0.002"):
        choose_rates(tried)


def test_demonstrations_are_made_once_for_a_suite(grid: Grid, tmp_path: Path) -> None:
    data = Demonstrations(grid, "strict", tmp_path)
    assert not data.finished()
    assert f"dataset={data.folder}" in Cell(grid, tmp_path, "strict", "no memory", 0).training_words()
    assert tables(grid, tmp_path, "strict") == ""


def test_an_interrupted_training_is_gone_on_with_by_its_own_command_alone(
    grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = Cell(grid, tmp_path, "strict", "frames, no time", 0)

    def interrupted(words: list[str], output: IO[str], environment: object) -> tuple[int, Cost]:
        _keep_checkpoint(cell.policy / "checkpoints" / "last")
        raise KeyboardInterrupt

    monkeypatch.setattr(stages, "_run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cell.run()
    (tmp_path / "grid.yaml").write_text(SMALL.replace("steps=4", "steps=8"))
    with pytest.raises(MemobenchError, match="is of another command"):
        Cell(read_grid(tmp_path / "grid.yaml"), tmp_path, "strict", "frames, no time", 0).run()


def test_a_training_that_failed_before_its_first_checkpoint_begins_anew(
    grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = Cell(grid, tmp_path, "strict", "no memory", 0)

    def failing(words: list[str], output: IO[str], environment: object) -> tuple[int, Cost]:
        cell.policy.mkdir(parents=True)  # as LeRobot makes it, which refuses one that is there
        output.write("out of memory")
        output.flush()
        return 1, Cost(1.0, 1.0)

    monkeypatch.setattr(stages, "_run", failing)
    for _ in range(2):
        with pytest.raises(MemobenchError, match="out of memory"):
            cell.run()


def _evaluate(cell: Cell, *parts: str, rollouts: int = 10, solved: int = 4, **more: str) -> None:
    """Let these parts of a cell be evaluated, by so many rollouts each; half of the solved ones are solved early on."""
    for part in parts:
        right = solved // 2 if part.startswith("after") else solved
        episodes = [_rollout(episode, part == "evidence", right) | more for episode in range(rollouts)]
        write_episodes(cell.evaluation(part), episodes)
        _write_card(cell, part, episodes)
        _end(cell, part)
    _end(cell, TRAINING)


def _write_card(cell: Cell, part: str, episodes: list[dict[str, Any]]) -> None:
    """Write of a card what tables read."""
    card = {
        "protocol": protocol_of_log(episodes),
        "runs": [{"command": [*cell.carded_words(part), "resume=true"]}],
    }
    (cell.evaluation(part) / CARD_FILE).write_text(json.dumps(card))


def _end(cell: Cell, part: str) -> None:
    words = cell.training_words() if part == TRAINING else cell.evaluation_words(part)
    cell.log(part).with_suffix(".json").parent.mkdir(parents=True, exist_ok=True)
    cell.log(part).with_suffix(".json").write_text(json.dumps({**TOLD, "words": words, "ended": True}))


def test_tables_and_figures_show_what_is_evaluated(tmp_path: Path) -> None:
    more = SMALL.replace("controls: [evidence]}", "controls: [evidence, replan 5], after: [2]}").replace(
        "controls: {", "controls: {replan 5: [replan=5], "
    )
    (tmp_path / "grid.yaml").write_text(
        more.replace("[suite=strict]}", f"[suite=strict], tasks: [object], ceilings: {{{BUTTER}: 33.3}}}}")
    )
    grid = read_grid(tmp_path / "grid.yaml")
    assert draw_all(grid, tmp_path, tmp_path) == []
    _evaluate(Cell(grid, tmp_path, "strict", "no memory", 0), ROLLOUTS)
    _evaluate(Cell(grid, tmp_path, "strict", "frames, no time", 0), ROLLOUTS, "after 2", "evidence")
    _evaluate(Cell(grid, tmp_path, "strict", "frames, no time", 0), "replan 5", solved=2)
    assert figures_of_rows(grid, tmp_path, "strict") == {
        "no memory": {"solved": [40.0], "follows": [], "without": {"solved": 33.3, "follows": None}},
        "frames, no time": {"solved": [40.0], "follows": [80.0], "without": {"solved": 33.3, "follows": 50.0}},
    }
    told = tables(grid, tmp_path, "strict").splitlines()
    assert f"| best found without a memory | – | 33.3 |{8 * ' – |'}" in told
    assert "| no memory | 1 | **40.0** | 10.0–70.0 | 40 | 100.0 | – | 100.0 | – | – | – |" in told
    (line,) = (one for one in told if one.startswith("| frames, no time | 1 | **40.0** |"))
    assert re.search(r"\| 80.0 \(\d+\.\d–100\.0\) \| 50\.0 \| 5 \|$", line)
    assert f"| `{BUTTER}` | 33.3 | 40.0 | 40.0 |" in told
    (line,) = (one for one in told if one.startswith("| frames, no time | 40.0 | "))
    assert re.search(r"\| 20\.0 \(-20\.0, -\d+\.\d to \+\d+\.\d\) \|$", line), "replan=5 less as it is, same scenes"
    assert "| frames, no time | 2 | 1 | 20.0 | 100.0 | – | 100.0 |" in told, "after 2 updates"
    assert "| frames, no time | 4 | 1 | 40.0 | 100.0 | – | 100.0 |" in told
    drawn = draw_all(grid, tmp_path, tmp_path)
    assert [path.name for path in drawn] == ["study.png", "study_tasks_strict.png", "study_updates_strict.png"]
    assert all(path.stat().st_size > 5_000 for path in drawn)


def test_means_of_training_seeds_are_of_figures_that_are_not_rounded(grid: Grid, tmp_path: Path) -> None:
    """1/6 and 1/4 are 20.83 %; of 16.7 and 25.0 it would be 20.9."""
    for seed, solved in enumerate((2, 3)):
        _evaluate(Cell(grid, tmp_path, "strict", "no memory", seed), ROLLOUTS, rollouts=12, solved=solved)
    assert f"| `{BUTTER}` | – | 20.8 |" in tables(grid, tmp_path, "strict").splitlines()


def test_a_privileged_row_is_drawn_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "grid.yaml").write_text(SMALL.replace("controls: [evidence]}", "privileged: true}"))
    grid, drawn = read_grid(tmp_path / "grid.yaml"), list[Any]()
    for row in ("frames, no time", "no memory"):
        _evaluate(Cell(grid, tmp_path, "strict", row, 0), ROLLOUTS)
    monkeypatch.setattr(figure, "save", lambda drawing, path: drawn.append(drawing))
    figure.draw(grid, tmp_path, tmp_path / "study.png")
    labels = [label.get_text() for label in drawn[0].axes[0].get_yticklabels()]
    assert labels == ["no memory", "frames, no time (privileged)"]


def test_checkpoints_are_evaluated_by_their_own_weights(tmp_path: Path) -> None:
    (tmp_path / "grid.yaml").write_text(SMALL.replace("controls: [evidence]}", "after: [2]}"))
    cell = Cell(read_grid(tmp_path / "grid.yaml"), tmp_path, "strict", "frames, no time", 0)
    assert cell.parts == [ROLLOUTS, "after 2"]
    assert f"policy={cell.policy}/checkpoints/000002" in cell.evaluation_words("after 2")
    assert f"policy={cell.policy}" in cell.evaluation_words(ROLLOUTS)


def test_the_sealed_test_is_asked_for_and_stays(grid: Grid, tmp_path: Path) -> None:
    cell = Cell(grid, tmp_path, "strict", "no memory", 0)
    assert SEALED not in cell.parts
    asked = replace(cell, sealed=True)
    assert asked.parts == [ROLLOUTS, SEALED]
    words = asked.evaluation_words(SEALED)
    assert words[:3] == ["memobench", "test-sealed", f"policy={cell.policy}"]
    assert not any(word.startswith("split=") for word in words), "its seeds are the command's"
    _evaluate(cell, ROLLOUTS, SEALED)
    assert cell.parts == [ROLLOUTS, SEALED], "what was tested is told, whoever reads"
    assert "### The sealed test" in tables(grid, tmp_path, "strict")
    other = Cell(grid, tmp_path, "strict", "frames, no time", 0, sealed=True)
    _evaluate(other, ROLLOUTS)
    assert "sealed test, minus" not in tables(grid, tmp_path, "strict"), "it has not been tested"
    _evaluate(other, SEALED, solved=8)
    _, _, told = tables(grid, tmp_path, "strict").partition("### The sealed test, minus *no memory*")
    assert "frames, no time minus no memory | 10 | +40.0" in told


def test_ceilings_are_of_the_tasks_that_are_rolled_out() -> None:
    suites = read_grid(GRID).suites
    for name, suite in suites.items():
        assert sorted(suite.ceilings) == sorted(resolve_tasks(suite.tasks, name))
    for task, value in suites["strict"].ceilings.items():
        assert value == pytest.approx(100 * ceiling(get_task(task)), abs=0.051)


def test_the_average_of_ceilings_is_of_memory_types(grid: Grid, tmp_path: Path) -> None:
    milk = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
    counted = "check_the_middle_drawer_a_given_number_of_times"
    suite = replace(grid.suites["strict"], ceilings={BUTTER: 10.0, milk: 20.0, counted: 45.0})
    changed = replace(grid, suites={"strict": suite})
    _evaluate(Cell(changed, tmp_path, "strict", "no memory", 0), ROLLOUTS)
    assert "| best found without a memory | – | 30.0 | –" in tables(changed, tmp_path, "strict")


def _rollout(episode: int, evidence: bool, solved: int = 4) -> dict[str, Any]:
    """Return one of ten rollouts: the first ``solved`` succeed; of two variants four scenes in five choose rightly."""
    variant, right = episode % 2, episode < 8
    told: dict[str, Any] = {}
    if evidence:
        told = {"seed": 7 + episode // 2, "variant": variant, "choice": variant if right else None}
        told |= {"variants": 2, "chance": 0.5}
    told |= {"wall_s": 1.0, "steps": 80, "prompt_steps": 20}
    return rollout(BUTTER, "object", "SC", [True, True], episode < solved, episode, **told)


NOTES = Path(__file__).parents[2] / "docs" / "research"


def test_a_page_is_not_emptied_and_a_cut_log_is_told(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    shutil.copy(NOTES / "study.md", page)
    shutil.copytree(NOTES / "study", tmp_path / "out")
    assert main(["--out", str(tmp_path / "nothing"), "--page", str(page)]) == 2
    assert page.read_text() == (NOTES / "study.md").read_text()
    log = Cell(read_grid(GRID), tmp_path / "out", "published", "frames", 0).evaluation(ROLLOUTS) / "episodes.jsonl.gz"
    lines = gzip.decompress(log.read_bytes()).splitlines(keepends=True)
    log.write_bytes(gzip.compress(b"".join(lines[:50])))
    with pytest.raises(MemobenchError, match=r"frames-0/rollouts holds 50 rollouts of the 120 that its card asks for"):
        tables(read_grid(GRID), tmp_path / "out", "published")
    with pytest.raises(MemobenchError, match="is --out too"):
        study(tmp_path / "out", keep=tmp_path / "out")


def test_logs_are_kept_as_they_are(tmp_path: Path) -> None:
    cell = Cell(read_grid(GRID), tmp_path / "out", "published", "frames", 0)
    kept = Cell(cell.grid, NOTES / "study", "published", "frames", 0).folder
    shutil.copytree(kept, cell.folder)
    again = tmp_path / "kept" / "cells" / "published" / "frames-0"
    assert again / ROLLOUTS in cell.keep(tmp_path / "kept")
    files = sorted(path.relative_to(again) for path in again.glob("**/*") if path.is_file())
    assert Path(ROLLOUTS, "episodes.jsonl.gz") in files
    for file in files:
        assert (again / file).read_bytes() == (kept / file).read_bytes()


def test_the_page_is_of_the_kept_logs() -> None:
    """Each figure of its tables is counted again."""
    before, after = around(NOTES / "study.md", STUDY)
    made = (NOTES / "study.md").read_text().removeprefix(before).removesuffix(after).strip()
    assert made == tables_of(read_grid(GRID), NOTES / "study")
    assert sum(file.stat().st_size for file in (NOTES / "study").glob("**/*")) < 5_000_000


def test_evidence_without_a_chance_is_in_no_table(grid: Grid, tmp_path: Path) -> None:
    cell = Cell(grid, tmp_path, "strict", "frames, no time", 0)
    for part in (ROLLOUTS, "evidence"):
        episodes = [{**_rollout(k, part == "evidence"), "chance": None} for k in range(10)]
        write_episodes(cell.evaluation(part), episodes)
        _write_card(cell, part, episodes)
        _end(cell, part)
    _end(cell, TRAINING)
    assert figures_of_rows(grid, tmp_path, "strict")["frames, no time"]["follows"] == []
    assert "frames, no time" in tables(grid, tmp_path, "strict")


# -- nothing of another recipe, policy or scene counts -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("steps=4", "steps=8", "training.json .*'steps=4'"),
        ("[policy.memory=none]", "[policy.memory=bank]", "training.json .*'policy.memory=none'"),
        ("episodes=2", "episodes=3", "rollouts.json .*'episodes=2'"),
    ],
)
def test_what_ended_by_another_grid_is_neither_done_nor_counted(
    grid: Grid, tmp_path: Path, old: str, new: str, what: str
) -> None:
    cell = Cell(grid, tmp_path, "strict", "no memory", 0)
    _evaluate(cell, ROLLOUTS)
    assert cell.finished()
    (tmp_path / "grid.yaml").write_text(SMALL.replace(old, new))
    changed = read_grid(tmp_path / "grid.yaml")
    with pytest.raises(MemobenchError, match=what):
        replace(cell, grid=changed).finished()
    with pytest.raises(MemobenchError, match=what):
        tables(changed, tmp_path, "strict")


def test_demonstrations_of_another_grid_are_not_learned(grid: Grid, tmp_path: Path) -> None:
    data = Demonstrations(grid, "strict", tmp_path)
    data.folder.mkdir(parents=True)
    words = ["memobench", "generate", "--suite", "strict", "--out", "/elsewhere/demonstrations/strict"]
    data.folder.with_suffix(".json").write_text(json.dumps({**TOLD, "words": words, "ended": True}))
    assert data.finished(), "in whichever folder they were made"
    data.keep(tmp_path / "kept")
    assert replace(data, out=tmp_path / "kept").finished()
    some = SMALL.replace("[suite=strict]}", f"[suite=strict], tasks: [{FIND}]}}")
    (tmp_path / "grid.yaml").write_text(some)
    with pytest.raises(MemobenchError, match=r"strict\.json is of another command"):
        Demonstrations(read_grid(tmp_path / "grid.yaml"), "strict", tmp_path).finished()


def test_a_crash_makes_no_demonstrations(grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Status 1 says that a seed was not solved; a traceback ends with it, too."""
    data, makes = Demonstrations(grid, "strict", tmp_path), False

    def fake(words: list[str], output: IO[str], environment: object) -> tuple[int, Cost]:
        if makes:
            (data.folder / "meta").mkdir(parents=True)
            (data.folder / "meta" / "info.json").touch()
        return 1, Cost(1.0, 1.0)

    monkeypatch.setattr(stages, "_run", fake)
    with pytest.raises(MemobenchError, match="ended with status 1"):
        data.run()
    assert not data.finished()
    makes = True
    data.run()
    assert data.finished()


def test_rollouts_of_a_policy_that_is_gone_are_told(grid: Grid, tmp_path: Path) -> None:
    cell = Cell(grid, tmp_path, "strict", "no memory", 0)
    _evaluate(cell, ROLLOUTS)
    cell.log(TRAINING).with_suffix(".json").unlink()
    with pytest.raises(MemobenchError, match=r"rollouts is of a training that .*training\.json does not tell"):
        tables(grid, tmp_path, "strict")
    with pytest.raises(MemobenchError, match="rollouts is of a policy that is not in"):
        cell.finished()


def test_a_cell_is_of_one_policy_and_a_policy_of_one_cell(grid: Grid, tmp_path: Path) -> None:
    def told(out: Path, rollouts: str, evidence: str) -> str:
        _evaluate(Cell(grid, out, "strict", "no memory", 0), ROLLOUTS, policy="first")
        cell = Cell(grid, out, "strict", "frames, no time", 0)
        _evaluate(cell, ROLLOUTS, policy=rollouts)
        _evaluate(cell, "evidence", policy=evidence)
        return tables(grid, out, "strict")

    assert told(tmp_path / "right", "second", "second")
    with pytest.raises(MemobenchError, match="evidence are of two policies"):
        told(tmp_path / "mixed", "second", "older")
    with pytest.raises(MemobenchError, match="are of one policy"):
        told(tmp_path / "copied", "first", "first")


@pytest.mark.parametrize("exchanged", ["another condition", "another row", "no card"])
def test_a_log_that_was_exchanged_is_refused(grid: Grid, tmp_path: Path, exchanged: str) -> None:
    cell, other = (Cell(grid, tmp_path, "strict", row, 0) for row in ("frames, no time", "no memory"))
    _evaluate(cell, ROLLOUTS, "evidence")
    _evaluate(other, ROLLOUTS)
    assert tables(grid, tmp_path, "strict")
    tables_module._figures.cache_clear()
    source = cell.evaluation("evidence") if exchanged == "another condition" else other.evaluation(ROLLOUTS)
    if exchanged == "no card":
        (cell.evaluation(ROLLOUTS) / CARD_FILE).unlink()
    else:
        shutil.copytree(source, cell.evaluation(ROLLOUTS), dirs_exist_ok=True)
    with pytest.raises(MemobenchError, match=r"rollouts is of another evaluation than its cell's"):
        tables(grid, tmp_path, "strict")


def test_a_log_that_nothing_tells_about_is_not_left_out_in_silence(grid: Grid, tmp_path: Path) -> None:
    cell = Cell(grid, tmp_path, "strict", "no memory", 0)
    _evaluate(cell, ROLLOUTS)
    cell.log(ROLLOUTS).with_suffix(".json").unlink()
    with pytest.raises(MemobenchError, match=r"rollouts is there, and .*rollouts\.json.* is gone"):
        tables(grid, tmp_path, "strict")


def test_a_folder_that_is_no_study_is_not_written_into(
    grid: Grid, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    told = ["--out", str(out), "--grid", str(tmp_path / "grid.yaml")]
    _evaluate(Cell(grid, out, "strict", "no memory", 0), ROLLOUTS)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("")
    for wrong in (mine, mine / "thesis.tex"):
        assert main([*told, "--keep", str(wrong)]) == 2
        assert "is no folder of a study" in capsys.readouterr().err
    assert [file.name for file in mine.iterdir()] == ["thesis.tex"]
    assert main([*told, "--only", "seed=1", "--keep", str(tmp_path / "new")]) == 2
    assert "nothing is kept" in capsys.readouterr().err
    for _ in range(2):
        assert main([*told, "--keep", str(tmp_path / "new")]) == 0


def test_rows_are_compared_on_the_same_scenes(grid: Grid, tmp_path: Path) -> None:
    _evaluate(Cell(grid, tmp_path, "strict", "no memory", 0), ROLLOUTS)
    _evaluate(Cell(grid, tmp_path, "strict", "frames, no time", 0), ROLLOUTS, scene_hash="another")
    with pytest.raises(MemobenchError, match="scene_hash is another for 'frames, no time'"):
        tables(grid, tmp_path, "strict")


def test_a_row_that_solves_everything_has_its_interval(grid: Grid, tmp_path: Path) -> None:
    for seed in (0, 1):
        _evaluate(Cell(grid, tmp_path, "strict", "no memory", seed), ROLLOUTS, rollouts=12, solved=12)
    assert "**100.0**" in tables(grid, tmp_path, "strict")


def test_words_are_tried_before_anything_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "grid.yaml").write_text(SMALL.replace("policy.memory=none", "policy.memry=none"))
    monkeypatch.setattr(stages, "_run", lambda *given: pytest.fail("something was run"))
    with pytest.raises(MemobenchError, match="memory"):
        study(tmp_path / "out", tmp_path / "grid.yaml", plan=True)


def test_cells_that_run_at_once_share_the_cores(grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = set[str]()

    def fake(words: list[str], output: IO[str], environment: dict[str, str]) -> tuple[int, Cost]:
        told.add(environment[PROCESSES])
        return 0, Cost(1.0, 1.0)

    monkeypatch.setattr(stages, "_run", fake)
    Cell(grid, tmp_path, "strict", "no memory", 0, beside=2).run()
    assert told == {"2"}


@pytest.mark.parametrize("content", ['{"ended": true}', '{"words": [], "ended": "no", "wall_s": 1, "cpu_s": 1}'])
def test_a_damaged_file_of_a_command_is_told(grid: Grid, tmp_path: Path, content: str) -> None:
    cell = Cell(grid, tmp_path, "strict", "no memory", 0)
    _evaluate(cell, ROLLOUTS)
    cell.log(ROLLOUTS).with_suffix(".json").write_text(content)
    with pytest.raises(MemobenchError, match=r"rollouts\.json.*remove it"):
        tables(grid, tmp_path, "strict")
