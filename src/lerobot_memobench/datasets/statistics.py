"""Statistics of a dataset: computed from its frames, compared with ``meta/stats.json``, and completed there.

LeRobot normalises by them. Datasets that were converted from its format v2.1 lack quantiles, others those of pictures.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.datasets.frames import frame_reader, read_frame_table
from lerobot_memobench.datasets.lerobot_format.assembling import numeric_stats
from lerobot_memobench.datasets.lerobot_format.layout import ADVICE, STATS_FILE, read_info
from lerobot_memobench.datasets.lookup import read_recorded
from lerobot_memobench.datasets.video import ImageHistograms, Stats
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import read_json, short, telling_of_the_disk, write_file
from lerobot_memobench.protocol import CLOCK

PICTURES, TEXTS = ("video", "image"), ("string", "language")
BLOCK = 64
"""Pictures that are decoded at a time."""
NEEDED = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""LeRobot's mode of normalisation -> the statistics that it takes."""
NEAR, NEAR_PICTURES = 1e-3, 0.02
"""By how much of its range a number's statistic may be off, and by how much of all levels a picture's mean and
deviation: they are of pictures before they were encoded."""


def measured(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the features with statistics in LeRobot: numbers and pictures, but neither clock nor numbering."""
    from lerobot.utils.constants import DEFAULT_FEATURES

    counted = {*CLOCK, *DEFAULT_FEATURES}  # LeRobot's tools leave those of the numbering as they were
    return [name for name, one in features.items() if name not in counted and one["dtype"] not in TEXTS]


def compute(folder: Path, names: Iterable[str]) -> dict[str, Stats]:
    """Return the statistics of a dataset's features: exact ones of numbers; of pictures, of the frames that LeRobot
    samples of each episode.

    Raises:
        MemobenchError: a column is missing or damaged.
    """
    features, chosen = read_info(folder)["features"], list(names)
    cameras = [name for name in chosen if features[name]["dtype"] in PICTURES]
    numbers = [name for name in chosen if name not in cameras]
    columns = read_recorded(folder, numbers)[0] if numbers else {}
    found = {name: numeric_stats(column.numpy()) for name, column in columns.items()}
    return found | {camera: _of_pictures(folder, camera) for camera in cameras}


def _of_pictures(folder: Path, camera: str) -> Stats:
    from lerobot.datasets.compute_stats import aggregate_stats, sample_indices

    read, found = frame_reader(folder, camera), []
    for episode, length in enumerate(np.diff(read_frame_table(folder).episodes).tolist()):
        seen = ImageHistograms()
        sampled = sample_indices(length)
        for first in range(0, len(sampled), BLOCK):
            pictures = read(episode, sampled[first : first + BLOCK])
            for picture in (pictures * 255).round().byte().permute(0, 2, 3, 1).numpy():
                seen.add(np.ascontiguousarray(picture))
        found.append({camera: seen.stats()})
    stats: Stats = aggregate_stats(found)[camera]
    return stats


def recorded(folder: Path) -> dict[str, dict[str, Any]]:
    """Return ``meta/stats.json``; empty where there is none.

    Raises:
        MemobenchError: it cannot be read.
    """
    try:
        found: dict[str, dict[str, Any]] = read_json(folder / STATS_FILE, dict[str, dict[str, Any]], ADVICE, nan=True)
    except FileNotFoundError:
        return {}
    return found


def check_statistics(folder: Path, names: Iterable[str]) -> None:
    """Compare the statistics of features in ``meta/stats.json`` with those of the frames.

    Quantiles need only lie between the extremes: LeRobot's tools average those of the episodes.

    Raises:
        MemobenchError: naming the first that differs.
    """
    features, kept = read_info(folder)["features"], recorded(folder)
    for name, stats in compute(folder, names).items():
        pictures = features[name]["dtype"] in PICTURES
        low, high = (np.zeros(1), np.ones(1)) if pictures else (stats["min"].ravel(), stats["max"].ravel())
        slack = NEAR_PICTURES if pictures else NEAR * (1 + high - low)
        for key, value in stats.items():
            bounded = key.startswith("q") or (pictures and key != "mean" and key != "std")
            least, most = (low, high) if bounded else (value.ravel(), value.ravel())
            there = kept.get(name, {}).get(key)
            if not (pictures and key == "count") and not _within(there, value.size, least - slack, most + slack):
                raise MemobenchError(
                    f"{key} of {name} is {short(there)}, and the frames have {short(value.tolist())}; {ADVICE}"
                )


def _within(there: Any, size: int, least: Any, most: Any) -> bool:
    try:
        found = np.asarray(there, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return False
    return found.size == size and bool(((least <= found) & (found <= most)).all())


def needed_by(policy: Any, features: Mapping[str, Mapping[str, Any]], imagenet: bool) -> dict[str, Collection[str]]:
    """Return feature -> names of the statistics by which a training normalises it.

    Args:
        policy: its configuration. features: of the dataset.
        imagenet: whether LeRobot puts ImageNet's statistics in the place of the pictures', which it must find.
    """
    from lerobot.utils.feature_utils import dataset_to_policy_features

    found: dict[str, Collection[str]] = {}
    for name, feature in dataset_to_policy_features(dict(features)).items():
        mode = policy.normalization_mapping.get(feature.type.value)
        keys = NEEDED.get(getattr(mode, "value", mode), ())
        if features[name]["dtype"] in PICTURES and imagenet:
            keys = (*keys, "mean", "std")
        depth = features[name]["dtype"] in PICTURES and 3 not in features[name]["shape"]
        if keys and name not in CLOCK and not depth:
            found[name] = keys
    return found


def lacking(folder: Path, needed: Mapping[str, Collection[str]]) -> list[str]:
    """Return the features that lack one of the ``needed`` statistics in a dataset."""
    there = recorded(folder)
    return [name for name, keys in needed.items() if set(keys) - set(there.get(name, {}))]


def complete(folder: Path, names: Sequence[str], tell: Callable[[str], None]) -> None:
    """Compute statistics of a dataset's features and write into its ``meta/stats.json`` those that it lacks.

    Args:
        tell: called with the features before they are computed.

    Raises:
        MemobenchError: a column is missing or damaged, or the folder cannot be written.
    """
    tell(f"{folder / STATS_FILE} lacks statistics of {', '.join(names)}: they are computed from the frames and added")
    there = recorded(folder)
    for name, stats in compute(folder, names).items():
        there[name] = {key: value.tolist() for key, value in stats.items()} | there.get(name, {})
    with telling_of_the_disk(folder):
        write_file(folder / STATS_FILE, json.dumps(there, indent=4))
