"""The summary of a dataset: tables and hashes."""

from __future__ import annotations

import errno
import json
import os

import pytest

from lerobot_memobench.datasets.describe import (
    TABLES_FILE,
    card_tables,
    describe,
    short_manifest,
)
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.lerobot_format.layout import MANIFEST_FILE
from lerobot_memobench.errors import MemobenchError


@pytest.fixture
def dataset(make_task, make_demo, tmp_path, monkeypatch):
    """Two memory types with images; checkpoints done at the frames 6 and 9 of 15. Its name is a pattern of `glob`."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    rows = ["0" * 6 + "1" * 9, "0" * 9 + "1" * 6]
    first = make_demo(rows, task=make_task("SU", name="first"), size=64)
    second = make_demo(rows, task=make_task("SU", name="second", memory_type="object"), size=64, exec_start=4)
    return write_dataset([first, second], tmp_path / "ds [v2]")


def test_files_and_hashes(dataset, tmp_path):
    files = describe(dataset, tmp_path / "out")
    assert [file.name for file in files] == [TABLES_FILE, MANIFEST_FILE]
    kept = json.loads((tmp_path / "out" / MANIFEST_FILE).read_text())["tasks"]
    whole = json.loads((dataset / MANIFEST_FILE).read_text())["episodes"]
    assert kept == {row["task_name"]: {"10000": row["digest"]} for row in whole}
    tables = (tmp_path / "out" / TABLES_FILE).read_text()
    assert "| first | SU | 1/1 | 15.0 |" in tables
    assert "## Columns" not in tables


def test_a_full_disk_is_one_sentence_and_leaves_the_earlier_files(dataset, tmp_path, monkeypatch):
    files = describe(dataset, tmp_path / "out")
    earlier = [file.read_bytes() for file in files]

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(MemobenchError, match=r"out cannot be written \(No space left on device; .* free there\): make"):
        describe(dataset, tmp_path / "out")
    monkeypatch.undo()
    assert [file.read_bytes() for file in files] == earlier
    assert sorted((tmp_path / "out").iterdir()) == sorted(files)
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match=r"out cannot be written \(Not a directory"):
        describe(dataset, tmp_path / "file" / "out")


def test_failed_seeds_keep_their_reason():
    episodes = [
        {"task_name": "a", "seed": 1, "digest": "ff", "failure": None},
        {"task_name": "a", "seed": 2, "digest": None, "failure": "goal not reached"},
    ]
    text = short_manifest({"version": "1", "episodes": episodes})
    assert json.loads(text) == {"version": "1", "tasks": {"a": {"1": "ff", "2": "goal not reached"}}}


def test_what_is_no_dataset_is_told(tmp_path):
    with pytest.raises(MemobenchError, match=r"no dataset \(there is no meta/info.json\)"):
        describe(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(MemobenchError, match="How it was made"):
        card_tables("# another card")
