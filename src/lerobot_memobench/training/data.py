"""Open the data of a training: datasets, texts, the lookup of frames, samples and processors."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor
from torch.utils.data import Dataset

from lerobot_memobench.constants import OBS_PHASE
from lerobot_memobench.datasets.episodes import STRANGER, list_episodes
from lerobot_memobench.datasets.frames import (
    LEVEL_COLUMNS,
    MEMORY_COLUMN,
    Encoded,
    FrameLookup,
    FrameTable,
    Remember,
    SamplesInMemory,
    read_frame_table,
    read_recorded,
)
from lerobot_memobench.datasets.layout import EPISODE_INFO, without_pattern
from lerobot_memobench.datasets.statistics import complete, lacking, needed_by
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.settings import OBJECTS
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.policies.compatibility import check_features, trained_convention
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    ANSWERS,
    PROGRESS,
    SHUFFLED,
    MemobenchMemConfig,
)
from lerobot_memobench.policies.memobench_mem.encoders import (
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    encoded_key,
)
from lerobot_memobench.policies.memobench_mem.memory import NONE
from lerobot_memobench.policies.memobench_mem.objects import DETECTED, OBS_RAW_STATE, VIEWS, DetectionEncoder
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import (
    follow_training,
    make_memobench_mem_pre_post_processors,
)
from lerobot_memobench.policies.memobench_mem.texts import (
    answers,
    make_text_encoder,
    progress,
    shuffled,
    subgoals_of,
    texts_of,
)
from lerobot_memobench.sim.convention import convention_of
from lerobot_memobench.training.features import detected_slots, visual_features
from lerobot_memobench.training.sampler import seed_of

logger = logging.getLogger(__name__)

RECORDED = (OBS_STATE, OBS_ENV_STATE, ACTION, "timestamp", "frame_index", "episode_index", "task_index", "index")
"""Columns of samples if training decodes no video."""
STD_OFFSET = 0.01
"""Added to the standard deviations of actions, so that nearly constant numbers are not scaled up to noise."""


@dataclass
class Training:
    """A policy, its pre- and postprocessor, the episodes to train on and to hold out, and the lookup of all frames."""

    policy: Any  # possibly with adapters
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
    """Make or load the policy of a training, compute missing features, and make the processors."""
    dataset, held_out = datasets
    policy_config: Any = config.policy
    set_subgoals(policy_config, dataset.meta)
    policy: Any = make_policy(policy_config, ds_meta=dataset.meta, rename_map=config.rename_map)
    if config.peft is not None and not policy_config.use_peft:
        policy = policy.wrap_with_peft(peft_cli_overrides=asdict(config.peft))
    lookup = open_lookup(Path(dataset.meta.root), policy_config, policy.perception, config.rename_map)
    processors = make_training_processors(config, dataset.meta, lookup)
    return Training(policy, processors, dataset, held_out, lookup, config.seed or 0)


# -- datasets ----------------------------------------------------------------------------------------------------------


def open_datasets(config: TrainPipelineConfig) -> tuple[LeRobotDataset, LeRobotDataset | None]:
    """Open episodes to train on and held-out ones like LeRobot, with statistics. Errors as of `open_metadata`."""
    opened = copy.copy(config)
    opened.dataset = replace(config.dataset)
    complete_statistics(config.policy, open_metadata(opened.dataset), opened.dataset)
    train, held_out = make_train_eval_datasets(opened)
    return train, held_out


def open_metadata(config: DatasetConfig) -> LeRobotDatasetMetadata:
    """Return the metadata of a training's dataset; refuse one of another version, and episodes that it lacks."""
    if config.root is not None:
        config.root = str(without_pattern(Path(config.root)))
    meta = LeRobotDatasetMetadata(config.repo_id, root=config.root, revision=config.revision)
    if EPISODE_INFO in meta.features:
        list_episodes(Path(meta.root))  # reads all records
    absent = [episode for episode in config.episodes or () if episode >= meta.total_episodes]
    if absent or config.episodes == []:  # LeRobot ignores them, and fails if none is left
        raise MemobenchError(
            f"found episodes={absent or config.episodes}, and the dataset {meta.root} has "
            f"{count_of(meta.total_episodes, 'episode')}; choose from 0 to {meta.total_episodes - 1}, or leave "
            "episodes out for all"
        )
    return meta


