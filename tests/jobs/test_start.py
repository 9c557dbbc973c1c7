"""Commands with foreign streams, temporary folders and homes."""

from __future__ import annotations

import getpass
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from lerobot_memobench import io
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import cache_folder, choose_caches, private_folder
from lerobot_memobench.jobs import processes

COMMAND = """
import sys
from lerobot_memobench.cli.console import run_command, say
sys.exit(run_command(lambda: ({}), "a", "again"))
"""
linux = pytest.mark.skipif(sys.platform != "linux", reason="streams are closed by a POSIX shell")


def run_in_shell(line: str, call: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a shell's line, in which ``"$@"`` is a command that makes a call."""
    words = ["bash", "-c", line, "bash", sys.executable, "-c", COMMAND.format(call)]
    return subprocess.run(words, capture_output=True, text=True, check=False, env={**os.environ, **variables})


@linux
def test_any_letter_is_printed_in_any_encoding() -> None:
    done = run_in_shell('"$@"', 'say("a–b\\udcff")', PYTHONIOENCODING="ascii:strict")
    assert (done.returncode, done.stdout, done.stderr) == (0, "a\\u2013b\\udcff\n", "")


@linux
def test_output_may_be_closed(tmp_path: Path) -> None:
    """A file that is opened next does not take the place of the closed stream, for child processes neither."""
    call = """[say("a"), (f := open("f", "w")), __import__("subprocess").run(["echo", "b"], check=True)][0]"""
    done = run_in_shell(f'cd {tmp_path} && "$@" >&- <&-', call)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "f").read_text() == ""
    assert run_in_shell('"$@" >&- 2>&-', "[say(1), print(2, file=sys.stderr)][2:] or 0").returncode == 0


@linux
@pytest.mark.parametrize(
    ("call", "unbuffered"), [("print('a' * 10**6, flush=True)", "1"), ("say('a' * 10**6)", ""), ("print('a')", "")]
)
def test_a_reader_may_leave(call: str, unbuffered: str) -> None:
    line = '{ sleep 0.2; "$@"; echo "status $?" >&2; } | true'
    done = run_in_shell(line, call, PYTHONUNBUFFERED=unbuffered)
    assert done.stderr == "status 1\n"


SOCKET = """[
    __import__("lerobot_memobench.jobs.processes").jobs.processes.prepare_process(),
    __import__("multiprocessing.connection").connection.Listener(family="AF_UNIX"),
    open(__import__("tempfile").mkstemp()[1], "w").close(),
][2]"""


@linux
def test_sockets_fit_into_a_long_temporary_folder(tmp_path: Path) -> None:
    long = tmp_path / ("a" * 120)
    long.mkdir()
    for _ in range(2):  # the second command finds the link
        done = run_in_shell('"$@"', SOCKET, TMPDIR=str(long))
        assert (done.returncode, done.stderr) == (0, "")
    assert len(list(long.glob("tmp*"))) == 2  # temporary files stay where they were asked for


@linux
def test_a_long_temporary_folder_without_a_short_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/" + "a" * 73)
    monkeypatch.setattr(processes, "SHORT_FOLDERS", (str(tmp_path / "none"),))
    with pytest.raises(MemobenchError, match="set TMPDIR"):
        processes.prepare_process()
    monkeypatch.setattr(tempfile, "tempdir", "/" + "a" * 71)
    processes.prepare_process()


@linux
def test_a_user_without_name_and_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown() -> str:
        raise KeyError("uid not found")

    for name in ("XDG_CACHE_HOME", "MPLCONFIGDIR", "USER", "HOME"):
        monkeypatch.setenv(name, "set, so that it is set again after the test")
        monkeypatch.delenv(name)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(getpass, "getuser", unknown)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    choose_caches()
    assert cache_folder() == tmp_path / f"memobench-{os.getuid()}" / "cache" / "lerobot_memobench"
    assert os.environ["USER"]
    assert os.environ["HOME"] == str(tmp_path / f"memobench-{os.getuid()}")


@linux
@pytest.mark.parametrize("writable", [True, False])
def test_caches_of_an_unwritable_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writable: bool) -> None:
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "a" / "b"))
    monkeypatch.delenv("MPLCONFIGDIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(io.os, "access", lambda path, mode: writable and Path(path) == home)
    choose_caches()
    assert cache_folder().is_relative_to(home) == writable
    monkeypatch.delenv("MPLCONFIGDIR", raising=False)


@linux
def test_a_folder_of_another_user_is_refused(tmp_path: Path) -> None:
    folder = private_folder(str(tmp_path))
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    with pytest.raises(PermissionError):
        private_folder(str(tmp_path))
    folder.rmdir()
    folder.symlink_to("/")
    with pytest.raises(PermissionError):
        private_folder(str(tmp_path))
