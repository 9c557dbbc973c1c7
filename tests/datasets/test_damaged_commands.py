"""Whole commands on a small dataset and on a file in the published layout, damaged in any way.

Each ends in a result or in a sentence, whether a value, a text, a column or a byte is another.
"""

from __future__ import annotations

import contextlib
import json
import random
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_memobench.cli import data as commands
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.hdf5.mjcf import model_file
from lerobot_memobench.datasets.hdf5.writing import write_task_file
from lerobot_memobench.datasets.lerobot_format import write_dataset
from lerobot_memobench.datasets.replay import resimulate
from lerobot_memobench.datasets.staging.stage import stage_demonstration
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks import get_task

from .. import mutations

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
FRAMES, EXEC_START, SIZE = 6, 2, 32
DATASET, FILES = "dataset", "published"

Damage = Callable[[Path, random.Random], None]


def demonstration() -> Demonstration:
    """Six steps of a task with a prompt, and small pictures."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (FRAMES, 7)).astype(np.float32)
    demo = resimulate(get_task(TASK), 10_000, actions, EXEC_START)
    images = rng.integers(0, 255, (FRAMES, SIZE, SIZE, 3), dtype=np.uint8)
    xml = model_file(demo.task, demo.fixture_poses)
    return replace(demo, images={"image": images, "wrist_image": 255 - images}, model_xml=xml)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, and the same demonstration twice in a file of the published layout."""
    folder, demo = tmp_path_factory.mktemp("whole"), demonstration()
    write_dataset([demo], folder / "source" / DATASET)
    staged = stage_demonstration(demo, folder / "staged", ("hdf5",))
    file = folder / "source" / FILES / f"{TASK}_demo.hdf5"
    write_task_file(file, staged.hdf5_attributes, [staged.hdf5] * 2)
    return folder / "source"


# --- what is damaged ---


def any_json(folder: Path, rng: random.Random) -> None:
    """info.json, stats.json or manifest.json, now and then the card."""
    names = ("meta/info.json", "meta/info.json", "meta/stats.json", "manifest.json")
    mutations.damage(folder / rng.choice(names), rng)
    if rng.random() < 0.05:
        mutations.damage(folder / "README.md", rng, mutations.mutated_bytes)


def any_bytes(folder: Path, rng: random.Random) -> None:
    """A parquet file or a video."""
    paths = [path for suffix in ("parquet", "mp4") for path in sorted(folder.rglob(f"*.{suffix}"))]
    mutations.damage(rng.choice(paths), rng, mutations.mutated_bytes)


def any_column(folder: Path, rng: random.Random) -> None:
    """A parquet file with another value, which may change its column's type, without a column, or without rows."""
    path = rng.choice(sorted(folder.rglob("*.parquet")))
    table = pq.read_table(path)
    if rng.random() < 0.05:
        pq.write_table(table.slice(0, rng.randrange(table.num_rows)), path)
        return
    number = rng.randrange(table.num_columns)
    name, values = table.column_names[number], table.column(number).to_pylist()
    row = rng.randrange(len(values))
    if isinstance(values[row], str) and values[row][:1] in ("{", "[") and rng.random() < 0.8:
        values[row] = mutations.mutated_json(values[row].encode(), rng).decode(errors="replace")
    else:
        values[row] = mutations.mutated_value(values[row], rng)
    pq.write_table(table.drop_columns([name]), path)
    if rng.random() < 0.8:
        with contextlib.suppress(pa.ArrowException, TypeError, ValueError, OverflowError):  # parquet has no such value
            pq.write_table(table.set_column(number, name, pa.array(values)), path)


def any_attribute(folder: Path, rng: random.Random) -> None:
    """An attribute of a file in the published layout, or what a JSON text among them says."""
    with h5py.File(next(folder.glob("*.hdf5")), "r+") as file:
        group = rng.choice([file["data"], file["data"], *file["data"].values()])
        key = rng.choice(list(group.attrs))
        value: Any = group.attrs[key]
        if rng.random() < 0.1:
            del group.attrs[key]
            return
        if isinstance(value, str) and rng.random() < 0.7:
            mutate = mutations.mutated_json if value[:1] in ("{", "[") else mutations.mutated_bytes
            value = mutate(value.encode(), rng).decode(errors="replace")
        else:
            value = rng.choice([*mutations.VALUES, np.float32(1), np.array(["a", "b"], "S")])
        try:
            group.attrs[key] = value
        except (TypeError, ValueError, OverflowError, OSError):  # HDF5 takes no such value
            group.attrs[key] = np.array([1.5, np.nan])


