"""Files are complete or absent, names from data stay in one folder, disk errors are explained, JSON has its schema."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import AfterValidator

from lerobot_memobench.cli.console import as_path
from lerobot_memobench.datasets.episodes import from_frames
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import (
    disk_refusal,
    draft_of,
    explaining_disk_errors,
    file_name,
    files_below,
    remove_drafts,
    write_file,
)
from lerobot_memobench.tasks.catalogue import task_names
from lerobot_memobench.untrusted import Count, Malformed, Name, Number, checked, parsed, read_json, refusing

# --- trees ---


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
        with pytest.raises(MemobenchError, match=f"linked/{name} is a pipe"):
            files_below(tree, ".h5")
        assert len(files_below(tree, ".txt")) == 1
        (elsewhere / name).unlink()
        (elsewhere / "broken.h5").symlink_to("nothing")


def test_a_folder_that_cannot_be_read_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "secret").mkdir()
    scan = os.scandir

    def refuse(path: str) -> object:
        if os.path.basename(path) == "secret":  # permissions do not bind root
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(MemobenchError, match=r"secret cannot be read \(Permission denied\)"):
        files_below(tmp_path)


# --- writing ---


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_is_replaced_whole(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "report.json"
    for content in ("äöü\n", b"\x00\x01"):
        write_file(path, content, durable=durable)
        assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
    with pytest.raises(ZeroDivisionError), draft_of(path) as draft:
        draft.write_text("half" * (draft.write_text("half") // 0))
    assert path.read_bytes() == b"\x00\x01"
    assert list(tmp_path.iterdir()) == [path]


def test_each_writer_has_a_draft_and_drafts_of_killed_processes_are_removed(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    with draft_of(path) as first, draft_of(path) as second:
        assert first != second
        assert first.suffix == second.suffix == path.suffix
        first.write_text("first")
        second.write_text("second")
        (tmp_path / first.name.replace("log", "other")).write_text("")
    assert path.read_text() == "first"  # the outer block ends last
    keep = write_file(tmp_path / "kept.part.txt", "")
    remove_drafts(tmp_path)
    assert sorted(tmp_path.iterdir()) == [keep, path]


# --- names and paths ---


@pytest.mark.parametrize("name", ["", ".", "../x", "a/b", "a\\b", ".hidden", "a\0b", "a\nb", "C:x", "x" * 256, 3, None])
def test_a_name_outside_the_folder_is_refused(name: object) -> None:
    with pytest.raises(MemobenchError, match="the task's name"):
        file_name(name, "the task's name")
    assert [file_name(name, "a task") for name in task_names()] == task_names()


@given(st.text())
def test_an_accepted_name_stays_in_its_folder(name: str) -> None:
    with contextlib.suppress(MemobenchError):
        path = Path("/some/folder") / file_name(name, "a name")
        assert (path.parent, path.name) == (Path("/some/folder"), name)


@pytest.mark.parametrize(
    ("word", "path"),
    [
        ("~/x", "/home/me/x"),
        ("output_dir=~/x", "output_dir=/home/me/x"),
        ("policy.align=~", "policy.align=~"),
        ("run: 2", "{here}/run: 2"),
        ("dataset=run: 2", "dataset={here}/run: 2"),
    ],
)
def test_every_library_recognises_a_path(word: str, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.chdir(tmp_path)
    Path("run: 2").mkdir()
    assert as_path(word) == path.format(here=tmp_path)


# --- errors of the disk ---


def test_errors_of_the_disk_are_recognised() -> None:
    """The system's number, a library's words, or a cause; nothing else."""
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    behind = RuntimeError("could not save")
    behind.__cause__ = full
    in_c = RuntimeError("write failed: errno = 28, error message = 'No space left on device'")
    assert [disk_refusal(error) for error in (full, behind, in_c)] == ["No space left on device"] * 3
    assert disk_refusal(PermissionError(errno.EACCES, "denied", "/a")) == "Permission denied"
    for other in (FileNotFoundError(errno.ENOENT, "gone"), ValueError("5"), MemobenchError("No space left on device")):
        assert disk_refusal(other) is None


def test_only_the_written_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), explaining_disk_errors(tmp_path / "out"):
        raise PermissionError(errno.EACCES, "Permission denied", "/source/a.hdf5")
    refused = pytest.raises(MemobenchError, match=r"out cannot be written \(Permission denied; .*; b")
    with refused, explaining_disk_errors(tmp_path / "out", "b"):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "out" / "a"))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the system has no /dev/full")
def test_a_full_disk_of_the_output_is_not_that_of_the_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = open("/dev/full", "w")  # noqa: SIM115 - closing it fails
    with monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", full)
        refused = pytest.raises(MemobenchError, match=r"^the output of this command cannot be written .*; kept$")
        with refused, explaining_disk_errors(tmp_path, "kept"):
            print("a report", flush=True)
    with contextlib.suppress(OSError):
        full.close()


# --- JSON of an expected schema ---


class Part(TypedDict):
    name: Name
    size: NotRequired[Count | list[Count] | None]


class Whole(TypedDict):
    parts: list[Part]
    share: Number


GOOD: dict[str, Any] = {"parts": [{"name": "a", "size": 1, "other": "kept"}, {"name": "b", "size": [1, 2]}], "share": 1}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"share": "1"}, "found share = '1', expected a number"),
        ({"share": 1e300}, "found share = 1e+300, expected at most 9007199254740992"),
        ({"parts": [GOOD["parts"][0], 3]}, "found parts[1] = 3, expected an object"),
        ({"parts": [{"size": 1}]}, "found no name in parts[0]"),
        ({"parts": [{"name": "a", "size": "x" * 500}]}, "xxx…, expected an integer or a list"),
    ],
)
def test_the_first_place_that_differs_is_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(Malformed) as error:
        checked({**GOOD, **change}, Whole)
    assert words in str(error.value)
    assert len(str(error.value)) < 300
    assert checked(GOOD, Whole) is GOOD


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b'"\xff"', b'"\\ud800"', b"NaN", b"[" * 5_000 + b"]" * 5_000, b"1" * 5_000, b"{} {}", b"\x00"],
)
def test_malformed_json_is_refused(content: bytes) -> None:
    with pytest.raises(Malformed, match="it is not JSON"):
        parsed(content)


def test_values_of_json_are_exact() -> None:
    numbers = [0.1 + 0.2, 1e-320, 1 / 3, 2**70, -0.0, 5]
    assert parsed(json.dumps(numbers)) == numbers
    assert parsed(b'\xef\xbb\xbf{"a": 1, "a": 2}') == {"a": 2}
    assert parsed(b"[Infinity]", nan=True) == [float("inf")]


def test_messages_are_ours(tmp_path: Path) -> None:
    def ours(value: str) -> str:
        raise MemobenchError("the seed 7 is an evaluation's")

    with pytest.raises(Malformed, match=r"^found a = 'x': the seed 7 is an evaluation's$"):
        checked({"a": "x"}, dict[str, Annotated[str, AfterValidator(ours)]])
    with pytest.raises(MemobenchError, match=r"\(found task_name = 3, expected text\)"):
        from_frames('{"task_name": 3}', "a dataset")
    path = tmp_path / "it.json"
    with pytest.raises(FileNotFoundError):
        read_json(path, Whole, "look elsewhere")
    path.write_text("[]")
    with pytest.raises(MemobenchError, match=r"it\.json: found \[\], expected an object; look elsewhere$"):
        read_json(path, Whole, "look elsewhere")
    path.unlink()
    path.mkdir()
    with pytest.raises(MemobenchError, match=r"it\.json cannot be read \(Is a directory\); look elsewhere$"):
        read_json(path, Whole, "look elsewhere")


@pytest.mark.parametrize("error", [KeyError("a"), OSError(5, "bad\n\ndisk"), RecursionError("x" * 5_000)])
def test_an_error_of_a_library_is_one_line(error: Exception) -> None:
    with pytest.raises(MemobenchError) as caught, refusing(lambda why: MemobenchError(f"it is damaged ({why})")):
        raise error
    assert str(caught.value).startswith(f"it is damaged ({type(error).__name__}: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("error", [MemobenchError("as it was"), KeyboardInterrupt("as it was")])
def test_other_errors_pass_unchanged(error: BaseException) -> None:
    with pytest.raises(type(error), match=r"^as it was$"), refusing(lambda why: MemobenchError("another")):
        raise error
