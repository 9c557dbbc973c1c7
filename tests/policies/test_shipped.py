"""Trained policies that come with the package: found by name, known by it on other machines."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_memobench.engine import memory_demo
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies import checkpoint
from lerobot_memobench.settings.choices import checkpoint_of


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with one trained policy, and a folder that is none."""
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path / "shipped")
    for name, config in (("memobench_small", {"type": "memobench_mem"}), ("notes", None)):
        (tmp_path / "shipped" / name).mkdir(parents=True)
        if config is not None:
            (tmp_path / "shipped" / name / "config.json").write_text(json.dumps(config))
    return tmp_path / "shipped"


def test_a_policy_is_found_by_its_name(shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = shipped / "memobench_small"
    assert checkpoint.shipped_policies() == {"memobench_small": folder}
    assert checkpoint_of("memobench_small", {"act"}) == str(folder)
    assert checkpoint.checkpoint_type(str(folder)) == "memobench_mem"
    assert checkpoint_of("notes", {"act"}) is None
    assert checkpoint.portable_path(str(folder)) == "memobench_small"
    assert checkpoint.portable_path("outputs/train/me") == "outputs/train/me"
    mine = tmp_path / "here" / "memobench_small"
    mine.mkdir(parents=True)
    (mine / "config.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "here")
    assert checkpoint_of("memobench_small", {"act"}) == "memobench_small", "a folder of the user's comes first"


def test_the_demo_compares_only_what_is_there(shipped: Path) -> None:
    assert not memory_demo.has_policies()
    (shipped / "memobench_small_memoryless").mkdir()
    (shipped / "memobench_small_memoryless" / "config.json").write_text("{}")
    assert memory_demo.has_policies()


def test_a_name_that_is_nearly_one_is_told(shipped: Path) -> None:
    from lerobot.configs.eval import EvalPipelineConfig

    from lerobot_memobench.settings.choices import choice_flags

    with pytest.raises(MemobenchError, match="did you mean 'memobench_small'"):
        choice_flags(EvalPipelineConfig, "policy", "memobench_smal")
