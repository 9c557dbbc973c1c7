"""A dataset's frames as arrays, because twelve runs would otherwise decode the same videos twelve times."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_memobench.datasets.memory_cache import dataset_fingerprint
from lerobot_memobench.datasets.memory_cache.decoding import frame_reader
from lerobot_memobench.files import draft_of
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

Say = Callable[[str], None]


class Frames:
    """A dataset's frames as arrays: images decoded once into ``folder``, everything else in memory."""

    def __init__(self, root: Path, folder: Path, say: Say) -> None:
        self.root = root
        self.meta = LeRobotDatasetMetadata(root.name, root=root)
        columns = ["index", "observation.state", "action", "task_index"]
        table = pq.read_table(root / "data", columns=columns).sort_by("index")
        self.states = np.array(table.column("observation.state").to_pylist(), dtype=np.float32)
        self.actions = np.array(table.column("action").to_pylist(), dtype=np.float32)
        self.tasks = table.column("task_index").to_numpy()
        self.task_texts = {int(row.task_index): str(text) for text, row in self.meta.tasks.iterrows()}
        starts = [int(first) for first in self.meta.episodes["dataset_from_index"]]
        self.episodes = np.array([*starts, len(self.states)])
        self.features = dataset_to_policy_features(self.meta.features)
        self.images = {
            key: self._decode(key, folder, say)
            for key in self.meta.camera_keys
            if key == MemobenchMemConfig.memory_camera
        }

    def _decode(self, key: str, folder: Path, say: Say) -> np.ndarray:
        """Pictures (N, 3, H, W) uint8 of a camera, from ``folder`` when they have been decoded before."""
        path = folder / f"{key}-{dataset_fingerprint(self.root, key)}.npy"
        if not path.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            with draft_of(path) as draft:
                self._decode_to(draft, key, say)
        return np.load(path, mmap_mode="r")

    def _decode_to(self, path: Path, key: str, say: Say) -> None:
        height, width, channels = self.meta.features[key]["shape"]
        shape = (len(self.states), channels, height, width)
        store = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
        read = frame_reader(self.root, key)
        for episode, (first, last) in enumerate(itertools.pairwise(self.episodes)):
            store[first:last] = (read(episode, list(range(last - first))) * 255).round().to(torch.uint8).numpy()
            say(f"decoded {key}, episode {episode + 1} of {len(self.episodes) - 1}")
        store.flush()

    def batch(self, indices: np.ndarray, chunk: int) -> dict[str, Any]:
        """What LeRobot's loader gives for frames (B,) of the dataset, with chunks of ``chunk`` actions."""
        episode = np.searchsorted(self.episodes, indices, "right") - 1
        wanted = indices[:, None] + np.arange(chunk)
        last = self.episodes[episode + 1][:, None] - 1
        found: dict[str, Any] = {
            key: torch.from_numpy(images[indices].astype(np.float32) / 255.0) for key, images in self.images.items()
        }
        return found | {
            "observation.state": torch.from_numpy(self.states[indices]),
            "action": torch.from_numpy(self.actions[np.minimum(wanted, last)]),
            "action_is_pad": torch.from_numpy(wanted > last),
            "index": torch.from_numpy(indices),
            "episode_index": torch.from_numpy(episode),
            "task": [self.task_texts[int(number)] for number in self.tasks[indices]],
        }
