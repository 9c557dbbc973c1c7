"""The dataset that studies are made on."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)
sys.path.insert(0, str(Path(__file__).parents[1]))  # for object_dataset.py: pytest imports tests by their paths


@pytest.fixture(scope="session")
def twice_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Objects as slots: four episodes of one task, two of another (`object_dataset.NAMES`)."""
    from object_dataset import make_object_dataset

    return make_object_dataset(tmp_path_factory.mktemp("data") / "twice", repeats=2, records=True)
