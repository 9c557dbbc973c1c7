"""The feature cache as training and `memobench cache` make it: found, finished, side by side, elsewhere."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.datasets.feature_cache.layout import FOLDER
from lerobot_memobench.datasets.feature_cache.reading import FeatureCache
from lerobot_memobench.policies.memobench_mem.caching import cache_dataset, load_image_tower, open_cache
from lerobot_memobench.policies.memobench_mem.encoders import ImageTowerEncoder
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import made_for_training, small_config


def _opened(root: Path, **fields: Any) -> FeatureCache:
    """The cache that a policy opens when it is made to train."""
    config = small_config(**fields)
    return open_cache(root, config, load_image_tower(config))


def _copy(dataset_root: Path, root: Path) -> Path:
    """The dataset without its caches."""
    return shutil.copytree(dataset_root, root, ignore=shutil.ignore_patterns(FOLDER))


def test_training_reads_the_cache_that_the_command_wrote(
    dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = _copy(dataset_root, tmp_path / "data")
    folder = cache_dataset(root, small_config())
    assert folder.parent == root / FOLDER
    assert folder.name.startswith("tiny-stride1-")

    def refuse(*_: Any) -> None:
        raise AssertionError("it encodes again")

    monkeypatch.setattr(ImageTowerEncoder, "__call__", refuse)
    made_for_training(root)  # the policy's own tower reads what `memobench cache` wrote


@pytest.mark.parametrize("size", ["tiny", "small"])
def test_without_pictures_there_is_nothing_to_encode(
    tmp_path: Path, size: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root = make_object_dataset(tmp_path / "d1")
    capsys.readouterr()
    assert main(["cache", str(root), "--size", size]) == 2
    told = capsys.readouterr().err
    assert told == (
        f"memobench: {root} holds no pictures, which a detector and perception=pixels need; name a dataset with "
        "pictures, or leave detector out at perception=objects\n"
    )
    assert not (root / FOLDER).exists()


def test_training_finishes_a_cache_that_was_killed(
    dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = _copy(dataset_root, tmp_path / "data")
    seen: list[int] = []

    def killed_in_its_second_pass(perception: ImageTowerEncoder, images: torch.Tensor) -> torch.Tensor:
        if seen:
            raise KeyboardInterrupt
        seen.append(len(images))
        return torch.zeros(len(images), 16, perception.dim)

    with monkeypatch.context() as patched:
        patched.setattr(ImageTowerEncoder, "__call__", killed_in_its_second_pass)
        with pytest.raises(KeyboardInterrupt):
            cache_dataset(root, small_config(), batch_size=40)
    cache = _opened(root)
    assert cache.meta.complete
    assert not cache.tokens(0, [0]).any()  # the first episode, done before the kill, is not done again
    assert cache.tokens(1, [0]).any()


def test_caches_of_other_cameras_and_resolutions_lie_side_by_side(dataset_root: Path, tmp_path: Path) -> None:
    root = _copy(dataset_root, tmp_path / "data")
    wrist, small = {"memory_camera": "observation.images.wrist_image"}, {"image_resolution": (48, 48)}
    first = cache_dataset(root, small_config())
    tokens = (first / "tokens.bin").read_bytes()
    others = [cache_dataset(root, small_config(**fields)) for fields in (wrist, small)]
    assert len({first, *others}) == 3
    assert (first / "tokens.bin").read_bytes() == tokens
    assert _opened(root, **wrist).meta.camera == wrist["memory_camera"]


def test_a_cache_can_be_put_elsewhere(dataset_root: Path, tmp_path: Path) -> None:
    root = _copy(dataset_root, tmp_path / "data")
    cache = _opened(root, feature_cache_dir=str(tmp_path / "caches"))
    assert not (root / FOLDER).exists()
    (folder,) = (path for path in (tmp_path / "caches").iterdir() if path.is_dir())
    assert folder.name.startswith("data-tiny-stride1-")
    assert cache.folder == folder
