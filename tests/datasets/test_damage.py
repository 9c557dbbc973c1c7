"""Damaged files: readers end in a result or in a `MemobenchError` that names the file, and `validate` finds all."""

from __future__ import annotations

import json
import shutil
from functools import reduce
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.datasets.card import describe
from lerobot_memobench.datasets.episodes import check_whole
from lerobot_memobench.datasets.validate import check_description, validate
from lerobot_memobench.datasets.write import write_dataset
from lerobot_memobench.envs.episode_log import read_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import check_checkpoint, checkpoint_folder
from tests.support.lerobot_policies import words_of

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0b' * 32}\nsize 48213\n"


@pytest.fixture(scope="module")
def swapped(shown, tmp_path_factory) -> Path:
    """The episodes of `simulated` in another order: every file is valid in itself."""
    return write_dataset(shown[::-1], tmp_path_factory.mktemp("swapped") / "ds")


# --- one damage per kind of file ---

FILES = {
    "data": "data/**/*.parquet",
    "episodes": "meta/episodes/**/*.parquet",
    "states": "states/**/*.parquet",
    "video": "videos/*wrist_image/**/*.mp4",
    "tasks": "meta/tasks.parquet",
    "info": "meta/info.json",
    "stats": "meta/stats.json",
    "manifest": "manifest.json",
}


def missing(path: Path, _: Path) -> None:
    path.unlink()


def truncated(path: Path, _: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def edited(path: Path, _: Path) -> None:
    """Change one byte: of JSON a digit, else the middle one."""
    content = path.read_bytes()
    at = content.index(b"1") if path.suffix == ".json" else len(content) // 2
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])


def pointer(path: Path, _: Path) -> None:
    path.write_text(POINTER)


def exchanged(path: Path, twin: Path) -> None:
    shutil.copy(twin, path)


@pytest.fixture
def files_only(monkeypatch) -> None:
    monkeypatch.setattr("lerobot_memobench.datasets.validate.replay", lambda *_, **__: None)


DAMAGED = [
    *(("data", missing), ("episodes", truncated), ("states", exchanged), ("video", edited)),
    *(("tasks", pointer), ("info", missing), ("stats", edited), ("manifest", truncated)),
]
"""Each kind of file and each damage."""


@pytest.mark.usefixtures("files_only")
@pytest.mark.parametrize(("kind", "damage"), DAMAGED)
def test_validate_finds_every_damage(simulated, swapped, copy, kind, damage):
    folder = copy(simulated)
    (path,), (twin,) = folder.glob(FILES[kind]), swapped.glob(FILES[kind])
    damage(path, twin)
    name = path.relative_to(folder).as_posix()
    verdicts, message = [], ""
    try:
        verdicts = validate(folder)
    except MemobenchError as error:
        message = str(error)
    if message:
        assert path.name in message or damage is missing
        return
    found = [each for each in verdicts if each.subject == name or name in str(each.disagreement)]
    assert any(each.disagreement or (damage in (missing, exchanged) and each.note) for each in found), verdicts
    if damage is pointer:
        assert any("git lfs pull" in str(each.disagreement) for each in found)


