"""Settings of ``memobench_mem``: defaults of each size and of the paper, refusals, and the effect of every field."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies.rtc.configuration_rtc import RTCConfig

import lerobot_policy_memobench  # noqa: F401  (registers the environment)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import configuration_memobench_mem
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    MAY_DIFFER,
    MEMORY_FUSIONS,
    READERS,
    SIZES,
    Gemma,
    MemobenchMemConfig,
    UnreadError,
)
from lerobot_memobench.policies.memobench_mem.memory import OURS, find_mechanism, read_settings
from lerobot_memobench.policies.memobench_mem.network import FUSIONS
from lerobot_memobench.run.arguments import recipe_file
from lerobot_memobench.training.loop import make_sampler
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import Samples, batch_of, open_small_training, train_config

OBJECTS = {"size": "small", "perception": "objects"}


def config(**fields: Any) -> MemobenchMemConfig:
    return MemobenchMemConfig(device="cpu", **fields)


# -- defaults ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        (
            {"size": "tiny"},
            {"objective": "flow_matching", "num_inference_steps": 10, "chunk_size": 50, "ema_decay": 0.999}
            | {"memory_stride": 1, "frames_per_episode": 1, "tokens_per_frame": 16, "task_weights": None},
        ),
        (
            OBJECTS,
            {"objective": "regression", "num_inference_steps": 1, "chunk_size": 16, "ema_decay": 0.995}
            | {"memory_stride": 8, "frames_per_episode": 6, "tokens_per_frame": 2, "task_weights": {}}
            | {"n_action_steps": 6, "optimizer_lr": 1e-3, "optimizer_weight_decay": 1e-4, "visual_encoder": None},
        ),
        (
            {"size": "small"},
            {"visual_encoder": "package", "memory_stride": 8, "frames_per_episode": 6, "tokens_per_frame": 16},
        ),
        (
            {"size": "pi05", "align": "contrastive"},
            {"chunk_size": 50, "ema_decay": 0.999, "image_resolution": (224, 224), "visual_encoder": None}
            | {"optimizer_lr": 5e-5, "optimizer_betas": (0.9, 0.95), "optimizer_weight_decay": 0.0},
        ),
    ],
    ids=["tiny", "objects", "small", "pi05"],
)
def test_defaults_of_each_size(fields: dict[str, Any], expected: dict[str, Any], tmp_path: Path) -> None:
    made = config(**fields)
    assert {name: getattr(made, name) for name in expected} == expected
    assert made.memory_settings == {"frames": 32, "content": True}
    given = config(**fields, chunk_size=8, ema_decay=0.0)
    assert (given.chunk_size, given.ema_decay) == (8, 0.0)
    assert given.n_action_steps == min(8, made.n_action_steps)
    given.save_pretrained(tmp_path)
    again = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--n_action_steps=5"])
    assert dataclasses.asdict(again) == dataclasses.asdict(given) | {"n_action_steps": 5}


def test_defaults_of_each_memory() -> None:
    assert {*FUSIONS, "own"} == set(MEMORY_FUSIONS)
    for name in OURS:
        made = config(memory=name)
        assert (made.memory_fusion == "own") == (find_mechanism(name).fusion is not None)
        assert made.memory_settings == vars(read_settings(name, {}))
    without = config(memory="none")
    assert (without.memory_fusion, without.memory_settings) == (None, {})


def test_fields_of_lerobots_main_are_not_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot 0.6.1 would refuse them in a checkpoint."""
    monkeypatch.setattr(configuration_memobench_mem, "PI05_ALONE", ("compile_mode",))
    config().save_pretrained(tmp_path)
    assert "compile_mode" not in json.loads((tmp_path / "config.json").read_text())
    assert PreTrainedConfig.from_pretrained(tmp_path) == config()


@pytest.mark.parametrize(("fields", "last"), [({"size": "tiny"}, 1.0), (OBJECTS, 0.02)])
def test_learning_rate_warms_up_then_stays_or_falls(fields: dict[str, Any], last: float) -> None:
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = config(**fields).get_scheduler_preset().build(optimizer, num_training_steps=200)
    rates = [schedule.lr_lambdas[0](step) for step in range(201)]
    assert rates[:3] == pytest.approx([0.1, 0.2, 0.3], abs=1e-3)
    assert rates[100] == pytest.approx((1 + last) / 2)
    assert rates[200] == pytest.approx(last)
    assert rates[10:] == sorted(rates[10:], reverse=True)


