"""``memobench merge`` and ``memobench rerun``, and evaluations shared among executors, without a simulator."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from lerobot_memobench.cli.evaluate import SHARD_PROGRAM
from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.slurm import run_part
from lerobot_memobench.run import shards
from tests.support.sbatch import Sbatch

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "check_the_top_drawer_of_the_cabinet"
COMMAND = ["eval", "env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4", "batch_size=2"]


def comparable(folder: str) -> list[dict[str, Any]]:
    return [{k: v for k, v in record.items() if k != "wall_s"} for record in read_episodes(Path(folder))]


# --- merge ---


def test_merged_parts_are_the_whole(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert lerobot([*COMMAND, "output_dir=whole"]) == 0
    assert lerobot([*COMMAND, "output_dir=out", "shard=1/2"]) == 0
    capsys.readouterr()
    assert memobench(["merge", "out"]) == 1
    assert f"4 episodes that were asked for are missing, the first is {DRAWER}, episode 0" in capsys.readouterr().out
    assert lerobot([*COMMAND, "output_dir=out", "shard=2/2"]) == 0
    assert memobench(["merge", "out"]) == 0
    assert comparable("out") == comparable("whole")
    assert json.loads(Path("out/report.json").read_text()) == json.loads(Path("whole/report.json").read_text())
    assert (
        json.loads(Path("out/evaluation.json").read_text())["episodes"]
        == json.loads(Path("whole/evaluation.json").read_text())["episodes"]
    )
    # What was merged can be gone on with like any other evaluation.
    fake_loop.ran.clear()
    assert lerobot([*COMMAND[:3], "episodes=6", "output_dir=out", "resume=true"]) == 0
    assert fake_loop.ran == [(STOVE, 4), (STOVE, 5), (DRAWER, 4), (DRAWER, 5)]
    assert len(read_episodes("out")) == 12


def test_folders_can_be_named(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for number in (1, 2):
        assert lerobot([*COMMAND, f"output_dir=machine{number}", f"shard={number}/2"]) == 0
    folders = [f"machine{number}/shard-{number}-of-2" for number in (1, 2)]
    assert memobench(["merge", "out", *folders]) == 0
    assert len(read_episodes("out")) == 8
    assert memobench(["merge", "empty"]) == 2
    assert "name the folders" in capsys.readouterr().err
    fake_loop.changed = {"scene_hash": "another"}
    assert lerobot([*COMMAND, "output_dir=wrong", "shard=2/2"]) == 0
    assert memobench(["merge", "out", folders[0], "wrong/shard-2-of-2"]) == 2
    assert "scene_hash" in capsys.readouterr().err


# --- rerun ---


def test_a_card_is_repeated(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert lerobot([*COMMAND, "output_dir=out", "seed=9", "horizon=600"]) == 0
    first = fake_loop.plans[0].settings.portable
    assert memobench(["rerun", "out/evaluation.json", "--out", "again"]) == 0
    assert "repeated: 8 episodes, as on the card" in capsys.readouterr().out
    assert fake_loop.plans[1].settings.portable == first
    assert memobench(["rerun", "out", "--out", "folder"]) == 0
    fake_loop.changed = {"steps": 5}
    assert memobench(["rerun", "out", "--out", "changed"]) == 1
    out = capsys.readouterr().out.replace("\n", " ")
    assert f"not repeated: {DRAWER}, episode 0: steps is 109 on the card and 5 here" in out


def test_a_part_alone_is_repeated_as_a_part(fake_loop: Any) -> None:
    assert lerobot([*COMMAND, "output_dir=out", "shard=2/2"]) == 0
    fake_loop.ran.clear()
    assert memobench(["rerun", "out/shard-2-of-2/evaluation.json", "--out", "again"]) == 0
    assert fake_loop.ran == [(DRAWER, k) for k in range(4)]


INCOMPLETE = {
    "bare": lambda episodes: [{key: each[key] for key in ("task", "episode", "referent")} for each in episodes],
    "without steps": lambda episodes: [episodes[0], *({**each, "steps": None} for each in episodes[1:])],
    "one alone": lambda episodes: episodes[:1],
    "one more": lambda episodes: [*episodes, {**episodes[-1], "episode": 9}],
    "another outcome": lambda episodes: [{**episodes[0], "success": not episodes[0]["success"]}, *episodes[1:]],
}


@pytest.mark.parametrize("change", INCOMPLETE)
def test_a_card_is_repeated_only_with_the_outcome_of_every_episode(fake_loop: Any, change: str, capsys: Any) -> None:
    assert lerobot([*COMMAND, "output_dir=out"]) == 0
    card = json.loads(Path("out/evaluation.json").read_text())
    card["episodes"] = INCOMPLETE[change](card["episodes"])
    Path("evaluation.json").write_text(json.dumps(card))
    capsys.readouterr()
    status = 1 if change in ("another outcome", "without steps") else 2
    assert memobench(["rerun", "evaluation.json", "--out", "again"]) == status
    assert "\nrepeated: " not in capsys.readouterr().out
    assert Path("again").exists() == (status == 1), "an incomplete card runs nothing"


def test_other_versions_are_told(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert lerobot([*COMMAND, "output_dir=out"]) == 0
    card = json.loads(Path("out/evaluation.json").read_text())
    card["runs"][0]["versions"]["mujoco"] = "0.1"
    Path("evaluation.json").write_text(json.dumps(card))
    assert memobench(["rerun", "evaluation.json", "--out", "again"]) == 0
    assert "note: the card's run used mujoco 0.1 (here " in capsys.readouterr().out


def test_another_or_no_checkpoint_is_refused(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path("checkpoint")
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"type": "memobench_random", "device": "cpu"}))
    save_file({"weight": torch.zeros(1)}, folder / "model.safetensors")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).write_text(json.dumps({"name": name, "steps": []}))
    assert lerobot([*COMMAND, "output_dir=out", "policy=checkpoint"]) == 0
    assert memobench(["rerun", "out", "--out", "again"]) == 0
    save_file({"weight": torch.ones(1)}, folder / "model.safetensors")
    capsys.readouterr()
    assert memobench(["rerun", "out", "--out", "other"]) == 2
    assert "is not the one that was evaluated" in capsys.readouterr().err
    (folder / "config.json").unlink()
    assert memobench(["rerun", "out", "--out", "other"]) == 2
    assert "is not here" in capsys.readouterr().err
    assert not Path("other").exists()


def test_a_card_of_an_unfinished_evaluation(fake_loop: Any, capsys: pytest.CaptureFixture[str]) -> None:
    fake_loop.kill_after = 1
    with pytest.raises(fake_loop.killed):
        lerobot([*COMMAND, "output_dir=out"])
    assert memobench(["rerun", "out"]) == 2
    assert "has ended" in capsys.readouterr().err


# --- parts as jobs ---


@pytest.fixture
def here(fake_loop: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Parts run in the process that asks for them."""

    def run(job: shards.ShardJob) -> None:
        assert lerobot(job.arguments) == 0

    monkeypatch.setattr(shards.ShardJob, "run", run)
    return fake_loop


