"""`scripts/trace.py`: which of the project's files a call enters."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys

import pytest

from lerobot_memobench.tasks.catalogue import task_names
from tests.support.scripts import SCRIPTS


def test_functions_count_and_imports_do_not() -> None:
    trace = runpy.run_path(str(SCRIPTS / "trace.py"))  # by its name it would hide a module of Python's
    module = sys.modules[task_names.__module__]
    with trace["Watch"]() as watch:
        runpy.run_path(str(module.__file__))
    assert not watch.functions
    with trace["Watch"]() as watch:
        task_names(suite="strict")
    task_names(suite="published")
    files = {file for file, _ in watch.functions}
    assert str(trace["SOURCE"] / next(iter(files))).endswith(".py")
    assert any((trace["SOURCE"] / file).samefile(str(module.__file__)) for file in files)


@pytest.mark.slow
def test_words_to_plan_are_traced_and_listed() -> None:
    command = [sys.executable, str(SCRIPTS / "trace.py"), "words to plan", "--list"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    row = re.search(r"^\| words to plan \| (\d+) \| (\d+) \|$", said, flags=re.M)
    assert row is not None
    listed = re.findall(r"^    (\S+\.py): ", said, flags=re.M)
    assert len(listed) == int(row[1]) > 5
    assert int(row[2]) >= len(listed)


def test_an_unknown_call_is_refused() -> None:
    run = subprocess.run([sys.executable, str(SCRIPTS / "trace.py"), "a nap"], capture_output=True, text=True)
    assert run.returncode == 2
    assert "there is no call 'a nap'; expected one of: words to plan" in run.stderr