@pytest.mark.parametrize(("kind", "fused"), [("cuda", True), ("cpu", True), ("mps", None)])
def test_optimizer_is_fused(kind: str, fused: bool | None, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[dict[str, Any]] = []
    monkeypatch.setattr(configuration_memobench_mem, "AdamW", lambda *_, **options: made.append(options))
    parameters: Any = [SimpleNamespace(device=SimpleNamespace(type=kind))] * 2
    config().get_optimizer_preset().build(parameters)
    assert made == [{"fused": fused}]


ROWS: dict[str, list[str]] = {
    "memory": [],
    "none": ["policy.memory=none"],
    "oracle memory": ["policy.memory=none", "policy.oracle_memory=true"],
    "shuffled": ["policy.align=contrastive", "policy.subgoal_level=coarse", "policy.shuffle_subgoals=true"],
    "random referents": ["env.type=memobench", "env.referent=random"],
}


@pytest.mark.parametrize("row", ROWS)
def test_recipe_has_the_papers_values(row: str) -> None:
    flags = [f"--{word}" for word in ("policy.device=cpu", "output_dir=/tmp/never-made", *ROWS[row])]
    recipe: Any = TrainPipelineConfig.from_pretrained(recipe_file("train_paper"), cli_args=flags)
    recipe.validate()  # sets the policy's presets
    optimizer, schedule, policy = recipe.optimizer, recipe.scheduler, recipe.policy
    assert (optimizer.lr, optimizer.betas, optimizer.weight_decay) == (5e-5, (0.9, 0.95), 0.0)
    assert optimizer.grad_clip_norm == 1.0
    assert (schedule.type, schedule.warmup_fraction) == ("memobench_constant_with_warmup", 0.05)
    assert (recipe.batch_size, recipe.steps, recipe.save_freq) == (64, 80_000, 10_000)
    assert (policy.size, policy.dtype, policy.ema_decay) == ("pi05", "bfloat16", 0.999)
    assert policy.gradient_checkpointing
    assert policy.memory_settings == ({} if policy.memory == "none" else {"frames": 32, "content": True})
    for override in ROWS[row]:
        key, _, value = override.partition("=")
        section, field = key.split(".")
        assert str(getattr(getattr(recipe, section), field)).lower() == value


# -- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"align": "contrstive"}, "contrastive"),
        ({"size": "tny"}, "tiny"),
        ({"perception": "object"}, "objects"),
        ({"subgoal_level": "middle"}, "intermediate"),
        ({"memory_fusion": "modulate"}, "modulation"),
        ({"memory_fusion": "none"}, "memory_fusion"),
        ({"memory_fusion": "own"}, "memory_fusion=own"),
        ({"memory": "subgoal", "memory_fusion": "context"}, "memory_fusion=own"),
        ({"memory": "bnak"}, "bnak.*bank"),
        ({"memory_settings": {"frame": 4}}, "'frame'.*memory=frames.*frames"),
        ({"memory_settings": {"frames": "many"}}, "frames='many'.*int"),
        ({"memory_settings": {"frames": 0}}, "frames=0"),
        ({"memory": "bank", "memory_settings": {"length": True}}, "length=True.*int"),
        ({"memory": "bank", "memory_settings": {"length": None}}, "length=None.*int"),
        ({"memory": "recurrent", "memory_settings": {"slots": 0}}, "slots=0"),
        ({"memory": "fast_weights", "memory_settings": {"gradient_frames": 0}}, "gradient_frames=0"),
        ({"memory": "none", "memory_settings": {"frames": 4}}, "memory_settings"),
        ({"memory": "none", "memory_fusion": "context"}, "memory_fusion"),
        ({"memory": "none", "align": "semantic"}, "align=semantic"),
        ({"memory": "keyframes", "align": "semantic"}, "memory=keyframes"),
        ({"memory": "bank", "align": "framewise"}, "memory=bank"),
        ({"memory_stride": 0}, "memory_stride=0"),
        ({"frames_per_episode": 0}, "frames_per_episode=0"),
        ({"ema_decay": 1.0}, "ema_decay=1.0"),
        ({"ema_decay": float("nan")}, "ema_decay=nan"),
        ({"warmup_fraction": 2.0}, "warmup_fraction=2.0"),
        ({"task_weights": {"prompted": -1.0}}, "task_weights"),
        (OBJECTS | {"detection_noise": -1.0}, "detection_noise=-1.0"),
        ({"image_resolution": (100, 100)}, "image_resolution.*48"),
    ],
)
def test_bad_values_are_refused(fields: dict[str, Any], named: str) -> None:
    with pytest.raises(MemobenchError, match=named):
        config(**fields)


