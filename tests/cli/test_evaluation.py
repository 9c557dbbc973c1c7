"""An evaluation as it is asked for: complete flags, and what is known of its policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import huggingface_hub
import pytest

from lerobot_memobench.cli.arguments import Translation, without_flag
from lerobot_memobench.cli.evaluation import Evaluation, joined_flags, number, with_checkpoint
from lerobot_memobench.cli.orders import Orders

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def evaluation(*flags: str) -> Evaluation:
    return Evaluation(Translation(list(flags)), Orders(), None, None, None)


def test_flags_are_complete_but_for_what_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("checkpoint").mkdir()
    flags = ["--output_dir=out", "--env.log_dir", "log", "--policy.path=checkpoint", "--seed", "7", "--env.videos=true"]
    asked = evaluation(*flags)
    assert asked.flags == ["--seed=7", "--env.videos=true", f"--policy.path={tmp_path / 'checkpoint'}"]
    assert (asked.output, asked.log, asked.seed, asked.batch) == (Path("out"), Path("log"), 7, 1)
    assert evaluation("--policy.path=user/name").flags == ["--policy.path=user/name"]  # a repository stays one


def test_flags_in_both_spellings() -> None:
    assert joined_flags(["--a", "1", "--b=2", "--c", "--d", "x"]) == ["--a=1", "--b=2", "--c", "--d=x"]
    assert without_flag(["--a", "1", "--b=2", "--a=3", "--ab=4"], "a") == ["--b=2", "--ab=4"]
    translation = Translation(["--seed", "3", "--x=1"])
    translation.set("seed", 5)
    assert translation.flags == ["--x=1", "--seed=5"]


def test_numbers() -> None:
    assert [number(text) for text in ("7", "-1", "null", None)] == [7, -1, None, None]


def test_a_repository_is_known_once_it_has_been_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = tmp_path / "models--user--name" / "snapshots" / COMMIT
    snapshot.mkdir(parents=True)
    cached = lambda repo, name: str(snapshot / name) if (snapshot / name).exists() else None  # noqa: E731
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", cached)
    card: dict[str, Any] = {"policy": {"type": "act"}, "checkpoint": None, "trained_on": None}
    assert with_checkpoint(card, None) == card
    assert with_checkpoint(card, "user/name") == card
    (snapshot / "config.json").write_text("{}")  # the configuration comes first, the weights when the policy is made
    assert with_checkpoint(card, "user/name") == card
    (snapshot / "model.safetensors").write_bytes(b"weights")
    found = with_checkpoint(card, "user/name")
    assert sorted(found["checkpoint"]["files"]) == ["config.json", "model.safetensors"]
    assert found["checkpoint"]["revision"] == COMMIT
    assert len(found["policy"]["sha256"]) == 64
