"""Statistics of a dataset: computed from its frames, compared with ``meta/stats.json``, and completed there.

LeRobot normalises by them. Datasets converted from its format v2.1 lack quantiles, others the statistics of images.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.datasets.episodes import read_info
from lerobot_memobench.datasets.frames import read_frame_table, read_recorded
from lerobot_memobench.datasets.layout import ADVICE, STATS_FILE
from lerobot_memobench.datasets.video import ImageHistograms, Stats, frame_reader
from lerobot_memobench.datasets.write import numeric_stats
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import explaining_disk_errors, read_json, short, write_file
from lerobot_memobench.protocol import CLOCK

IMAGES, TEXTS = ("video", "image"), ("string", "language")
BLOCK = 64
"""Images decoded at a time."""
NEEDED = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""LeRobot's mode of normalisation -> statistics that it uses."""
TOLERANCE, IMAGE_TOLERANCE = 1e-3, 0.02
"""Tolerance of statistics of numbers, as a share of the range, and of mean and deviation of images, as a share of all
levels: the recorded ones are of images before encoding."""


def measured(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the features with statistics: numbers and images, without clock and numbering."""
    from lerobot.utils.constants import DEFAULT_FEATURES

    counted = {*CLOCK, *DEFAULT_FEATURES}  # LeRobot's tools do not update the statistics of the numbering
    return [name for name, feature in features.items() if name not in counted and feature["dtype"] not in TEXTS]


def compute(folder: Path, names: Iterable[str]) -> dict[str, Stats]:
    """Compute the statistics of a dataset's features: exact for numbers, over LeRobot's sample of frames for images.

    Held frames do not count for numbers: nothing is learned from them, and they may be most frames.

    Raises:
        MemobenchError: a column is missing or damaged.
    """
    features, chosen = read_info(folder)["features"], list(names)
    cameras = [name for name in chosen if features[name]["dtype"] in IMAGES]
    numbers = [name for name in chosen if name not in cameras]
    columns, table = read_recorded(folder, numbers)
    found = {name: numeric_stats(column.numpy()[~table.held]) for name, column in columns.items()}
    return found | {camera: _image_stats(folder, camera) for camera in cameras}


def _image_stats(folder: Path, camera: str) -> Stats:
    from lerobot.datasets.compute_stats import aggregate_stats, sample_indices

    read, found = frame_reader(folder, camera), []
    for episode, length in enumerate(np.diff(read_frame_table(folder).episodes).tolist()):
        seen = ImageHistograms()
        sampled = sample_indices(length)
        for first in range(0, len(sampled), BLOCK):
            images = read(episode, sampled[first : first + BLOCK])
            for image in (images * 255).round().byte().permute(0, 2, 3, 1).numpy():
                seen.add(np.ascontiguousarray(image))
        found.append({camera: seen.stats(sampled=True)})
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

    Quantiles must lie between the extremes only, because LeRobot's tools average the quantiles of episodes.

    Raises:
        MemobenchError: naming the first statistic that differs.
    """
    features, kept = read_info(folder)["features"], recorded(folder)
    for name, stats in compute(folder, names).items():
        is_image = features[name]["dtype"] in IMAGES
        low, high = (np.zeros(1), np.ones(1)) if is_image else (stats["min"].ravel(), stats["max"].ravel())
        slack = IMAGE_TOLERANCE if is_image else TOLERANCE * (1 + high - low)
        for key, value in stats.items():
            bounded = key.startswith("q") or (is_image and key != "mean" and key != "std")
            least, most = (low, high) if bounded else (value.ravel(), value.ravel())
            there = kept.get(name, {}).get(key)
            if not (is_image and key == "count") and not _within(there, value.size, least - slack, most + slack):
                raise MemobenchError(
                    f"{key} of {name} is {short(there)}, expected {short(value.tolist())} of the frames; {ADVICE}"
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
        policy: configuration of the policy.
        features: features of the dataset.
        imagenet: whether LeRobot replaces the statistics of images, which must exist, by ImageNet's.
    """
    from lerobot.utils.feature_utils import dataset_to_policy_features

    found: dict[str, Collection[str]] = {}
    for name, feature in dataset_to_policy_features(dict(features)).items():
        mode = policy.normalization_mapping.get(feature.type.value)
        keys = NEEDED.get(getattr(mode, "value", mode), ())
        if features[name]["dtype"] in IMAGES and imagenet:
            keys = (*keys, "mean", "std")
        depth = features[name]["dtype"] in IMAGES and 3 not in features[name]["shape"]
        if keys and name not in CLOCK and not depth:
            found[name] = keys
    return found


def lacking(folder: Path, needed: Mapping[str, Collection[str]]) -> list[str]:
    """Return the features of a dataset that lack one of the ``needed`` statistics."""
    there = recorded(folder)
    return [name for name, keys in needed.items() if set(keys) - set(there.get(name, {}))]


def complete(folder: Path, names: Sequence[str], notify: Callable[[str], None]) -> None:
    """Compute the statistics of a dataset's features and add missing ones to its ``meta/stats.json``.

    Args:
        folder: the dataset.
        names: features that lack statistics.
        notify: called with their names before they are computed.

    Raises:
        MemobenchError: a column is missing or damaged, or the folder cannot be written.
    """
    notify(f"computing and adding statistics that {folder / STATS_FILE} lacks: {', '.join(names)}")
    there = recorded(folder)
    for name, stats in compute(folder, names).items():
        there[name] = {key: value.tolist() for key, value in stats.items()} | there.get(name, {})
    with explaining_disk_errors(folder):
        write_file(folder / STATS_FILE, json.dumps(there, indent=4))