def complete_statistics(policy: Any, meta: LeRobotDatasetMetadata, config: Any) -> None:
    """Add missing statistics that a policy needs for normalisation to the dataset of LeRobot's ``DatasetConfig``."""
    if missing := lacking(Path(meta.root), needed_by(policy, meta.features, config.use_imagenet_stats)):
        complete(downloaded(config, meta), missing, logger.warning)


def downloaded(config: DatasetConfig, meta: LeRobotDatasetMetadata) -> Path:
    """Return the folder of a dataset; download its data if only its metadata is here."""
    root = Path(meta.root)
    if (root / "data").is_dir():
        return root
    return Path(LeRobotDataset(config.repo_id, root=config.root, revision=config.revision).root)


def with_features(policy: Any, features: dict[str, Any]) -> Any:
    """Return a policy's configuration with a dataset's features, as LeRobot sets them; given inputs stay."""
    unused = None if getattr(policy, "uses_images", True) else FeatureType.VISUAL
    known = dataset_to_policy_features(features)
    config = copy.copy(policy)
    config.output_features = {key: feature for key, feature in known.items() if feature.type is FeatureType.ACTION}
    config.input_features = dict(policy.input_features or {}) or {
        key: feature for key, feature in known.items() if feature.type not in (FeatureType.ACTION, unused)
    }
    return config


def check_environment(config: TrainPipelineConfig, meta: Any, features: dict[str, Any]) -> None:
    """Refuse images of another convention than a continued checkpoint's, and evaluations on other images.

    The environment of evaluations during a training receives the plans of the policy, on which holds depend.
    """
    policy, env, stated = config.policy, config.env, convention_of(features)
    if policy is None:
        return
    if stated is not None and policy.pretrained_path is not None and not config.resume and policy.image_features:
        trained, why = trained_convention(str(policy.pretrained_path), policy)
        if trained not in (None, stated):
            raise MemobenchError(
                f"the policy {policy.pretrained_path} was trained on images of convention={trained} ({why}), and "
                f"{meta.root} has convention={stated}; mirror them: `memobench view {meta.root} --convention {trained} "
                "--out <folder>`"
            )
    if not isinstance(env, MemobenchEnvConfig):
        return
    if stated not in (None, env.convention) and env.obs_type != OBJECTS:
        raise MemobenchError(f"{meta.root} has images of convention={stated}; set env.convention={stated}")
    if policy.type == "xvla":
        raise MemobenchError(
            "LeRobot's trainer evaluates every XVLA with the processors of LIBERO; leave env out, and evaluate its "
            "checkpoints with `lerobot eval env=memobench`"
        )
    env.declare_plans(policy)
    completed = with_features(policy, features)
    check_features(f"that learns from {meta.root}", completed, env_to_policy_features(env), config.rename_map)


# -- frames ------------------------------------------------------------------------------------------------------------