@pytest.mark.parametrize(
    ("name", "fields"),
    [(name, OBJECTS) for name in ("visual_encoder", "image_resolution", "empty_cameras")]
    + [(name, {"size": "tiny"}) for name in ("max_state_dim", *READERS["perception=objects"][1].split())]
    + [("image_resolution", {"size": "small"})]
    + [(name, {"memory": "none"}) for name in (*READERS["a memory"][1].split(), "memory_phase")]
    + [(name, OBJECTS) for name in READERS["objective=flow_matching"][1].split()]
    + [(name, {}) for name in ("text_encoder", "subgoal_level", "subgoals", "scheduler_decay_lr", "n_obs_steps")],
)
def test_settings_without_effect_are_refused(name: str, fields: dict[str, Any]) -> None:
    plain = config(**fields)
    assert config(**fields | {name: getattr(plain, name)}) == plain, "defaults may be given"
    with pytest.raises(UnreadError, match=f"policy.{name}=") as refused:
        config(**fields | {name: other(name, getattr(plain, name))})
    assert config(**fields | {name: refused.value.defaults[name]}) == plain


def test_default_settings_of_another_memory_are_replaced() -> None:
    """A checkpoint's settings are merged with those of the command."""
    had = config().memory_settings
    for name in set(OURS) - {"frames", "subgoal"}:  # these two have the same settings
        assert config(memory=name, memory_settings=had).memory_settings == vars(read_settings(name, {}))
    kept = {"frames": 4, "content": False}
    assert config(memory="subgoal", memory_settings=kept).memory_settings == kept
    assert config(memory="bank", memory_settings={**kept, "length": 4}).memory_settings == {"length": 4}
    assert config(memory="none", memory_settings=had).memory_settings == {}
    with pytest.raises(MemobenchError, match=r"'content'.*memory=bank"):
        config(memory="bank", memory_settings={"content": True, "length": 4})


def test_fields_that_training_fixes() -> None:
    made = config()
    names = {one.name for one in dataclasses.fields(made)}
    assert names - MAY_DIFFER == set(made.fixed_by_training) == set(made.kept_since_begun)
    assert {"n_action_steps", "device", "dtype", "detector"} <= MAY_DIFFER
    assert {"memory", "memory_settings", "align", "chunk_size", "optimizer_lr"} <= set(made.fixed_by_training)


# -- the effect of every field -------------------------------------------------------------------------------------

STRIDED = OBJECTS | {"memory_stride": 2}
BASES: dict[str, dict[str, Any]] = {
    "regression": STRIDED,
    "flow matching, aligned": {
        **STRIDED,
        **{"objective": "flow_matching", "align": "contrastive", "shuffle_subgoals": True},
        **{"num_inference_steps": 2, "use_relative_actions": True},
    },
    "no memory": OBJECTS | {"memory": "none"},
    "privileged": STRIDED | {"memory": "subgoal"},
    "pixels": {"size": "tiny", "num_inference_steps": 2},
}
OTHERS: dict[str, Any] = {
    "size": {"small": "tiny", "tiny": "small"},
    "perception": {"pixels": "objects", "objects": "pixels"},
    "objective": {"regression": "flow_matching", "flow_matching": "regression"},
    "ema_decay": 0.0,
    "object_classes": ["knob"],
    "align": "semantic",
    "text_encoder": "labels",
    "memory": "bank",
    "memory_settings": {"no_such": 1},
    "memory_fusion": "context",
    "subgoals": {"do it": ["it is done"]},
    "subgoal_level": "coarse",
    "memory_camera": "observation.images.no_such",
    "task_weights": {"prompted": 9.0},
    "detector": "no such file",
    "visual_encoder": "no such encoder",
    "base_weights": "no such folder",
    "normalization_mapping": dict.fromkeys(("STATE", "ACTION", "VISUAL"), NormalizationMode.IDENTITY),
    "image_resolution": (144, 144),
    "tokenizer_max_length": 3,
    "tokenizer_name": "no such tokenizer",
    "dtype": "bfloat16",
    "rtc_config": RTCConfig(),
    "paligemma_variant": "gemma_300m",
    "action_expert_variant": "gemma_2b",
    "optimizer_betas": (0.5, 0.6),
}
LEROBOTS = (
    *("device", "push_to_hub", "repo_id", "private", "tags", "license", "pretrained_path", "pretrained_revision"),
    *("use_peft", "output_features", "input_features", "action_feature_names", "use_amp", "rtc_config"),
    *("relative_exclude_joints", "compile_model", "compile_mode"),
)
"""Fields that LeRobot reads or writes, or that change results by rounding only."""


