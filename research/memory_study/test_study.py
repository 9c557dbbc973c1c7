"""The grid is checked, killed cells resume, and tables count only results of the grid's own commands."""

from __future__ import annotations

import fcntl
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import pytest

from lerobot_memobench.envs.evaluation_file import read_evaluation, write_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.threads import PROCESSES
from lerobot_memobench.rollouts.card import run_facts
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks
from research.kept import keep, restore
from research.memory_study import cells, commands
from research.memory_study import tables as tables_module
from research.memory_study.__main__ import main, planned, study
from research.memory_study.cells import Cell, Demonstrations
from research.memory_study.commands import Cost, has_ended
from research.memory_study.grid import GRID_FILE, ROLLOUTS, SEALED, TRAINING, Grid, chosen, read_grid
from research.memory_study.tables import figures_of_rows, tables
from research.necessity.adversaries import ceiling
from tests.support.logs import card, rollout, write_log

FIND = "find_the_artichoke_hidden_in_one_of_the_drawers"
BUTTER = "put_only_the_butter_picked_up_in_the_prompt_video_on_the_plate"
SMALL = """
policy: [policy=memobench_mem, size=small, perception=objects]
training: [steps=4, save_freq=2]
evaluation: [split=validation, episodes=2, videos=0]
suites: {strict: {demonstrations: [--suite, strict], evaluation: [suite=strict]}}
controls: {evidence: [evidence=true, episodes=12]}
rows:
  no memory: {training: [policy.memory=none], seeds: 2, sealed: true}
  frames, no time: {training: [], seeds: 1, controls: [evidence]}
contrasts: {registered: [["frames, no time", no memory]]}
"""
COMMAND = {"words": [], "ended": False, "wall_s": 60.0, "cpu_s": 50.0}
"""The file of a command."""


def grid_of(folder: Path, *changes: tuple[str, str]) -> Grid:
    text = SMALL
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "grid.yaml").write_text(text)
    return read_grid(folder / "grid.yaml")


@pytest.fixture
def grid(tmp_path: Path) -> Grid:
    return grid_of(tmp_path)


@pytest.fixture
def frames(grid: Grid, tmp_path: Path) -> Cell:
    return Cell(grid, tmp_path, "strict", "frames, no time", 0)


@pytest.fixture
def no_memory(grid: Grid, tmp_path: Path) -> Cell:
    return Cell(grid, tmp_path, "strict", "no memory", 0)


# --- the grid ---


