"""The plugin of examples/, installed as a package of a third party, and the commands of its guide."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from lerobot_memobench.cli import memobench
from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.conformance.checks import PASSED, run_checks
from lerobot_memobench.conformance.subject import load_subject
from tests.conformance.conftest import EXAMPLE
from tests.test_docs import commands

ROOT = Path(__file__).parents[2]
TRAIN = ("policy=window", "policy.width=16", "policy.frames=8", "policy.stride=2", "policy.device=cpu")


def test_guide_shows_the_example() -> None:
    guide = (ROOT / "docs" / "guides" / "memory_policy.md").read_text()
    code = unindented((EXAMPLE / "lerobot_policy_window.py").read_text())
    skeleton = guide[guide.index("## The skeleton") : guide.index("## Check it")]
    shown = re.findall(r"```python\n(.*?)```", skeleton, re.DOTALL)
    assert len(shown) == 3
    assert [block for block in shown if unindented(block) not in code] == []


def unindented(code: str) -> str:
    """Return lines of code without indentation and empty lines, which the formatter changes."""
    return "".join(f"{line.strip()}\n" for line in code.splitlines() if line.strip())


def test_trained_example_conforms(example: Path, objects: Path, tmp_path: Path) -> None:
    """Phase and step are read without being listed as inputs, so they are not normalised."""
    run = tmp_path / "run"
    words = [*TRAIN, f"dataset={objects}", "steps=4", "batch_size=16", "num_workers=0", f"output_dir={run}"]
    assert main(["train", *words]) == 0
    checkpoint = run / "checkpoints" / "last" / "pretrained_model"
    inputs = json.loads((checkpoint / "config.json").read_text())["input_features"]
    assert set(inputs) == {"observation.state", "observation.environment_state"}
    results = run_checks(load_subject([f"policy={checkpoint}", f"dataset={objects}"], tmp_path))
    assert {result.outcome for result in results} == {PASSED}, results


@pytest.mark.slow
@pytest.mark.parametrize("page", ["guides/memory_policy.md", "develop/add_a_memory_mechanism.md"])
def test_commands_of_the_pages_run_in_their_order(
    page: str, example: Path, traces: None, images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fixtures install the packages, the demonstrations are short; another test runs the command of pytest."""
    programs = {"lerobot": main, "memobench": memobench.main}
    shutil.copytree(images, tmp_path / "outputs" / "demonstrations")
    monkeypatch.chdir(tmp_path)
    typed = list(commands(ROOT / "docs" / page))
    assert {program for program, *_ in typed} <= {"pip", "python", *programs}
    for program, *words in typed:
        if program in programs:
            assert programs[program](words) == 0, shlex.join([program, *words])
