"""The sealed test by its command: counted is what has begun, once, by the policy that ran it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.sealed import user_ledger

COMMAND = ["test-sealed", "policy=memobench_random", "tasks=turn_on_the_stove_and_turn_it_off", "episodes=2"]


@pytest.fixture(autouse=True)
def ledger(fake_loop: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def lines() -> int:
    return len(user_ledger().read_text().splitlines()) if user_ledger().exists() else 0


def number(folder: str) -> int:
    found: int = json.loads(Path(folder, "evaluation.json").read_text())["sealed"]["run"]
    return found


def test_a_run_that_ends_before_its_first_scene_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_weights(*asked: object) -> None:
        raise MemobenchError("the weights cannot be loaded")

    with monkeypatch.context() as patch:
        patch.setattr("lerobot_memobench.run.run.evaluate", no_weights)
        assert main([*COMMAND, "output_dir=a"]) == 2
    assert lines() == 0
    assert not Path("a").exists()
    assert main([*COMMAND, "output_dir=a"]) == 0
    assert (lines(), number("a")) == (1, 1)


def test_going_on_is_the_same_start_and_running_again_another(fake_loop: Any) -> None:
    fake_loop.kill_after = 1
    with pytest.raises(fake_loop.killed):
        main([*COMMAND, "output_dir=a"])
    fake_loop.kill_after = None
    assert main([*COMMAND, "output_dir=a", "resume=true"]) == 0
    assert main([*COMMAND, "output_dir=a", "resume=true"]) == 0  # nothing is left to run
    assert (lines(), number("a")) == (1, 1)
    shutil.rmtree("a/episodes")
    Path("a/episodes.jsonl").unlink()
    assert main([*COMMAND, "output_dir=a"]) == 0
    assert (lines(), number("a")) == (2, 2)
    Path("c").mkdir()
    shutil.copy("a/evaluation.json", "c")
    assert main([*COMMAND, "output_dir=c"]) == 0
    assert (lines(), number("c")) == (3, 3)
    assert main([*COMMAND, "output_dir=e", "policy.seed=7"]) == 0
    assert (lines(), number("e")) == (4, 1)


def test_a_ledger_that_cannot_be_written_ends_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    assert main([*COMMAND, "output_dir=a"]) == 2
    assert "XDG_STATE_HOME" in capsys.readouterr().err
    assert not Path("a").exists()
