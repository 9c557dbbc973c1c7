"""What LeRobot's training is made to do beside its own: leave the frames of prompts out, and say what a policy sees.

What it relies on is listed in tests/engine/test_lerobot_training.py; how it gets there, and out again: `lerobot_hooks`.
Whether prompt frames are wanted is decided where the policy is known for sure: when LeRobot, its configuration
complete, has opened the datasets. So is what a policy sees: our datasets hold pictures and, beside them, what shows in
them as objects, and LeRobot would give both to its own policies.
"""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from lerobot.configs import FeatureType
from lerobot.utils.constants import OBS_STATE

from lerobot_memobench.datasets.execution_frames import ExecutionFrames, leave_out_prompts
from lerobot_memobench.datasets.lerobot_format.layout import OBJECTS as INPUT
from lerobot_memobench.datasets.lerobot_format.layout import PRIVILEGED
from lerobot_memobench.envs.observations import BOTH, OBJECTS, PIXELS
from lerobot_memobench.envs.prompting import knows_phases
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import OPEN_DATASETS, check_version, install
from lerobot_memobench.policies.shown import check_features

logger = logging.getLogger(__name__)


@contextmanager
def trained_on(prompt_frames: bool | None, obs_type: str | None = None) -> Iterator[None]:
    """While this lasts, LeRobot trains on prompt frames too, or on none; None: on none unless the policy knows phases.

    ``obs_type`` is what a policy that does not know phases sees (`envs.observations.OBS_TYPES`); None: pictures where
    the dataset has them, else objects.

    Raises:
        MemobenchError: the installed LeRobot is another than the one whose training is known here.
    """
    undo = steer(prompt_frames, obs_type)
    try:
        yield
    finally:
        undo()


def steer(prompt_frames: bool | None, obs_type: str | None = None) -> Callable[[], None]:
    """As `trained_on`, until the function returned is called."""
    check_version("training")
    return install(OPEN_DATASETS, lambda make: _steered(make, prompt_frames, obs_type))


def _steered(make: Callable[..., Any], prompt_frames: bool | None, obs_type: str | None) -> Callable[..., Any]:
    """Wrap what opens LeRobot's datasets: those that it returns hold no prompts where none are wanted."""

    @functools.wraps(make)
    def run(config: Any) -> Any:
        from lerobot_memobench.policies.memobench_mem.recorded_items import check_transforms

        if prompt_frames is not False:
            _check_streaming(config)
        check_transforms(config.policy, config.dataset.image_transforms.enable)
        train, held_out = make(config)
        if _reads_objects(config.policy, obs_type):
            for dataset in (train, held_out):
                _take_for_input(dataset)
        _choose_inputs(config.policy, train.meta.features, obs_type)
        _check_environment(config, train)
        wanted = config.policy is None or knows_phases(config.policy) if prompt_frames is None else prompt_frames
        if not wanted:
            count = leave_out_prompts(train)
            told = "the frames" if count is None else f"{count} frames"
            logger.info("%s of prompts are left out of the %d to train on", told, train.num_frames)
        # A policy that draws execution frames alone sees to what it trains on, and not to what it is tested on.
        tested = wanted and not getattr(config.policy, "execution_only", False)
        if held_out is not None:
            held_out.reader.trained_with = train.meta
        if held_out is not None and not tested and leave_out_prompts(held_out):
            held_out = ExecutionFrames(held_out)
        return train, held_out

    return run


def _check_streaming(config: Any) -> None:
    """Refuse to stream to a policy that draws its own execution frames: it would get prompts, which do not count."""
    if config.dataset.streaming and getattr(config.policy, "execution_only", False):
        raise MemobenchError(
            f"policy={config.policy.type} draws execution frames alone, and dataset.streaming=true leaves no choice of "
            "frames; use dataset.streaming=false, or prompt_frames=false to take execution frames as they come"
        )


def _reads_objects(policy: Any, obs_type: str | None) -> bool:
    """Return whether a policy of LeRobot's is to see objects: as it was asked now, or when its training began."""
    if policy is None or knows_phases(policy):
        return False
    begun = policy.input_features or {}
    return INPUT in begun if begun else obs_type in (OBJECTS, BOTH)


def _take_for_input(dataset: Any) -> None:
    """Give the objects of an opened dataset with pictures the name that LeRobot takes for an input's."""
    if dataset is None or PRIVILEGED not in dataset.meta.features:
        return

    def named(table: dict[str, Any]) -> dict[str, Any]:
        return {INPUT if key == PRIVILEGED else key: value for key, value in table.items()}

    dataset.meta.info.features, dataset.meta.stats = named(dataset.meta.features), named(dataset.meta.stats)
    reader = getattr(dataset, "reader", dataset)  # a stream reads by itself
    reader.hf_dataset = reader.hf_dataset.rename_column(PRIVILEGED, INPUT)
    for holder, name in ((dataset, "delta_timestamps"), (reader, "delta_indices")):  # as of any other observation
        deltas = getattr(holder, name, None)
        if deltas and OBS_STATE in deltas:
            setattr(holder, name, {**deltas, INPUT: deltas[OBS_STATE]})


def _check_environment(config: Any, dataset: Any) -> None:
    """Refuse to evaluate between updates on the benchmark what is trained on other cameras, numbers or sizes."""
    from lerobot.envs.utils import env_to_policy_features
    from lerobot.utils.feature_utils import dataset_to_policy_features

    environment = getattr(config, "env", None)
    if config.policy is None or getattr(environment, "type", None) != "memobench":
        return
    unseen = None if getattr(config.policy, "sees_pictures", True) else FeatureType.VISUAL
    features = dataset_to_policy_features(dataset.meta.features)
    policy = copy.copy(config.policy)
    policy.output_features = {key: one for key, one in features.items() if one.type is FeatureType.ACTION}
    policy.input_features = policy.input_features or {
        key: one for key, one in features.items() if one.type not in (FeatureType.ACTION, unseen)
    }
    check_features(f"that learns from {dataset.root}", policy, env_to_policy_features(environment), config.rename_map)


def _choose_inputs(policy: Any, features: dict[str, Any], obs_type: str | None) -> None:
    """Tell a policy's configuration what it sees, as LeRobot would from all that a dataset holds."""
    from lerobot.utils.feature_utils import dataset_to_policy_features

    if policy is None or policy.input_features or knows_phases(policy):
        return
    inputs = {key: f for key, f in dataset_to_policy_features(features).items() if f.type is not FeatureType.ACTION}
    pictures = any(feature.type is FeatureType.VISUAL for feature in inputs.values())
    seen = obs_type or (PIXELS if pictures else OBJECTS)
    unseen = {PIXELS: FeatureType.ENV, OBJECTS: FeatureType.VISUAL}.get(seen)
    chosen = {key: feature for key, feature in inputs.items() if feature.type is not unseen}
    if obs_type is not None and not {FeatureType.VISUAL, FeatureType.ENV} & {
        feature.type for feature in chosen.values()
    }:
        raise MemobenchError(
            f"obs_type={obs_type} was asked for, but the dataset has {', '.join(inputs)}; choose another obs_type, or "
            "generate a dataset that has it"
        )
    policy.input_features = chosen
