"""Datasets to train on, made once for the tests of policies and of training; tests that change one copy it."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of squares, with one prompt."""
    from tests.support.synthetic_dataset import make_dataset

    return make_dataset(tmp_path_factory.mktemp("data") / "synthetic")


@pytest.fixture(scope="session")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Object slots without images, with two prompts and records."""
    from tests.support.synthetic_dataset import make_object_dataset

    return make_object_dataset(tmp_path_factory.mktemp("data") / "objects", records=True)
