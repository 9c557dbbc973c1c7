"""What is kept of a dataset: pictures, tables and hashes that say what it holds."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lerobot_memobench.datasets.describe import (
    FRAME,
    LENGTHS_FIGURE,
    STORYBOARD_FIGURE,
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
    assert [file.name for file in files] == [LENGTHS_FIGURE, STORYBOARD_FIGURE, TABLES_FILE, MANIFEST_FILE]
    kept = json.loads((tmp_path / "out" / MANIFEST_FILE).read_text())["tasks"]
    whole = json.loads((dataset / MANIFEST_FILE).read_text())["episodes"]
    assert kept == {row["task_name"]: {"10000": row["digest"]} for row in whole}
    tables = (tmp_path / "out" / TABLES_FILE).read_text()
    assert "| first | SU | 1/1 | 15.0 |" in tables
    assert "## Columns" not in tables


def test_the_storyboard_shows_the_frames_of_the_checkpoints(dataset, tmp_path):
    """Each row begins with the start of execution or the prompt; the white bar of the pictures tells the frame."""
    describe(dataset, tmp_path / "out")
    sheet = np.asarray(Image.open(tmp_path / "out" / STORYBOARD_FIGURE).convert("L")).astype(float)
    row = sheet.shape[0] // 2

    def bar(line: int, column: int) -> int:
        top, left = line * row + 26, column * (FRAME + 6)
        return int(sheet[top : top + FRAME, left : left + FRAME].mean(axis=0).argmax())

    scale = FRAME / 64
    for line, column, frame in [(0, 0, 0), (0, 1, 6), (0, 2, 9), (1, 0, 2), (1, 1, 4)]:
        assert bar(line, column) == pytest.approx((frame * 4 + 2) * scale, abs=6), (line, column)


def test_an_interrupted_drawing_leaves_the_earlier_one_whole(dataset, tmp_path, monkeypatch):
    files = describe(dataset, tmp_path / "out")
    earlier = [file.read_bytes() for file in files]

    def torn(self, path, *args, **kwargs):
        Path(path).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", torn)
    with pytest.raises(OSError, match="disk full"):
        describe(dataset, tmp_path / "out")
    monkeypatch.undo()
    monkeypatch.setattr("lerobot_memobench.datasets.describe.draw_lengths", lambda rows, path: path)
    monkeypatch.setattr("PIL.Image.Image.save", torn)
    with pytest.raises(OSError, match="disk full"):
        describe(dataset, tmp_path / "out")
    assert [file.read_bytes() for file in files] == earlier
    assert sorted((tmp_path / "out").iterdir()) == sorted(files)


def test_a_full_disk_is_one_sentence(dataset, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full)
    with pytest.raises(MemobenchError, match=r"out cannot be written \(No space left on device; .* free there\): make"):
        describe(dataset, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []
    monkeypatch.undo()
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match=r"out cannot be written \(Not a directory"):
        describe(dataset, tmp_path / "file" / "out")


def test_without_images_there_is_no_storyboard(make_demo, tmp_path):
    folder = write_dataset([make_demo(["0011"])], tmp_path / "ds")
    assert STORYBOARD_FIGURE not in {file.name for file in describe(folder, tmp_path / "out")}


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
