"""LeRobot's trainer, with samples from main memory for policies without pictures: ``python -m`` runs it.

LeRobot decodes all videos of a sample, and reads a table for each time of each column of a history. Here numbers are
tensors and pictures are left out; all else of a sample equals LeRobot's to the bit.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from typing import Any

import draccus
import numpy as np
import pyarrow as pa
import torch
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.scripts import lerobot_train
from torch import Tensor

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import lock_refusal
from lerobot_memobench.run.command_line import register_plugins

logger = logging.getLogger(__name__)


class SamplesInMemory:
    """The samples of LeRobot's dataset by rows, without pictures."""

    def __init__(self, dataset: LeRobotDataset) -> None:
        reader: Any = dataset.reader
        meta, table = dataset.meta, reader.hf_dataset
        shown = [name for name in table.column_names if name not in meta.camera_keys]
        like = table.select_columns(shown)[0]
        held: pa.Table = table.select_columns(shown).with_format("arrow")[:]
        numbers = [name for name in shown if isinstance(like[name], Tensor)]
        self.columns = {name: _tensor(held.column(name), like[name]) for name in numbers}
        self._texts, self._others = dict[str, tuple[np.ndarray, list[Any]]](), dict[str, pa.Array]()
        for name in set(shown) - set(numbers):
            column = held.column(name).combine_chunks()
            if pa.types.is_string(column.type):
                coded = column.dictionary_encode(null_encoding="encode")
                self._texts[name] = coded.indices.to_numpy(), coded.dictionary.to_pylist()
            else:
                self._others[name] = column
        self._deltas = {name: torch.tensor(steps) for name, steps in (reader.delta_indices or {}).items()}
        self._tasks = meta.tasks.index.tolist()
        self._bounds = torch.tensor([meta.episodes["dataset_from_index"], meta.episodes["dataset_to_index"]])

    def sample(self, row: int) -> dict[str, Any]:
        """Return LeRobot's sample of a row."""
        return self.samples([row])[0]

    def samples(self, rows: Sequence[int]) -> list[dict[str, Any]]:
        """Return LeRobot's samples of several rows, each column read once."""
        at = torch.tensor(rows)
        found: dict[str, Any] = {name: column[at] for name, column in self.columns.items() if name not in self._deltas}
        # A reader may have some episodes only.
        first, end = (self._bounds[:, self.columns["episode_index"][at]] - self.columns["index"][at] + at)[..., None]
        for name, steps in self._deltas.items():
            wanted = at[:, None] + steps
            found[f"{name}_is_pad"] = (wanted < first) | (wanted >= end)
            if name in self.columns:
                found[name] = self.columns[name][wanted.clamp(first, end - 1)]
        parts: dict[str, Any] = {name: values.unbind() for name, values in found.items()}
        parts |= {name: [texts[code] for code in codes[rows].tolist()] for name, (codes, texts) in self._texts.items()}
        parts |= {name: [column[row].as_py() for row in rows] for name, column in self._others.items()}
        parts["task"] = [self._tasks[number] for number in found["task_index"].tolist()]
        return [dict(zip(parts, values, strict=True)) for values in zip(*parts.values(), strict=True)]


def _tensor(column: pa.ChunkedArray, like: Tensor) -> Tensor:
    """Return a column in the type and shape of LeRobot's first row."""
    flat: Any = column.combine_chunks()
    while isinstance(flat, pa.ExtensionArray | pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        flat = flat.storage if isinstance(flat, pa.ExtensionArray) else flat.flatten()
    numbers = torch.from_numpy(flat.to_numpy(zero_copy_only=False).copy())
    return numbers.to(like.dtype).reshape(len(column), *like.shape)


def keep_in_memory(dataset: Any) -> None:
    """Let an opened dataset return its samples from main memory, without pictures."""
    held = SamplesInMemory(dataset)
    dataset.reader.get_item, dataset.__getitems__ = held.sample, held.samples  # torch's loader asks for a batch at once


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
