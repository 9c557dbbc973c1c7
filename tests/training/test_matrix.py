"""Every memory and every input: a training saves, resumes to the bit in its second epoch, and its checkpoint acts."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.policies import make_pre_post_processors
from safetensors import safe_open
from safetensors.torch import load_file

from lerobot_memobench.constants import OBS_PHASE, OBS_STEP
from lerobot_memobench.policies.memobench_mem.memory import NONE, OURS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.training.loop import TRAINING_FILE, TrainingState
from tests.training.conftest import hashes, read_losses

SEEN = {
    "objects": ("perception=objects", "size=tiny", "batch_size=50", "policy.chunk_size=4"),
    "pixels": (
        *("perception=pixels", "size=tiny", "batch_size=2", "num_workers=0", "policy.chunk_size=4"),
        "dataset.image_transforms.enable=true",
    ),
}
ROLLED = ("env.obs_type=environment_state_agent_pos", "env_eval_freq=1", "eval.n_episodes=1", "eval.batch_size=1")
DEFAULT = {("pixels", "frames"), ("objects", "bank"), ("objects", "subgoal")}
CASES = [
    pytest.param(seen, memory, marks=() if (seen, memory) in DEFAULT else pytest.mark.slow)
    for seen in SEEN
    for memory in (NONE, *OURS)
]


@pytest.mark.parametrize(("seen", "memory"), CASES)
def test_training_saves_resumes_to_the_bit_and_acts(
    seen: str, memory: str, objects: Path, synthetic: Path, tmp_path: Path, train: Callable[..., None]
) -> None:
    root = objects if seen == "objects" else synthetic
    words = ("policy=memobench_mem", *SEEN[seen], f"policy.memory={memory}", f"dataset={root}", "log_freq=1")
    run, again = tmp_path / "run", tmp_path / "again"
    train(*words, f"output_dir={run}", "steps=4", "save_freq=3")
    shutil.copytree(run, again, symlinks=True)
    shutil.rmtree(again / "checkpoints/000004")
    (again / "checkpoints/last").unlink()
    train(f"output_dir={again}", "resume=true")
    straight = hashes(run / "checkpoints/000004")
    assert len(straight) > 100
    assert hashes(again / "checkpoints/000004") == straight
    losses = [row for row in read_losses(run) if row[2] == "action_loss"]
    assert [row[0] for row in losses] == [1, 2, 3, 4]
    assert [row for row in read_losses(again) if row[2] == "action_loss"] == losses

    checkpoint = run / "checkpoints/last/pretrained_model"
    saved, trained = load_file(checkpoint / "model.safetensors"), load_file(checkpoint / TRAINING_FILE)
    averaged = [name.removeprefix("weights.") for name in trained if name.startswith("weights.")]
    assert any(not torch.equal(saved[name], trained[f"weights.{name}"]) for name in averaged)
    policy = MemobenchMemPolicy.from_pretrained(checkpoint)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    for step in range(3):
        action = after(policy.select_action(before(observation(policy, step))))
        assert action.shape == (1, 7)
        assert action.isfinite().all()


def test_interrupted_rollouts_are_made_up_for(
    objects: Path, tmp_path: Path, train: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def evaluate(_: Any, step: int) -> dict[str, Any]:
        asked.append(step)
        if len(asked) == 2:
            raise Killed
        return {"overall": {"avg_sum_reward": 0.0, "pc_success": 50.0, "eval_s": 1.0}}

    asked: list[int] = []
    monkeypatch.setattr(TrainingState, "evaluate", evaluate)
    words = (
        "policy=memobench_mem",
        *SEEN["objects"],
        "policy.memory=none",
        f"dataset={objects}",
        "steps=2",
        "save_freq=1",
    )
    with pytest.raises(Killed):
        train(*words, f"output_dir={tmp_path / 'run'}", "env=memobench", *ROLLED)
    for _ in range(2):
        train(f"output_dir={tmp_path / 'run'}", "resume=true")
    assert asked == [1, 2, 2]  # once more, and not once more again
    rates = [row[0] for row in read_losses(tmp_path / "run") if row[2] == "pc_success"]
    assert rates == [1, 2]


def observation(policy: Any, step: int) -> dict[str, Any]:
    features = policy.config.input_features.items()
    found: dict[str, Any] = {name: torch.full((1, *feature.shape), 0.1) for name, feature in features}
    return found | {OBS_PHASE: torch.ones(1, 1), OBS_STEP: torch.full((1, 1), step), "task": ["open the drawer"]}


def test_held_out_loss_is_logged(objects: Path, tmp_path: Path, train: Callable[..., None]) -> None:
    held_out = ("dataset.eval_split=0.3", "eval_steps=2", "max_eval_samples=20")
    words = ("policy=memobench_mem", *SEEN["objects"], f"dataset={objects}", *held_out)
    train(*words, f"output_dir={tmp_path / 'run'}", "steps=4", "policy.ema_decay=0.5")
    found = [row for row in read_losses(tmp_path / "run") if row[1:3] == ("eval", "eval_loss")]
    assert [row[0] for row in found] == [2, 4]
    assert all(0 < row[3] < 100 for row in found)


@pytest.fixture(scope="module")
def begun(objects: Path, tmp_path_factory: pytest.TempPathFactory, train: Callable[..., None]) -> Path:
    out = tmp_path_factory.mktemp("begun") / "run"
    train("policy=memobench_mem", *SEEN["objects"], f"dataset={objects}", f"output_dir={out}", "steps=2")
    return out / "checkpoints/last/pretrained_model"


def test_new_memory_on_a_checkpoint(begun: Path, objects: Path, tmp_path: Path, train: Callable[..., None]) -> None:
    """Another memory starts from its initial weights; everything else continues, its average as well."""
    out = f"output_dir={tmp_path / 'run'}"
    train(f"policy={begun}", *SEEN["objects"][2:], f"dataset={objects}", "policy.memory=bank", out, "steps=1")
    made = tmp_path / "run/checkpoints/last/pretrained_model"
    assert MemobenchMemPolicy.from_pretrained(made).config.memory == "bank"
    with safe_open(made / TRAINING_FILE, framework="pt") as file:
        counts = file.metadata()
    assert counts["updates"] == "3"
    assert any(name.startswith("updates.model.memory.") and value == "1" for name, value in counts.items())


def test_adapters_are_trained_on_a_checkpoint(
    begun: Path, objects: Path, tmp_path: Path, train: Callable[..., None]
) -> None:
    out = f"output_dir={tmp_path / 'run'}"
    train(f"policy={begun}", *SEEN["objects"][2:], f"dataset={objects}", "peft.method_type=LORA", out, "steps=1")
    made = tmp_path / "run/checkpoints/last/pretrained_model"
    assert (made / "adapter_model.safetensors").is_file()
    assert not (made / TRAINING_FILE).exists()


@pytest.mark.parametrize(
    "align", ["contrastive", *(pytest.param(align, marks=pytest.mark.slow) for align in ("semantic", "framewise"))]
)
def test_alignments_log_their_loss(align: str, objects: Path, tmp_path: Path, train: Callable[..., None]) -> None:
    words = ("policy=memobench_mem", *SEEN["objects"], f"align={align}", f"dataset={objects}", "log_freq=1")
    train(*words, f"output_dir={tmp_path / 'run'}", "steps=1")
    names = {row[2] for row in read_losses(tmp_path / "run")}
    assert {"action_loss", "align_loss", "align_grad_norm", "align_top1"} <= names
