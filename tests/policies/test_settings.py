"""Every setting of ``memobench_mem`` changes something, or is refused: each field is changed in turn."""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import NormalizationMode
from lerobot.policies.rtc.configuration_rtc import RTCConfig

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    PI05_ALONE,
    READERS,
    SIZES,
    Gemma,
    MemobenchMemConfig,
    UnreadError,
)
from lerobot_memobench.training.loop import make_sampler
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import Samples, batch_of, open_small_training, train_config

OBJECTS = {"size": "small", "perception": "objects", "memory_stride": 2}
BASES: dict[str, dict[str, Any]] = {
    "regression": OBJECTS,
    "flow matching, aligned": {
        **OBJECTS,
        **{"objective": "flow_matching", "align": "contrastive", "shuffle_subgoals": True},
        **{"num_inference_steps": 2, "use_relative_actions": True},
    },
    "no memory": {"size": "small", "perception": "objects", "memory": "none"},
    "privileged": OBJECTS | {"memory": "subgoal"},
    "pixels": {"size": "tiny", "num_inference_steps": 2},
}
OTHERS: dict[str, Any] = {
    "size": {"small": "tiny", "tiny": "small"},
    "perception": {"pixels": "objects", "objects": "pixels"},
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
    "objective": {"regression": "flow_matching", "flow_matching": "regression"},
    "task_weights": {"prompted": 9.0},
    "detector": "no such file",
    "visual_encoder": "package",
    "base_weights": "no such folder",
    "normalization_mapping": dict.fromkeys(("STATE", "ACTION", "VISUAL"), NormalizationMode.IDENTITY),
    "image_resolution": (144, 144),
    "tokenizer_max_length": 3,
    "tokenizer_name": "no such tokenizer",
    "dtype": "bfloat16",
    "rtc_config": RTCConfig(),
    "relative_exclude_joints": ["x"],
    "paligemma_variant": "gemma_300m",
    "action_expert_variant": "gemma_2b",
    "compile_mode": "default",
    "input_features": {},
    "output_features": {},
    "optimizer_betas": (0.5, 0.6),
}
LEROBOTS = {
    "device": "make_policy",
    **dict.fromkeys(("push_to_hub", "repo_id", "private", "tags", "license"), "push_model_to_hub"),
    **dict.fromkeys(("pretrained_path", "pretrained_revision", "use_peft", "output_features"), "make_policy"),
    "input_features": "make_policy",
    "action_feature_names": "make_policy",
    "use_amp": "eval_main",
    "rtc_config": "rollout/inference/rtc.py",
    "relative_exclude_joints": "RelativeActionsProcessorStep, of datasets that name their actions",
    **dict.fromkeys(("compile_model", "compile_mode"), "torch.compile, by which results are equal to rounding"),
}
"""Fields that LeRobot reads or writes itself -> where."""


def other(name: str, value: Any) -> Any:
    """Return another value of a field."""
    found = OTHERS.get(name)
    if name in ("size", "objective", "perception"):
        return found[value]
    if found is not None:
        return found
    if isinstance(value, bool):
        return not value
    if value is None:
        return 0.5  # of a weight that the alignment decides
    assert isinstance(value, int | float), f"name another value of {name}"
    return value + 1 if isinstance(value, int) else 0.5 * value + 0.1


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Two transformers of one narrow layer."""
    narrow = Gemma(width=32, depth=1, mlp_dim=32, num_heads=8, num_kv_heads=1, head_dim=8)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("small", "tiny"):
            patch.setitem(SIZES, name, dataclasses.replace(SIZES[name], vlm=narrow, expert=narrow))
        yield


@pytest.fixture(scope="module")
def roots(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Mapping[bool, Path]:
    """Whether objects are seen -> a dataset."""
    objects = make_object_dataset(tmp_path_factory.mktemp("objects") / "data", repeats=2, records=True)
    return {True: objects, False: dataset_root}


def effects(root: Path, fields: Mapping[str, Any]) -> str:
    """Return a hash of all that a training and a rollout of such a policy do."""
    config = MemobenchMemConfig(device="cpu", push_to_hub=False, **fields)
    training = open_small_training(root, config)
    policy, (before, after), dataset = training.policy, training.processors, Samples(training)
    sampler = make_sampler(train_config(root, config), training)
    drawn = [sampler.together, sampler.order(0), sampler.starts, sampler.weights]
    settings = config.get_optimizer_preset()
    optimizer = settings.build(policy.get_optim_params())
    rates = config.get_scheduler_preset().build(optimizer, 40).lr_lambdas[0]
    seen: list[Any] = [
        drawn,
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
        seen.append(after(policy.select_action(before({**frame, **clock}))).float().numpy())
        seen.append([len(row.queue) for row in policy.rollout.rows])
    return hashlib.sha256(pickle.dumps(seen)).hexdigest()


@pytest.mark.slow
@pytest.mark.parametrize("base", BASES)
def test_a_setting_does_something_or_is_refused(
    base: str, roots: Mapping[bool, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fields = BASES[base]
    known = MemobenchMemConfig(device="cpu", push_to_hub=False, **fields)
    plain = effects(roots[known.uses_objects], fields)
    assert plain == effects(roots[known.uses_objects], fields), "the measure itself must be repeatable"
    idle = []
    for one in dataclasses.fields(known):
        if one.name in LEROBOTS:
            continue
        try:
            changed = {**fields, one.name: other(one.name, getattr(known, one.name))}
            if effects(roots[MemobenchMemConfig(device="cpu", **changed).uses_objects], changed) == plain:
                idle.append(one.name)
                print(base, one.name, "does nothing", flush=True)
            else:
                print(base, one.name, "changes something", flush=True)
        except (MemobenchError, ValueError) as error:
            print(base, one.name, "refused:", str(error)[:90], flush=True)
    assert idle == []


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        (name, {"size": "small", "perception": "objects"})
        for name in ("visual_encoder", "image_resolution", "empty_cameras")
    ]
    + [(name, {"size": "tiny"}) for name in ("max_state_dim", *READERS["perception=objects"][1].split())]
    + [(name, {"memory": "none"}) for name in (*READERS["a memory"][1].split(), "memory_frames", "open_gate")]
    + [(name, {"size": "small", "perception": "objects"}) for name in READERS["objective=flow_matching"][1].split()]
    + [(name, {}) for name in READERS["policy=pi05"][1].split() if name not in PI05_ALONE]
    + [(name, {}) for name in ("text_encoder", "subgoal_level", "subgoals")]
    + [("memory_frames", {"memory": "bank"}), ("open_gate", {"memory_fusion": "context"})]
    + [
        ("relative_exclude_joints", {}),
        ("memory_phase", {"memory": "none"}),
    ],
)
def test_a_setting_that_nothing_reads_is_refused(name: str, fields: dict[str, Any]) -> None:
    """Its default is taken, as a recipe or a checkpoint may hold it."""
    plain = MemobenchMemConfig(device="cpu", **fields)
    MemobenchMemConfig(device="cpu", **fields | {name: getattr(plain, name)})
    with pytest.raises(UnreadError, match=f"policy.{name}=") as refused:
        MemobenchMemConfig(device="cpu", **fields | {name: other(name, getattr(plain, name))})
    default = refused.value.defaults[name]
    assert MemobenchMemConfig(device="cpu", **fields | {name: default}) == plain
