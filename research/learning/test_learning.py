"""From commands to tables: what is run once, gone on with and counted (`python -m research.learning`)."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageColor

from lerobot_memobench.envs.episode_log import MERGED_FILE, write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import read_rollouts
from lerobot_memobench.tasks.catalogue import DEMO_TASK, get_task, task_names
from research.alignment.study import ALIGNMENTS
from research.learning import stages as stages_module
from research.learning import study as study_module
from research.learning.__main__ import main
from research.learning.experiments import MEMORY, MEMORYLESS, Experiment, changed, experiment
from research.learning.results import COLOURS, outcomes_of
from research.learning.stages import Cost, Stages, run_once
from research.learning.study import learn
from tests.support.scripts import load_script

STRICT_TASK = "open_and_close_the_microwave_a_given_number_of_times"


def test_a_command_that_ended_well_is_not_run_again(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "objects.log"
    first = run_once(["memobench", "objects", "--json"], log)
    assert json.loads(log.read_text())["slots"] == 16
    assert first.cpu_s > 0
    assert run_once(["memobench", "objects", "--json"], log) == first
    assert run_once(["memobench", "objects", "--json"], log, how=["--workers", "2"]) == first, "by whomever it was done"
    with pytest.raises(MemobenchError, match="is of another command"):
        run_once(["memobench", "objects"], log)


def test_a_command_that_fails_is_told_and_gone_on_with(tmp_path: Path) -> None:
    log = tmp_path / "wrong.log"
    words = ["memobench", "describe", str(tmp_path / "nothing")]
    with pytest.raises(
        MemobenchError, match=r"ended with status 2 \(memobench: .* is no dataset .*\); see .*wrong\.log"
    ):
        run_once(words, log)
    assert "is no dataset" in log.read_text()
    spent = run_once(words, log, going_on=["memobench", "objects", "--json"])
    kept = json.loads(log.with_suffix(".json").read_text())
    assert kept["words"] == words
    assert kept["ended"]
    assert spent.wall_s == kept["wall_s"] > 0


def write_rollouts(folder: Path, solved: int, wrong: int, episodes: int = 10, task: str = DEMO_TASK) -> None:
    from tests.support.logs import rollout

    kinds = ("reference_drift", "wrong_place", "miscount")
    failures = [kinds[k % len(kinds)] for k in range(wrong)] + ["storage_failure"] * (episodes - solved - wrong)
    records = [
        rollout(
            task,
            get_task(task).memory_type,
            "S",
            [k < solved],
            k < solved,
            k,
            failure=None if k < solved else failures[k - solved],
        )
        for k in range(episodes)
    ]
    write_episodes(folder, records)


def test_outcomes_tell_wrong_referents_places_and_counts_apart(tmp_path: Path) -> None:
    for seed, (solved, wrong) in enumerate([(9, 1), (5, 3)]):
        write_rollouts(tmp_path / str(seed), solved, wrong)
    found = outcomes_of([read_rollouts(tmp_path / "0")[0], read_rollouts(tmp_path / "1")[0]])
    assert set(found) == {"all", "object", DEMO_TASK}
    for outcome in found.values():
        assert outcome.success.value == pytest.approx(0.7)
        assert outcome.of_seeds == pytest.approx((0.9, 0.5))
        assert (outcome.wrong, outcome.others) == (4, 2)
    assert found[DEMO_TASK].success.n == 20


def test_the_figure_of_two_evaluations_tells_differences_on_what_both_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rollouts(tmp_path / "with", solved=15, wrong=5, episodes=20)
    write_rollouts(tmp_path / "without", solved=4, wrong=6, episodes=10)
    write_rollouts(tmp_path / "other", solved=20, wrong=0, episodes=20, task="turn_on_the_stove_and_turn_it_off")
    with (tmp_path / "with" / MERGED_FILE).open("a") as file:
        file.write((tmp_path / "other" / MERGED_FILE).read_text())
    arms = [f"{name}={tmp_path / name}" for name in ("with", "without")]
    monkeypatch.setattr(sys, "argv", ["learned_figure.py", *arms, "--out", str(tmp_path / "figure.png")])
    load_script("learned_figure").main()
    told = capsys.readouterr().out
    assert "| all, with | 20 | 75.0 |" in told, "of what both have done"
    assert "| object, with | 20 | 75.0 |" in told
    assert "temporal" not in told
    monkeypatch.setattr(sys, "argv", ["learned_figure.py", arms[1], f"other={tmp_path / 'other'}", "--out", "none.png"])
    with pytest.raises(SystemExit, match="no task in common"):
        load_script("learned_figure").main()
    assert "prompted tasks, 10 shared episodes" in told
    assert "| without minus with | 10 | -60.0 |" in told
    assert (tmp_path / "figure.png").is_file()


def test_an_experiment_runs_its_parts_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[list[str]] = []

    def fake(words: list[str], log: Path, **options: Any) -> Cost:
        ran.append(words)
        if words[1] == "eval":
            out = next(word.partition("=")[2] for word in words if word.startswith("output_dir="))
            write_rollouts(Path(out), *((9, 1) if "no_memory" not in out else (3, 6)))
        return Cost(60.0, 90.0)

    monkeypatch.setattr(stages_module, "run_once", fake)
    said: list[str] = []
    few = changed(experiment("bowl"), seeds=2, steps=5, rollouts=10, first_seed=None)
    text = learn(few, tmp_path / "out", said.append)
    assert [words[1] for words in ran] == ["generate", *["train"] * 4, *["eval"] * 4]
    assert "--perturb" in ran[0]
    memoryless = [word for word in ran[2] if word not in ran[1]]
    assert "policy.memory_fusion=none" in memoryless
    assert all("seed=7" in words and "referent=random" in words for words in ran[5:])
    assert f"| {DEMO_TASK}, {MEMORY} | 20 | 90.0 |" in text
    assert f"| {DEMO_TASK}, {MEMORYLESS} | 20 | 30.0 |" in text
    assert f"| {MEMORYLESS} minus {MEMORY} | 10 | -60.0 | " in text
    assert "| training | 4 | 1.0 | 6.0 |" in text
    assert f"{MEMORY}: policy inputs: not recorded" in text
    assert (tmp_path / "out" / "learning.md").read_text() == text
    assert json.loads((tmp_path / "out" / "learning.json").read_text())[MEMORYLESS][DEMO_TASK]["wrong"] == 12
    with Image.open(tmp_path / "out" / "learning.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    memory, memoryless = ((pixels == ImageColor.getrgb(colour)).all(axis=1).sum() for colour in COLOURS[:2])
    assert memory / memoryless == pytest.approx(3, rel=0.15), "bars are as long as their rates"


@pytest.mark.parametrize("word", ["policy.nothing=1", "policy.chunk_size=broad"])
def test_what_training_would_refuse_is_told_before_anything_is_made(tmp_path: Path, word: str) -> None:
    with pytest.raises(MemobenchError, match=word.partition("=")[0]):
        learn(changed(experiment("bowl"), settings=(word,)), tmp_path / "out", print)
    assert not list(tmp_path.iterdir())


def test_a_killed_training_goes_on_from_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = list[list[str]]()
    monkeypatch.setattr(stages_module, "_run", lambda words, *rest: (ran.append(words), (0, Cost(1, 1)))[1])
    stages = Stages(replace(experiment("bowl"), seeds=1), tmp_path)
    half_made = stages.policy(MEMORY, 0) / "half_made"
    half_made.mkdir(parents=True)
    stages.train(MEMORY, 0)
    assert ran == [stages.training_words(MEMORY, 0)]
    assert not half_made.exists()
    kept = stages.log("training", MEMORY, 0).with_suffix(".json")
    last = stages.policy(MEMORY, 0) / "checkpoints" / "last"
    for name in ("pretrained_model/train_config.json", "training_state/training_step.json"):
        (last / name).parent.mkdir(parents=True)
        (last / name).touch()
    told = kept.read_text()
    kept.unlink()
    with pytest.raises(MemobenchError, match="which says by which command, is gone"):
        stages.train(MEMORY, 0)
    kept.write_text(told.replace('"ended": true', '"ended": false'))
    stages.train(MEMORY, 0)
    config = last / "pretrained_model" / "train_config.json"
    assert ran[1] == ["lerobot", "train", f"config_path={config}", "resume=true"]


def test_what_is_told_in_training_is_told_in_rollouts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: dict[str, list[str]] = {}
    monkeypatch.setattr(stages_module, "run_once", lambda words, log, **options: ran.update({log.stem: words}))
    stages = Stages(replace(experiment("bowl"), arms=ALIGNMENTS), tmp_path)
    for arm in stages.experiment.arms:
        stages.evaluate(arm, 0)
    told = [name for name, words in ran.items() if "env.oracle_memory=true" in words]
    assert told == ["oracle_text-0"]
    assert len(ran) == 6


@pytest.mark.parametrize(
    ("perception", "trained", "rolled_out"),
    [
        ("objects", {"perception=objects", "steps=1600"}, set()),
        ("detections", {"perception=objects", "policy.detection_noise=1", "steps=1600"}, {"detector=package"}),
        ("pixels", {"perception=pixels", "steps=2000"}, set()),
    ],
)
def test_policies_learn_and_act_by_the_perception_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, perception: str, trained: set[str], rolled_out: set[str]
) -> None:
    ran: list[list[str]] = []
    monkeypatch.setattr(stages_module, "run_once", lambda words, log, **options: ran.append(words))
    stages = Stages(changed(experiment("bowl", perception), settings=("batch_size=32",)), tmp_path)
    stages.generate()
    stages.train(MEMORY, 0)
    stages.evaluate(MEMORY, 0)
    assert ("--no-images" in ran[0]) == (perception in ("objects", "detections")), (
        "pictures are made for who learns from them"
    )
    assert trained | {"batch_size=32"} <= set(ran[1])
    assert ("policy.detection_noise=1" in ran[1]) == (perception == "detections")
    assert {word for word in ran[2] if word.startswith("detector=")} == rolled_out


@pytest.mark.parametrize("name", ["prompted", "joint"])
def test_prompts_are_learned_from_more_demonstrations_by_an_aligned_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    ran: list[list[str]] = []
    monkeypatch.setattr(stages_module, "run_once", lambda words, log, **options: ran.append(words))
    stages = Stages(experiment(name), tmp_path)
    stages.generate()
    for arm in (MEMORY, MEMORYLESS):
        stages.train(arm, 0)
    more = dict(zip(ran[0], ran[0][1:], strict=False))
    assert more.get("--prompted-episodes", more["--episodes"]) == "240"
    assert ["align=semantic" in words for words in ran[1:]] == [True, False]


@pytest.mark.parametrize(("task", "referent", "strict"), [(DEMO_TASK, "random", False), (STRICT_TASK, "drawn", True)])
def test_rollouts_are_of_the_demonstrations_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: str, referent: str, strict: bool
) -> None:
    ran: list[str] = []
    monkeypatch.setattr(stages_module, "run_once", lambda words, log, **options: ran.extend(words))
    stages = Stages(replace(experiment("bowl"), tasks=(task,), referent=referent), tmp_path)
    stages.generate()
    assert ("--suite strict" in " ".join(ran)) == strict
    stages.evaluate(MEMORY, 0)
    assert f"referent={referent}" in ran
    assert ("suite=strict" in ran) == strict


@pytest.mark.parametrize(
    ("told", "made"), [([], (80, 240)), (["--episodes", "3"], (3, 3)), (["--prompted-episodes", "5"], (80, 5))]
)
def test_the_command_takes_how_many_demonstrations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: list[str], made: tuple[int, int]
) -> None:
    asked: list[Experiment] = []
    monkeypatch.setattr(study_module, "learn", lambda which, *_, **__: asked.append(which) or "")
    assert main(["joint", "--out", str(tmp_path / "out"), *told]) == 0
    assert (asked[0].episodes, asked[0].prompted_episodes) == made


def test_the_command_takes_some_of_the_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Experiment] = []
    monkeypatch.setattr(study_module, "learn", lambda which, *_, **__: asked.append(which) or "")
    for told in (["--tasks", "object"], ["--tasks", f"{DEMO_TASK},temporal"], []):
        assert main(["prompted", "--out", str(tmp_path / "out"), *told]) == 0
    object_tasks, named, all_of_them = (which.tasks for which in asked)
    assert object_tasks == tuple(task_names("object")) == all_of_them[:5]
    assert named == (DEMO_TASK, *task_names("temporal"))
    assert main(["prompted", "--out", str(tmp_path / "out"), "--tasks", "objekt"]) == 2


@pytest.mark.parametrize("name", ["bowl", "prompted", "joint"])
def test_the_command_takes_the_strict_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    asked: list[Experiment] = []
    monkeypatch.setattr(study_module, "learn", lambda which, *_, **__: asked.append(which) or "")
    for told in ([], ["--suite", "strict"], ["--suite", "strict", "--tasks", STRICT_TASK]):
        assert main([name, "--out", str(tmp_path / "out"), *told]) == 0
    published, strict_tasks, one = (which.tasks for which in asked)
    assert sorted(get_task(strict_task).derived_from for strict_task in strict_tasks) == sorted(published)
    assert one == (STRICT_TASK,)
    assert main([name, "--out", str(tmp_path / "out"), "--tasks", STRICT_TASK]) == 2


def test_how_many_processes_work_decides_nothing_that_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[list[str], list[str]]] = []
    monkeypatch.setattr(stages_module, "run_once", lambda words, log, how=(), **_: told.append((words, [*how])))
    for workers in (1, 2):
        stages = Stages(experiment("bowl"), tmp_path, workers=workers)
        stages.generate()
        stages.train(MEMORY, 0)
        stages.evaluate(MEMORY, 0)
    kept = [words for words, _ in told]
    assert kept[:3] == kept[3:]
    assert told[0][1] == ["--workers", "1"]
    assert [how for _, how in told[3:]] == [["--workers", "2"], [], ["shards=2", "workers=2"]]
