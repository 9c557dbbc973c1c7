"""Starting from a checkpoint with other settings: the saved preprocessor follows them, or refuses."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.scripts.lerobot_train import train
from safetensors.torch import load_file

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import checkpoints
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.fusion import plain_name
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import WordTokenizerProcessorStep, gathering
from tests.support.small_policy import batch_of


@pytest.fixture(scope="module")
def start(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoint of one step without alignment, read with eight frames of memory."""
    out = tmp_path_factory.mktemp("start") / "run"
    config = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(dataset_root)),
        policy=MemobenchMemConfig(
            device="cpu", push_to_hub=False, chunk_size=6, n_action_steps=6, num_inference_steps=2, memory_frames=8
        ),
        output_dir=out,
        steps=1,
        batch_size=8,
        num_workers=0,
    )
    train(config)
    return out / "checkpoints" / "000001" / "pretrained_model"


@pytest.fixture
def go_on(dataset_root: Path, start: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run one step of lerobot-train from the checkpoint; give its batch and the checkpoint it wrote."""
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
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *named])
        train()  # type: ignore[call-arg]
        return seen[-1], tmp_path / "run" / "checkpoints" / "000001" / "pretrained_model"

    return run


@pytest.mark.parametrize(
    "settings",
    [
        ["align=contrastive"],
        ["align=framewise", "memory_frames=4"],
        ["memory_frames=4"],
        ["align=semantic", "subgoal_level=coarse"],
        ["align=semantic", "shuffle_subgoals=true", "shuffle_seed=3"],
        ["oracle_memory=true"],
    ],
    ids=" ".join,
)
@pytest.mark.slow
def test_a_step_from_a_checkpoint_takes_the_new_settings(go_on: Any, dataset_root: Path, settings: list[str]) -> None:
    batch, written = go_on(*settings)
    config = PreTrainedConfig.from_pretrained(written)
    assert isinstance(config, MemobenchMemConfig)
    # The batch is what a preprocessor of this configuration makes of the same frames, when it is made anew ...
    meta = LeRobotDataset("memobench/synthetic", root=dataset_root).meta
    dataset = LeRobotDataset(
        "memobench/synthetic", root=dataset_root, delta_timestamps=resolve_delta_timestamps(config, meta)
    )
    policy = MemobenchMemPolicy.from_pretrained(written, config=config, dataset_meta=meta)
    fresh, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    expected = fresh(batch_of(dataset, batch["index"].tolist()))
    assert {key for key in batch if key.startswith("memory.")} == {key for key in expected if key.startswith("memory.")}
    for key in (*(key for key in batch if key.startswith("memory.")), "phase", "observation.state", "action"):
        assert torch.equal(batch[key], expected[key]), key
    assert batch["observation.language.tokens"].shape == expected["observation.language.tokens"].shape
    # ... and the checkpoint it writes says so.
    steps = json.loads((written / "policy_preprocessor.json").read_text())["steps"]
    saved = {step["registry_name"]: step["config"] for step in steps}
    assert saved["memobench_gather_memory"].items() <= gathering(config).items()
    assert saved["memobench_oracle_memory"] == {"enabled": config.oracle_memory}
    if config.align != "none":
        assert config.align_weight == MemobenchMemConfig(device="cpu", align=config.align).align_weight > 0


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
    with pytest.raises(MemobenchError, match=r"oracle_memory=True would have no effect.*base_weights"):
        go_on("oracle_memory=true", source=old)
    relative = _edited(start, tmp_path / "relative", relative_actions_processor={"enabled": True})
    with pytest.raises(MemobenchError, match=r"use_relative_actions=False would have no effect"):
        go_on(source=relative)
    with pytest.raises(MemobenchError, match=r"tokenizer_name=google/some would have no effect.*words"):
        go_on("tokenizer_name=google/some", source=start)
    config = PreTrainedConfig.from_pretrained(start)
    config.oracle_memory = True  # type: ignore[attr-defined]
    with pytest.raises(MemobenchError, match=r"oracle_memory=True would have no effect"):
        MemobenchMemPolicy.from_pretrained(start, config=config)


@pytest.mark.parametrize("fusion", ["none", "context"])
def test_another_memory_begins_anew_and_says_so(
    dataset_root: Path, start: Path, fusion: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(checkpoints.logger, "warning", lambda text, *of: told.append(text % of))
    meta = LeRobotDataset("memobench/synthetic", root=dataset_root).meta
    config = PreTrainedConfig.from_pretrained(start, cli_overrides=[f"--memory_fusion={fusion}", "--memory_frames=32"])
    policy = MemobenchMemPolicy.from_pretrained(start, config=config, dataset_meta=meta)
    assert "was trained with memory=frames, and this is memory=" in told[0]
    assert policy.average is not None
    with policy.average.applied():
        found = {plain_name(name): tensor.clone() for name, tensor in policy.state_dict().items()}
    held = {plain_name(name): tensor for name, tensor in load_file(start / "model.safetensors").items()}
    of_memory = {name for name in found if "memory" in name or ".modulator." in name}
    assert bool(of_memory) == (fusion == "context")
    assert all(torch.equal(found[name], held[name]) for name in found.keys() - of_memory)
    drawn = [found[name] for name in of_memory if name.startswith("model.memory.encoder.")]
    assert all(weight.isfinite().all() and weight.any() for weight in drawn)


def test_another_head_keeps_the_average_of_everything_else(dataset_root: Path, start: Path) -> None:
    meta = LeRobotDataset("memobench/synthetic", root=dataset_root).meta
    same = MemobenchMemPolicy.from_pretrained(start, dataset_meta=meta).average
    config = PreTrainedConfig.from_pretrained(start)
    config.align, config.align_weight = "framewise", 0.05  # type: ignore[attr-defined]
    policy = MemobenchMemPolicy.from_pretrained(start, config=config, dataset_meta=meta)
    assert policy.average is not None
    assert same is not None
    assert policy.average.updates == same.updates == 1
    assert policy.average.average.keys() - same.average.keys() == {"alignment.project.weight", "alignment.project.bias"}
    for name, tensor in same.average.items():
        assert torch.equal(policy.average.average[name], tensor), name
        assert torch.equal(policy.average.parameters[name], same.parameters[name]), name
