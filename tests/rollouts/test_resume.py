"""Kill and resume an evaluation, whole or in parts: the result is that of an undisturbed run."""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.rollouts import shards
from tests.support.fake_loop import DRAWER, STOVE, FakeLoop, Killed, content, make_checkpoint, results

COMMAND = ["eval", "env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4", "batch_size=2"]
ALL = [(STOVE, k) for k in range(4)] + [(DRAWER, k) for k in range(4)]


def evaluate(*words: str) -> int:
    return main([*COMMAND, *words])


@pytest.fixture(autouse=True)
def jobs_here(fake_loop: FakeLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs run in this process."""

    def run(job: shards.ShardJob) -> None:
        assert main(job.arguments) == 0

    monkeypatch.setattr(shards.ShardJob, "run", run)


def commands(way: str, out: str, *words: str) -> Iterator[int]:
    """Evaluate in one of three ways."""
    if way == "whole":
        yield evaluate(f"output_dir={out}", *words)
    elif way == "jobs":
        yield evaluate(f"output_dir={out}", "shards=3", "workers=1", *words)
    else:
        for number in (1, 2, 3):
            yield evaluate(f"output_dir={out}", f"shard={number}/3", *words)
        yield memobench(["merge", out])


@pytest.mark.parametrize("count", [1, 4, 7])
@pytest.mark.parametrize("way", ["whole", "parts", "jobs"])
def test_resume_equals_undisturbed_run(fake_loop: FakeLoop, way: str, count: int) -> None:
    assert evaluate("output_dir=undisturbed") == 0
    fake_loop.kill_after = count
    with pytest.raises(Killed):
        list(commands(way, "out"))
    fake_loop.kill_after = None
    drafts = [Path("out/.77-ab.part.evaluation.json"), Path("out/videos/.77-ab.part.film.mp4")]
    for draft in drafts if way == "whole" else ():
        draft.parent.mkdir(exist_ok=True)
        draft.write_text("half")
    fake_loop.ran.clear()
    fake_loop.cells.clear()
    assert set(commands(way, "out", "resume=true")) == {0}
    assert fake_loop.ran == ALL[count:]
    opened = {task.name for cells in fake_loop.cells for task, _ in cells}
    assert opened == {task for task, _ in ALL[count:]}, "environments of finished tasks are not opened"
    assert results("out") == results("undisturbed")
    assert not any(draft.exists() for draft in drafts)
    # All is done: no episode runs, no result changes, and the card has no more starts.
    before, card = results("out"), json.loads(Path("out/evaluation.json").read_text())
    assert set(commands(way, "out", "resume=true")) == {0}
    assert (fake_loop.ran, results("out")) == (ALL[count:], before)
    assert json.loads(Path("out/evaluation.json").read_text())["runs"] == card["runs"]


@pytest.mark.parametrize("way", ["whole", "parts", "jobs"])
def test_episodes_that_could_not_be_run_are_run_again(fake_loop: FakeLoop, way: str) -> None:
    assert evaluate("output_dir=undisturbed") == 0
    fake_loop.unrun = {(STOVE, 1), (DRAWER, 2)}
    assert set(commands(way, "out")) == {0}
    assert results("out")[1]["not_run"] == {STOVE: 1, DRAWER: 1}
    for left in (fake_loop.unrun, {(DRAWER, 2)}, set()):
        fake_loop.unrun, before = left, fake_loop.unrun
        fake_loop.ran.clear()
        assert set(commands(way, "out", "resume=true")) == {0}
        assert set(fake_loop.ran) == before
    assert results("out") == results("undisturbed")
    assert Path("out/episodes.jsonl").read_text().count("\n") == len(ALL)


def test_resume_widens_an_evaluation(fake_loop: FakeLoop) -> None:
    assert evaluate("output_dir=out", "resume=true") == 0  # begun in an empty folder
    assert fake_loop.ran == ALL
    fake_loop.ran.clear()
    wider = "check_the_middle_drawer_of_the_cabinet"
    assert evaluate("output_dir=out", "resume=true", "episodes=6", f"tasks={DRAWER},{wider}") == 0
    assert fake_loop.ran == [(DRAWER, 4), (DRAWER, 5), *((wider, k) for k in range(6))]
    card = json.loads(Path("out/evaluation.json").read_text())
    assert card["protocol"]["tasks"] == card["settings"]["env"]["tasks"].split(",") == sorted([STOVE, DRAWER, wider])
    assert card["protocol"]["episodes"] == 6
    fake_loop.ran.clear()
    assert evaluate("output_dir=out", "resume=true", "episodes=2") == 0  # fewer: all are kept
    assert (fake_loop.ran, len(results("out")[0])) == ([], 16)


@pytest.mark.parametrize(
    ("words", "differs"),
    [
        ([], "resume=true"),
        (["resume=true", "horizon=600"], "horizon: 1200 and 600"),
        (["resume=true", "seed=8"], "policy.seed: 7 and 8"),
        (["resume=true", "policy=memobench_random"], "policy.type: memobench_expert and memobench_random"),
        (["resume=true", "shards=2", "horizon=5"], "horizon: 1200 and 5"),
        (["shards=2"], "already holds an evaluation"),
    ],
)
def test_another_evaluation_in_the_folder_is_refused(
    fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str], words: list[str], differs: str
) -> None:
    fake_loop.killed_after(3, *COMMAND, "output_dir=out")
    assert "resume=true output_dir=out" in capsys.readouterr().err
    before = content(Path("out"))
    assert evaluate("output_dir=out", *words) == 2
    error = capsys.readouterr().err
    assert differs in error
    assert error.count("\n") == 1
    assert (fake_loop.ran, content(Path("out"))) == ([], before)


def test_other_weights_and_task_files_are_refused(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    policy = make_checkpoint(Path("checkpoint"))
    words = [f"policy={policy}", "output_dir=out"]
    fake_loop.killed_after(3, *COMMAND, *words)
    save_file({"weight": np.ones(1, np.float32)}, policy / "model.safetensors")
    capsys.readouterr()
    assert evaluate(*words, "resume=true") == 2
    assert "policy.sha256: " in capsys.readouterr().err
    save_file({"weight": np.zeros(1, np.float32)}, policy / "model.safetensors")
    (policy / "train_config.json").write_text("{}")  # does not change the policy
    file = Path("out/evaluation.json")
    card = json.loads(file.read_text())
    file.write_text(json.dumps(card | {"task_files": {STOVE: "edited"}}))
    assert evaluate(*words, "resume=true") == 2
    assert STOVE in capsys.readouterr().err
    file.write_text(json.dumps(card))
    assert evaluate(*words, "resume=true") == 0


def test_resume_keeps_the_batch_size(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    words = [word for word in COMMAND if not word.startswith("batch_size")]
    for out, more in (("out", []), ("other", ["batch_size=1"])):
        fake_loop.killed_after(3, *COMMAND, f"output_dir={out}")
        capsys.readouterr()
        assert main([*words, f"output_dir={out}", "resume=true", *more]) == 0
        assert fake_loop.plans[-1].batch == (1 if more else 2)
        assert ("batch_size 2, now 1" in capsys.readouterr().err) == bool(more)


@pytest.mark.parametrize("known", [False, True])
def test_a_log_of_plain_lerobot_eval_is_resumed(
    fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str], known: bool
) -> None:
    fake_loop.killed_after(3, *COMMAND, "output_dir=out")
    file = Path("out/evaluation.json")
    content = json.loads(file.read_text())
    policy = {name: content["policy"][name] for name in ("type", "identity")} if known else {}
    file.write_text(json.dumps({"format": content["format"], "protocol": content["protocol"], "policy": policy}))
    capsys.readouterr()
    assert evaluate("output_dir=out", "resume=true") == 0
    assert ("names no policy" in capsys.readouterr().err) == (not known)
    assert fake_loop.ran == ALL[3:]
    file.unlink()
    assert evaluate("output_dir=out", "resume=true") == 2, "without its file a log is of unknown settings"
    record = {"task": STOVE, "memory_type": "temporal", "episode": 0, "success": True, "checkpoints": []}
    EpisodeLog("foreign/shard-1-of-2").append(record)
    assert evaluate("output_dir=foreign", "shard=1/2") == 2


def test_a_part_has_the_settings_of_the_other_parts(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate("output_dir=out", "shard=1/2") == 0
    fake_loop.ran.clear()
    assert evaluate("output_dir=out", "shard=2/2", "horizon=40") == 2
    assert re.search(r"shard-1-of-2 holds an evaluation with another protocol \(horizon: ", capsys.readouterr().err)
    assert not fake_loop.ran
    assert not Path("out/shard-2-of-2").exists()
    assert evaluate("output_dir=out", "shard=2/2") == 0


def test_parts_have_whole_batches_on_any_machine(
    fake_loop: FakeLoop, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate("output_dir=none", "shard=1/5") == 0
    assert "holds no episode" in capsys.readouterr().out
    assert not Path("none").exists()
    words = [word for word in COMMAND if not word.startswith("batch_size")]
    for cores in (2, 64):
        monkeypatch.setattr("lerobot_memobench.rollouts.plan.cores", lambda cores=cores: cores)
        assert main([*words, f"output_dir=out{cores}", "shard=2/3"]) == 0
    assert results("out2/shard-2-of-3") == results("out64/shard-2-of-3")
    assert json.loads(Path("out2/shard-2-of-3/evaluation.json").read_text())["shard"] == "2/3"


def test_a_run_without_episodes_leaves_no_folder(fake_loop: FakeLoop) -> None:
    def fail(plan: Any) -> None:
        (plan.output / "videos").mkdir(parents=True)
        raise Killed

    fake_loop.before = fail
    Path("kept/own").mkdir(parents=True)
    for out in ("outputs/new", "kept"):
        with pytest.raises(Killed):
            evaluate(f"output_dir={out}")
    assert not Path("outputs").exists()
    assert sorted(path.name for path in Path("kept").iterdir()) == ["own", "videos"]


def test_a_full_disk_is_named_with_folder_and_command(
    fake_loop: FakeLoop, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as a write raises it, without a path

    with monkeypatch.context() as patch:
        patch.setattr("lerobot_memobench.rollouts.evaluate.write_report", full)
        assert evaluate("output_dir=out") == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert "out cannot be written (No space left on device; " in last
    assert "finished episodes stay; resume with: lerobot eval" in last
    assert "resume=true output_dir=out" in last


@pytest.mark.parametrize("name", ["videos", "memory_reads"])
def test_files_of_another_evaluation_are_not_written_through_a_link(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    other, out = tmp_path / "other", Path("out")
    other.mkdir()
    out.mkdir()
    draft = other / ".7-abcd.part.film.mp4"  # of an evaluation that runs
    draft.touch()
    (out / name).symlink_to(other)
    assert evaluate("output_dir=out") == 2
    assert f"out/{name} is a link to {other}" in capsys.readouterr().err
    assert draft.exists()
