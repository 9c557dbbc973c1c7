"""The synthetic dataset that policies are trained on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The synthetic dataset, without a cache at first; tests that change it must copy it."""
    from tests.support.synthetic_dataset import make_dataset

    return make_dataset(tmp_path_factory.mktemp("data") / "synthetic")


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of objects, with records; tests that change it must copy it."""
    from tests.support.object_dataset import make_object_dataset

    return make_object_dataset(tmp_path_factory.mktemp("data") / "objects", records=True)
