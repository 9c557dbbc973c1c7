"""Statistics of images and numbers, by the names under which LeRobot keeps and uses them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)

BLOCK = 16
"""Columns of which statistics are made at once: of all, a copy in float64 for thousands of episodes is gigabytes."""

Stats = dict[str, NDArray]


class ImageHistograms:
    """Statistics of a video's frames, collected while they pass: a histogram of 256 bins per frame and channel.

    LeRobot takes frames evenly spread over the episode, at least 100; which ones is known only at its end. A
    frame's histograms are 3 kB, the frame itself 192 kB.
    """

    def __init__(self) -> None:
        self._counts: list[NDArray[np.int32]] = []

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Count one more frame, (H, W, 3) uint8."""
        import cv2

        counts = [cv2.calcHist([frame], [channel], None, [256], [0, 256])[:, 0] for channel in range(3)]
        self._counts.append(np.array(counts, dtype=np.int32))

    def stats(self) -> Stats:
        """Return LeRobot's statistics: each (3, 1, 1), in [0, 1], and ``count`` (1,).

        Over the frames that LeRobot samples, but exact over their pixels: eight bits need a histogram of 256
        bins, not of 5,000 adaptive ones.
        """
        from lerobot.datasets.compute_stats import sample_indices

        chosen = sample_indices(len(self._counts))
        counts = np.stack([self._counts[index] for index in chosen]).sum(axis=0, dtype=np.int64)
        levels, total = np.arange(256) / 255.0, counts[0].sum()
        mean = counts @ levels / total
        cumulative = counts.cumsum(axis=1)
        stats = {
            "min": levels[(counts > 0).argmax(axis=1)],
            "max": levels[255 - (counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0)),
        }
        for q in QUANTILES:
            stats[f"q{int(q * 100):02d}"] = levels[(cumulative >= q * total).argmax(axis=1)]
        return {name: value.reshape(3, 1, 1) for name, value in stats.items()} | {"count": np.array([len(chosen)])}


def image_stats(frames: NDArray[np.uint8]) -> Stats:
    """Return the statistics of (T, H, W, 3) uint8 frames, see :class:`ImageHistograms`."""
    histograms = ImageHistograms()
    for frame in frames:
        histograms.add(frame)
    return histograms.stats()


def numeric_stats(values: NDArray) -> Stats:
    """Return exact statistics of (T,) or (T, n) numbers over T: each (n,) (n = 1 for (T,)), and ``count``
    (1,).

    LeRobot averages the episodes' quantiles; over a whole dataset that is no quantile. pi0.5 normalises by
    q01 and q99, so they are computed from all frames here.
    """
    flat = values.reshape(len(values), -1)
    blocks = [_stats_of(flat[:, start : start + BLOCK].astype(np.float64)) for start in range(0, flat.shape[1], BLOCK)]
    stats = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    return stats | {"count": np.array([len(values)])}


def _stats_of(flat: NDArray[np.float64]) -> Stats:
    stats = {"min": flat.min(0), "max": flat.max(0), "mean": flat.mean(0), "std": flat.std(0)}
    quantiles = np.quantile(flat, QUANTILES, axis=0, overwrite_input=True)
    return stats | {f"q{int(q * 100):02d}": row for q, row in zip(QUANTILES, quantiles, strict=True)}
