"""Evaluations that are killed and gone on with, in parts, as their user sees them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.episode_log import EpisodeLog, read_episodes

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "check_the_top_drawer_of_the_cabinet"
COMMAND = ["eval", "env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4", "batch_size=2"]
ALL = [(STOVE, k) for k in range(4)] + [(DRAWER, k) for k in range(4)]


def evaluate(*words: str) -> int:
    return main([*COMMAND, *words])


def killed_after(fake_loop: Any, count: int, *words: str) -> None:
    fake_loop.kill_after = count
    with pytest.raises(fake_loop.killed):
        evaluate(*words)
    fake_loop.kill_after = None
    fake_loop.ran.clear()


def comparable(folder: str) -> list[dict[str, Any]]:
    return [{k: v for k, v in record.items() if k != "wall_s"} for record in read_episodes(Path(folder))]


@pytest.mark.parametrize("count", [1, 4, 7])
def test_only_the_missing_episodes_are_run(fake_loop: Any, count: int) -> None:
    assert evaluate("output_dir=whole") == 0
    killed_after(fake_loop, count, "output_dir=out")
    assert evaluate("output_dir=out", "resume=true") == 0
    assert fake_loop.ran == ALL[count:]
    assert {task.name for task, _ in fake_loop.cells[-1]} == {task for task, _ in ALL[count:]}, "others stay closed"
    assert comparable("out") == comparable("whole")
    whole, out = (json.loads(Path(name, "evaluation.json").read_text()) for name in ("whole", "out"))
    assert out["episodes"] == whole["episodes"]
    assert json.loads(Path("out/report.json").read_text()) == json.loads(Path("whole/report.json").read_text())
    whole_info, info = (json.loads(Path(name, "eval_info.json").read_text()) for name in ("whole", "out"))
    assert info == whole_info
    assert info["overall"]["n_episodes"] == len(ALL)


def test_a_complete_evaluation_only_prints_its_report(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate("output_dir=out") == 0
    calls, card = len(fake_loop.plans), Path("out/evaluation.json").read_text()
    capsys.readouterr()
    assert evaluate("output_dir=out", "resume=true") == 0
    assert len(fake_loop.plans) == calls
    assert STOVE in capsys.readouterr().out
    assert json.loads(Path("out/evaluation.json").read_text())["episodes"] == json.loads(card)["episodes"]


def test_a_folder_without_an_evaluation_is_begun(fake_loop: Any) -> None:
    assert evaluate("output_dir=out", "resume=true") == 0
    assert fake_loop.ran == ALL


def test_without_resume_an_earlier_evaluation_is_left_alone(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    killed_after(fake_loop, 3, "output_dir=out")
    assert "resume=true output_dir=out" in capsys.readouterr().err
    assert evaluate("output_dir=out") == 2
    assert "resume=true" in capsys.readouterr().err


def test_more_episodes_and_tasks_may_follow(fake_loop: Any) -> None:
    assert evaluate("output_dir=out") == 0
    fake_loop.ran.clear()
    wider = "check_the_middle_drawer_of_the_cabinet"
    assert evaluate("output_dir=out", "resume=true", "episodes=6", f"tasks={DRAWER},{wider}") == 0
    assert fake_loop.ran == [(DRAWER, 4), (DRAWER, 5), *((wider, k) for k in range(6))]
    card = json.loads(Path("out/evaluation.json").read_text())
    assert card["protocol"]["tasks"] == sorted([STOVE, DRAWER, wider])
    assert card["protocol"]["episodes"] == 6
    assert card["settings"]["episodes"] == 6
    assert card["settings"]["env"]["tasks"] == ",".join(card["protocol"]["tasks"])
    fake_loop.ran.clear()
    assert evaluate("output_dir=out", "resume=true", "episodes=2") == 0  # less than is there: nothing to do, all stays
    assert fake_loop.ran == []
    assert len(json.loads(Path("out/evaluation.json").read_text())["episodes"]) == 16
    assert len(Path("out/episodes.jsonl").read_text().splitlines()) == 16


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["horizon=600"], "horizon: 1200 and 600"),
        (["referent=random"], "referent: fixed and random"),
        (["env.render=fast"], "render: default and fast"),
        (["demonstration_prompt=false"], "demonstration_prompt: True and False"),
        (["env.oracle_memory=true"], "oracle_memory: False and True"),
        (["env.seed_base=100"], "seed_base: 7 and 100"),
        (["env.replan_steps=5"], "replan_steps: None and 5"),
        (["seed=8"], "policy.seed: 7 and 8"),
        (["policy=memobench_random"], "policy.type: memobench_expert and memobench_random"),
    ],
)
def test_another_protocol_is_refused(
    fake_loop: Any, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    killed_after(fake_loop, 3, "output_dir=out")
    before = {path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()}
    capsys.readouterr()
    assert evaluate("output_dir=out", "resume=true", *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert fake_loop.ran == []
    assert before == {path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()}


def test_other_weights_are_refused(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    policy = random_checkpoint(Path("checkpoint"))
    killed_after(fake_loop, 3, "output_dir=out", f"policy={policy}")
    save_file({"weight": torch.ones(1)}, policy / "model.safetensors")
    capsys.readouterr()
    assert evaluate("output_dir=out", "resume=true", f"policy={policy}") == 2
    assert "policy.sha256: " in capsys.readouterr().err
    save_file({"weight": torch.zeros(1)}, policy / "model.safetensors")
    (policy / "train_config.json").write_text("{}")  # says nothing about what the policy does
    assert evaluate("output_dir=out", "resume=true", f"policy={policy}") == 0


def random_checkpoint(folder: Path) -> Path:
    """A checkpoint folder of a policy that needs no statistics."""
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"type": "memobench_random", "device": "cpu"}))
    save_file({"weight": torch.zeros(1)}, folder / "model.safetensors")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).write_text(json.dumps({"name": name, "steps": []}))
    return folder


def test_the_batch_size_is_kept(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    killed_after(fake_loop, 3, "output_dir=out")
    words = [word for word in COMMAND if not word.startswith("batch_size")]
    assert main([*words, "output_dir=out", "resume=true"]) == 0
    assert fake_loop.plans[-1].batch == 2
    killed_after(fake_loop, 3, "output_dir=other")
    capsys.readouterr()
    assert main([*words, "output_dir=other", "resume=true", "batch_size=1"]) == 0
    assert "batch_size: 2 and 1" in capsys.readouterr().err


def test_a_log_of_plain_lerobot_eval_is_gone_on_with(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    killed_after(fake_loop, 3, "output_dir=out")
    Path("out/evaluation.json").unlink()
    capsys.readouterr()
    assert evaluate("output_dir=out", "resume=true") == 0
    assert "cannot be checked" in capsys.readouterr().err
    assert fake_loop.ran == ALL[3:]


def test_drafts_of_a_killed_run_are_removed(fake_loop: Any) -> None:
    killed_after(fake_loop, 3, "output_dir=out")
    drafts = [Path("out/.77-ab.part.evaluation.json"), Path("out/videos/.77-ab.part.film.mp4")]
    drafts[-1].parent.mkdir(parents=True, exist_ok=True)
    for draft in drafts:
        draft.write_text("half")
    assert evaluate("output_dir=out", "resume=true") == 0
    assert not [draft for draft in drafts if draft.exists()]


def test_two_runs_in_one_folder(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    inner: list[int] = []
    fake_loop.before = lambda plan: inner.append(evaluate("output_dir=out", "resume=true"))
    assert evaluate("output_dir=out") == 0
    assert inner == [2]
    assert "another run is writing to out" in capsys.readouterr().err
    assert fake_loop.ran == ALL


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resume=true"], "output_dir=<folder>"),
        (["--config_path=x.yaml"], "x.yaml: there is no such file"),
        (["shard=3/2", "output_dir=out"], "i from 1 to n"),
        (["eval.recording=true", "output_dir=out"], "eval.recording"),
        (["shards=9", "output_dir=out"], "more than the 4 batches"),
        (["shards=2", "slurm=gpu", "output_dir=out"], "--partition=gpu"),
    ],
)
def test_what_cannot_be_asked_for(
    fake_loop: Any, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert evaluate(*words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not fake_loop.plans
    assert not Path("out").exists()


def test_other_environments_are_not_ours_to_resume(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "env=pusht", "policy=act", "resume=true"]) == 2
    assert "env=memobench" in capsys.readouterr().err


# --- parts ---


def test_parts_make_up_the_whole(fake_loop: Any) -> None:
    assert evaluate("output_dir=whole") == 0
    for number in (1, 2, 3):
        fake_loop.ran.clear()
        assert evaluate("output_dir=out", f"shard={number}/3") == 0
        assert fake_loop.ran == [ALL[:2], ALL[2:4], ALL[4:]][number - 1]
    assert [path.name for path in sorted(Path("out").iterdir())] == [f"shard-{k}-of-3" for k in (1, 2, 3)]
    assert json.loads(Path("out/shard-2-of-3/evaluation.json").read_text())["shard"] == "2/3"


def test_a_part_is_gone_on_with_as_well(fake_loop: Any) -> None:
    killed_after(fake_loop, 1, "output_dir=out", "shard=2/2")
    assert evaluate("output_dir=out", "shard=2/2", "resume=true") == 0
    assert fake_loop.ran == ALL[5:]
    fake_loop.ran.clear()
    assert evaluate("output_dir=out", "shard=2/2", "resume=true") == 0
    assert fake_loop.ran == []


def test_more_parts_than_batches(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate("output_dir=out", "shard=1/5") == 0
    assert "holds no episode" in capsys.readouterr().out
    assert not Path("out").exists()


def test_parts_do_not_depend_on_the_cores_of_a_machine(fake_loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    words = [word for word in COMMAND if not word.startswith("batch_size")]
    for cores in (2, 64):
        monkeypatch.setattr("lerobot_memobench.run.plan.cores", lambda cores=cores: cores)
        assert main([*words, f"output_dir=out{cores}", "shard=2/3"]) == 0
    assert comparable("out2/shard-2-of-3") == comparable("out64/shard-2-of-3")


def test_a_foreign_log_in_the_folder_of_a_part(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    record = {"task": STOVE, "memory_type": "temporal", "episode": 0, "success": True, "checkpoints": []}
    EpisodeLog("out/shard-1-of-2").append(record)
    assert evaluate("output_dir=out", "shard=1/2") == 2
    assert "already holds an evaluation" in capsys.readouterr().err
