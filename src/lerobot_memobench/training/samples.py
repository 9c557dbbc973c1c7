"""LeRobot's trainer, with samples from main memory for policies without pictures: ``python -m`` runs it.

LeRobot decodes all videos of a sample, and reads a table for each time of each column of a history. Here numbers are
tensors and pictures are left out; all else of a sample is bit-identical to LeRobot's.
"""

from __future__ import annotations

import json
import logging
import sys
from typing import Any

import draccus
import numpy as np
import pyarrow as pa
import torch
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.scripts import lerobot_train
from torch import Tensor

from lerobot_memobench.datasets.frames import SamplesInMemory
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import lock_refusal
from lerobot_memobench.run.command_line import register_plugins

logger = logging.getLogger(__name__)


def keep_in_memory(dataset: Any) -> None:
    """Let an opened dataset return its samples from main memory, without pictures."""
    reader: Any = dataset.reader
    names = [name for name in reader.hf_dataset.column_names if name not in dataset.meta.camera_keys]
    table = reader.hf_dataset.select_columns(names)
    first, arrow = table[0], table.with_format("arrow")[:]
    columns: dict[str, Tensor] = {}
    texts: dict[str, pa.Array] = {}
    for name, like in first.items():
        column = arrow.column(name).combine_chunks()
        if isinstance(like, Tensor):
            columns[name] = _tensor(column, like)
        else:
            texts[name] = column.dictionary_encode() if pa.types.is_string(column.type) else column
    # A reader may have some episodes only.
    starts = np.flatnonzero(np.diff(columns["episode_index"].numpy(), prepend=-1))
    bounds = np.append(starts, len(table))
    held = SamplesInMemory(columns, bounds, reader.delta_indices or {}, dataset.meta.tasks.index.tolist(), texts)
    reader.get_item = held.__getitem__
    dataset.__getitems__ = held.__getitems__  # torch's loader asks for a batch at once


def _tensor(column: Any, like: Tensor) -> Tensor:
    """Return a column in the type and shape of LeRobot's first row."""
    rows = len(column)
    while isinstance(column, pa.ExtensionArray | pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        column = column.storage if isinstance(column, pa.ExtensionArray) else column.flatten()
    numbers = torch.from_numpy(column.to_numpy(zero_copy_only=False).copy())
    return numbers.to(like.dtype).reshape(rows, *like.shape)


def needs_no_pictures(config: TrainPipelineConfig, dataset: Any) -> bool:
    """Return whether a policy reads no picture of an opened dataset."""
    inputs = getattr(config.policy, "input_features", None) or {}
    seen = any(one.type is FeatureType.VISUAL for one in inputs.values()) if inputs else bool(dataset.meta.camera_keys)
    return config.policy is not None and not config.dataset.streaming and not seen


def open_datasets(config: TrainPipelineConfig) -> tuple[Any, Any]:
    """Open LeRobot's datasets of a training and of its held-out episodes; keep them in memory without pictures.

    LeRobot opens environments without the policy, so those of the benchmark receive its plans here.
    """
    if isinstance(config.env, MemobenchEnvConfig):
        config.env.declare_plans(config.policy)
    datasets: tuple[Any, Any] = make_train_eval_datasets(config)
    if needs_no_pictures(config, datasets[0]):
        for dataset in datasets:
            if dataset is not None:
                keep_in_memory(dataset)
        config.num_workers = 0  # each would hold a copy
        logger.info("samples are read from main memory, num_workers=0")
    return datasets


def main() -> None:
    """Run LeRobot's trainer with the configuration in the standard input, as JSON."""
    register_plugins()
    config = draccus.decode(TrainPipelineConfig, json.load(sys.stdin))
    lerobot_train.make_train_eval_datasets = open_datasets
    try:
        lerobot_train.train(config)
    except MemobenchError as error:
        sys.exit(f"lerobot: {error}")
    except OSError as error:
        if (refusal := lock_refusal(error)) is None:
            raise
        sys.exit(f"lerobot: {refusal}")


if __name__ == "__main__":
    main()
