"""The dataset that studies are made on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def twice_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Objects as slots: four episodes of one task, two of another (`object_dataset.NAMES`)."""
    from tests.support.object_dataset import make_object_dataset

    return make_object_dataset(tmp_path_factory.mktemp("data") / "twice", repeats=2, records=True)
