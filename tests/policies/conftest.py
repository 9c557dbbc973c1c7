"""The datasets that policies are trained on, by the names of these tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def dataset_root(synthetic: Path) -> Path:
    return synthetic


@pytest.fixture(scope="session")
def root(objects: Path) -> Path:
    return objects
