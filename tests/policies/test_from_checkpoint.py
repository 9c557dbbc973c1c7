"""Starting from a checkpoint with other settings: the saved preprocessor follows them, or refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import make_pre_post_processors

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import WordTokenizerProcessorStep
from lerobot_memobench.training.configuration import read_training
from lerobot_memobench.training.loop import train
from tests.support.small_policy import train_with


@pytest.fixture(scope="module")
def start(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoint of one step without alignment, read with eight frames of memory."""
    out = tmp_path_factory.mktemp("start") / "run"
    config = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(dataset_root)),
        policy=MemobenchMemConfig(
            device="cpu",
            push_to_hub=False,
            chunk_size=6,
            n_action_steps=6,
            num_inference_steps=2,
            memory_settings={"frames": 8},
        ),
        output_dir=out,
        steps=1,
        batch_size=8,
        num_workers=0,
    )
    train_with(config)
    return out / "checkpoints" / "000001" / "pretrained_model"


@pytest.fixture
def go_on(dataset_root: Path, start: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Train one step from the checkpoint; give its batch and the checkpoint it wrote."""
    seen: list[dict[str, Any]] = []
    forward = MemobenchMemPolicy.forward

    def spied(self: MemobenchMemPolicy, batch: dict[str, Any], reduction: str = "mean") -> Any:
        seen.append(batch)
        return forward(self, batch, reduction)

    monkeypatch.setattr(MemobenchMemPolicy, "forward", spied)

    def run(*settings: str, source: Path = start) -> tuple[dict[str, Any], Path]:
        fixed = (
            *("dataset.repo_id=memobench/synthetic", f"dataset.root={dataset_root}", f"output_dir={tmp_path / 'run'}"),
            *("steps=1", "batch_size=8", "num_workers=0", f"policy.path={source}"),
        )
        named = [f"--{one}" for one in (*fixed, *(f"policy.{setting}" for setting in settings))]
        train(read_training(named))
        return seen[-1], tmp_path / "run" / "checkpoints" / "000001" / "pretrained_model"

    return run


def test_oracle_memory_is_spelled_out_behind_the_checkpoints_own_words(go_on: Any, start: Path) -> None:
    before = _tokenizer(start)
    batch, written = go_on("oracle_memory=true")
    after = _tokenizer(written)
    assert after.vocabulary[: len(before.vocabulary)] == before.vocabulary
    said = [
        after.input_tokenizer.decode(row[mask])
        for row, mask in zip(
            batch["observation.language.tokens"], batch["observation.language.attention_mask"].bool(), strict=True
        )
    ]
    assert all("memory" in text and "action" in text and "<unk>" not in text for text in said), said


def _tokenizer(checkpoint: Path) -> WordTokenizerProcessorStep:
    config = PreTrainedConfig.from_pretrained(checkpoint)
    MemobenchMemPolicy.from_pretrained(checkpoint, config=config)  # for evaluation: nothing is followed
    pipeline, _ = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    return next(step for step in pipeline.steps if isinstance(step, WordTokenizerProcessorStep))


def _edited(start: Path, target: Path, **changed: dict[str, Any] | None) -> Path:
    """Copy of a checkpoint whose named preprocessor steps have other settings, or are not there (None)."""
    shutil.copytree(start, target)
    path = target / "policy_preprocessor.json"
    saved = json.loads(path.read_text())
    saved["steps"] = [step for step in saved["steps"] if changed.get(step["registry_name"], step) is not None]
    for step in saved["steps"]:
        step["config"] |= changed.get(step["registry_name"]) or {}
    path.write_text(json.dumps(saved))
    return target


def test_what_saved_steps_cannot_follow_is_refused(go_on: Any, start: Path, tmp_path: Path) -> None:
    old = _edited(start, tmp_path / "old", memobench_oracle_memory=None)  # as checkpoints were before
    with pytest.raises(MemobenchError, match=r"oracle_memory=True has no effect.*base_weights"):
        go_on("oracle_memory=true", source=old)
    relative = _edited(start, tmp_path / "relative", relative_actions_processor={"enabled": True})
    with pytest.raises(MemobenchError, match=r"use_relative_actions=False has no effect"):
        go_on(source=relative)
    with pytest.raises(MemobenchError, match=r"tokenizer_name=google/some has no effect.*words"):
        go_on("tokenizer_name=google/some", source=start)
    config = PreTrainedConfig.from_pretrained(start)
    config.oracle_memory = True  # type: ignore[attr-defined]
    with pytest.raises(MemobenchError, match=r"oracle_memory=True has no effect"):
        MemobenchMemPolicy.from_pretrained(start, config=config)
