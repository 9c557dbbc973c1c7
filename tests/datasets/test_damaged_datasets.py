"""What stands beside a dataset, damaged in any way: what reads it ends in a result or a sentence."""

from __future__ import annotations

import hashlib
import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_memobench.datasets.convert import convert
from lerobot_memobench.datasets.describe import short_manifest
from lerobot_memobench.datasets.generation import is_finished
from lerobot_memobench.datasets.hdf5.reading import read_extras
from lerobot_memobench.datasets.lerobot_format.layout import episode_count, read_manifest
from lerobot_memobench.datasets.staging import episodes_folder, read_staged
from tests.support import mutations

Prepare = Callable[[Path], None]
Use = Callable[[Path], object]


def write(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


INFO = {
    "task_name": "task_a",
    "memory_type": "temporal",
    "family": "f",
    "language": "do it",
    "operations": "SU",
    "seed": 10_000,
    "referent": "fixed",
    "variant": 0,
    "success": True,
    "frames": 5,
    "exec_start_index": 0,
    "key_frames": [1, 3],
    "scene_hash": "abc",
    "fixture_poses": {"stove": [0.0] * 7},
    "digest": "0" * 64,
}
ROW = {key: INFO[key] for key in ("task_name", "memory_type", "seed", "success", "frames", "scene_hash", "digest")}
MANIFEST = {
    "request": {"files": [["source.hdf5", 0, 0]], "upside_down": False, "formats": ["hdf5"]},
    "left_out": [{"file": "a.hdf5", "group": "demo_0", "reason": "it is"}],
    "episodes": [{**ROW, "episode_index": 0, "failure": None}, {**ROW, "episode_index": None, "failure": "fell"}],
}
RECORD = {
    "failure": None,
    "info": INFO,
    "language_persistent": [{"role": "assistant", "content": "a", "style": "memory", "timestamp": 0.0}],
    "image_stats": {"image": {"mean": [[[0.5]]] * 3, "count": [5]}},
    "files": {"arrays.npz": hashlib.sha256(b"").hexdigest()},
}
LEROBOT_INFO = {"codebase_version": "v3.0", "total_episodes": 2, "total_frames": 10, "fps": 20, "features": {"a": {}}}


def manifests(folder: Path) -> None:
    write(folder / "manifest.json", MANIFEST)
    write(folder / "meta" / "info.json", LEROBOT_INFO)
    for part, rows in (("data", 10), ("meta/episodes", 2)):
        (folder / part).mkdir(parents=True)
        pq.write_table(pa.table({"index": range(rows)}), folder / part / "file-000.parquet")


def use_manifest(folder: Path) -> None:
    is_finished(folder)
    if (folder / "manifest.json").is_file():
        short_manifest(read_manifest(folder))


def use_conversion(folder: Path) -> None:
    source = folder.parent / "source.hdf5"
    source.touch()
    os.utime(source, (0, 0))
    convert(source, folder)


def staged(folder: Path) -> None:
    write(folder / "episode.json", RECORD)
    (folder / "arrays.npz").write_bytes(b"")


def use_staged(folder: Path) -> None:
    found = read_staged(folder)
    if found is not None:
        assert found.has_images is not None
        [found.image_stats(camera) for camera in found.record["image_stats"]]
        found.check()


def requests(folder: Path) -> None:
    write(folder / ".staging" / "request.json", MANIFEST["request"])


def use_request(folder: Path) -> None:
    with episodes_folder(folder, MANIFEST["request"]):
        pass


def infos(folder: Path) -> None:
    write(folder / "meta" / "info.json", LEROBOT_INFO)
    (folder / "meta" / "episodes").mkdir()
    pq.write_table(pa.table({"episode_index": [0, 1]}), folder / "meta" / "episodes" / "file-000.parquet")


KINDS: dict[str, tuple[Prepare, Use, str]] = {
    "manifest": (manifests, use_manifest, "manifest.json"),
    "manifest of a conversion": (manifests, use_conversion, "manifest.json"),
    "staged episode": (staged, use_staged, "episode.json"),
    "request": (requests, use_request, ".staging/request.json"),
    "info": (infos, episode_count, "meta/info.json"),
}


def check(
    tmp_path: Path,
    kind: str,
    count: int,
    monkeypatch: pytest.MonkeyPatch,
    mutate: Callable[[bytes, random.Random], bytes] = mutations.mutated_json,
) -> tuple[int, int]:
    prepare, use, files = KINDS[kind]
    source, whole = tmp_path / "source", tmp_path / "whole"
    whole.mkdir()
    monkeypatch.chdir(whole)
    prepare(source / "data")

    def damage(rng: random.Random) -> None:
        mutations.fresh_copy(source, whole)
        mutations.damage(whole / "data" / rng.choice(files.split()), rng, mutate)

    found = mutations.ends_well(
        range(count), damage, lambda _: use(whole / "data"), whole, ("data", "source.hdf5", "hdf5")
    )
    return found["result"], found["refused"]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_beside_a_dataset(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    results, refused = check(tmp_path, kind, 100, monkeypatch)
    assert results > 1
    assert refused > 10


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files_beside_a_dataset(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    results, refused = check(tmp_path, kind, 10_000, monkeypatch)
    print(f"{kind}: {results} results, {refused} refused")


# --- attributes ---

ATTRIBUTES: dict[str, Any] = {
    "seed": 10_000,
    "referent": "fixed",
    "variant": 0,
    "success": True,
    "fixture_poses": json.dumps({"stove": [0.0] * 7}),
    "scene_hash": "abc",
    "satisfied_intervals": "[[[3, 5]], [[4, 5]]]",
    "digest": "0" * 64,
}


def attributes(count: int) -> tuple[int, int]:
    with h5py.File("in memory", "w", driver="core", backing_store=False) as file:

        def prepare(rng: random.Random) -> None:
            file.attrs.clear()
            for key, value in mutated(rng).items():
                try:
                    file.attrs[key] = value
                except (TypeError, ValueError, OverflowError, OSError):  # HDF5 takes no such value
                    file.attrs[key] = np.array([1.5, np.nan])

        found = mutations.ends_well(range(count), prepare, lambda _: read_extras(file), Path(), ())
    return found["result"], found["refused"]


def mutated(rng: random.Random) -> dict[str, Any]:
    """Attributes of which one has another value, or a text that no longer says what it did."""
    found = dict(ATTRIBUTES)
    key = rng.choice(list(found))
    if isinstance(found[key], str) and rng.random() < 0.5:
        found[key] = mutations.mutated_json(json.dumps(found[key]).encode(), rng).decode(errors="replace")
        if key in ("fixture_poses", "satisfied_intervals"):
            found[key] = mutations.mutated_json(ATTRIBUTES[key].encode(), rng).decode(errors="replace")
    else:
        found[key] = rng.choice(
            [*mutations.VALUES, np.float32(1), np.bool_(True), np.int8(3), np.array(["a", "b"], "S")]
        )
    return found


def test_damaged_attributes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    results, refused = attributes(100)
    assert results > 7
    assert refused > 30


@pytest.mark.slow
def test_many_damaged_attributes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    results, refused = attributes(10_000)
    print(f"attributes: {results} results, {refused} refused")
