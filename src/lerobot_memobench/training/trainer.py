"""LeRobot's own trainer, for other policies: the view of a dataset that it reads, its process, and its samples.

``python -m`` runs the process. LeRobot decodes all videos of a sample, and reads a table for each time of each column
of a history. For policies without images, samples come from main memory: numbers are tensors, images are left out;
all else of a sample is bit-identical to LeRobot's.
"""

from __future__ import annotations

import copy
import json
import logging
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pyarrow as pa
import torch
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from lerobot_memobench.commands.command_line import register_plugins
from lerobot_memobench.constants import CLOCK, IMAGE_SIZE
from lerobot_memobench.datasets.frames import SamplesInMemory
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.observations import chooses_inputs
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import lock_refusal
from lerobot_memobench.policies.checkpoint import trained_names
from lerobot_memobench.policies.compatibility import keeps_sizes
from lerobot_memobench.training.data import (
    check_environment,
    complete_statistics,
    downloaded,
    open_metadata,
    with_features,
)
from lerobot_memobench.training.features import cameras_of
from lerobot_memobench.training.view import (
    SOURCE_EPISODE,
    cached_view,
    has_benchmark_columns,
    needs_view,
    view_options,
)

logger = logging.getLogger(__name__)


def prepare(
    config: TrainPipelineConfig, prompt_frames: bool | None, obs_type: str | None, notify: Callable[[str], None]
) -> TrainPipelineConfig:
    """Return the configuration for LeRobot's trainer, with a view of the dataset if it is needed.

    Args:
        prompt_frames: whether to train on prompt frames; None: if the policy reads prompts.
        obs_type: kind of observation; None: images if the dataset has them, else objects.
    """
    config = copy.deepcopy(config)
    dataset, policy = config.dataset, config.policy
    if policy is None:
        return config
    meta = open_metadata(dataset)
    options = view_options(policy, meta.features, prompt_frames, obs_type)
    features = {new: meta.features[name] for name, new in options.columns(meta.features).items()}
    if policy.pretrained_path is not None and not config.rename_map:
        names = trained_names(policy.pretrained_path)
        config.rename_map = {old: new for old, new in names.items() if old in features}
    check_environment(config, meta, features)
    check_inputs(policy, meta, features, config.rename_map)
    sizes = [tuple(features[name]["shape"][:2]) for name in cameras_of(features)]
    other = any(size != (IMAGE_SIZE, IMAGE_SIZE) for size in sizes)
    if other and has_benchmark_columns(meta.features) and keeps_sizes(policy):
        height, width = sizes[0]
        notify(
            f"note: {meta.root} has images of {height} x {width} pixels, and policy={policy.type} does not resize "
            f"them; evaluate it with observation_height={height} observation_width={width}"
        )
    changed = needs_view(meta.features, options)
    if dataset.streaming and not (Path(meta.root) / "data").is_dir():
        if changed:
            raise MemobenchError(
                f"dataset.streaming=true reads {dataset.repo_id} from the hub with its prompts and all of its columns; "
                "leave dataset.streaming out"
            )
        return config
    complete_statistics(policy, meta, dataset)
    if options.prompts and not policy.input_features and not chooses_inputs(policy):
        policy.input_features = {  # the view has the clock, which is not an input
            name: feature
            for name, feature in dataset_to_policy_features(features).items()
            if feature.type is not FeatureType.ACTION and name not in CLOCK
        }
    if not changed:
        return config
    folder = cached_view(downloaded(dataset, meta), options)
    frames = "all frames" if options.prompts else "without the frames of prompts and holds"
    notify(f"LeRobot's trainer reads {folder}: {frames}, {options.obs_type or 'all observations'}")
    if dataset.episodes is not None:
        sources = LeRobotDatasetMetadata(dataset.repo_id, root=folder).episodes[SOURCE_EPISODE]
        dataset.episodes = [number for number, source in enumerate(sources) if source in dataset.episodes]
    dataset.root = str(folder)
    return config


