"""`scripts/trace.py`: the files that an operation executes."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys

import pytest

from lerobot_memobench.tasks.catalogue import task_names
from tests.support.scripts import SCRIPTS

COMMAND = [sys.executable, str(SCRIPTS / "trace.py")]


def test_trace_counts_functions_but_no_imports() -> None:
    script = runpy.run_path(str(SCRIPTS / "trace.py"))  # an import would hide the standard library's `trace`
    module = sys.modules[task_names.__module__]
    with script["Trace"]() as trace:
        runpy.run_path(str(module.__file__))
    assert not trace.functions
    with script["Trace"]() as trace:
        task_names(suite="strict")
    task_names(suite="published")
    file = str(module.__file__).removeprefix(f"{script['SOURCE']}/")
    assert (file, "task_names") in trace.functions


@pytest.mark.slow
def test_trace_prints_table_and_files() -> None:
    output = subprocess.run([*COMMAND, "words to plan", "--list"], capture_output=True, text=True, check=True).stdout
    row = re.search(r"^\| words to plan \| (\d+) \| (\d+) \|$", output, flags=re.MULTILINE)
    assert row is not None
    files = re.findall(r"^    (\S+\.py): ", output, flags=re.MULTILINE)
    assert 5 < len(files) == int(row[1]) <= int(row[2])


def test_unknown_operation_is_an_error() -> None:
    run = subprocess.run([*COMMAND, "step"], capture_output=True, text=True)
    assert (run.returncode, "'step'" in run.stderr, "control step" in run.stderr) == (2, True, True)
