"""Damaged files of every kind: whatever reads them ends in a result or in one sentence, and `validate` notices."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import random
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_memobench.cli import data as commands
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.lerobot_format.layout import read_manifest
from lerobot_memobench.datasets.staging import episodes_folder, read_staged, stage_demonstration
from lerobot_memobench.datasets.validate import validate
from lerobot_memobench.errors import MemobenchError
from tests.support import mutations
from tests.support.published_files import write_published
from tests.support.short_demonstrations import drawn_steps, with_pictures

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
FRAMES, EXEC_START, SIZE = 6, 2, 32
REQUEST = {"files": [["source.hdf5", 0, 0]], "upside_down": False, "world": "libero"}

Damage = Callable[[Path, random.Random], None]
Use = Callable[[Path], object]


def demonstration(seed: int = 10_000) -> Demonstration:
    """Six steps of a task with a prompt, and small pictures."""
    return with_pictures(drawn_steps(TASK, seed, FRAMES, EXEC_START), SIZE)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, a published file, the dataset that it becomes, a staged episode, and an unfinished run."""
    folder, demo = tmp_path_factory.mktemp("whole") / "source", demonstration()
    write_dataset([demo, demonstration(10_001)], folder / "dataset")
    published = write_published(folder / "published" / f"{TASK}_demo.hdf5", [demo] * 2)
    os.utime(published, (0, 0))
    assert commands.convert(folder / "published", folder / "converted") == 0
    stage_demonstration(demo, folder / "staged")
    (folder / "run" / ".staging").mkdir(parents=True)
    (folder / "run" / ".staging" / "request.json").write_text(json.dumps(REQUEST))
    return folder


# --- damage ---


def any_value(path: Path, rng: random.Random) -> None:
    """Mutate a JSON file."""
    mutations.damage(path, rng)


def any_bytes(path: Path, rng: random.Random) -> None:
    mutations.damage(path, rng, mutations.mutated_bytes)


def any_column(path: Path, rng: random.Random) -> None:
    """Change a value of a parquet file, which may change its column's type; take a column out, or rows."""
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


def any_attribute(path: Path, rng: random.Random) -> None:
    """Change an attribute of a published file, or the JSON in one."""
    with h5py.File(path, "r+") as file:
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


def any_array(path: Path, rng: random.Random) -> None:
    """Take out an array of a published file, or change its type, its shape or a number in it."""
    with h5py.File(path, "r+") as file:
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


# --- what reads it ---


def describe(whole: Path) -> None:
    commands.describe(whole / "dataset", whole / "out")


def check(whole: Path) -> None:
    commands.validate(whole / "dataset")


def convert(whole: Path) -> None:
    commands.convert(whole / "published", whole / "out")


def convert_again(whole: Path) -> None:
    os.utime(next((whole / "published").iterdir()), (0, 0))
    commands.convert(whole / "published", whole / "converted")


def use_staged(whole: Path) -> None:
    found = read_staged(whole / "staged")
    if found is not None:
        assert isinstance(found.language_rows, list)
        [found.image_stats(camera) for camera in found.record.image_stats]
        found.check()


def resume(whole: Path) -> None:
    with episodes_folder(whole / "run", REQUEST):
        pass


TABLES, VIDEOS, FILE = "dataset/**/*.parquet", "dataset/**/*.mp4", "published/*.hdf5"
MATRIX: list[tuple[str, Damage, Use, int, int]] = [
    ("dataset/meta/info.json", any_value, describe, 3, 2_000),
    ("dataset/m*/**/*.json", any_value, check, 3, 8_000),
    ("dataset/manifest.json", any_value, check, 2, 2_000),
    ("dataset/README.md", any_bytes, describe, 2, 100),
    (TABLES, any_bytes, describe, 3, 2_000),
    (TABLES, any_bytes, check, 3, 8_000),
    (TABLES, any_column, describe, 3, 2_000),
    (TABLES, any_column, check, 4, 8_000),
    (VIDEOS, any_bytes, check, 3, 8_000),
    (FILE, any_attribute, convert, 4, 5_000),
    (FILE, any_array, convert, 4, 5_000),
    (FILE, any_bytes, convert, 4, 5_000),
    ("converted/manifest.json", any_value, convert_again, 40, 10_000),
    ("staged/episode.json", any_value, use_staged, 100, 10_000),
    ("run/.staging/request.json", any_value, resume, 100, 10_000),
]
"""Pattern of files, damage, reader, and how many mutations it meets in the default and in the slow tests."""


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=[pytest.mark.slow, pytest.mark.timeout(36_000)])])
@pytest.mark.parametrize(
    ("pattern", "damage", "use", "few", "many"),
    MATRIX,
    ids=[f"{pattern}, {damage.__name__}, {use.__name__}" for pattern, damage, use, *_ in MATRIX],
)
def test_a_damaged_file_ends_in_a_result_or_a_sentence(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    pattern: str, damage: Damage, use: Use, few: int, many: int, slow: bool,
) -> None:  # fmt: skip
    whole = tmp_path / "whole"
    whole.mkdir()
    monkeypatch.chdir(whole)

    def prepare(rng: random.Random) -> None:
        mutations.fresh_copy(source, whole)
        damage(rng.choice(sorted(whole.glob(pattern))), rng)

    inside = [path.name for path in source.iterdir()] + ["out"]
    found = mutations.ends_well(range(many if slow else few), prepare, lambda _: use(whole), whole, inside)
    assert found["result"] or few < 5
    assert found["refused"] > 10 or few < 50


