"""Open the data of a training: datasets, the lookup of their frames, samples and processors."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor
from torch.utils.data import Dataset

from lerobot_memobench.datasets.episodes import list_episodes, read_info
from lerobot_memobench.datasets.frames import (
    Encoded,
    FrameLookup,
    Remember,
    SamplesInMemory,
    TextEncoder,
    read_frame_table,
    read_recorded,
)
from lerobot_memobench.datasets.layout import EPISODE_INFO, without_pattern
from lerobot_memobench.datasets.statistics import complete, lacking, needed_by
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import count_of
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    encoded_key,
)
from lerobot_memobench.policies.memobench_mem.objects import DETECTED, OBS_RAW_STATE, VIEWS, DetectionEncoder
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import (
    follow_training,
    make_memobench_mem_pre_post_processors,
)
from lerobot_memobench.policies.memobench_mem.text_encoders import make_text_encoder
from lerobot_memobench.protocol import OBS_PHASE
from lerobot_memobench.training.features import cameras_of, detections, picture_tokens, remembered_features
from lerobot_memobench.training.sampler import seed_of
from lerobot_memobench.training.texts import set_subgoals, with_targets

logger = logging.getLogger(__name__)

RECORDED = (OBS_STATE, OBS_ENV_STATE, ACTION, "timestamp", "frame_index", "episode_index", "task_index", "index")
"""Columns of samples if training decodes no video."""
STD_OFFSET = 0.01
"""Added to the standard deviations of actions, so that nearly constant numbers are not scaled up to noise."""


@dataclass
class Training:
    """A policy and its training data.

    Attributes:
        policy: possibly with adapters. processors: pre- and postprocessor.
        dataset: the episodes to train on. held_out: the held-out episodes, or None.
        lookup: all frames of the dataset.
        seed: of augmentations.
    """

    policy: Any
    processors: tuple[Any, Any]
    dataset: LeRobotDataset
    held_out: LeRobotDataset | None
    lookup: FrameLookup
    seed: int = 0

    def samples(self, dataset: LeRobotDataset | None = None) -> Dataset[dict[str, Any]]:
        """Return the samples of a part of the dataset by their global indices; None: of the episodes to train on."""
        dataset = dataset or self.dataset
        chunk = self.policy.config.action_delta_indices
        if not self.lookup.columns:
            return DecodedSamples(dataset, self.lookup, chunk, self.seed)
        tasks = dataset.meta.tasks.index.tolist()
        return SamplesInMemory(self.lookup.columns, self.lookup.runs, {ACTION: chunk}, tasks)  # chunks end at a hold


def open_training(config: TrainPipelineConfig, datasets: tuple[LeRobotDataset, LeRobotDataset | None]) -> Training:
    """Make or load the policy of a training, compute missing features, and make the processors.

    Args:
        datasets: of `open_datasets`.

    Raises:
        MemobenchError: the dataset does not fit the policy.
    """
    dataset, held_out = datasets
    policy_config: Any = config.policy
    set_subgoals(policy_config, dataset.meta)
    policy: Any = make_policy(policy_config, ds_meta=dataset.meta, rename_map=config.rename_map)
    if config.peft is not None and not policy_config.use_peft:
        policy = policy.wrap_with_peft(peft_cli_overrides=asdict(config.peft))
    lookup = open_lookup(Path(dataset.meta.root), policy_config, policy.perception, config.rename_map)
    processors = make_processors(config, dataset.meta, lookup)
    return Training(policy, processors, dataset, held_out, lookup, config.seed or 0)


# -- datasets ----------------------------------------------------------------------------------------------------------


def open_datasets(config: TrainPipelineConfig) -> tuple[LeRobotDataset, LeRobotDataset | None]:
    """Open the episodes to train on and the held-out ones, as LeRobot does, and complete their statistics.

    Raises:
        MemobenchError: the dataset lacks an episode, or another version made it.
    """
    opened = copy.copy(config)
    if config.dataset.root is not None:
        opened.dataset = replace(config.dataset, root=str(without_pattern(Path(config.dataset.root))))
    given = opened.dataset
    meta = LeRobotDatasetMetadata(given.repo_id, root=given.root, revision=given.revision)
    check_episodes(given.episodes, meta)
    complete_statistics(config.policy, meta, given)
    train, held_out = make_train_eval_datasets(opened)
    if EPISODE_INFO in train.meta.features:
        list_episodes(Path(train.meta.root))  # refuses records that another version of this package wrote
    return train, held_out


def check_episodes(episodes: Sequence[int] | None, meta: LeRobotDatasetMetadata) -> None:
    """Refuse episodes that a dataset lacks; LeRobot ignores them, and fails if no episode is left."""
    if episodes is None:
        return
    absent = [episode for episode in episodes if episode >= meta.total_episodes]
    if absent or not episodes:
        raise MemobenchError(
            f"found episodes={absent or episodes}, and the dataset {meta.root} has "
            f"{count_of(meta.total_episodes, 'episode')}; choose from 0 to {meta.total_episodes - 1}, or leave "
            "episodes out for all"
        )


def complete_statistics(policy: Any, meta: LeRobotDatasetMetadata, given: Any) -> None:
    """Add missing statistics that a policy needs for normalisation to its dataset.

    Args:
        policy: its configuration. given: LeRobot's configuration of the dataset.
    """
    root = Path(meta.root)
    missing = lacking(root, needed_by(policy, meta.features, given.use_imagenet_stats))
    if not missing:
        return
    if not (root / "data").is_dir():
        root = Path(LeRobotDataset(given.repo_id, root=given.root, revision=given.revision).root)
    complete(root, missing, logger.warning)


# -- frames ------------------------------------------------------------------------------------------------------------


def open_lookup(
    root: Path, config: MemobenchMemConfig, encoder: ObservationEncoder, renamed: Mapping[str, str] | None = None
) -> FrameLookup:
    """Open the lookup of a dataset's frames; compute missing features first.

    Args:
        encoder: the policy's perception.
        renamed: LeRobot's ``rename_map``: names of the dataset -> names of the policy.

    Raises:
        MemobenchError: the dataset lacks a column, or features cannot be computed.
    """
    in_data = {known: given for given, known in (renamed or {}).items()}
    remember: Remember | None = None
    if isinstance(encoder, ImageTowerEncoder):
        table = with_targets(read_frame_table(root), config, root)
        if config.memory != "none":
            remembered = encoder.memory_input
            camera = in_data.get(remembered, remembered) or next(iter(cameras_of(read_info(root)["features"])), "")
            remember = remembered_features(root, config, encoder, camera).tokens
        return FrameLookup(root, table, stride=config.memory_stride, texts=text_encoder(config), remember=remember)
    names = [name for name in RECORDED if name != OBS_ENV_STATE] if config.uses_pictures else RECORDED
    columns, table = read_recorded(root, names)
    table = with_targets(table, config, root)
    logger.info("%d frames of %s are read into memory", table.episodes[-1], root)
    encoded: dict[str, Encoded] = {}
    if isinstance(encoder, VisualTokenEncoder):
        cameras = dict.fromkeys(encoder.cameras or [*cameras_of(read_info(root)["features"]), encoder.memory_input])
        memory, present = picture_tokens(root, config, encoder, {name: in_data.get(name, name) for name in cameras})
        encoded = {encoded_key(camera): one.of_frames for camera, one in present.items()}
        remember = None if memory is None else memory.tokens
    else:
        observed = {**columns, OBS_RAW_STATE: columns[OBS_STATE], OBS_PHASE: torch.from_numpy(table.phase)}
        if isinstance(encoder, DetectionEncoder):
            views = {name: in_data.get(name, name) for name in VIEWS}
            found = detections(root, encoder.detect, views, in_data.get(OBS_STATE, OBS_STATE))
            slots = found.all_frames().sum(dim=1, dtype=torch.float32)
            observed[DETECTED], encoded[DETECTED] = slots, lambda indices: slots[indices]

        def remember_objects(episode: int, slots: Sequence[int]) -> Tensor:
            first = int(table.episodes[episode])
            return encoder.remember(observed, [first + slot * config.memory_stride for slot in slots])

        remember = remember_objects

    return FrameLookup(
        root,
        table,
        stride=config.memory_stride,
        texts=text_encoder(config),
        remember=remember,
        columns=columns,
        encoded=encoded,
    )


def text_encoder(config: MemobenchMemConfig) -> TextEncoder:
    """Return the text encoder of the subgoals for the alignment; without an alignment its output is not used."""
    name = "words" if config.align == "none" else config.text_encoder
    assert name is not None  # the configuration sets it
    return make_text_encoder(name, config.dimensions.text_dim, str(config.device))


# -- samples -----------------------------------------------------------------------------------------------------------


class DecodedSamples(Dataset[dict[str, Any]]):
    """LeRobot's samples by their global indices, pictures included; actions of a chunk after a hold are padding.

    With the number of a draw (`FrameSampler.numbered`) an augmentation depends on it and the seed alone.
    """

    def __init__(self, dataset: LeRobotDataset, lookup: FrameLookup, chunk: Sequence[int], seed: int) -> None:
        self._dataset, self._seed, self._row = dataset, seed, dataset.absolute_to_relative_idx
        self._lookup, self._chunk = lookup, torch.tensor([*chunk])

    def __getitem__(self, drawn: int | tuple[int, int]) -> dict[str, Any]:
        index, number = drawn if isinstance(drawn, tuple) else (drawn, 0)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed_of(self._seed, number, 0, 0))
            found: dict[str, Any] = self._dataset[index if self._row is None else self._row[index]]
        found[f"{ACTION}_is_pad"] |= index + self._chunk >= self._lookup.run_of(index)[1]
        return found


# -- processors --------------------------------------------------------------------------------------------------------


def make_processors(config: TrainPipelineConfig, meta: LeRobotDatasetMetadata, lookup: FrameLookup) -> tuple[Any, Any]:
    """Return pre- and postprocessor of a training: new ones, or those of the checkpoint that it begins with."""
    policy: Any = config.policy
    stats = {**meta.stats, **execution_statistics(policy, meta, lookup)}
    if not policy.pretrained_path:
        return make_memobench_mem_pre_post_processors(policy, stats, meta, lookup)
    normalizer: dict[str, Any] = {
        "features": {**policy.input_features, **policy.output_features},
        "norm_map": policy.normalization_mapping,
    }
    unnormalizer: dict[str, Any] = {**normalizer, "features": policy.output_features}
    if not config.resume:  # a resumed training keeps its statistics
        normalizer["stats"] = unnormalizer["stats"] = stats
    before: dict[str, Any] = {
        "device_processor": {"device": torch.device(policy.device).type},
        "normalizer_processor": normalizer,
        "rename_observations_processor": {"rename_map": config.rename_map},
    }
    after: dict[str, Any] = {"unnormalizer_processor": unnormalizer}
    if policy.use_relative_actions:
        before["relative_actions_processor"] = {
            "enabled": True,
            "exclude_joints": policy.relative_exclude_joints,
            "action_names": policy.action_feature_names,
        }
        after["absolute_actions_processor"] = {"enabled": True}
    preprocessor, postprocessor = make_pre_post_processors(
        policy_cfg=policy,
        pretrained_path=policy.pretrained_path,
        pretrained_revision=policy.pretrained_revision,
        preprocessor_overrides=before,
        postprocessor_overrides=after,
    )
    follow_training(preprocessor.steps, policy, meta, lookup)
    return preprocessor, postprocessor


def execution_statistics(
    config: MemobenchMemConfig, meta: LeRobotDatasetMetadata, lookup: FrameLookup
) -> dict[str, dict[str, Any]]:
    """Return the statistics of states and actions over frames to learn from; {} if LeRobot makes the samples.

    Statistics of relative actions depend on the chunk and are the dataset's.

    Raises:
        MemobenchError: actions are relative, and the dataset has statistics of absolute actions.
    """
    if not lookup.columns:
        return {}
    columns = {name: lookup.columns[name].numpy() for name in (OBS_STATE, ACTION)}
    found = {name: get_feature_stats(one[lookup.acts], axis=0, keepdims=False) for name, one in columns.items()}
    if config.use_relative_actions:
        found[ACTION] = dict(meta.stats[ACTION])
        if np.allclose(found[ACTION]["mean"], columns[ACTION].mean(axis=0), atol=1e-4):
            raise MemobenchError(
                f"the dataset {meta.root} has statistics of absolute actions, and "
                "--policy.use_relative_actions=true normalises relative ones; recompute them "
                "(`lerobot-edit-dataset --operation.type=recompute_stats --operation.relative_action=true "
                f"--operation.chunk_size={config.chunk_size}`) or leave use_relative_actions out"
            )
    found[ACTION]["std"] = np.asarray(found[ACTION]["std"]) + STD_OFFSET
    return found
