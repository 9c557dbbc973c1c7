"""A file is there whole or not at all, and a name out of data names a file in its folder or nothing."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lerobot_memobench
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import (
    as_path,
    disk_refusal,
    draft_of,
    explaining_disk_errors,
    file_name,
    files_below,
    remove_drafts,
    write_file,
)
from lerobot_memobench.tasks.catalogue import task_names


def test_folders_are_read_through_links_once(tmp_path: Path) -> None:
    tree, elsewhere = tmp_path / "tree", tmp_path / "elsewhere"
    for file in (tree / "b.hdf5", tree / "sub" / "A.HDF5", tree / "notes.txt", elsewhere / "deep" / "c.h5"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    (tree / "linked").symlink_to(elsewhere)
    (elsewhere / "deep" / "circle").symlink_to(tree)
    (tree / "sub" / "again").symlink_to(elsewhere)
    names = [path.relative_to(tree).as_posix() for path in files_below(tree, ".hdf5", ".h5")]
    assert names == ["b.hdf5", "linked/deep/c.h5", "sub/A.HDF5"]
    assert len(files_below(tree)) == 4
    assert files_below(tmp_path / "absent") == []
    os.mkfifo(elsewhere / "pipe.h5")
    for name in ("pipe.h5", "broken.h5"):
        with pytest.raises(MemobenchError, match=f"linked/{name} is a pipe, a device or a broken link"):
            files_below(tree, ".h5")
        assert len(files_below(tree, ".txt")) == 1
        (elsewhere / name).unlink()
        (elsewhere / "broken.h5").symlink_to("nothing")


def test_a_folder_that_cannot_be_read_is_not_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "secret").mkdir()
    scan = os.scandir

    def refusing(path: str) -> object:
        if os.path.basename(path) == "secret":  # permissions do not bind root
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", refusing)
    with pytest.raises(MemobenchError, match=r"secret cannot be read \(Permission denied\)"):
        files_below(tmp_path)


def test_every_tree_is_read_by_the_one_function() -> None:
    source = Path(lerobot_memobench.__file__).parent
    used = [
        f"{path.relative_to(source).as_posix()}: {line.strip()}"
        for path in source.rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if "rglob(" in line or 'glob("**' in line or "/**/" in line or "os.walk(" in line
    ]
    # These remove empty folders, and look for one own file.
    expected = ["io.py", "run/evaluate.py", "training/resume.py"]
    assert sorted({each.split(":")[0] for each in used}) == expected, used


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_is_replaced_whole(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "report.json"
    write_file(path, "äöü\n", durable=durable)
    assert path.read_text(encoding="utf-8") == "äöü\n"
    write_file(path, b"\x00\x01", durable=durable)
    assert path.read_bytes() == b"\x00\x01"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_leaves_the_earlier_file_and_no_draft(tmp_path: Path) -> None:
    path = write_file(tmp_path / "card.json", "earlier")
    with pytest.raises(ZeroDivisionError), draft_of(path) as draft:
        draft.write_text("half" * (draft.write_text("half") // 0))
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_writers_of_one_file_have_drafts_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    with draft_of(path) as first, draft_of(path) as second:
        assert first != second
        assert first.suffix == second.suffix == path.suffix
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the outer block ends last


def test_what_killed_processes_left_is_removed(tmp_path: Path) -> None:
    keep = write_file(tmp_path / "kept.part.txt", "")
    with draft_of(tmp_path / "film.mp4") as draft:
        (tmp_path / draft.name.replace("film", "other")).write_text("")
        draft.write_text("")
    remove_drafts(tmp_path)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "film.mp4", keep]


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "a/b", "a\\b", ".hidden", "a\0b", "a\nb", "C:x", "x" * 256, 3, None]
)
def test_a_name_that_leads_elsewhere_is_refused(name: object) -> None:
    with pytest.raises(MemobenchError, match="the task's name"):
        file_name(name, "the task's name")


def test_the_names_of_tasks_are_names_of_files() -> None:
    assert [file_name(name, "a task") for name in task_names()] == list(task_names())


@given(st.text())
def test_an_accepted_name_stays_in_its_folder(name: str) -> None:
    base = Path("/some/folder")
    try:
        accepted = file_name(name, "a name")
    except MemobenchError:
        return
    assert (base / accepted).parent == base
    assert (base / accepted).name == name


def test_what_a_disk_answers_is_found_however_it_is_told() -> None:
    """As the system's number, in a library's words, or behind another error; and nothing else is taken for it."""
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    behind = RuntimeError("could not save")
    behind.__cause__ = full
    in_c = RuntimeError("write failed: errno = 28, error message = 'No space left on device'")
    assert [disk_refusal(error) for error in (full, behind, in_c)] == ["No space left on device"] * 3
    assert disk_refusal(PermissionError(errno.EACCES, "denied", "/a")) == "Permission denied"
    assert disk_refusal(FileNotFoundError(errno.ENOENT, "gone", "/a")) is None
    assert disk_refusal(ValueError("5 is no number")) is None
    assert disk_refusal(MemobenchError("No space left on device is what it said")) is None


def test_what_cannot_be_read_is_not_said_to_be_unwritable(tmp_path: Path) -> None:
    elsewhere = PermissionError(errno.EACCES, "Permission denied", "/source/a.hdf5")
    with pytest.raises(PermissionError), explaining_disk_errors(tmp_path / "out"):
        raise elsewhere
    here = PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "out" / "a"))
    told = pytest.raises(MemobenchError, match=r"out cannot be written \(Permission denied; .*; b")
    with told, explaining_disk_errors(tmp_path / "out", "b"):
        raise here


@pytest.mark.parametrize(
    ("word", "leads_to"),
    [
        ("~/x", "/home/me/x"),
        ("output_dir=~/x", "output_dir=/home/me/x"),
        ("--out=~/x", "--out=/home/me/x"),
        ("mine=a~/x", "mine=a~/x"),
        ("policy.align=~", "policy.align=~"),
        ("~x", "~x"),
        ("run: 2", "{here}/run: 2"),
        ("dataset=run: 2", "dataset={here}/run: 2"),
        ("policy.device=cuda:0", "policy.device=cuda:0"),
    ],
)
def test_a_word_is_a_path_for_every_library(
    word: str, leads_to: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.chdir(tmp_path)
    Path("run: 2").mkdir()
    assert as_path(word) == leads_to.format(here=tmp_path)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no /dev/full")
def test_a_full_disk_of_the_output_is_not_that_of_the_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = open("/dev/full", "w")  # noqa: SIM115 - closing it fails
    with monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", full)
        with (
            pytest.raises(MemobenchError, match=r"^the output of this command cannot be written \(No space .*; kept$"),
            explaining_disk_errors(tmp_path, "kept"),
        ):
            print("a report", flush=True)
    with contextlib.suppress(OSError):
        full.close()
