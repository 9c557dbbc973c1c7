"""Demonstrations as a LeRobotDataset v3.0.

Two ways in: :func:`write_dataset` takes demonstrations; :func:`assemble` takes episodes that workers have
staged, already encoded. Both give the same bytes for the same episodes. LeRobot's own metadata writer and
feature schema are used; its frame-by-frame recording loop is not, because it writes every image as PNG first
and copies a growing video again for every episode, and because it drops language rows, which a second pass
has to add. Here a table holds them from the start, so there is no state in which a dataset lacks a column.
"""

from lerobot_memobench.datasets.lerobot_format.assembling import assemble, write_dataset
from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    HDF5_FOLDER,
    MANIFEST_FILE,
    check_destination,
    dataset_features,
    image_key,
    is_dataset,
)
from lerobot_memobench.datasets.lerobot_format.reading import episodes_where

__all__ = [
    "DEFAULT_REPO_ID",
    "HDF5_FOLDER",
    "MANIFEST_FILE",
    "assemble",
    "check_destination",
    "dataset_features",
    "episodes_where",
    "image_key",
    "is_dataset",
    "write_dataset",
]
