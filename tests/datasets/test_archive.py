"""A zip archive of published files: one command, one file at a time, whatever its names and sizes claim."""

from __future__ import annotations

import os
import re
import stat
import zipfile
from pathlib import Path

import pytest

from lerobot_memobench.cli.data import convert as command
from lerobot_memobench.datasets import generation
from lerobot_memobench.datasets.convert import convert
from lerobot_memobench.datasets.hdf5.archive import Archive
from lerobot_memobench.datasets.lerobot_format.layout import is_dataset
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.datasets.video import VideoWriter
from lerobot_memobench.errors import MemobenchError
from tests.support.kills import hashes, killed_at
from tests.support.published_files import write_published
from tests.support.short_demonstrations import drawn_steps, with_pictures

DRAWER, BUTTER = "check_the_middle_drawer_of_the_cabinet", "put_the_butter_into_the_bowl_from_the_prompt_video"
FRAMES = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two files of two short demonstrations each, in folders, and one that is none."""
    root = tmp_path_factory.mktemp("archive")
    for task, place in ((DRAWER, "temporal"), (BUTTER, "object")):
        demo = with_pictures(drawn_steps(task, 10_000, FRAMES), 16)
        write_published(root / "hdf5" / place / f"{task}_demo.hdf5", [demo] * 2)
    (root / "hdf5" / "notes.h5").write_text("no HDF5")
    return root / "hdf5"


def packed(folder: Path, path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*.h*5")):
            archive.write(file, file.relative_to(folder))
        archive.writestr("README.md", "about it")
        archive.writestr("__MACOSX/temporal/._a_demo.hdf5", "a fork")
    return path


def test_an_archive_gives_what_its_folder_gives(folder, tmp_path):
    told, counted = [], []
    summary = convert(packed(folder, tmp_path / "a.zip"), tmp_path / "ds", tell=told.append, progress=counted.append)
    direct = convert(folder, tmp_path / "direct")
    assert (summary.episodes, summary.problems, summary.exit_status) == (4, direct.problems, 1)
    for part in ("data", "videos", "states", "meta"):
        assert hashes(tmp_path / "ds" / part) == hashes(tmp_path / "direct" / part)
    assert not (tmp_path / "ds" / ".staging").exists()
    largest = max(file.stat().st_size for file in folder.rglob("*.hdf5"))
    assert re.match(rf"3 files of [\d.]+ MiB, unpacked one by one \(up to {largest / 1024:.1f} KiB\): about ", told[0])
    assert [line.split(",")[0] for line in told[1:]] == [
        "file 1 of 3: notes.h5",
        f"file 2 of 3: object/{BUTTER}_demo.hdf5",
        f"file 3 of 3: temporal/{DRAWER}_demo.hdf5",
    ]
    assert [news.done for news in counted] == [1, 2, 3, 4]
    assert counted[-1].total == 4
    assert convert(tmp_path / "a.zip", tmp_path / "ds") == summary


@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("holder", "name", "call"),
    [(os, "replace", "_demo.hdf5"), (os, "replace", "00002.json"), (VideoWriter, "add", 5 * FRAMES)],
    ids=["while a file is unpacked", "while it is noted what it holds", "in the third file"],
)
def test_a_killed_conversion_goes_on(folder, tmp_path, monkeypatch, holder, name, call):
    source = packed(folder, tmp_path / "a.zip")
    convert(source, tmp_path / "undisturbed")
    killed_at(holder, name, call, lambda: convert(source, tmp_path / "ds"))
    assert not is_dataset(tmp_path / "ds")
    unpacked, inner = [], Archive.extract
    monkeypatch.setattr(
        Archive, "extract", lambda self, member, *rest: unpacked.append(member.name) or inner(self, member, *rest)
    )
    convert(source, tmp_path / "ds")
    assert hashes(tmp_path / "ds") == hashes(tmp_path / "undisturbed")
    finished = 2 if holder is VideoWriter else 1
    assert len(unpacked) == 3 - finished, "finished files are not unpacked again"


def _claim(path: Path, name: str, size: int) -> None:
    """Write another size, unpacked, into the archive's directory."""
    data = bytearray(path.read_bytes())
    entry = data.rindex(b"PK\x01\x02", 0, data.rindex(name.encode()))
    data[entry + 24 : entry + 28] = size.to_bytes(4, "little")
    path.write_bytes(data)


def test_hostile_names_and_sizes_are_refused(folder, tmp_path, capsys):
    """Each is named with its reason, nothing is written where it leads, and the sound files are converted."""
    source, work = tmp_path / "a.zip", tmp_path / "work"
    work.mkdir()
    sound = (folder / "temporal" / f"{DRAWER}_demo.hdf5").read_bytes()
    link = zipfile.ZipInfo("link.hdf5")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    names = {
        "../out.hdf5": "'..', which names no file",
        "/tmp/out.hdf5": "'', which names no file",
        "a/../../out.hdf5": "'..', which names no file",
        "C:\\out.hdf5": "names no file",
        ".hidden/a.hdf5": "names no file",
        "two\nlines.hdf5": "names no file",
        "Twice.hdf5": "two files of this name",
        "link.hdf5": "a link, or something else",
        "bomb.hdf5": "claims to become 3.9 GiB of",
        "cut.hdf5": "it is 50 B long, not 60 B",
    }
    with zipfile.ZipFile(source, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("good/a.hdf5", sound)
        for name in names:
            archive.writestr(link if name == "link.hdf5" else name, "x" * 50)
        archive.writestr("twice.hdf5", sound)
    _claim(source, "bomb.hdf5", 2**32 - 2**27)
    _claim(source, "cut.hdf5", 60)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(work)
        status = command(source, tmp_path / "ds")
    out = capsys.readouterr().out
    assert status == 1
    assert list(work.iterdir()) == []
    assert not (tmp_path / "out.hdf5").exists()
    for name, reason in names.items():
        shown = "twice.hdf5" if name == "Twice.hdf5" else name.replace("\n", "?")
        (line,) = [line for line in out.splitlines() if line.startswith(f"left out: {shown}: ")]
        assert reason in line
    assert [read_episode(tmp_path / "ds", number).task_name for number in range(2)] == [DRAWER] * 2


def test_no_archive_no_room(folder, tmp_path, monkeypatch):
    source = packed(folder, tmp_path / "a.zip")
    whole = source.read_bytes()
    (tmp_path / "cut.zip").write_bytes(whole[: len(whole) // 2])
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as archive:
        archive.writestr("README.md", "about nothing")
    for name, reason in (("cut", "was not downloaded to its end"), ("empty", "found 0 HDF5 files")):
        with pytest.raises(MemobenchError, match=reason):
            convert(tmp_path / f"{name}.zip", tmp_path / "ds")
    monkeypatch.setattr(generation, "free_bytes", lambda _: 1000)
    with pytest.raises(MemobenchError, match=r"3 files of .* would take about .*: make room"):
        convert(source, tmp_path / "ds")
