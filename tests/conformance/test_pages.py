"""The commands of the pages on writing a policy and a memory run, as they are printed."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

from lerobot_memobench.cli import lerobot, memobench
from tests.test_docs import commands

DOCS = Path(__file__).parents[2] / "docs"
PROGRAMS = {"lerobot": lerobot.main, "memobench": memobench.main}


@pytest.mark.slow
@pytest.mark.parametrize("page", ["guides/memory_policy.md", "develop/add_a_memory_mechanism.md"])
def test_commands_run_in_their_order(
    page: str, example: Path, traces: None, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The packages of `pip install` are installed by fixtures, and the demonstrations are short."""
    shutil.copytree(pictures, tmp_path / "outputs" / "demonstrations")
    monkeypatch.chdir(tmp_path)
    typed = list(commands(DOCS / page))
    assert {program for program, *_ in typed} == {"pip", *PROGRAMS}
    for program, *words in typed:
        if program != "pip":
            assert PROGRAMS[program](words) == 0, shlex.join([program, *words])
