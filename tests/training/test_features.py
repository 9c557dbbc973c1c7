"""The feature cache: a file per episode, computed once; its name is a hash of its inputs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from lerobot_memobench.datasets.frames import FrameLookup, read_frame_table
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.training import features as module
from lerobot_memobench.training.features import EpisodeFeatures, Features, episode_file, features_folder, make_features
from tests.support.held_dataset import make_held_dataset
from tests.support.synthetic_dataset import LENGTHS

CAMERA = "observation.images.image"


class Encoder:
    """Numbers frames: the features of frame t of an episode are t."""

    def __init__(self) -> None:
        self.calls: list[int] = []

    def features(self, key: str = "numbers") -> Features:
        return Features(key, 6, self.encode)

    def encode(self, frames: torch.Tensor) -> torch.Tensor:
        return frames.view(-1, 1, 1).expand(-1, 2, 3)

    def read(self, episode: int, frames: Sequence[int]) -> torch.Tensor:
        self.calls.append(episode)
        return torch.tensor(frames, dtype=torch.float32)

    def made(self, root: Path, **how: Any) -> EpisodeFeatures:
        return make_features(root, "test", self.features(), camera=CAMERA, read=self.read, **{"batch_size": 7} | how)


@pytest.fixture
def root(synthetic: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(synthetic, tmp_path / "data"))


@pytest.mark.parametrize("stride", [1, 4])
def test_features_of_frames_and_slots(root: Path, stride: int) -> None:
    found = Encoder().made(root, stride=stride)
    for episode, length in enumerate(LENGTHS):
        slots = range(0, -(-length // stride))
        assert found.tokens(episode, [*slots])[:, 0, 0].tolist() == [stride * slot for slot in slots]
    lookup = FrameLookup(root, read_frame_table(root), stride=stride, remember=found.tokens)
    assert lookup.tokens(1, [0, 2])[:, 1, 2].tolist() == [0, 2 * stride]
    index = LENGTHS[0] + 2 * stride
    assert found.of_frames([index, 0])[:, 0, 0].tolist() == [2 * stride, 0]
    assert len(found.all_frames()) == sum(-(-length // stride) for length in LENGTHS)


def test_complete_caches_move_with_their_dataset(root: Path, tmp_path: Path) -> None:
    Encoder().made(root)
    moved = Path(shutil.move(root, tmp_path / "elsewhere"))
    again = Encoder()
    assert again.made(moved).tokens(2, [3]).shape == (1, 2, 3)
    assert again.calls == []


def test_missing_episodes_are_computed(root: Path) -> None:
    first = Encoder().made(root)
    episode_file(first.folder, 1).unlink()
    again, seen = Encoder(), list[tuple[int, int]]()
    again.made(root, progress=lambda done, count: seen.append((done, count)))
    assert set(again.calls) == {1}
    assert seen == [(2, 3), (3, 3)]


def test_name_depends_on_encoder_camera_stride_and_videos(root: Path) -> None:
    encoder = Encoder()
    names = {
        features_folder(root, "test", encoder.features(key), camera, stride).name
        for key, camera, stride in (
            *(("numbers", CAMERA, 1), ("numbers", CAMERA, 2), ("others", CAMERA, 1)),
            ("numbers", "observation.images.wrist_image", 1),
        )
    }
    video = next((root / "videos" / CAMERA).rglob("*.mp4"))
    video.write_bytes(video.read_bytes() + b"0")
    names.add(features_folder(root, "test", encoder.features(), CAMERA, 1).name)
    assert len(names) == 5


def test_a_scene_at_rest_is_encoded_once(tmp_path: Path) -> None:
    root = make_held_dataset(tmp_path / "data", images=True)
    expected = [0, 1, 2, 3, *[4] * 6, 10, 11, 12, 13, *[14] * 4, 18, 19, 20, 21, 22, 22]  # of `held_dataset.HOLDS`
    for stride in (1, 2):
        assert Encoder().made(root, stride=stride).episode(0)[:, 0, 0].tolist() == expected[::stride]


def test_processes_share_the_episodes(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second of two encodes every second episode, and waits for the first."""
    calls = {}
    for rank in (0, 1):
        encoder = Encoder()
        monkeypatch.setattr(module, "rank_of_world", lambda rank=rank: (rank, 2))
        monkeypatch.setattr(module.time, "sleep", lambda _: (_ for _ in ()).throw(TimeoutError))
        if rank == 0:
            with pytest.raises(TimeoutError):
                encoder.made(root)
        else:
            encoder.made(root)
        calls[rank] = set(encoder.calls)
    assert calls[0] == {0, 2}
    assert calls[1] == {1}


def test_full_disk_is_refused_before_encoding(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "free_bytes", lambda _: 10)
    encoder = Encoder()
    with pytest.raises(MemobenchError, match="feature cache"):
        encoder.made(root)
    assert encoder.calls == []
    assert not features_folder(root, "test", encoder.features(), CAMERA, 1).exists()


def test_damaged_file_is_named(root: Path) -> None:
    found = Encoder().made(root)
    path = episode_file(found.folder, 0)
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(MemobenchError, match=path.name):
        Encoder().made(root).tokens(0, [1])
