"""What the head of a file says is named before damage is: a pointer, an earlier format, a lock, a link; and statistics
that a dataset lacks are computed.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.datasets.hdf5.reading import PublishedFile, Unusable
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.lerobot_format.layout import image_key, read_info
from lerobot_memobench.datasets.statistics import check_statistics, complete, lacking, measured
from lerobot_memobench.envs.episode_log import read_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import check_fetched
from lerobot_memobench.policies.checkpoint import check_checkpoint, checkpoint_folder

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0b' * 32}\nsize 48213\n"
TRUTH = ["0" * 6 + "1" * 9, "0" * 13 + "1" * 2]


@pytest.fixture
def root(make_demo, tmp_path) -> Path:
    return write_dataset([make_demo(TRUTH, size=32), make_demo(TRUTH, size=32, seed=9)], tmp_path / "ds")


def last_line(run: Callable[[list[str]], int], line: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert run(line) == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize("pattern", ["data/**/*.parquet", "meta/tasks.parquet", "videos/*wrist*/**/*.mp4"])
def test_a_pointer_in_a_dataset_is_named_with_the_command_that_fetches_it(root, tmp_path, capsys, pattern):
    (path,) = root.glob(pattern)
    path.write_text(POINTER)
    train = ["train", "policy=memobench_mem", "size=tiny", f"dataset={root}", f"output_dir={tmp_path / 'run'}"]
    lines = [last_line(lerobot, train, capsys)]
    if "tasks" not in pattern:  # which describing does not read
        lines.append(last_line(memobench, ["describe", str(root)], capsys))
    assert memobench(["validate", str(root)]) == 1
    lines += [
        line for line in capsys.readouterr().err.splitlines() + capsys.readouterr().out.splitlines() if "LFS" in line
    ]
    for line in lines:
        assert str(path) in line, line
        assert "git lfs pull" in line, line
        assert "damaged" not in line, line


@pytest.mark.parametrize("name", ["episodes.jsonl", "episodes.jsonl.gz"])
def test_a_pointer_in_the_place_of_a_log_or_of_weights_is_named(tmp_path, name):
    (tmp_path / name).write_text(POINTER)
    with pytest.raises(MemobenchError, match=f"{name} is a Git LFS pointer.*git lfs pull"):
        read_log(tmp_path)
    checkpoint = Path(shutil.copytree(checkpoint_folder("memobench_small"), tmp_path / "policy"))
    check_fetched(checkpoint)
    for weights in checkpoint.glob("*.safetensors"):
        kept = weights.read_bytes()
        weights.write_text(POINTER)
        with pytest.raises(MemobenchError, match=f"{weights.name} is a Git LFS pointer.*git lfs pull"):
            check_checkpoint(str(checkpoint))
        weights.write_bytes(kept)


@pytest.mark.parametrize("command", ["validate", "describe", "cache", "train"])
def test_an_earlier_format_is_named_with_its_converter(root, tmp_path, capsys, command):
    info = json.loads((root / "meta" / "info.json").read_text())
    (root / "meta" / "info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    line = [command, str(root)]
    if command == "train":
        line = ["train", "policy=act", f"dataset={root}", f"output_dir={tmp_path / 'run'}"]
    told = last_line(lerobot if command == "train" else memobench, line, capsys)
    assert "v2.1" in told
    assert f"python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/converted --root={root}" in told


def opened(path: Path) -> str:
    """Return why a file is not read."""
    with pytest.raises(Unusable) as error, PublishedFile(path) as file:
        file.read("demo_0")
    return str(error.value)


def test_a_lock_a_pointer_and_a_broken_link_are_no_damage(tmp_path):
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs.update(bddl_file_name="a", bddl_file_content="b")
        group = data.create_group("demo_0")
        group["actions"] = np.zeros((3, 7))
        group["states"] = h5py.ExternalLink("elsewhere.hdf5", "/states")
    with path.open("rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)  # as HDF5 locks what it writes
        assert "is locked" in opened(path)
    assert "'states' is a link into the file 'elsewhere.hdf5'" in opened(path)
    with h5py.File(path, "r+") as file:
        del file["data/demo_0"]
        file["data/demo_0"] = h5py.ExternalLink("elsewhere.hdf5", "/demo_0")
    assert "'demo_0' is a link into the file 'elsewhere.hdf5'" in opened(path)
    path.write_text(POINTER)
    assert "git lfs pull" in opened(path)


def test_statistics_that_are_lacking_are_computed_and_added(root):
    path, names = root / "meta" / "stats.json", measured(read_info(root)["features"])
    check_statistics(root, names)
    whole = json.loads(path.read_text())
    assert set(names) < set(whole)
    camera = image_key("image")
    left = {name: {key: one[key] for key in one if key[0] != "q"} for name, one in whole.items() if name != camera}
    path.write_text(json.dumps(left))
    needed = {"action": ("q01", "q99"), camera: ("mean", "std"), "observation.state": ("mean", "std")}
    assert lacking(root, needed) == ["action", camera]
    told: list[str] = []
    complete(root, lacking(root, needed), told.append)
    again = json.loads(path.read_text())
    assert lacking(root, needed) == []
    assert again["action"] == whole["action"]
    assert again["observation.state"] == left["observation.state"]
    np.testing.assert_allclose(again[camera]["mean"], whole[camera]["mean"], atol=0.02)
    assert len(told) == 1
    assert all(name in told[0] for name in ("action", camera))


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("action", "mean", 0.5),
        ("action", "q99", 7.0),
        ("observation.state", "count", 29),
        (image_key("image"), "std", 0.9),
    ],
)
def test_other_statistics_are_named(root, name, key, value):
    path = root / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    changed = np.asarray(stats[name][key])
    changed.flat[0] = value
    stats[name][key] = changed.tolist()
    path.write_text(json.dumps(stats))
    with pytest.raises(MemobenchError, match=f"^{key} of {name} is"):
        check_statistics(root, measured(read_info(root)["features"]))