@pytest.mark.parametrize(
    ("kind", "damage"), [("data", truncated), ("episodes", missing), ("states", pointer), ("video", truncated)]
)
def test_quick_check_and_description_find_cut_files(simulated, copy, tmp_path, kind, damage):
    folder = copy(simulated)
    (path,) = folder.glob(FILES[kind])
    damage(path, path)
    for read in (check_whole, lambda folder: describe(folder, tmp_path / "out")):
        with pytest.raises(MemobenchError) as error:
            read(folder)
        assert str(path) in str(error.value) or damage is missing
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("kind", "damage"), [("data", truncated), ("tasks", pointer)])
def test_training_names_the_damaged_file(simulated, copy, tmp_path, capsys, kind, damage):
    folder = copy(simulated)
    (path,) = folder.glob(FILES[kind])
    damage(path, path)
    train = ["train", *words_of("act"), "policy.device=cpu", "batch_size=4", "num_workers=0", "steps=3"]
    assert lerobot([*train, f"dataset={folder}", f"output_dir={tmp_path / 'run'}"]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert str(path) in last
    assert ("git lfs pull" in last) == (damage is pointer)


@pytest.mark.parametrize("command", ["validate", "train"])
def test_earlier_format_is_named_with_its_converter(synthetic, copy, tmp_path, capsys, command):
    root = copy(synthetic)
    info = json.loads((root / "meta" / "info.json").read_text())
    (root / "meta" / "info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    shutil.rmtree(root / "meta" / "episodes")  # v2.1 has meta/episodes.jsonl
    train = ["train", "policy=act", f"dataset={root}", f"output_dir={tmp_path / 'run'}"]
    assert (lerobot(train) if command == "train" else memobench([command, str(root)])) == 2
    assert f"convert_dataset_v21_to_v30 --repo-id=local/converted --root={root}" in capsys.readouterr().err


def test_a_dataset_is_no_log(synthetic, copy):
    root = copy(synthetic)
    (root / "meta" / "episodes.jsonl").write_text('{"episode_index": 0}')  # as LeRobot's format v2.1 has it
    with pytest.raises(MemobenchError, match="is a LeRobotDataset, expected the folder of an evaluation"):
        read_log(root)


@pytest.mark.parametrize("name", ["episodes.jsonl", "episodes.jsonl.gz", "weights"])
def test_pointers_to_logs_and_weights_are_named(tmp_path, name):
    if name == "weights":
        checkpoint = Path(shutil.copytree(checkpoint_folder("memobench_strict"), tmp_path / "policy"))
        path = next(checkpoint.glob("*.safetensors"))
    else:
        path = tmp_path / name
    path.write_text(POINTER)
    with pytest.raises(MemobenchError, match=f"{path.name} is a Git LFS pointer.*git lfs pull"):
        check_checkpoint(str(checkpoint)) if name == "weights" else read_log(tmp_path)


# --- numbers of the metadata ---

IMAGE = "observation.images.image"
TIMES = [f"videos/{IMAGE}/from_timestamp", f"videos/{IMAGE}/to_timestamp"]
NUMBERS = ["dataset_to_index", "length", "episode_index", "tasks", "data/file_index", f"videos/{IMAGE}/file_index"]
INFO = [
    *((("total_frames",), 13), (("fps",), 10), (("splits", "train"), "0:1")),
    (("data_path",), "data/{chunk_index:03d}-{file_index:03d}.parquet"),
    *((("features", "action", "shape"), [6]), (("features", "action", "dtype"), "float64")),
    *((("features", "action", "names"), ["x", "y"]), (("features", "action"), None)),
    (("features", "gripper"), {"dtype": "float32", "shape": [1], "names": None}),
    *((("features", IMAGE, "shape"), [32, 64, 3]), (("features", IMAGE, "info", "video.fps"), 30)),
]


def noticed(folder: Path) -> str:
    """Return the message of the first check of numbers that fails."""
    for check in (check_whole, check_description):
        try:
            check(folder)
        except MemobenchError as error:
            return str(error)
    return ""


@pytest.mark.parametrize("names", [*([name] for name in NUMBERS), TIMES[:1], TIMES], ids=", ".join)
def test_other_bounds_and_places_are_found(simulated, copy, names):
    folder = copy(simulated)
    assert noticed(folder) == ""
    (path,) = folder.glob("meta/episodes/**/*.parquet")
    table = pd.read_parquet(path)
    for column in names:
        values = table[column].tolist()
        values[1] = ["another task"] if column == "tasks" else values[1] + (0.05 if "timestamp" in column else 1)
        table[column] = values
    table.to_parquet(path)
    assert "meta/episodes" in noticed(folder) or path.name in noticed(folder)


@pytest.mark.parametrize("name", ["frame_index", "task_index", "timestamp"])
def test_other_numbers_of_frames_are_found(simulated, copy, name):
    folder = copy(simulated)
    (path,) = folder.glob("data/**/*.parquet")
    table = pq.read_table(path)
    changed = table.column(name).to_numpy().copy()
    changed[4] += 1
    place = table.schema.get_field_index(name)
    pq.write_table(table.set_column(place, name, pa.array(changed)), path)
    assert noticed(folder)


@pytest.mark.parametrize(("keys", "value"), INFO, ids=[".".join(keys) for keys, _ in INFO])
def test_other_descriptions_are_found(simulated, copy, keys, value):
    folder = copy(simulated)
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    part = reduce(dict.__getitem__, keys[:-1], info)
    if value is None:
        del part[keys[-1]]
    else:
        part[keys[-1]] = value
    path.write_text(json.dumps(info))
    assert noticed(folder)


def test_task_numbers_are_places(simulated, copy):
    """LeRobot takes the text of a task by its place in the table."""
    folder = copy(simulated)
    path = folder / "meta" / "tasks.parquet"
    tasks = pd.read_parquet(path)
    pd.concat([tasks.rename(index={tasks.index[0]: "another task"}), tasks + 1]).to_parquet(path)
    assert "total_tasks" in noticed(folder)
    (tasks + 1).to_parquet(path)
    assert "task_index" in noticed(folder)


@pytest.mark.usefixtures("files_only")
def test_validate_compares_bounds_and_columns(simulated, copy):
    folder = copy(simulated)
    (folder / "manifest.json").unlink()
    (path,) = folder.glob("meta/episodes/**/*.parquet")
    table = pd.read_parquet(path)
    table.loc[0, "dataset_to_index"] += 60
    table.to_parquet(path)
    info = folder / "meta" / "info.json"
    info.write_text(info.read_text().replace('"float32"', '"float64"', 1))
    found = [verdict.disagreement for verdict in validate(folder) if verdict.subject == "meta/info.json"]
    assert ["dataset_to_index" in found[0], "type of the column" in found[1]] == [True, True]
