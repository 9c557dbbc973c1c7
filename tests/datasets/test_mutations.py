"""Damage to every kind of file of a dataset: whatever changes what is read of it is noticed by `validate`.

The table: ``python -m pytest tests/datasets/test_mutations.py -m slow -s``.
"""

from __future__ import annotations

import hashlib
import pickle
import random
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import datasets
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_memobench.datasets.hdf5.reading import PublishedFile
from lerobot_memobench.datasets.lerobot_format.assembling import assemble
from lerobot_memobench.datasets.lerobot_format.layout import image_key, read_manifest
from lerobot_memobench.datasets.staging import FORMATS, stage_demonstration
from lerobot_memobench.datasets.validate import validate
from lerobot_memobench.errors import MemobenchError
from tests.datasets.test_damaged_commands import demonstration

CAMERA = image_key("image")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two episodes and its HDF5 file."""
    folder = tmp_path_factory.mktemp("mutations")
    demos = [demonstration(10_000 + k) for k in range(2)]
    staged = [stage_demonstration(demo, folder / str(k), FORMATS) for k, demo in enumerate(demos)]
    root = assemble(staged, folder / "whole", formats=FORMATS)
    return root


# --- what is read ---


def by_lerobot(root: Path) -> Any:
    """Everything that a LeRobotDataset gives: metadata, and each frame with its pictures."""
    dataset = LeRobotDataset("local/mutated", root=root)
    meta = dataset.meta
    frames = [
        {key: str(value.tolist() if hasattr(value, "tolist") else value) for key, value in dataset[k].items()}
        for k in range(len(dataset))
    ]
    stats = {name: {key: value.tolist() for key, value in one.items()} for name, one in meta.stats.items()}
    return [str(meta.info), stats, meta.tasks.to_csv(), [str(row) for row in meta.episodes], frames]


def by_convert(root: Path) -> Any:
    """Everything that a conversion reads of an HDF5 file."""
    (path,) = (root / "hdf5").iterdir()
    with PublishedFile(path) as file:
        found = [file.bddl_name, file.bddl_text, file.task_metadata, file.attribute("memory_type")]
        for group in file.groups():
            found += [str(asdict(file.read(group))), *(str(each) for each in file.images(group))]
        return [*found, *(file.pictures(group, range(6)) for group in file.groups())]


def by_replay(root: Path) -> Any:
    return [pq.read_table(path).to_pydict() for path in sorted((root / "states").rglob("*.parquet"))]


def by_describe(root: Path) -> Any:
    return read_manifest(root)["episodes"]


KINDS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "videos": ("videos/**/*.mp4", by_lerobot),
    "data": ("data/**/*.parquet", by_lerobot),
    "episodes": ("meta/episodes/**/*.parquet", by_lerobot),
    "tasks": ("meta/tasks.parquet", by_lerobot),
    "info.json": ("meta/info.json", by_lerobot),
    "stats.json": ("meta/stats.json", by_lerobot),
    "manifest": ("manifest.json", by_describe),
    "states": ("states/**/*.parquet", by_replay),
    "HDF5": ("hdf5/*.hdf5", by_convert),
}


def mutate(content: bytes, rng: random.Random) -> bytes:
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


def table(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, each: int) -> dict[str, Counter[str]]:
    """Mutate files of each kind; count those that changed what is read, and those of them that were noticed."""
    assert not noticed(whole)
    found: dict[str, Counter[str]] = {}
    for kind, (pattern, reader) in KINDS.items():
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
            changed = mutate(content, rng)
            if changed == content:  # zeros over zeros
                continue
            path.write_bytes(changed)
            if read(reader, root) != reference:
                counts["changed"] += 1
                counts["noticed"] += noticed(root)
            shutil.rmtree(root)
            shutil.rmtree(tmp_path / f"cache-{kind}-{seed}", ignore_errors=True)
    return found


def show(found: dict[str, Counter[str]]) -> None:
    print("\n| files | mutations | change what is read | noticed |\n|---|---|---|---|")
    for kind, counts in [*found.items(), ("all", sum(found.values(), Counter()))]:
        print(f"| {kind} | {counts['mutations']} | {counts['changed']} | {counts['noticed']} |")


def test_some_mutations_are_noticed(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the files alone: nothing is replayed."""
    monkeypatch.setattr("lerobot_memobench.datasets.validate._Check._replay", lambda _: None)
    found = table(whole, tmp_path, monkeypatch, 1)
    assert all(counts["noticed"] == counts["changed"] for counts in found.values()), found


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_every_mutation_that_changes_what_is_read_is_noticed(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = table(whole, tmp_path, monkeypatch, 16)
    show(found)
    assert all(counts["noticed"] == counts["changed"] > 8 for counts in found.values()), found
