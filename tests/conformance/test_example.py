"""The plugin of examples/, installed as a package of a third party, and the commands of its guide."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli import memobench
from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.conformance.checks import Outcome, run_checks
from lerobot_memobench.conformance.streams import TASK
from lerobot_memobench.conformance.subject import load_subject
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import protocol_of
from tests.conformance.conftest import EXAMPLE
from tests.support.lerobots_trainer import trainer_in_this_process
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


@pytest.fixture(scope="module")
def checkpoint(example: Path, objects: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train four updates by the command."""
    run = tmp_path_factory.mktemp("example") / "run"
    words = [*TRAIN, f"dataset={objects}", "steps=4", "batch_size=16", "num_workers=0", f"output_dir={run}"]
    with pytest.MonkeyPatch.context() as patch, trainer_in_this_process():
        watch(patch, load_subject([*TRAIN, f"dataset={objects}"], run.parent).policy)
        assert main(["train", *words]) == 0
    return run / "checkpoints" / "last" / "pretrained_model"


BATCHES: list[dict[str, Any]] = []


def watch(patch: pytest.MonkeyPatch, policy: Any) -> None:
    """Keep the training batches of this policy's class."""
    forward = type(policy).forward

    def learned(this: Any, batch: Any) -> Any:
        BATCHES.append(batch)
        return forward(this, batch)

    patch.setattr(type(policy), "forward", learned)


def test_phase_and_step_are_not_normalised(checkpoint: Path) -> None:
    """They are not listed as inputs; frames of prompts are trained on too."""
    phases = [phase for batch in BATCHES for phase in batch["observation.phase"][:, -1].tolist()]
    assert set(phases) == {0, 1}
    assert max(float(batch["observation.step"].max()) for batch in BATCHES) > 5
    assert all(batch["observation.step"].shape == (16, 8) for batch in BATCHES[:2])
    inputs = json.loads((checkpoint / "config.json").read_text())["input_features"]
    assert set(inputs) == {"observation.state", "observation.environment_state"}


def test_trained_example_conforms(checkpoint: Path, objects: Path, tmp_path: Path) -> None:
    results = run_checks(load_subject([f"policy={checkpoint}", f"dataset={objects}"], tmp_path))
    assert {result.outcome for result in results} == {Outcome.PASSED}, results


@pytest.mark.slow
def test_trained_example_runs_in_the_environment(
    checkpoint: Path, objects: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two rows have prompts of different lengths."""
    policy = type(load_subject([f"policy={checkpoint}", f"dataset={objects}"], tmp_path).policy)
    select = policy.select_action
    clocks: list[tuple[list[float], list[float]]] = []

    def acted(this: Any, batch: Any, **options: Any) -> Any:
        clocks.append((batch["observation.phase"].tolist(), batch["observation.step"].tolist()))
        return select(this, batch, **options)

    monkeypatch.setattr(policy, "select_action", acted)
    out = tmp_path / "eval"
    words = [f"policy={checkpoint}", f"tasks={TASK}", "episodes=2", "batch_size=2", "horizon=3", f"output_dir={out}"]
    assert main(["eval", "env=memobench", *words]) == 0
    assert [record["steps"] for record in read_episodes(out)] == [3, 3]
    protocol = protocol_of(out)
    assert (protocol["prompt_in"], protocol["obs_type"]) == ("steps", "environment_state_agent_pos")
    first, second = ([phases[row] for phases, _ in clocks].index(1) for row in range(2))
    assert first != second
    assert clocks[first][1][0] == clocks[second][1][1] == 0


@pytest.mark.slow
@pytest.mark.parametrize("page", ["guides/memory_policy.md", "develop/add_a_memory_mechanism.md"])
def test_commands_of_the_pages_run_in_their_order(
    page: str, example: Path, traces: None, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fixtures install the packages of `pip install`, and the demonstrations are short."""
    programs = {"lerobot": main, "memobench": memobench.main}
    shutil.copytree(pictures, tmp_path / "outputs" / "demonstrations")
    monkeypatch.chdir(tmp_path)
    typed = list(commands(ROOT / "docs" / page))
    assert {program for program, *_ in typed} == {"pip", *programs}
    for program, *words in typed:
        if program != "pip":
            assert programs[program](words) == 0, shlex.join([program, *words])