def check_inputs(policy: Any, meta: Any, features: dict[str, Any], renamed: Mapping[str, str]) -> None:
    """Refuse inputs that a policy cannot have, such as two cameras of VQ-BeT; LeRobot does after opening the data."""
    config = with_features(policy, features)
    read, cameras = [*config.image_features], {renamed.get(name, name): name for name in cameras_of(features)}
    missing = [name for name in read if name not in cameras]
    free = [name for name in cameras if name not in read]
    if missing and free:
        guess = json.dumps(dict(zip((cameras[name] for name in free), missing, strict=False)))
        raise MemobenchError(
            f"the policy {policy.pretrained_path or policy.type} reads {', '.join(read)}, and {meta.root} has "
            f"{', '.join(cameras.values())}; map its names, for example by rename_map='{guess}'"
        )
    try:
        config.validate_features()
    except ValueError as error:
        raise MemobenchError(
            f"policy={policy.type} cannot read {', '.join(config.input_features)} of {meta.root}: {error} Choose its "
            "inputs by policy.input_features"
        ) from None


# -- the process -------------------------------------------------------------------------------------------------------


def run_lerobot(config: TrainPipelineConfig) -> int:
    """Run LeRobot's trainer, with samples in memory, in a process of its own; return its exit status."""
    command = [sys.executable, "-m", __name__]
    if config.checkpoint_path is not None:  # LeRobot reads it in the arguments
        command.append(f"--config_path={config.checkpoint_path / 'pretrained_model'}")
    return subprocess.run(command, input=json.dumps(draccus.encode(config)).encode(), check=False).returncode


def main() -> None:
    """Run LeRobot's trainer with the configuration in the standard input, as JSON."""
    from lerobot.scripts import lerobot_train

    register_plugins()
    config = draccus.decode(TrainPipelineConfig, json.load(sys.stdin))
    lerobot_train.make_train_eval_datasets = open_trainer_datasets
    try:
        lerobot_train.train(config)
    except MemobenchError as error:
        sys.exit(f"lerobot: {error}")
    except OSError as error:
        if (refusal := lock_refusal(error)) is None:
            raise
        sys.exit(f"lerobot: {refusal}")


def open_trainer_datasets(config: TrainPipelineConfig) -> tuple[Any, Any]:
    """Open LeRobot's datasets of a training and of its held-out episodes; keep them in memory without images.

    LeRobot opens environments without the policy, so those of the benchmark receive its plans here.
    """
    if isinstance(config.env, MemobenchEnvConfig):
        config.env.declare_plans(config.policy)
    datasets: tuple[Any, Any] = make_train_eval_datasets(config)
    inputs = getattr(config.policy, "input_features", None) or {}
    images = [name for name, feature in inputs.items() if feature.type is FeatureType.VISUAL]
    reads_images = bool(images if inputs else datasets[0].meta.camera_keys)
    if config.policy is not None and not config.dataset.streaming and not reads_images:
        for dataset in datasets:
            if dataset is not None:
                keep_in_memory(dataset)
        config.num_workers = 0  # each would hold a copy
        logger.info("samples are read from main memory, num_workers=0")
    return datasets


def keep_in_memory(dataset: Any) -> None:
    """Let an opened dataset return its samples from main memory, without images."""
    reader: Any = dataset.reader
    names = [name for name in reader.hf_dataset.column_names if name not in dataset.meta.camera_keys]
    table = reader.hf_dataset.select_columns(names)
    arrow = table.with_format("arrow")[:]
    columns: dict[str, Tensor] = {}
    texts: dict[str, pa.Array] = {}
    for name, like in table[0].items():  # LeRobot's first row has the types and shapes
        column = arrow.column(name).combine_chunks()
        if not isinstance(like, Tensor):
            texts[name] = column.dictionary_encode() if pa.types.is_string(column.type) else column
            continue
        while isinstance(column, pa.ExtensionArray | pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
            column = column.storage if isinstance(column, pa.ExtensionArray) else column.flatten()
        numbers = torch.from_numpy(column.to_numpy(zero_copy_only=False).copy())
        columns[name] = numbers.to(like.dtype).reshape(len(table), *like.shape)
    # A reader may have some episodes only.
    starts = np.flatnonzero(np.diff(columns["episode_index"].numpy(), prepend=-1))
    bounds = np.append(starts, len(table))
    samples = SamplesInMemory(columns, bounds, reader.delta_indices or {}, dataset.meta.tasks.index.tolist(), texts)
    reader.get_item = samples.__getitem__
    dataset.__getitems__ = samples.__getitems__  # torch's loader asks for a batch at once


if __name__ == "__main__":
    main()