def open_lookup(
    root: Path, config: MemobenchMemConfig, encoder: ObservationEncoder, renamed: Mapping[str, str]
) -> FrameLookup:
    """Open the lookup of a dataset's frames; compute missing features of the policy's perception first."""
    in_data = {known: name for name, known in renamed.items()}
    columns: dict[str, Tensor] = {}
    encoded: dict[str, Encoded] = {}
    if isinstance(encoder, ImageTowerEncoder):
        table = read_frame_table(root)
    else:
        names = [name for name in RECORDED if name != OBS_ENV_STATE] if config.uses_images else RECORDED
        columns, table = read_recorded(root, names)
        logger.info("%d frames of %s are read into memory", table.episodes[-1], root)
    table = with_targets(table, config, root)
    if isinstance(encoder, ImageTowerEncoder | VisualTokenEncoder):
        memory, present = visual_features(root, config, encoder, in_data)
        encoded = {encoded_key(camera): features.of_frames for camera, features in present.items()}
        remember: Remember | None = None if memory is None else memory.tokens
    else:
        observed = {**columns, OBS_RAW_STATE: columns[OBS_STATE], OBS_PHASE: torch.from_numpy(table.phase)}
        if isinstance(encoder, DetectionEncoder):
            views = {name: in_data.get(name, name) for name in VIEWS}
            stored = detected_slots(root, encoder.detect, views, in_data.get(OBS_STATE, OBS_STATE))
            slots = stored.all_frames().sum(dim=1, dtype=torch.float32)
            observed[DETECTED], encoded[DETECTED] = slots, lambda indices: slots[indices]

        def remember(episode: int, slots: Sequence[int]) -> Tensor:
            first = int(table.episodes[episode])
            return encoder.remember(observed, [first + slot * config.memory_stride for slot in slots])

    # Without an alignment no embedding of a text is used, so the cheapest encoder does.
    texts = make_text_encoder(
        "words" if config.align == NONE else str(config.text_encoder), config.dimensions.text_dim, str(config.device)
    )
    stride = config.memory_stride
    return FrameLookup(root, table, stride=stride, texts=texts, remember=remember, columns=columns, encoded=encoded)


# -- texts -------------------------------------------------------------------------------------------------------------


def set_subgoals(config: MemobenchMemConfig, meta: LeRobotDatasetMetadata) -> None:
    """Set the subgoals of a memory that learns from texts; refuse a dataset that lacks texts, or has unknown ones."""
    if config.align == NONE and not config.oracle_memory and not config.privileged_memory:
        return
    table, level = read_frame_table(Path(meta.root)), config.subgoal_level
    levels = [name for name in LEVEL_COLUMNS if any(table.subgoals.get(name, []))]
    lacks = f"The dataset {meta.root} has no {level} subgoals (no text in a column '{LEVEL_COLUMNS[level]}')"
    if config.align != NONE and level not in levels:
        hint = "use --policy.align=none, or a dataset that has the subgoal of each frame there"
        if levels:
            hint = f"it has {' and '.join(levels)} subgoals: choose one with --policy.subgoal_level"
        raise MemobenchError(f"{lacks}, so --policy.align={config.align} has no text to align memory with; {hint}.")
    if config.oracle_memory and not any(table.memory or []):
        raise MemobenchError(
            f"The dataset {meta.root} has no text in a column '{MEMORY_COLUMN}', which --policy.oracle_memory=true "
            "reads; leave it out, or generate the dataset again with this version."
        )
    if not config.privileged_memory:
        return
    own = subgoals_of(table.subgoals.get(level, []), table.episodes, meta.episodes["tasks"])
    if not any(own.values()):
        raise MemobenchError(
            f"{lacks}, from which this memory learns; name a dataset of `memobench generate`, another "
            "policy.subgoal_level, or another policy.memory."
        )
    config.subgoals = config.subgoals or own
    if new := sorted({*texts_of(own)} - {*texts_of(config.subgoals)}):
        raise MemobenchError(
            f"The dataset {meta.root} has {len(new)} checkpoint texts that this memory does not know, the first "
            f"being {new[0]!r}; train on the tasks it was trained on, or train a new memory with "
            "--policy.subgoals=null."
        )