def test_parts_as_jobs(here: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert lerobot([*COMMAND, "output_dir=whole"]) == 0
    assert lerobot([*COMMAND, "output_dir=out", "shards=3", "workers=1"]) == 0
    assert "3/3 part 3/3" in capsys.readouterr().out
    assert comparable("out") == comparable("whole")
    assert lerobot([*COMMAND, "output_dir=out", "shards=3", "workers=1"]) == 2
    assert "already holds an evaluation" in capsys.readouterr().err
    here.ran.clear()
    assert lerobot([*COMMAND, "output_dir=out", "shards=3", "workers=1", "resume=true"]) == 0
    assert here.ran == []
    assert lerobot([*COMMAND, "output_dir=out", "shards=3", "workers=1", "resume=true", "horizon=5"]) == 2
    assert "horizon: 1200 and 5" in capsys.readouterr().err


def test_a_lost_part_is_run_again(here: Any) -> None:
    assert lerobot([*COMMAND, "output_dir=out", "shards=4", "workers=1"]) == 0
    here.ran.clear()
    log = next(Path("out/shard-2-of-4/episodes").iterdir())
    log.unlink()
    Path("out/shard-2-of-4/episodes.jsonl").unlink()
    assert lerobot([*COMMAND, "output_dir=out", "shards=4", "workers=1", "resume=true"]) == 0
    assert here.ran == [(STOVE, 2), (STOVE, 3)]


def test_slurm_gets_a_job_per_part_and_one_that_merges(
    here: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a stand-in for sbatch: what it is given, and what the jobs then do when they run."""
    sbatch = Sbatch(tmp_path / "bin", monkeypatch)
    words = ["slurm=--partition=gpu --time=08:00:00 --account=lab --no-requeue", "workers=2"]
    assert lerobot([*COMMAND, "output_dir=out", "shards=4", *words]) == 0
    printed = capsys.readouterr().out
    assert "jobs are submitted" in printed
    assert "--cpus-per-task=2 --mem=8G --partition=gpu" in printed
    assert here.ran == []
    make, finish = sbatch.calls
    assert {"--array=0-3%2", "--account=lab", "--no-requeue"} <= set(make)
    assert "--dependency=afterany:4711" in finish  # a failed part does not leave it waiting

    def run(part: str, rank: int = 0) -> None:
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(rank))
        run_part(part, tmp_path / "out" / "logs")

    for rank in (0, 1, 3):
        run("make", rank)
    with pytest.raises(MemobenchError, match=r"^1 of 4 jobs .*shard-3-of-4.* resume=true"):
        run("finish")
    assert not Path("out/report.md").exists()
    run("make", 2)
    run("finish")
    assert len(read_episodes("out")) == 8
    assert Path("out/report.md").is_file()


@pytest.mark.slow
def test_a_parts_process_ends_with_the_one_that_wanted_it(tmp_path: Path) -> None:
    words = ["eval", "env=memobench", f"tasks={STOVE}", "episodes=50", "output_dir=out", "shard=1/1", "batch_size=1"]
    part = subprocess.Popen([sys.executable, *SHARD_PROGRAM, *words], cwd=tmp_path, stdin=subprocess.PIPE)
    while not (tmp_path / "out" / "shard-1-of-1" / "evaluation.json").exists():
        assert part.poll() is None
    assert part.stdin is not None
    part.stdin.close()
    assert part.wait(60) == 1


@pytest.mark.slow
def test_a_part_that_fails_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["eval", "env=memobench", f"tasks={STOVE}", "episodes=1", f"output_dir={tmp_path / 'out'}", "shards=1"]
    assert lerobot([*words, "policy=memobench_remote", "host=127.0.0.1", "port=1", "policy.connect_timeout=0.1"]) == 2
    error = capsys.readouterr().err
    assert "part 1/1 ended with" in error
    assert "127.0.0.1:1" in error
    assert "resume=true goes on" in error