def test_commands_of_the_study_are_understood(tmp_path: Path) -> None:
    grid = read_grid(GRID_FILE)
    for place in chosen(grid, []):
        Cell(grid, tmp_path, *place, sealed=True).check()


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("controls: [evidence]", "controls: [evidenec]", "'evidence'"),
        ("rows:", "row:", "row"),
        ("frames, no time", "no_memory", "no_memory"),
        ("seeds: 2", "seeds: 0", "'no memory'"),
        ("suites: {", "suites: {}\nnone: {", "none"),
        ("controls: {evidence:", "controls: {sealed:", "'sealed'"),
        ("controls: {evidence:", "controls: {a b: [], a_b: [], evidence:", "a b, a_b"),
        ("frames, no time:", "no memory:", "'no memory'"),
        ("[suite=strict]}", "[suite=strict], tasks: [objects]}", "'object'"),
        ("[suite=strict]}", "[suite=strict], ceilings: {find_it: 3.0}}", "find_it"),
        ("[--suite, strict]", "[--referent, random]", "suite published"),
        ("evaluation: [suite=strict]", "evaluation: []", "rollouts of published"),
        ("[--suite, strict]", "[--suite, strict, --tasks, object]", "--tasks"),
        ("training: [steps=4,", "training: [seed=1, steps=4,", "seed="),
        ("frames, no time:", "frames | time:", "'frames | time'"),
        ("frames, no time:", "strict:", "'strict'"),
        ("frames, no time:", "seed=1:", "'seed=1'"),
        ("no memory]]", "no memories]]", "'no memories'.*'no memory'"),
    ],
)
def test_invalid_grids_are_refused(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(MemobenchError, match=named.replace("|", r"\|")):
        grid_of(tmp_path, (old, new))


def test_words_choose_cells(grid: Grid) -> None:
    assert chosen(grid, []) == [
        ("strict", "no memory", 0),
        ("strict", "frames, no time", 0),
        ("strict", "no memory", 1),
    ]
    assert chosen(grid, ["no memory", "seed=1"]) == [("strict", "no memory", 1)]
    with pytest.raises(MemobenchError, match="'strict'"):
        chosen(grid, ["stricd"])


def test_ceilings_cover_the_strict_tasks_and_are_exact() -> None:
    suite = read_grid(GRID_FILE).suites["strict"]
    assert sorted(suite.ceilings) == sorted(resolve_tasks(",".join(suite.tasks), "strict"))
    for task, value in suite.ceilings.items():
        assert value == pytest.approx(100 * ceiling(get_task(task)), abs=0.051)


# --- commands of a cell ---


def test_tasks_alone_are_demonstrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = grid_of(tmp_path, ("[suite=strict]}", f"[suite=strict], tasks: [object, {FIND}]}}"))
    ran = list[list[str]]()
    monkeypatch.setattr(cells, "run_once", lambda words, *_, **__: ran.append(words))
    Demonstrations(grid, "strict", tmp_path).run()
    assert ran[0][:6] == ["memobench", "generate", "--suite", "strict", "--tasks", f"object,{FIND}"]


def test_controls_are_of_the_last_training_seed(tmp_path: Path) -> None:
    grid = grid_of(tmp_path, ("seeds: 1", "seeds: 2"))
    first, last = (Cell(grid, tmp_path, "strict", "frames, no time", seed) for seed in (0, 1))
    assert (first.parts, last.parts) == ([ROLLOUTS], [ROLLOUTS, "evidence"])


def test_sealed_test_is_run_once_where_wanted(no_memory: Cell, frames: Cell, tmp_path: Path) -> None:
    assert no_memory.parts == [ROLLOUTS]
    assert replace(frames, sealed=True).parts == [ROLLOUTS, "evidence"], "the row has no sealed test"
    with pytest.raises(MemobenchError, match="no sealed test"):
        study(tmp_path / "out", tmp_path / "grid.yaml", only=["frames, no time"], sealed=True)
    sealed = replace(no_memory, sealed=True)
    assert sealed.parts == [ROLLOUTS, SEALED]
    words = sealed.evaluation_words(SEALED)
    assert words[:3] == ["memobench", "test-sealed", f"policy={no_memory.policy}"]
    assert not any(word.startswith("split=") for word in words)


def test_words_are_checked_before_anything_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid_of(tmp_path, ("policy.memory=none", "policy.memry=none"))
    monkeypatch.setattr(commands, "_run", lambda *given: pytest.fail("something was run"))
    with pytest.raises(MemobenchError, match="memory"):
        study(tmp_path / "out", tmp_path / "grid.yaml", plan=True)


# --- running and resuming ---


def keep_checkpoint(folder: Path) -> None:
    for name in ("pretrained_model/train_config.json", "training_state/training_step.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("{}")


def test_killed_cells_resume(frames: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands die at every moment in turn; a command that has ended well is never run again."""
    ran, dies = list[str](), [True] * 3

    def fake(words: list[str], output: IO[str], environment: dict[str, str]) -> tuple[int, Cost]:
        assert environment[PROCESSES] == "2"
        ran.append(words[1] if words[1] == "eval" else "resume" if "resume=true" in words else "train")
        print("…", file=output)
        if dies and dies.pop():
            if words[1] == "train":
                keep_checkpoint(cell.policy / "checkpoints" / "last")
            return 1, Cost(1.0, 1.0)
        return 0, Cost(1.0, 1.0)

    cell = replace(frames, at_once=2)
    monkeypatch.setattr(commands, "_run", fake)
    for _ in range(3):
        assert not cell.finished()
        with pytest.raises(MemobenchError, match="status 1"):
            cell.run()
    assert planned([], [cell], 1).endswith("1 of 1 are left")
    cell.run()
    assert cell.finished()
    assert ran == ["train", "resume", "resume", "resume", "eval", "eval"]
    cell.run()
    assert len(ran) == 6
    assert cell.costs()["training"] == Cost(4.0, 4.0)
    assert planned([], [cell], 1) == "0 of 1 are left"


def test_unfinished_trainings_are_not_removed(no_memory: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither while one runs, nor for another command, nor when one was killed as it moved the link."""
    cell = no_memory
    mark = cell.policy / "mark"
    mark.parent.mkdir(parents=True)
    mark.touch()
    with cell.log("training").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(MemobenchError, match=r"training\.log"):
            cell.run()
    cell.log("training").with_suffix(".json").write_text(json.dumps({**COMMAND, "words": ["other"]}))
    with pytest.raises(MemobenchError, match="another command"):
        cell.run()
    assert mark.exists()
    cell.log("training").with_suffix(".json").write_text(json.dumps({**COMMAND, "words": cell.training_words()}))
    for updates in ("000002", "000004"):
        keep_checkpoint(cell.policy / "checkpoints" / updates)
    (cell.policy / "checkpoints" / "000002" / "training_state" / "optimizer_param_groups.json").touch()
    ran = list[list[str]]()
    monkeypatch.setattr(commands, "_run", lambda words, *rest: (ran.append(words), (1, Cost(1.0, 1.0)))[1])
    with pytest.raises(MemobenchError, match="status 1"):
        cell.run()
    assert ran[0][2].endswith("checkpoints/000002/pretrained_model/train_config.json"), "the last complete checkpoint"
    assert mark.exists()


def test_a_training_without_a_checkpoint_starts_again(no_memory: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(words: list[str], output: IO[str], environment: object) -> tuple[int, Cost]:
        no_memory.policy.mkdir(parents=True)  # LeRobot refuses an existing one
        output.write("out of memory")
        output.flush()
        return 1, Cost(1.0, 1.0)

    monkeypatch.setattr(commands, "_run", failing)
    for _ in range(2):
        with pytest.raises(MemobenchError, match="out of memory"):
            no_memory.run()


def test_killed_attempts_cost_until_their_last_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, words = tmp_path / "a.log", ["memobench", "--version"]
    log.touch()
    earlier = {"words": words, "ended": False, "wall_s": 5.0, "cpu_s": 4.0, "began": log.stat().st_mtime - 60}
    log.with_suffix(".json").write_text(json.dumps(earlier))
    monkeypatch.setattr(commands, "_run", lambda *given: (0, Cost(1.0, 1.0)))
    assert commands.run_once(words, log) == Cost(66.0, 5.0)
    assert has_ended(log)


def test_failed_demonstrations_need_their_dataset(grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Status 1 is a seed that was not solved, or a traceback."""
    data, makes = Demonstrations(grid, "strict", tmp_path), False

    def fake(words: list[str], output: IO[str], environment: object) -> tuple[int, Cost]:
        if makes:
            (data.folder / "meta").mkdir(parents=True)
            (data.folder / "meta" / "info.json").touch()
        return 1, Cost(1.0, 1.0)

    monkeypatch.setattr(commands, "_run", fake)
    with pytest.raises(MemobenchError, match="status 1"):
        data.run()
    assert not data.finished()
    makes = True
    data.run()
    assert data.finished()


# --- tables ---


def rollout_of(episode: int, evidence: bool, solved: int) -> dict[str, Any]:
    """Return one of ten rollouts: the first ``solved`` succeed; of two variants four scenes in five choose rightly."""
    variant, right = episode % 2, episode < 8
    more: dict[str, Any] = {"wall_s": 1.0, "steps": 80, "prompt_steps": 20, "referent": "drawn"}
    if evidence:
        more |= {"seed": 7 + episode // 2, "variant": variant, "choice": variant if right else None}
        more |= {"variants": 2, "chance": 0.5}
    return rollout(BUTTER, "object", "SC", [True, True], episode < solved, episode, **more)


def evaluate(cell: Cell, *parts: str, rollouts: int = 10, solved: int = 4, **more: Any) -> None:
    for part in parts:
        episodes = [rollout_of(episode, part == "evidence", solved) | more for episode in range(rollouts)]
        (cell.evaluation(part) / "evaluation.json").unlink(missing_ok=True)
        folder = write_log(cell.evaluation(part), episodes)
        protocol = {**read_evaluation(folder)["protocol"], "tasks": [BUTTER], "episodes": rollouts}
        start = run_facts([*cell.carded_words(part), "resume=true"], 1)
        write_evaluation(folder, card(protocol, read_evaluation(folder)["policy"], runs=[start]))
    for part in (*parts, TRAINING):
        words = cell.training_words() if part == TRAINING else cell.evaluation_words(part)
        cell.log(part).with_suffix(".json").write_text(json.dumps({**COMMAND, "words": words, "ended": True}))


def test_tables_show_evaluated_cells(tmp_path: Path) -> None:
    grid = grid_of(
        tmp_path,
        ("controls: [evidence]}", "controls: [evidence, replan 5]}"),
        ("controls: {", "controls: {replan 5: [replan=5], "),
        ("[suite=strict]}", f"[suite=strict], tasks: [object], ceilings: {{{BUTTER}: 33.3}}}}"),
    )
    no_memory, frames = (Cell(grid, tmp_path, "strict", row, 0) for row in grid.rows)
    assert tables(grid, tmp_path, "strict") == ""
    evaluate(no_memory, ROLLOUTS)
    evaluate(frames, ROLLOUTS, "evidence")
    evaluate(frames, "replan 5", solved=2)
    evaluate(no_memory, SEALED)
    evaluate(frames, SEALED, solved=8)
    assert figures_of_rows(grid, tmp_path, "strict") == {
        "no memory": {"solved": [40.0], "follows": [], "without": 33.3},
        "frames, no time": {"solved": [40.0], "follows": [80.0], "without": 33.3},
    }
    text = tables(grid, tmp_path, "strict")
    for line in (
        f"| ceiling without a memory | – | 33.3 |{8 * ' – |'}",
        "| no memory | 1 | **40.0** | 10.0–70.0 | 40 | 100.0 | – | 100.0 | – | – | – |",
        f"| `{BUTTER}` | 33.3 | 40.0 | 40.0 |",
        "| frames, no time | 40.0 | 20.0 (-20.0, ",
        "| frames, no time minus no memory | 10 | +0.0 |",
        "| frames, no time minus no memory | 10 | +40.0 |",
        "| frames, no time | 1 | +6.7 | -23.3 to +36.7 |",
    ):
        assert f"\n{line}" in text, line


def test_p_is_adjusted_within_a_family(tmp_path: Path) -> None:
    """Seven of ten rollouts differ: p is 2/2^7. Twice that in a family of two, as it is in one of one."""
    row, reference, other = "frames, no time", "no memory", "bank"
    families = f"{{both: [[{row!r}, {reference}], [{row!r}, {other}]], alone: [[{row!r}, {reference}]]}}"
    grid = grid_of(
        tmp_path,
        ('{registered: [["frames, no time", no memory]]}', families),
        ("rows:\n", "rows:\n  bank: {training: [policy.memory=bank]}\n"),
    )
    for name, solved in ((row, 9), (reference, 2), (other, 2)):
        evaluate(Cell(grid, tmp_path, "strict", name, 0), ROLLOUTS, solved=solved)
    both, alone = tables(grid, tmp_path, "strict").split("### Contrasts, ")[1:]
    assert [line.split(" | ")[4] for line in both.splitlines() if " minus " in line] == ["0.031", "0.031"]
    assert [line.split(" | ")[4] for line in alone.splitlines() if " minus " in line] == ["0.016"]


def test_means_of_training_seeds_are_of_exact_figures(grid: Grid, tmp_path: Path) -> None:
    """1/6 and 1/4 are 20.83 %; 16.7 and 25.0 would be 20.9."""
    for seed, solved in enumerate((2, 3)):
        evaluate(Cell(grid, tmp_path, "strict", "no memory", seed), ROLLOUTS, rollouts=12, solved=solved)
    assert f"| `{BUTTER}` | – | 20.8 |" in tables(grid, tmp_path, "strict").splitlines()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("steps=4", "steps=8"), r"training\.json .*'steps=4'"),
        (("[policy.memory=none]", "[policy.memory=bank]"), r"training\.json .*'policy.memory=none'"),
        (("episodes=2", "episodes=3"), r"rollouts\.json .*'episodes=2'"),
    ],
)
def test_results_of_another_grid_do_not_count(
    no_memory: Cell, tmp_path: Path, change: tuple[str, str], named: str
) -> None:
    evaluate(no_memory, ROLLOUTS)
    assert no_memory.finished()
    changed = grid_of(tmp_path, change)
    with pytest.raises(MemobenchError, match=named):
        replace(no_memory, grid=changed).finished()
    with pytest.raises(MemobenchError, match=named):
        tables(changed, tmp_path, "strict")


@pytest.mark.parametrize("damage", ["training", "command", "log", "card", "row", "cut", "policy", "scene"])
def test_inconsistent_results_are_refused(no_memory: Cell, frames: Cell, tmp_path: Path, damage: str) -> None:
    evaluate(frames, ROLLOUTS, "evidence")
    evaluate(no_memory, ROLLOUTS)
    folder = frames.evaluation(ROLLOUTS)
    assert tables(frames.grid, tmp_path, "strict")
    tables_module._figures.cache_clear()
    match damage:
        case "training":
            frames.log(TRAINING).with_suffix(".json").unlink()
        case "command":
            frames.log(ROLLOUTS).with_suffix(".json").unlink()
        case "log":
            frames.log(ROLLOUTS).with_suffix(".json").write_text('{"ended": true}')
        case "card":
            (folder / "evaluation.json").unlink()
        case "row":
            shutil.copytree(no_memory.evaluation(ROLLOUTS), folder, dirs_exist_ok=True)
        case "cut":
            lines = (folder / "episodes.jsonl").read_text().splitlines(keepends=True)
            (folder / "episodes.jsonl").write_text("".join(lines[:5]))
        case "policy":
            evaluate(frames, ROLLOUTS, policy="new")
            evaluate(frames, "evidence", policy="old")
        case "scene":
            evaluate(frames, ROLLOUTS, variant=1)
            evaluate(no_memory, ROLLOUTS, variant=2)
    tables_module._rollouts.cache_clear()
    with pytest.raises(MemobenchError, match=r"frames_no_time-0|variant is"):
        tables(frames.grid, tmp_path, "strict")


# --- kept cells ---


def test_cells_are_kept_and_restored(no_memory: Cell, frames: Cell, tmp_path: Path) -> None:
    given = ["--out", str(tmp_path), "--grid", str(tmp_path / "grid.yaml")]
    assert main([*given, "--keep", str(tmp_path / "kept")]) == 2, "there is no evaluated cell"
    evaluate(no_memory, ROLLOUTS)
    assert main([*given, "--keep", str(tmp_path / "kept")]) == 0
    evaluate(frames, ROLLOUTS, "evidence")
    assert main([*given, "--only", "frames, no time", "--keep", str(tmp_path / "kept")]) == 0
    given[1] = str(tmp_path / "again")
    assert main([*given, "--kept", str(tmp_path / "kept")]) == 0
    text = (tmp_path / "again" / "study.md").read_text()
    assert text == tables(frames.grid, tmp_path, "strict") + "\n"
    assert (tmp_path / "again" / "study.png").stat().st_size > 5_000


def test_kept_cells_are_tabulated_whole_or_refused(no_memory: Cell, tmp_path: Path) -> None:
    evaluate(no_memory, ROLLOUTS)
    grid, kept = tmp_path / "grid.yaml", tmp_path / "kept"
    study(tmp_path, grid, keep=kept)
    for more in ({"only": ["no memory"]}, {"keep": kept}, {"plan": True}):
        with pytest.raises(MemobenchError, match="leave out"):
            study(tmp_path / "again", grid, kept=kept, **more)
    grid.write_text(SMALL.replace("suites: {strict:", "suites: {other:"))
    with pytest.raises(MemobenchError, match="no evaluated cell"):
        study(tmp_path / "again", grid, kept=kept)
    assert not (tmp_path / "again").exists()


def test_a_dataset_is_kept_as_its_command(no_memory: Cell, tmp_path: Path) -> None:
    evaluate(no_memory, ROLLOUTS)
    evaluation = str(no_memory.evaluation(ROLLOUTS).relative_to(tmp_path))
    (tmp_path / "demonstrations" / "strict" / "meta").mkdir(parents=True)
    (tmp_path / "demonstrations" / "strict.json").write_text('{"words": []}')
    keep(tmp_path, [evaluation, "demonstrations/strict"], tmp_path / "kept")
    assert restore(tmp_path / "kept", tmp_path / "again") == [evaluation, "demonstrations/strict"]
    assert [path.name for path in (tmp_path / "again" / "demonstrations").iterdir()] == ["strict.json"]
    with pytest.raises(MemobenchError, match="holds no evaluations"):
        restore(tmp_path / "again", tmp_path / "third")
