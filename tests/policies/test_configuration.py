"""Settings of ``memobench_mem``: defaults of each size and of the paper, refusals, and the effect of every field."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

import lerobot_policy_memobench  # noqa: F401  (registers the environment)
from lerobot_memobench.commands.command_line import parse_words, read_words, recipe_file
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import SHIPPED
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    ALIGN_TARGETS,
    SUPERVISED,
    MemobenchMemConfig,
    conditions,
)
from lerobot_memobench.policies.memobench_mem.memory import OURS, mechanism_settings
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.training.command import complete_training

OBJECTS = {"size": "small", "perception": "objects"}


def config(**fields: Any) -> MemobenchMemConfig:
    return MemobenchMemConfig(device="cpu", **fields)


# -- defaults ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fields", [{"size": "tiny"}, OBJECTS, {"size": "pi05", "align": "contrastive"}])
def test_given_settings_replace_defaults_of_the_size_and_are_saved(fields: dict[str, Any], tmp_path: Path) -> None:
    made, given = config(**fields), config(**fields, chunk_size=8, ema_decay=0.0)
    assert made.chunk_size != 8
    assert (given.chunk_size, given.ema_decay) == (8, 0.0)
    assert given.n_action_steps == min(8, made.n_action_steps)
    given.save_pretrained(tmp_path)
    again = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--n_action_steps=5"])
    assert dataclasses.asdict(again) == dataclasses.asdict(given) | {"n_action_steps": 5}


@pytest.mark.parametrize(("fields", "last"), [({"size": "tiny"}, 1.0), (OBJECTS, 0.02)])
def test_learning_rate_warms_up_then_stays_or_falls(fields: dict[str, Any], last: float) -> None:
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = config(**fields).get_scheduler_preset().build(optimizer, num_training_steps=200)
    rates = [schedule.lr_lambdas[0](step) for step in range(201)]
    assert rates[:3] == pytest.approx([0.1, 0.2, 0.3], abs=1e-3)
    assert rates[100] == pytest.approx((1 + last) / 2)
    assert rates[200] == pytest.approx(last)
    assert rates[10:] == sorted(rates[10:], reverse=True)


@pytest.mark.parametrize("memory", ["frames", "none"])
def test_recipe_has_the_papers_values(memory: str) -> None:
    flags = ["--policy.device=cpu", "--output_dir=/tmp/never-made", f"--policy.memory={memory}"]
    recipe: Any = TrainPipelineConfig.from_pretrained(recipe_file("train_paper"), cli_args=flags)
    recipe.validate()  # sets the policy's presets
    optimizer, schedule, policy = recipe.optimizer, recipe.scheduler, recipe.policy
    assert (optimizer.lr, optimizer.betas, optimizer.weight_decay) == (5e-5, (0.9, 0.95), 0.0)
    assert optimizer.grad_clip_norm == 1.0
    assert (schedule.type, schedule.warmup_fraction) == ("memobench_constant_with_warmup", 0.05)
    assert (recipe.batch_size, recipe.steps, recipe.save_freq) == (64, 80_000, 10_000)
    assert (policy.size, policy.dtype, policy.ema_decay) == ("pi05", "bfloat16", 0.999)
    assert policy.gradient_checkpointing
    assert policy.memory_settings == ({} if memory == "none" else {"frames": 32, "content": True})


# -- the mark of supervision with the answer -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "marked"),
    [
        *(({"memory": memory}, memory in ("subgoal", "keyframes")) for memory in (*OURS, "none")),
        *(({"align": align}, True) for align in ("semantic", "contrastive", "framewise")),
        *(({"align": "contrastive", "align_targets": name}, name != "progress") for name in ALIGN_TARGETS),
        ({"align": "contrastive", "text_encoder": "labels"}, True),
    ],
)
def test_policy_that_learns_from_the_answer_is_marked_for_good(
    fields: dict[str, Any], marked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = config(**fields)
    assert made.supervised_with_answer is marked
    made.save_pretrained(tmp_path)
    later = ["--align=none", "--memory=frames", "--align_targets=subgoals", "--text_encoder=null", "--subgoals=null"]
    later += ["--memory_settings={}", "--memory_fusion=null"]
    assert PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=later).supervised_with_answer is marked
    monkeypatch.setattr(ModelCard, "validate", lambda card: None)  # by the hub
    policy = MemobenchMemPolicy.__new__(MemobenchMemPolicy)
    torch.nn.Module.__init__(policy)
    policy.config = made
    assert (SUPERVISED in str(policy.generate_model_card("user/data", made.type, None, None))) is marked


def test_training_from_a_marked_checkpoint_keeps_the_mark(tmp_path: Path) -> None:
    """The shipped policy learned by alignment; files of earlier versions lack the setting."""
    source = Path(shutil.copytree(SHIPPED / "memobench_strict", tmp_path / "older"))
    config = json.loads((source / "config.json").read_text())
    assert config.pop("supervised_with_answer")
    (source / "config.json").write_text(json.dumps(config))

    def asked(*words: str) -> Any:
        words = (f"policy={words[0]}", "align=none", "device=cpu", *words[1:])
        return complete_training(read_words("train", parse_words(words))).policy

    assert asked("memobench_strict").supervised_with_answer
    assert asked(str(source)).supervised_with_answer
    assert not asked("memobench_strict_memoryless").supervised_with_answer
    with pytest.raises(MemobenchError, match=r"follows from policy\.align"):
        asked(str(source), "policy.supervised_with_answer=false")
    later: Any = PreTrainedConfig.from_pretrained(source, cli_overrides=["--align=none", "--device=cpu"])
    based = dataclasses.replace(later, base_weights=str(source))
    assert MemobenchMemPolicy(based).config.supervised_with_answer, "as base weights"
    assert MemobenchMemPolicy.from_pretrained(source, config=later, dataset_meta=object()).config.supervised_with_answer


# -- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"align": "contrstive"}, "contrastive"),
        ({"memory_fusion": "own"}, "memory_fusion=own"),
        ({"memory": "subgoal", "memory_fusion": "context"}, "memory_fusion=own"),
        ({"memory": "bnak"}, "bnak.*bank"),
        ({"memory_settings": {"frame": 4}}, "'frame'.*memory=frames.*frames"),
        ({"memory_settings": {"frames": 0}}, "frames=0"),
        ({"memory": "bank", "memory_settings": {"length": True}}, "length=True.*int"),
        ({"memory": "none", "memory_settings": {"frames": 4}}, "memory_settings"),
        ({"memory": "none", "memory_fusion": "context"}, "memory_fusion"),
        ({"memory": "none", "align": "semantic"}, "align=semantic"),
        ({"memory": "keyframes", "align": "semantic"}, "memory=keyframes"),
        ({"memory": "bank", "align": "framewise"}, "memory=bank"),
        ({"memory_stride": 0}, "memory_stride=0"),
        ({"chunk_size": 4, "n_action_steps": 5}, "n_action_steps=5.* 4 actions"),
        ({"n_obs_steps": 2}, "n_obs_steps=2"),
        ({"ema_decay": float("nan")}, "ema_decay=nan"),
        ({"task_weights": {"prompted": -1.0}}, "task_weights"),
    ],
)
def test_bad_values_are_refused(fields: dict[str, Any], named: str) -> None:
    with pytest.raises(MemobenchError, match=named):
        config(**fields)


def used_if(feature: str) -> list[str]:
    return [name for name, one in conditions().items() if one.name == feature]


@pytest.mark.parametrize(
    ("name", "fields"),
    [("visual_encoder", OBJECTS)]
    + [(name, {"size": "tiny"}) for name in ("max_state_dim", *used_if("perception=objects"))]
    + [(name, {"memory": "none"}) for name in (*used_if("a memory"), "memory_phase")]
    + [(name, OBJECTS) for name in used_if("objective=flow_matching")]
    + [(name, {}) for name in ("text_encoder", "subgoal_level", "subgoals")],
)
def test_settings_without_effect_are_refused(name: str, fields: dict[str, Any]) -> None:
    plain = config(**fields)
    assert config(**fields | {name: getattr(plain, name)}) == plain, "defaults may be given"
    with pytest.raises(MemobenchError, match=f"policy.{name}=.*no effect"):
        config(**fields | {name: other(name, getattr(plain, name))})
    unset = next(setting for setting in dataclasses.fields(plain) if setting.name == name)
    default = unset.default if unset.default_factory is dataclasses.MISSING else unset.default_factory()
    assert config(**fields | {name: default}) == plain


def test_default_settings_of_another_memory_are_replaced() -> None:
    """A checkpoint's settings are merged with those of the command."""
    had = config().memory_settings
    for name in set(OURS) - {"frames", "subgoal"}:  # these two have the same settings
        assert config(memory=name, memory_settings=had).memory_settings == vars(mechanism_settings(name, {}))
    kept = {"frames": 4, "content": False}
    assert config(memory="subgoal", memory_settings=kept).memory_settings == kept
    assert config(memory="bank", memory_settings={**kept, "length": 4}).memory_settings == {"length": 4}
    assert config(memory="none", memory_settings=had).memory_settings == {}
    with pytest.raises(MemobenchError, match=r"'content'.*memory=bank"):
        config(memory="bank", memory_settings={"content": True, "length": 4})


# -- the effect of every field -------------------------------------------------------------------------------------

OTHERS: dict[str, Any] = {
    "task_weights": {"prompted": 9.0},
    "detector": "no such file",
    "visual_encoder": "no such encoder",
    "object_classes": ["knob"],
    "memory_fusion": "context",
    "memory_settings": {"no_such": 1},
    "subgoals": {"do it": ["it is done"]},
    "subgoal_level": "coarse",
    "text_encoder": "labels",
    "memory_camera": "observation.images.no_such",
}


def other(name: str, value: Any) -> Any:
    found = OTHERS.get(name)
    if found is not None:
        return found
    if isinstance(value, bool):
        return not value
    assert isinstance(value, int | float), f"OTHERS needs a value of {name}"
    return value + 1 if isinstance(value, int) else 0.5 * value + 0.1
