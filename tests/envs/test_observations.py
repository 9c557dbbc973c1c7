"""Inputs of policies: the observation kind that each needs, and their names in reports."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config

from lerobot_memobench.constants import CAMERAS
from lerobot_memobench.envs.observations import Observer, check_obs_type, obs_type_of, policy_inputs
from lerobot_memobench.envs.settings import BOTH, DEFAULTS, OBJECTS, OBS_TYPES, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines import MemobenchExpertConfig, MemobenchRandomConfig, UntrainedConfig
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.remote import RemoteConfig
from lerobot_memobench.sim.object_layout import SIZE

STATE = {"observation.state": PolicyFeature(FeatureType.STATE, (8,))}
SLOTS = {"observation.environment_state": PolicyFeature(FeatureType.ENV, (SIZE,))}
IMAGE = {"observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 256, 256))}
POSES = "privileged object state"


def config(kind: type, *inputs: dict[str, PolicyFeature]) -> Any:
    return kind(device="cpu", push_to_hub=False, input_features={k: v for each in inputs for k, v in each.items()})


def memory(**settings: Any) -> MemobenchMemConfig:
    return MemobenchMemConfig(device="cpu", size="small", **settings)


@pytest.mark.parametrize(
    ("policy", "obs_type", "inputs"),
    [
        (config(ACTConfig, STATE, IMAGE), BOTH, "pixels"),
        (config(ACTConfig, STATE, IMAGE, SLOTS), BOTH, f"pixels, {POSES}"),
        (config(ACTConfig, STATE, SLOTS), OBJECTS, POSES),
        (config(ACTConfig), BOTH, f"pixels, {POSES}"),  # before training: everything
        (config(PI05Config, STATE, IMAGE, SLOTS), BOTH, "pixels"),  # it ignores object slots
        (memory(perception="objects", detector="package"), PIXELS, "detections"),
        (MemobenchExpertConfig(), PIXELS, "privileged simulator state"),
        (MemobenchRandomConfig(), PIXELS, "nothing"),
        (RemoteConfig(), BOTH, "pixels"),
        (RemoteConfig(keys="a=image,b=environment_state"), BOTH, f"pixels, {POSES}"),
    ],
)
def test_inputs_are_named(policy: Any, obs_type: str, inputs: str) -> None:
    assert policy_inputs(policy, obs_type) == inputs
    oracle = policy_inputs(policy, obs_type, oracle_memory=True)
    assert oracle == ("oracle memory text" if inputs == "nothing" else f"{inputs}, oracle memory text")


def declared(kind: str, *seen: FeatureType, **more: Any) -> Any:
    images = {"observation.images.image": None} if FeatureType.VISUAL in seen else {}
    module = "plugin" if kind.startswith(("memobench", "mine")) else "lerobot.policies"
    made = type("Config", (SimpleNamespace,), {"__module__": module})
    return made(type=kind, image_features=images, env_state_feature=FeatureType.ENV in seen or None, **more)


@pytest.mark.parametrize(
    ("policy", "needed"),
    [
        (None, None),
        (declared("pi05"), None),
        (declared("memobench_random", FeatureType.VISUAL, perception=UntrainedConfig.perception), None),
        (declared("diffusion", FeatureType.ENV, FeatureType.VISUAL), BOTH),
        (declared("pi05", FeatureType.ENV, FeatureType.VISUAL), PIXELS),
        (declared("mine", FeatureType.ENV), OBJECTS),
        (declared("memobench_mem", FeatureType.ENV, FeatureType.VISUAL, perception="objects"), OBJECTS),
        (declared("memobench_mem", perception="objects", uses_detector=True), PIXELS),
    ],
)
def test_observation_kind_must_contain_the_inputs(policy: Any, needed: str | None) -> None:
    assert obs_type_of(policy) == needed
    for obs_type in OBS_TYPES:
        if needed is None or obs_type in (needed, BOTH):
            check_obs_type(policy, obs_type)
        else:
            with pytest.raises(MemobenchError, match=f"obs_type is {obs_type}.*{BOTH}"):
                check_obs_type(policy, obs_type)


def test_a_image_may_be_changed_in_place() -> None:
    """A scene at rest is rendered once, and each observation has arrays of its own."""
    observer = Observer(DEFAULTS)
    observer._images = {name: np.ones((2, 2, 3), np.uint8) for name in CAMERAS}
    observer.observation()["pixels"]["image"][:] = 0
    assert observer.observation()["pixels"]["image"].all()
