"""The synthetic dataset that policies are trained on."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)
# For small_policy.py and synthetic_dataset.py: pytest imports tests by their paths.
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The synthetic dataset, without a cache at first; tests that change it must copy it."""
    from synthetic_dataset import make_dataset

    return make_dataset(tmp_path_factory.mktemp("data") / "synthetic")