# --- is it noticed? ---


def by_lerobot(root: Path) -> Any:
    """Return everything that a LeRobotDataset gives: metadata, and each frame with its pictures."""
    dataset = LeRobotDataset("local/mutated", root=root)
    meta = dataset.meta
    frames = [
        {key: str(value.tolist() if hasattr(value, "tolist") else value) for key, value in dataset[k].items()}
        for k in range(len(dataset))
    ]
    stats = {name: {key: value.tolist() for key, value in one.items()} for name, one in meta.stats.items()}
    return [str(meta.info), stats, meta.tasks.to_csv(), [str(row) for row in meta.episodes], frames]


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "videos": ("videos/**/*.mp4", by_lerobot),
    "data": ("data/**/*.parquet", by_lerobot),
    "episodes": ("meta/episodes/**/*.parquet", by_lerobot),
    "tasks": ("meta/tasks.parquet", by_lerobot),
    "info.json": ("meta/info.json", by_lerobot),
    "stats.json": ("meta/stats.json", by_lerobot),
    "manifest": ("manifest.json", lambda root: read_manifest(root)["episodes"]),
    "states": ("states/**/*.parquet", lambda root: [pq.read_table(p).to_pydict() for p in root.rglob("states/*/*")]),
}


def one_change(content: bytes, rng: random.Random) -> bytes:
    """Change one byte (60 %), write zeros over 64 (20 %), or cut the rest off (20 %)."""
    at, kind = rng.randrange(len(content)), rng.random()
    if kind < 0.6:
        return content[:at] + bytes([content[at] ^ rng.randrange(1, 256)]) + content[at + 1 :]
    return content[:at] + bytes(min(64, len(content) - at)) + content[at + 64 :] if kind < 0.8 else content[:at]


def read(reader: Callable[[Path], Any], root: Path) -> str:
    """Return a hash of what is read, or that it cannot be."""
    try:
        return hashlib.sha256(pickle.dumps(reader(root))).hexdigest()
    except Exception as error:
        return type(error).__name__


def noticed(root: Path) -> bool:
    try:
        return any(verdict.disagreement or verdict.note for verdict in validate(root))
    except MemobenchError:
        return True


def mutate_all(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, each: int) -> dict[str, Counter[str]]:
    """Mutate files of each kind; count those that changed what is read, and those of them that were noticed."""
    assert not noticed(whole)
    found: dict[str, Counter[str]] = {}
    for kind, (pattern, reader) in READERS.items():
        counts = found[kind] = Counter(mutations=each)
        reference = None
        for seed in range(each):
            root, rng = tmp_path / f"{kind}-{seed}", random.Random(f"{kind} {seed}")
            monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / f"cache-{kind}-{seed}")
            shutil.copytree(whole, root)
            if reference is None:
                reference = read(reader, root)
                assert len(reference) == 64, reference
            path = rng.choice(sorted(root.glob(pattern)))
            content = path.read_bytes()
            changed = one_change(content, rng)
            if changed != content:
                path.write_bytes(changed)
                if read(reader, root) != reference:
                    counts["changed"] += 1
                    counts["noticed"] += noticed(root)
            shutil.rmtree(root)
            shutil.rmtree(tmp_path / f"cache-{kind}-{seed}", ignore_errors=True)
    return found


def test_a_mutation_of_each_kind_is_noticed(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the files alone: nothing is replayed."""
    monkeypatch.setattr("lerobot_memobench.datasets.validate._EpisodeCheck._replay", lambda _: None)
    found = mutate_all(source / "dataset", tmp_path, monkeypatch, 1)
    assert all(counts["noticed"] == counts["changed"] for counts in found.values()), found


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_every_mutation_that_changes_what_is_read_is_noticed(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = mutate_all(source / "dataset", tmp_path, monkeypatch, 16)
    print("\n".join(f"{kind}: {dict(counts)}" for kind, counts in found.items()))
    assert all(counts["noticed"] == counts["changed"] > 8 for counts in found.values()), found
