"""The card of an evaluation that begins: what is known of its policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import huggingface_hub
import pytest

from lerobot_memobench.run.card import with_checkpoint

COMMIT = "0123456789abcdef0123456789abcdef01234567"


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
