"""Tables, progress and errors as the commands print them."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import httpx
import pytest
from filelock import FileLock
from huggingface_hub.errors import LocalEntryNotFoundError, OfflineModeIsEnabled
from rich.console import Console, RenderableType

from lerobot_memobench.cli.console import counting, one_sentence, run_command
from lerobot_memobench.cli.memobench import task_table
from lerobot_memobench.evaluation.metrics import summary_of
from lerobot_memobench.evaluation.report import rates_table
from lerobot_memobench.evaluation.tables import Unbroken, terminal_table
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.support import logs


def test_a_log_file_shows_the_time_left_by_this_run_alone() -> None:
    now, written = 0.0, io.StringIO()
    screen = Console(file=written, width=140, get_time=lambda: now)
    with counting(screen, "episodes") as count:
        for done in range(1, 5):
            count(done, 10, f"episode {done}", found=4)
        for done in range(5, 8):
            now += 2.0
            count(done, 10, f"episode {done}", trouble="it slipped" if done == 6 else None, found=4)
    first, *others = written.getvalue().splitlines()
    assert first.startswith("4/10 ")
    assert others == ["5/10 episode 5", "episode 6: it slipped", "7/10 episode 7, 0:00:06 left"]


@pytest.fixture(scope="module")
def tables() -> dict[str, RenderableType]:
    found = [get_task(name) for name in task_names()]
    solved = [
        logs.record(task.name, marks=[(one.operation, 1, 1) for one in task.checkpoints], memory_type=task.memory_type)
        for task in found
    ]
    return {"tasks": Unbroken(task_table(found), column=1), "report": terminal_table(rates_table(summary_of(solved)))}


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize("width", [60, 140])
@pytest.mark.parametrize("which", ["tasks", "report"])
def test_tables_do_not_break_task_names(
    tables: dict[str, RenderableType], which: str, width: int, terminal: bool
) -> None:
    written = io.StringIO()
    screen = Console(
        file=written, width=width, force_terminal=terminal, color_system=None, highlight=False, markup=False
    )
    screen.print(tables[which], crop=False)
    lines = written.getvalue().splitlines()
    for name in task_names():
        (line,) = (line for line in lines if name in line.replace("│", " ").split())
        assert which == "report" or str(task_names().index(name) + 1) in line.split(name)[0]
    if terminal:  # only a name may be wider than the terminal
        assert all(len(line) <= width or any(name in line for name in task_names()) for line in lines)


@pytest.mark.parametrize(
    "error",
    [
        httpx.ConnectError("no network", request=httpx.Request("HEAD", "https://hub/outputs/bowl_polcy/config.json")),
        OfflineModeIsEnabled("Cannot reach https://hub/outputs/bowl_polcy/config.json: offline mode is enabled."),
    ],
)
def test_a_misspelt_folder_appears_in_the_error_of_the_hub(error: Exception) -> None:
    outer = LocalEntryNotFoundError("an error happened while trying to locate the file")
    outer.__cause__ = error
    assert "https://hub/outputs/bowl_polcy/config.json: an error happened" in (one_sentence(outer) or "")


def broken_pipe() -> None:
    mine, other = Pipe()
    other.close()
    mine.recv()


def dead_loader() -> None:
    raise RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed.")


@pytest.mark.parametrize("call", [broken_pipe, dead_loader])
def test_a_killed_worker_ends_a_command_with_the_way_to_resume(call: Callable[[], None], capsys: Any) -> None:
    assert run_command(call, "lerobot", "resume with: that") == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert all(part in error for part in ("memory", "batch_size", "resume with: that"))


def test_a_librarys_lock_on_a_disk_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fcntl = pytest.importorskip("fcntl")

    def flock(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(OSError, match="locks") as caught, FileLock(tmp_path / "lock"):
        pass
    assert "HF_DATASETS_CACHE" in (one_sentence(caught.value) or "")
    assert one_sentence(OSError(errno.ENOLCK, "elsewhere")) is None
