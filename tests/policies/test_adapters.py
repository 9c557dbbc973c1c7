"""`lerobot-train --peft…`: adapters in pi0.5, memory and heads whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.training.average import begin_average
from tests.support.small_policy import batch_of, made_for_training


def _whole(policy: object) -> set[str]:
    """Parameters below the modules that peft is told to train whole; it compares the ends of names."""
    names = policy._get_default_peft_targets()["modules_to_save"]  # type: ignore[attr-defined]
    modules = [name for name, _ in policy.named_modules() if any(name.endswith(end) for end in names)]  # type: ignore[attr-defined]
    return {name for name, _ in policy.named_parameters() if any(name.startswith(f"{m}.") for m in modules)}  # type: ignore[attr-defined]


@pytest.mark.parametrize("memory_fusion", ["modulation", "context", "none"])
def test_memory_and_heads_are_trained_whole_and_nothing_else(dataset_root: Path, memory_fusion: str) -> None:
    without = memory_fusion == "none"
    fields = {"memory": "none"} if without else {"memory_fusion": memory_fusion, "align": "contrastive"}
    policy, *_ = made_for_training(dataset_root, **fields)
    own = {f"model.{name}" for name in policy.model.memory_parameters()}
    own |= {name for name, _ in policy.named_parameters() if name.startswith("alignment.")}
    assert _whole(policy) == own
    assert bool(own) == (memory_fusion != "none")


def test_what_is_asked_for_is_trained_whole_too(dataset_root: Path) -> None:
    policy, *_ = made_for_training(dataset_root)
    assert policy.trained_whole(["action_out_proj"]) == ["action_out_proj", *policy.trained_whole()]
    assert policy.trained_whole(["model.modulators.0"]).count("model.modulators.0") == 1


def test_adapters_are_made_beside_memory_and_heads(dataset_root: Path, tmp_path: Path) -> None:
    policy, before, _, dataset = made_for_training(dataset_root, align="contrastive")
    policy.save_pretrained(tmp_path)
    policy.config.pretrained_path = str(tmp_path)
    wrapped = policy.wrap_with_peft(peft_cli_overrides={"method_type": "LORA", "r": 2})
    wrapped.train()
    loss, logged = wrapped.forward(before(batch_of(dataset, [3, 50, 80])))
    loss.backward()
    assert logged["align_grad_norm"] > 0
    learning = {name for name, p in wrapped.named_parameters() if p.requires_grad and p.grad is not None}
    for part in ("lora_A", "model.memory.", "modulators", "memory_to_expert", "alignment"):
        assert any(part in name for name in learning), part
    assert begin_average(policy) is None