def any_array(folder: Path, rng: random.Random) -> None:
    """An array of a file in the published layout: gone, of another type or shape, or with another number in it."""
    with h5py.File(next(folder.glob("*.hdf5")), "r+") as file:
        group = rng.choice(list(file["data"].values()))
        names: list[str] = []
        group.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        name = rng.choice(names)
        values = group[name][()]
        del group[name]
        kind = rng.randrange(6)
        if kind == 0:
            group.create_group(name)
        elif kind == 1:
            group[name] = values.astype(rng.choice(["f2", "i8", "S5", "u1", "f8"]))
        elif kind == 2:
            group[name] = rng.choice([values[:-1], values[:0], values[..., None], values[:, :1], values.ravel()])
        elif kind < 5:
            place = rng.randrange(values.size)
            values.flat[place] = rng.choice([0, 255, np.nan, 1e30, -1]) if values.dtype.kind == "f" else 255
            group[name] = values


def bytes_of_file(folder: Path, rng: random.Random) -> None:
    """Bytes of a file in the published layout."""
    mutations.damage(next(folder.glob("*.hdf5")), rng, mutations.mutated_bytes)


# --- what is typed ---


def describe(whole: Path) -> None:
    commands.describe(whole / DATASET, whole / "out")


def validate(whole: Path) -> None:
    commands.validate(whole / DATASET)


def validate_files(whole: Path) -> None:
    commands.validate(whole / FILES)


def convert(whole: Path) -> None:
    commands.convert(whole / FILES, whole / "out")


COUNTS = {describe: (12, 2_000), validate: (20, 8_000), convert: (20, 5_000), validate_files: (20, 5_000)}
"""Command -> how often it meets each damage, and how often in the slow test: 10,000 times each damage."""

KINDS: dict[str, tuple[Callable[[Path], None], Damage, str]] = {
    f"{command.__name__}, {damage.__name__}": (command, damage, place)
    for place, calls, damages in (
        (DATASET, (describe, validate), (any_json, any_bytes, any_column)),
        (FILES, (convert, validate_files), (any_attribute, any_array, bytes_of_file)),
    )
    for command in calls
    for damage in damages
}


def check(source: Path, tmp_path: Path, kind: str, slow: bool, monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    command, damage, place = KINDS[kind]
    whole = tmp_path / "whole"
    whole.mkdir()
    monkeypatch.chdir(whole)

    def prepare(rng: random.Random) -> None:
        mutations.fresh_copy(source, whole)
        damage(whole / place, rng)

    seeds = range(COUNTS[command][slow])
    return mutations.ends_well(seeds, prepare, lambda _: command(whole), whole, (DATASET, FILES, "out"))


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_data(source: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check(source, tmp_path, kind, False, monkeypatch)["result"] > 3


def test_what_is_whole_gives_a_result(source: Path, tmp_path: Path) -> None:
    assert commands.validate(source / DATASET) == 0
    assert commands.validate(source / FILES) == 0
    assert commands.convert(source / FILES, tmp_path / "out") == 0
    assert commands.describe(source / DATASET, tmp_path / "description") == 0


@pytest.mark.slow
@pytest.mark.timeout(36_000)
@pytest.mark.parametrize("kind", KINDS)
def test_much_damaged_data(source: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = check(source, tmp_path, kind, True, monkeypatch)
    print(f"{kind}: {found['result']} results, {found['refused']} refused")


def test_a_feature_larger_than_memory_is_told_before_it_is_taken(source: Path, tmp_path: Path) -> None:
    """LeRobot would take memory for all that it tells of: 23 GB of six frames, and the kernel ended the process."""
    folder = shutil.copytree(source / DATASET, tmp_path / "dataset")
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["features"]["observation.environment_state"]["shape"][0] *= 10**6
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(MemobenchError, match=r"more than 50,000,000 numbers of observation\.environment_state"):
        commands.describe(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()