def with_targets(table: FrameTable, config: MemobenchMemConfig, root: Path) -> FrameTable:
    """Return a dataset's frames with the texts of ``config.align_targets`` in place of the aligned subgoals."""
    level, texts = config.subgoal_level, table.subgoals.get(config.subgoal_level, [])
    if config.align == NONE or not any(texts):
        return table
    if config.align_targets == SHUFFLED:
        if len({*texts} - {""}) < 2:
            raise MemobenchError(
                f"The dataset of {root} has one subgoal at the level of the alignment, and --policy.align_targets="
                f"{SHUFFLED} needs at least two; use a dataset of several tasks, or another --policy.subgoal_level."
            )
        texts = shuffled(texts, table.episodes)
    elif config.align_targets == ANSWERS:
        texts = answers(texts, table.episodes)
    elif config.align_targets == PROGRESS:
        names = [episode.record.task_name for episode in list_episodes(root) if episode.record is not None]
        if len(names) < table.num_episodes:
            raise MemobenchError(f"The dataset {root} cannot be aligned with align_targets={PROGRESS}: {STRANGER}.")
        texts = progress(texts, table.episodes, names)
    return replace(table, subgoals={**table.subgoals, level: texts})


# -- samples -----------------------------------------------------------------------------------------------------------


class DecodedSamples(Dataset[dict[str, Any]]):
    """LeRobot's samples by their global indices, images included; actions of a chunk after a hold are padding.

    An augmentation depends on the seed and the number of the draw (`FrameSampler.numbered`) alone.
    """

    def __init__(self, dataset: LeRobotDataset, lookup: FrameLookup, chunk: Sequence[int], seed: int) -> None:
        self._dataset, self._seed, self._row = dataset, seed, dataset.absolute_to_relative_idx
        self._lookup, self._chunk = lookup, torch.tensor([*chunk])

    def __getitem__(self, drawn: int | tuple[int, int]) -> dict[str, Any]:
        index, number = drawn if isinstance(drawn, tuple) else (drawn, 0)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed_of(self._seed, number, 0, 0))  # augmentations draw from torch's generator
            sample: dict[str, Any] = self._dataset[index if self._row is None else self._row[index]]
        sample[f"{ACTION}_is_pad"] |= index + self._chunk >= self._lookup.run_of(index)[1]
        return sample


# -- processors --------------------------------------------------------------------------------------------------------


def make_training_processors(
    config: TrainPipelineConfig, meta: LeRobotDatasetMetadata, lookup: FrameLookup
) -> tuple[Any, Any]:
    """Return pre- and postprocessor of a training: new ones, or those of the checkpoint that it begins with."""
    policy: Any = config.policy
    stats = {**meta.stats, **execution_statistics(lookup)}
    if not policy.pretrained_path:
        return make_memobench_mem_pre_post_processors(policy, stats, meta, lookup)
    # A resumed training keeps the statistics of its checkpoint.
    normalized = {"norm_map": policy.normalization_mapping} | ({} if config.resume else {"stats": stats})
    preprocessor, postprocessor = make_pre_post_processors(
        policy_cfg=policy,
        pretrained_path=policy.pretrained_path,
        pretrained_revision=policy.pretrained_revision,
        preprocessor_overrides={
            "device_processor": {"device": torch.device(policy.device).type},
            "normalizer_processor": {**normalized, "features": {**policy.input_features, **policy.output_features}},
            "rename_observations_processor": {"rename_map": config.rename_map},
        },
        postprocessor_overrides={"unnormalizer_processor": {**normalized, "features": policy.output_features}},
    )
    follow_training(preprocessor.steps, policy, meta, lookup)
    return preprocessor, postprocessor


def execution_statistics(lookup: FrameLookup) -> dict[str, dict[str, Any]]:
    """Return the statistics of states and actions over frames to learn from; {} if LeRobot makes the samples."""
    if not lookup.columns:
        return {}
    columns = {name: lookup.columns[name].numpy() for name in (OBS_STATE, ACTION)}
    stats = {name: get_feature_stats(values[lookup.acts], axis=0, keepdims=False) for name, values in columns.items()}
    stats[ACTION]["std"] = np.asarray(stats[ACTION]["std"]) + STD_OFFSET
    return stats
