"""Labelled images on disk: made once, reproducible, and checked when they are read."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from research.detector.data import (
    KINDS_FILE,
    PER_FRAME,
    TESTED,
    TRAINED,
    DetectorData,
    EpisodeImages,
    ExpertState,
    Pictures,
    Scenes,
)
from research.detector.randomisation import DomainRandomisation
from tests.support.labelled_images import BOWLS, simulation, synthetic


@pytest.mark.slow
def test_an_episode_is_made_once_and_the_same_again(tmp_path: Path) -> None:
    pictures = DetectorData([BOWLS], 30_000, 1, 2).pictures(tmp_path, TRAINED)
    assert PER_FRAME <= len(pictures) <= 2 * PER_FRAME
    (file,) = tmp_path.glob("*.npy")
    first = file.read_bytes()
    made = file.stat().st_mtime_ns
    DetectorData([BOWLS], 30_000, 1, 2).pictures(tmp_path, TRAINED)
    assert file.stat().st_mtime_ns == made
    again = EpisodeImages(BOWLS, 30_000, tmp_path / "again.npy", 2)
    again.run()
    assert again.folder.read_bytes() == first
    rows = pictures.rows([0, 1])
    assert rows["camera"].tolist() == [0, 1]
    assert (rows["count"] > 0).all()


def test_a_scene_that_mujoco_refuses_is_randomised_again(monkeypatch: pytest.MonkeyPatch) -> None:
    apply, calls = DomainRandomisation.apply, list[bool]()

    def refused_once(self: DomainRandomisation, *, reach: bool) -> bool:
        calls.append(reach)
        if len(calls) == 1:
            raise mujoco.FatalError("mj_narrowphase: collision function returned 9 contacts")
        return apply(self, reach=reach)

    monkeypatch.setattr(DomainRandomisation, "apply", refused_once)
    sim = simulation(BOWLS)
    rows = [*Scenes(sim, np.random.default_rng(0)).images(ExpertState(sim.state(), (), near=False))]
    assert [int(row["scene"]) for row in rows] == [0, 0, 1, 1, 2, 2]


def test_files_are_read_as_one(tmp_path: Path) -> None:
    rows = synthetic(5)
    for name, part in (("a", rows[:2]), ("b", rows[2:])):
        np.save(tmp_path / f"{name}.npy", part)
    pictures = Pictures([tmp_path / "a.npy", tmp_path / "b.npy"])
    assert len(pictures) == 5
    assert (pictures.rows([4, 1, 2])["pixels"] == rows["pixels"][[4, 1, 2]]).all()


@pytest.mark.parametrize("content", [b"", b"not an array"])
def test_damaged_files_are_named(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "damaged.npy"
    file.write_bytes(content)
    with pytest.raises(MemobenchError, match="damaged"):
        Pictures([file])


def test_other_arrays_are_no_pictures(tmp_path: Path) -> None:
    np.save(tmp_path / "other.npy", np.zeros(3))
    with pytest.raises(MemobenchError, match="no pictures of this version"):
        Pictures([tmp_path / "other.npy"])


def test_a_folder_of_other_kinds_is_refused(tmp_path: Path) -> None:
    (tmp_path / KINDS_FILE).write_text(json.dumps(["sock"]))
    with pytest.raises(MemobenchError, match="other kinds"):
        DetectorData([BOWLS], 30_000, 1, 1).pictures(tmp_path, TRAINED)


@pytest.mark.parametrize(("first", "allowed"), [(7, TRAINED), (20_000, TRAINED), (39_999, TRAINED), (30_000, TESTED)])
def test_seeds_of_training_test_and_evaluation_are_apart(tmp_path: Path, first: int, allowed: range) -> None:
    with pytest.raises(MemobenchError, match="seeds"):
        DetectorData([BOWLS], first, 2, 1).pictures(tmp_path, allowed)