def other(name: str, value: Any) -> Any:
    """Return another value of a field."""
    found = OTHERS.get(name)
    if name in ("size", "objective", "perception"):
        return found[value]
    if found is not None:
        return found
    if isinstance(value, bool):
        return not value
    assert isinstance(value, int | float), f"OTHERS needs a value of {name}"
    return value + 1 if isinstance(value, int) else 0.5 * value + 0.1


@pytest.fixture
def narrow() -> Iterator[None]:
    """Two transformers of one narrow layer."""
    gemma = Gemma(width=32, depth=1, mlp_dim=32, num_heads=8, num_kv_heads=1, head_dim=8)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("small", "tiny"):
            patch.setitem(SIZES, name, dataclasses.replace(SIZES[name], vlm=gemma, expert=gemma))
        yield


def effects(root: Path, fields: Mapping[str, Any]) -> str:
    """Return a hash of the sampler, the optimizer, two updates and a rollout of a policy."""
    made = config(push_to_hub=False, **fields)
    training = open_small_training(root, made)
    policy, (before, after), dataset = training.policy, training.processors, Samples(training)
    sampler = make_sampler(train_config(root, made), training)
    settings = made.get_optimizer_preset()
    optimizer = settings.build(policy.get_optim_params())
    rates = made.get_scheduler_preset().build(optimizer, 40).lr_lambdas[0]
    seen: list[Any] = [
        [sampler.together, sampler.order(0), sampler.starts, sampler.weights],
        vars(settings),
        [rates(step) for step in range(40)],
        policy.model.gradient_checkpointing_enabled,
    ]
    batch = before(batch_of(dataset, [8, 12, 60, 90]))
    for _ in range(2):
        loss, _ = policy.train().forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        seen.append(loss.item())
    frame = {
        key: value[None] if isinstance(value, torch.Tensor) else value
        for key, value in dataset[60].items()
        if (key.startswith("observation.") and not key.endswith("_is_pad")) or key == "task"
    }
    policy.reset()
    for step in range(20):
        clock = {"observation.step": torch.tensor([float(step)]), "observation.phase": torch.tensor([float(step > 2)])}
        if "observation.state" in frame:  # a hand that moves
            frame["observation.state"] = frame["observation.state"] + 0.01
        seen.append(after(policy.select_action(before({**frame, **clock}))).float().numpy())
        seen.append([len(row.queue) for row in policy.rollout.rows])
    return hashlib.sha256(pickle.dumps(seen)).hexdigest()


@pytest.mark.slow
@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("base", BASES)
def test_every_setting_has_an_effect_or_is_refused(
    base: str, dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    roots = {True: make_object_dataset(tmp_path / "data", repeats=2, records=True), False: dataset_root}
    monkeypatch.chdir(tmp_path)
    fields = BASES[base]
    known = config(push_to_hub=False, **fields)
    plain = effects(roots[known.uses_objects], fields)
    assert plain == effects(roots[known.uses_objects], fields), "the hash must be repeatable"
    idle = []
    for one in dataclasses.fields(known):
        if one.name in LEROBOTS:
            continue
        changed = {**fields, one.name: other(one.name, getattr(known, one.name))}
        try:
            if effects(roots[config(**changed).uses_objects], changed) == plain:
                idle.append(one.name)
        except (MemobenchError, ValueError):
            continue
    assert idle == []
