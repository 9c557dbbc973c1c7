"""Statistics of a dataset: computed from its frames, compared with ``meta/stats.json``, and completed there.

LeRobot normalises by them. Datasets converted from its format v2.1 lack quantiles, others the statistics of images.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.constants import CLOCK
from lerobot_memobench.datasets.episodes import read_info
from lerobot_memobench.datasets.frames import read_frame_table, read_recorded
from lerobot_memobench.datasets.layout import ADVICE, STATS_FILE
from lerobot_memobench.datasets.video import ImageHistograms, Stats, frame_reader
from lerobot_memobench.datasets.write import numeric_stats
from lerobot_memobench.errors import MemobenchError, short
from lerobot_memobench.io import explaining_disk_errors, write_file
from lerobot_memobench.untrusted import read_json

IMAGES, TEXTS = ("video", "image"), ("string", "language")
BLOCK = 64  # images decoded at a time
NEEDED = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""LeRobot's mode of normalisation -> statistics that it uses."""
TOLERANCE, IMAGE_TOLERANCE = 1e-3, 0.02
"""Tolerance of numbers, as a share of their range, and of images' mean and deviation, as a share of all levels: the
recorded ones are of images before encoding."""


def measured(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the features with statistics: numbers and images, without clock and numbering."""
    from lerobot.utils.constants import DEFAULT_FEATURES

    counted = {*CLOCK, *DEFAULT_FEATURES}  # LeRobot's tools do not update the statistics of the numbering
    return [name for name, feature in features.items() if name not in counted and feature["dtype"] not in TEXTS]


def compute(folder: Path, names: Iterable[str]) -> dict[str, Stats]:
    """Compute the statistics of a dataset's features: exact for numbers, over LeRobot's sample of frames for images.

    Held frames do not count for numbers, as in `write`.
    """
    features, names = read_info(folder)["features"], list(names)
    cameras = [name for name in names if features[name]["dtype"] in IMAGES]
    columns, table = read_recorded(folder, [name for name in names if name not in cameras])
    stats = {name: numeric_stats(column.numpy()[~table.held]) for name, column in columns.items()}
    return stats | {camera: _image_stats(folder, camera) for camera in cameras}


def _image_stats(folder: Path, camera: str) -> Stats:
    from lerobot.datasets.compute_stats import aggregate_stats, sample_indices

    read, episodes = frame_reader(folder, camera), []
    for episode, length in enumerate(np.diff(read_frame_table(folder).episodes).tolist()):
        histograms = ImageHistograms()
        sampled = sample_indices(length)
        for first in range(0, len(sampled), BLOCK):
            images = read(episode, sampled[first : first + BLOCK])
            for image in (images * 255).round().byte().permute(0, 2, 3, 1).numpy():
                histograms.add(np.ascontiguousarray(image))
        episodes.append({camera: histograms.stats(sampled=True)})
    stats: Stats = aggregate_stats(episodes)[camera]
    return stats


def recorded(folder: Path) -> dict[str, dict[str, Any]]:
    """Return ``meta/stats.json``; empty where there is none."""
    if not (folder / STATS_FILE).exists():
        return {}
    return dict(read_json(folder / STATS_FILE, dict[str, dict[str, Any]], ADVICE, nan=True))


def check_statistics(folder: Path, names: Iterable[str]) -> None:
    """Compare the statistics of features in ``meta/stats.json`` with those of the frames.

    Quantiles must lie between the extremes only, because LeRobot's tools average the quantiles of episodes.
    """
    features, recorded_stats = read_info(folder)["features"], recorded(folder)
    for name, stats in compute(folder, names).items():
        is_image = features[name]["dtype"] in IMAGES
        low, high = (np.zeros(1), np.ones(1)) if is_image else (stats["min"].ravel(), stats["max"].ravel())
        slack = IMAGE_TOLERANCE if is_image else TOLERANCE * (1 + high - low)
        for key, value in stats.items():
            bounded = key.startswith("q") or (is_image and key != "mean" and key != "std")
            least, most = (low, high) if bounded else (value.ravel(), value.ravel())
            stored = recorded_stats.get(name, {}).get(key)
            try:
                numbers = np.asarray(stored, dtype=np.float64).ravel()
            except (TypeError, ValueError):
                numbers = np.empty(0)
            within = numbers.size == value.size and ((least - slack <= numbers) & (numbers <= most + slack)).all()
            if not within and not (is_image and key == "count"):
                raise MemobenchError(
                    f"{key} of {name} is {short(stored)}, expected {short(value.tolist())} of the frames; {ADVICE}"
                )


def needed_by(policy: Any, features: Mapping[str, Mapping[str, Any]], imagenet: bool) -> dict[str, Collection[str]]:
    """Return feature -> names of the statistics by which a training with the configuration ``policy`` normalises it.

    ``imagenet``: whether LeRobot replaces the statistics of images, which must exist, by ImageNet's.
    """
    from lerobot.utils.feature_utils import dataset_to_policy_features

    needed: dict[str, Collection[str]] = {}
    for name, feature in dataset_to_policy_features(dict(features)).items():
        mode = policy.normalization_mapping.get(feature.type.value)
        keys = NEEDED.get(getattr(mode, "value", mode), ())
        if features[name]["dtype"] in IMAGES and imagenet:
            keys = (*keys, "mean", "std")
        depth = features[name]["dtype"] in IMAGES and 3 not in features[name]["shape"]
        if keys and name not in CLOCK and not depth:
            needed[name] = keys
    return needed


def lacking(folder: Path, needed: Mapping[str, Collection[str]]) -> list[str]:
    """Return the features of a dataset that lack one of the ``needed`` statistics."""
    stats = recorded(folder)
    return [name for name, keys in needed.items() if set(keys) - set(stats.get(name, {}))]


def complete(folder: Path, names: Sequence[str], notify: Callable[[str], None]) -> None:
    """Compute the statistics of features that lack some, and add those to a dataset's ``meta/stats.json``."""
    notify(f"computing and adding statistics that {folder / STATS_FILE} lacks: {', '.join(names)}")
    recorded_stats = recorded(folder)
    for name, stats in compute(folder, names).items():
        recorded_stats[name] = {key: value.tolist() for key, value in stats.items()} | recorded_stats.get(name, {})
    with explaining_disk_errors(folder):
        write_file(folder / STATS_FILE, json.dumps(recorded_stats, indent=4))
