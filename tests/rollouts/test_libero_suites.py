"""Evaluations of LIBERO's suites: commands, plans, results, and refusals of what its tasks do not have."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import draccus
import pytest

from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.rollouts.plan import EvaluationPlan, plan_line
from lerobot_memobench.tasks.catalogue import task_names
from tests.support.fake_loop import FakeLoop, make_checkpoint

SOUP, CHEESE = task_names(suite="libero_object")[:2]
RANDOM = ["env=memobench", "policy=memobench_random"]
LINE = [*RANDOM, "suite=libero_object", "tasks=0,1", "episodes=4", "batch_size=2"]
COMMAND = ["eval", *LINE]


def plan(*words: str) -> EvaluationPlan:
    return plan_line([*RANDOM, "output_dir=out", *words])


def error(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert lerobot(["eval", "env=memobench", *words]) == 2
    return capsys.readouterr().err.strip()


# --- plans ---


@pytest.mark.parametrize(
    "words",
    [
        ["suite=libero_object", "tasks=0-1"],
        ["suite=libero_object", f"tasks={SOUP},{CHEESE}"],
        ["task=libero_object", "task_ids=[0,1]"],
    ],
)
def test_task_numbers_are_liberos_ids(fake_loop: FakeLoop, words: list[str]) -> None:
    found = plan(*words)
    assert [task.name for task in found.grid.tasks] == [SOUP, CHEESE]
    assert found.settings.env["suite"] == "libero_object"
    assert not {"task", "task_ids"} & {*found.settings.portable["env"]}, "a card holds one name of each setting"


@pytest.mark.parametrize(
    ("suite", "horizon"),  # LeRobot's TASK_SUITE_MAX_STEPS
    [("libero_spatial", 280), ("libero_object", 280), ("libero_goal", 300), ("libero_10", 520), ("libero_90", 400)],
)
def test_settings_follow_the_suite(fake_loop: FakeLoop, suite: str, horizon: int) -> None:
    found = plan(f"suite={suite}", "tasks=0")
    settings = found.environment.settings
    assert (settings.horizon, settings.convention, found.grid.runs, found.seeds) == (
        horizon,
        "libero",
        50,
        range(7, 57),
    )
    asked = plan(f"suite={suite}", "tasks=0", "horizon=1200", "convention=upright").environment.settings
    assert (asked.horizon, asked.convention) == (1200, "upright")


# --- refusals ---


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["task=libero_objct"], "did you mean 'libero_object'"),
        (["suite=libero_objct"], "did you mean 'libero_object'"),
        (["task=libero_object", "task_ids=[10]", "policy=memobench_random"], "numbered 0 to 9"),
        (["task=libero_object,libero_90", "task_ids=[10]"], "tasks of the libero_object suite are numbered 0 to 9"),
        (["suite=libero_90", "tasks=90"], "`memobench tasks --suite libero_90` lists them"),
        (["task=libero_object", "task_ids=[0,"], "expected ids of LIBERO's tasks in a list"),
        (["task=libero_object,strict"], "run them by two commands, the second with suite=strict"),
        (["task=published,strict", "policy=memobench_random"], "'published' is a suite, no task; set suite=published"),
        (["suite=libero_long"], "LIBERO-Long is 'libero_10'"),
        (["suite=libero_object", "policy=memobench_strict"], "suite=libero_object has images alone"),
        (["task=libero_object", "task_ids=0"], "expected ids of LIBERO's tasks in a list"),
        (["task=libero_object", "suite=libero_goal"], "both given"),
        (["task=libero_object", "task_ids=[0]", "tasks=1"], "both given"),
        (["task_ids=[0]"], "ids of LIBERO's suites"),
        (["suite=libero_object", "tasks=libero_goal"], "is a suite, no task; set suite=libero_goal"),
        (["suite=libero_object", "tasks=pick_up_the_mil_and_place_it_in_the_basket"], "'pick_up_the_milk_and"),
        (["suite=libero_object", "tasks=turn_on_the_stove"], "is a task of the libero_goal suite"),
        (["suite=libero_object"], "no scripted expert"),
        (["suite=libero_object", "policy=memobench_random", "episodes=51"], "50 initial states"),
        (["suite=libero_object", "policy=memobench_random", "seed=50", "env.seed_base=7"], "50 initial states"),
        (["suite=libero_object", "policy=memobench_random", "split=validation"], "split=validation is of memory tasks"),
        (["suite=libero_object", "policy=memobench_random", "rules=upstream"], "requires rules=paper"),
        (["suite=libero_object", "policy=memobench_random", "evidence=true"], "requires evidence=false"),
    ],
)
def test_refusals_are_one_sentence(
    fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str], words: list[str], expected: str
) -> None:
    found = error(capsys, *words)
    assert expected in found
    assert found.count("\n") == 0
    assert "' or 'pick_up_the_butter" not in found, "a near name hides others"
    assert not fake_loop.ran


def test_checkpoints_run_on_the_images_of_their_training(
    fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]
) -> None:
    image = {"type": "VISUAL", "shape": [3, 256, 256]}
    state, action = {"type": "STATE", "shape": [8]}, {"type": "ACTION", "shape": [7]}
    for name, wrist in (("upright", "wrist_image"), ("mirrored", "image2")):
        images = {f"observation.images.{camera}": image for camera in ("image", wrist)}
        features = {"input_features": {**images, "observation.state": state}, "output_features": {"action": action}}
        make_checkpoint(Path(name), "act", **features)
    for name, convention in (("mirrored", "libero"), ("upright", "upright")):
        assert plan_line([*LINE[:1], *LINE[2:], f"policy=./{name}"]).environment.convention == convention
    found = error(capsys, "suite=libero_object", "convention=libero", "policy=./upright")
    assert "expects images of convention=upright" in found
    assert "and found libero" in found


def test_board_and_demonstrations_refuse_liberos_tasks(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    assert memobench(["generate", "--suite", "libero_object", "--out", "data"]) == 2
    assert "no scripted expert" in capsys.readouterr().err
    assert lerobot([*COMMAND, "output_dir=out"]) == 0
    assert memobench(["submit", "out", "--check"]) == 2
    assert "the board is of memory tasks" in capsys.readouterr().err


# --- results ---


def test_reports_hold_success_alone(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    assert lerobot([*COMMAND, "output_dir=out"]) == 0
    shown = capsys.readouterr().out
    report = json.loads(Path("out/report.json").read_text())
    assert report["tasks"] == {SOUP: {"n": 4, "SR": 50.0}, CHEESE: {"n": 4, "SR": 50.0}}
    assert report["memory_types"] == {"libero_object": {"n": 8, "SR": 50.0}}
    assert report["failures"] == {"execution_failure": 4}
    assert "memobench_random: libero_object suite, convention libero, seeds 7 to 10, 4 episodes of each of 2" in shown
    written = Path("out/report.md").read_text()
    assert memobench(["report", "out", "--format", "csv", "--format", "latex", "--format", "json"]) == 0
    printed = capsys.readouterr().out
    for text in (shown, written, printed):
        assert "libero_object" in text
        assert not {word for word in ("MSR", "MUR", "MCR", "Storage", "memory type", "average of") if word in text}
    assert "50.0 [21.5, 78.5]" in written, "Wilson's interval of 4 of 8"
    assert memobench(["report", "out", "--html", "page", "--figures", "figures"]) == 0
    assert Path("figures/outcomes.png").is_file()
    page = Path("page/index.html").read_text()
    assert '"metrics":["SR"]' in page.replace(" ", "")


def test_tables_hold_ids_in_liberos_order(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    chosen = [task_names(suite="libero_object")[number] for number in (2, 7)]
    assert sorted(chosen) == chosen[::-1], "the order of ids is not that of names"
    line = ["eval", *RANDOM, "task=libero_object", "task_ids=[2,7]", "episodes=2"]
    assert lerobot([*line, "output_dir=a"]) == 0
    assert [words.split()[:2] for words in capsys.readouterr().out.splitlines() if "_and_place_it_" in words][-2:] == [
        ["2", chosen[0]],
        ["7", chosen[1]],
    ]
    assert f"| 2 | `{chosen[0]}` | 2 | 50.0 " in Path("a/report.md").read_text()
    assert lerobot([*line, "output_dir=b"]) == 0
    assert memobench(["report", "a", "b", "--format", "markdown", "--format", "csv", "--out", "both"]) == 0
    assert memobench(["compare", "a", "b", "--format", "markdown", "--format", "csv", "--out", "both"]) == 0
    assert f"| 7 | `{chosen[1]}` | 50.0 | 50.0 |" in Path("both/report.md").read_text()
    assert f"| 7 | `{chosen[1]}` | SR | 2 | 50.0 | 50.0 |" in Path("both/compare.md").read_text()
    assert f"\n7,{chosen[1]},50.0," in Path("both/tables/joined.csv").read_text()
    rows = [*csv.DictReader(Path("both/compare.csv").read_text().splitlines())]
    assert [(row["scope"], row["id"]) for row in rows] == [("libero_object", ""), (chosen[0], "2"), (chosen[1], "7")]


def test_suites_are_averaged(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["eval", *RANDOM, "episodes=2", "task_ids=[0]"]
    assert lerobot([*line, "task=libero_10,libero_spatial", "output_dir=a"]) == 0
    fake_loop.changed = {"success": True, "failure": None}
    assert lerobot([*line, "task=libero_10", "output_dir=long"]) == 0
    fake_loop.changed = {}
    assert lerobot([*line, "task=libero_spatial", "output_dir=spatial"]) == 0
    for words in (["a"], ["pi=a/libero_10", "pi=a/libero_spatial"], ["a/libero_spatial", "a/libero_10"]):
        assert memobench(["report", *words, "--format", "csv", "--out", "out", "--html", "page"]) == 0
        rows = [*csv.DictReader(Path("out/tables/memory-types.csv").read_text().splitlines())]
        assert [(row["suite"], row["n"], row["SR"]) for row in rows] == [
            ("libero_spatial", "2", "50.0"),
            ("libero_10", "2", "50.0"),
            ("average of suites", "4", "50.0"),
        ]
        assert '"average":{"SR":[50.0,' in Path("page/index.html").read_text()
    assert memobench(["report", "A=a", "B=long", "B=spatial", "--format", "markdown"]) == 0
    shown = capsys.readouterr().out
    assert "| evaluation | inputs | k | libero\\_spatial SR | libero\\_10 SR | average SR |".replace("\\", "") in shown
    assert "| B | nothing | – | **50.0** | **100.0** | **75.0** |" in shown
    assert memobench(["compare", "A=a", "B=long"]) == 2
    assert memobench(["compare", "A=a", "B=a/libero_10"]) == 2
    for words in (["a", "long"], ["A=a/libero_10", "A=long", "A=spatial"]):
        assert memobench(["report", *words]) == 2
        assert "are of the suite libero_10" in capsys.readouterr().err
    assert lerobot(["eval", "env=memobench", "tasks=1", "episodes=1", "output_dir=memory"]) == 0
    assert memobench(["report", "spatial", "memory"]) == 2
    assert "report each suite by itself" in capsys.readouterr().err


def test_suites_are_evaluated_one_after_another(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["eval", *RANDOM, "task=libero_goal,libero_10", "task_ids=[2]", "episodes=2", "output_dir=out"]
    assert lerobot(line) == 0
    assert [made.environment.settings.horizon for made in fake_loop.plans] == [300, 520]
    shown = capsys.readouterr().out
    assert [line.split()[:5] for line in shown.splitlines() if "average of suites" in line] == [
        ["average", "of", "suites", "4", "50.0"]
    ]
    assert {*Path("out").iterdir()} == {Path("out/libero_goal"), Path("out/libero_10")}
    assert lerobot([*line, "resume=true"]) == 0
    assert len(fake_loop.ran) == 4


# --- LeRobot's configuration ---


def test_lerobot_eval_gets_environments_by_suite_and_id(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["lerobot-eval", "--env.type=memobench", "--policy.type=memobench_random", "--policy.device=cpu"]
    monkeypatch.setattr("sys.argv", [*line, "--seed=100", "--eval.n_episodes=5"])
    config = MemobenchEnvConfig(task="libero_goal,libero_10", task_ids=[0, 3], log_dir=str(tmp_path))
    found = config.create_envs(2)
    assert {suite: [*envs] for suite, envs in found.items()} == {"libero_goal": [0, 3], "libero_10": [0, 3]}
    settings = {suite: envs[0].envs[0].unwrapped.settings for suite, envs in found.items()}
    assert [(each.horizon, each.convention, each.seed_base) for each in settings.values()] == [
        (300, "libero", 100),
        (520, "libero", 100),
    ]
    monkeypatch.setattr("sys.argv", [*line, "--eval.n_episodes=51"])
    with pytest.raises(SystemExit):
        MemobenchEnvConfig(task="libero_goal", log_dir=str(tmp_path)).create_envs(1)
    assert "50 initial states" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--env.task=libero_object", "--env.task_ids=[99]"], "found 99 among the tasks; tasks of the libero_object"),
        (["--env.task=libero_object,strict"], "the second with suite=strict"),
        (["--env.task=libero_object", "--env.seed_base=3"], "found the initial states 997 to 1046"),
    ],
)
def test_lerobot_eval_refuses_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["lerobot-eval", *words])
    with pytest.raises(SystemExit) as stop:
        draccus.parse(MemobenchEnvConfig, args=[word.replace("env.", "") for word in words]).create_envs(1)
    assert stop.value.code == 2
    found = capsys.readouterr().err
    assert found.startswith("lerobot-eval: ")
    assert expected in found
    assert found.count("\n") == 1
