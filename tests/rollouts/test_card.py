"""The result card: the facts of an evaluation, read back, joined, and compared."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import huggingface_hub
import pytest

from lerobot_memobench.policies.checkpoint import checkpoint_files, tree_hash
from lerobot_memobench.rollouts.card import (
    policy_facts,
    run_facts,
    training_facts,
    with_checkpoint,
)
from tests.support import logs


def card(**changes: Any) -> dict[str, Any]:
    parts: dict[str, Any] = {
        "protocol": {"tasks": ["a"], "episodes": 2, "seed_base": 7, "referent": "fixed", "horizon": 1200},
        "policy": policy_facts({"type": "act", "chunk_size": 50, "device": "cuda"}, 7),
        "task_files": {"a": "1"},
        "settings": {"env": {"tasks": "a"}, "policy": {"type": "act"}},
    }
    return logs.card(**parts | changes)


# --- facts ---


def test_a_policy_is_known_by_settings_and_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = policy_facts({"type": "act", "chunk_size": 50, "device": "cuda", "pretrained_path": "/somewhere"}, 7)
    assert facts == {"type": "act", "seed": 7, "settings": {"chunk_size": 50}}
    # A repository is known once it has been fetched: the configuration first, the weights when the policy is made.
    snapshot = tmp_path / "models--user--name" / "snapshots" / "0123456789abcdef0123456789abcdef01234567"
    snapshot.mkdir(parents=True)
    cached = lambda repo, name: str(snapshot / name) if (snapshot / name).exists() else None  # noqa: E731
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", cached)
    plain: dict[str, Any] = {"policy": {"type": "act"}, "checkpoint": None, "trained_on": None}
    monkeypatch.setattr("lerobot_memobench.rollouts.card.identity_of", lambda policy, path, weights: f"act {weights}")
    of_path: Any = lambda path: SimpleNamespace(policy=None, policy_path=path)  # noqa: E731
    assert with_checkpoint(plain, of_path(None)) == {**plain, "policy": {"type": "act", "identity": "act None"}}
    assert with_checkpoint(plain, of_path("user/name")) == plain
    (snapshot / "config.json").write_text("{}")
    assert with_checkpoint(plain, of_path("user/name")) == plain
    (snapshot / "model.safetensors").write_bytes(b"weights")
    (snapshot / "train_config.json").write_text("{}")  # not part of the policy
    found = with_checkpoint(plain, of_path("user/name"))
    assert sorted(found["checkpoint"]["files"]) == ["config.json", "model.safetensors"]
    assert found["checkpoint"]["revision"] == snapshot.name
    sums = subprocess.run(["sha256sum", "config.json", "model.safetensors"], cwd=snapshot, capture_output=True)
    assert found["policy"]["identity"] == f"act {found['policy']['sha256']}"
    assert found["policy"]["sha256"] == hashlib.sha256(sums.stdout).hexdigest() == tree_hash(checkpoint_files(snapshot))


def test_the_dataset_of_a_checkpoint(tmp_path: Path) -> None:
    assert training_facts(tmp_path) is None
    data = tmp_path / "data"
    (data / "meta").mkdir(parents=True)
    (data / "meta" / "info.json").write_text("{}")
    config: dict[str, Any] = {"dataset": {"repo_id": "a/b", "root": str(data), "revision": "v1"}, "steps": 50}

    def facts() -> dict[str, Any] | None:
        (tmp_path / "train_config.json").write_text(json.dumps(config))
        return training_facts(tmp_path)

    first = facts() or {}
    assert (first["repo_id"], first["revision"], first["steps"]) == ("a/b", "v1", 50)
    (data / "manifest.json").write_text("{}")
    assert (facts() or {})["sha256"] != first["sha256"]
    config["dataset"]["root"] = 5000 * "a"  # no file system has such a name: the dataset is elsewhere
    assert "sha256" not in (facts() or {"sha256": None})
    config.clear()
    assert facts() is None


def test_this_machine_is_described() -> None:
    facts = run_facts(["lerobot"], 3)
    assert {"python", "lerobot", "mujoco", "torch", "lerobot_policy_memobench"} <= set(facts["versions"])
    assert "not installed" not in facts["versions"].values()
    assert facts["machine"]["cpu"]
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True)
    if head.returncode == 0:
        assert facts["git_commit"].startswith(head.stdout.strip())
