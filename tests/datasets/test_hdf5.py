"""Reading the published layout, without a simulator."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from lerobot_memobench.datasets.demonstration import labels
from lerobot_memobench.datasets.hdf5.reading import PublishedFile, Unusable, find_files, truth_from_intervals
from lerobot_memobench.errors import MemobenchError
from tests.support.published_files import write_published

SIZE = 32
ROWS = ["0010011", "0001111"]


@pytest.fixture
def demos(make_demo):
    return [make_demo(ROWS, seed=10_000 + k, size=SIZE) for k in range(2)]


@pytest.fixture
def path(demos, tmp_path):
    return write_published(tmp_path / "hdf5" / "synthetic_task_demo.hdf5", demos, scene="<mujoco/>")


def test_reading_back(path, demos):
    with PublishedFile(path) as file:
        assert (file.groups(), file.announced()) == (["demo_0", "demo_1"], 2)
        for group, demo in zip(file.groups(), demos, strict=True):
            read = file.read(group)
            np.testing.assert_array_equal(read.states, demo.states)
            np.testing.assert_array_equal(read.actions, demo.actions)
            assert (read.image_size, read.model_file) == ((SIZE, SIZE), "<mujoco/>")
            assert read.metadata["key_frame"] == labels(demo).key_frames.tolist() == [2, 3]
            satisfied = truth_from_intervals(read.extras.satisfied_intervals, len(demo))
            np.testing.assert_array_equal(satisfied, demo.satisfied)
            frames = list(file.images(group))
            for camera in demo.images:
                np.testing.assert_array_equal([frame[camera] for frame in frames], demo.images[camera])
            flipped = next(file.images(group, upside_down=True))
            np.testing.assert_array_equal(flipped["image"][::-1], demo.images["image"][0])


def test_groups_in_the_order_of_their_numbers(path):
    with h5py.File(path, "a") as file:
        file.copy("data/demo_0", "data/demo_10")
        file.copy("data/demo_0", "data/demo_9")
        file["data"].create_group("mask")
    with PublishedFile(path) as file:
        assert file.groups() == ["demo_0", "demo_1", "demo_9", "demo_10", "mask"]
        with pytest.raises(Unusable, match="no group demo_<number>"):
            file.read("mask")


def _delete(name):
    def change(group):
        del group[name]

    return change


def _put(name, make):
    def change(group):
        old = group[name][:]
        del group[name]
        group[name] = make(old)

    return change


def _attribute(name, value):
    def change(group):
        if value is None:
            del group.attrs[name]
        else:
            group.attrs[name] = value

    return change


def _nan(old):
    old[3, 1] = np.nan
    return old


def _huge(old):
    old[3, 1] = -1e30
    return old


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_delete("states"), "array 'states' is missing"),
        (_delete("obs"), "group 'obs' is missing"),
        (_delete("obs/robot0_eye_in_hand_image"), "'obs/robot0_eye_in_hand_image' is missing"),
        (_put("actions", lambda old: old[:-1]), "different lengths: states 7, actions 6, agentview_image 7"),
        (_put("actions", lambda old: old[:, :6]), r"actions has shape \(7, 6\)"),
        (_put("actions", lambda old: old.astype(np.int64)), "actions has type int64, expected float32 or float64"),
        (_put("states", lambda old: old.astype(np.float32)), "states has type float32, expected float64"),
        (_put("states", _nan), "states holds a value that is not finite at frame 3"),
        (_put("states", _huge), r"states holds a value beyond 1e\+10 at frame 3, more than the simulator takes"),
        (_put("obs/agentview_image", lambda old: old.astype(np.float32)), "agentview_image has type float32"),
        (_put("obs/agentview_image", lambda old: old[:, :16]), "cameras have different sizes"),
        (_attribute("num_samples", None), "attribute 'num_samples' is missing"),
        (_attribute("num_samples", 8), "num_samples is 8, but its arrays have 7 frames"),
        (_attribute("meta_data", None), "attribute 'meta_data' is missing"),
        (_attribute("meta_data", "{'key_frame': [2]}"), "meta_data is no valid JSON"),
        (_attribute("meta_data", "[1]"), "meta_data holds a list"),
        (_attribute("meta_data", 7), "attribute 'meta_data' is of type int64"),
    ],
)
def test_what_is_wrong_with_a_group_is_said(path, change, reason):
    with h5py.File(path, "a") as file:
        change(file["data/demo_1"])
    with PublishedFile(path) as file:
        file.read("demo_0")
        with pytest.raises(Unusable, match=reason):
            file.read("demo_1")


def test_what_is_wrong_with_a_file_is_said(path, tmp_path):
    whole = path.read_bytes()
    (tmp_path / "cut.hdf5").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.hdf5").write_text("no HDF5")
    with h5py.File(tmp_path / "empty.hdf5", "w") as file:
        file.create_group("episodes")
    with h5py.File(path, "a") as file:
        del file["data"].attrs["bddl_file_content"]
    for name, reason in [
        ("cut.hdf5", "cut off"),
        ("text.hdf5", "no HDF5 file"),
        ("empty.hdf5", r"no group 'data' \(found episodes\)"),
        ("hdf5/synthetic_task_demo.hdf5", "attribute 'bddl_file_content' is missing"),
        ("absent.hdf5", "no such file"),
    ]:
        with pytest.raises(Unusable, match=reason):
            PublishedFile(tmp_path / name)


def test_finding_files(path, tmp_path):
    assert find_files(tmp_path / "hdf5") == [path]
    assert find_files(path) == [path]
    (tmp_path / "nothing").mkdir()
    with pytest.raises(MemobenchError, match="found no HDF5 file"):
        find_files(tmp_path / "nothing")
