"""The plugin of examples/, installed as anybody's package, by the commands that users type."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.conformance.checks import Outcome, run_checks
from lerobot_memobench.conformance.streams import TASK
from lerobot_memobench.conformance.subject import load_subject
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.training import command
from tests.conformance.conftest import EXAMPLE

ROOT = Path(__file__).parents[2]
TRAIN = ("policy=window", "policy.width=16", "policy.frames=8", "policy.stride=2", "policy.device=cpu")


def test_the_guide_shows_the_example_as_it_is() -> None:
    guide = (ROOT / "docs" / "guides" / "memory_policy.md").read_text()
    code = unindented((EXAMPLE / "lerobot_policy_window.py").read_text())
    skeleton = guide[guide.index("## The skeleton") : guide.index("## Check it")]
    shown = re.findall(r"```python\n(.*?)```", skeleton, re.DOTALL)
    assert len(shown) == 3
    assert [block for block in shown if unindented(block) not in code] == []


def unindented(code: str) -> str:
    """Return lines of code without their indentation and the empty ones, which the formatter sets otherwise alone."""
    return "".join(f"{line.strip()}\n" for line in code.splitlines() if line.strip())


@pytest.fixture(scope="module")
def checkpoint(example: Path, objects: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some updates by the command."""
    run = tmp_path_factory.mktemp("example") / "run"
    words = [*TRAIN, f"dataset={objects}", "steps=4", "batch_size=16", "num_workers=0", f"output_dir={run}"]
    with pytest.MonkeyPatch.context() as patch:
        watch(patch, load_subject([*TRAIN, f"dataset={objects}"], run.parent).policy)
        patch.setattr(command, "run_lerobot", run_in_this_process)
        assert main(["train", *words]) == 0
    return run / "checkpoints" / "last" / "pretrained_model"


def run_in_this_process(flags: Sequence[str]) -> int:
    """Run LeRobot's trainer where the policy is watched, not in a process of its own."""
    from lerobot.scripts import lerobot_train

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-train", *flags])
        lerobot_train.main()
    return 0


BATCHES: list[dict[str, Any]] = []


def watch(patch: pytest.MonkeyPatch, policy: Any) -> None:
    """Keep the batches that a policy of this class learns from."""
    forward = type(policy).forward

    def learned(this: Any, batch: Any) -> Any:
        BATCHES.append(batch)
        return forward(this, batch)

    patch.setattr(type(policy), "forward", learned)


def test_it_trains_on_phase_and_step_as_they_are(checkpoint: Path) -> None:
    """They are no inputs, which would be normalised; frames of prompts are learned from too."""
    phases = [phase for batch in BATCHES for phase in batch["observation.phase"][:, -1].tolist()]
    assert set(phases) == {0, 1}
    assert max(float(batch["observation.step"].max()) for batch in BATCHES) > 5
    assert all(batch["observation.step"].shape == (16, 8) for batch in BATCHES[:2])
    inputs = json.loads((checkpoint / "config.json").read_text())["input_features"]
    assert set(inputs) == {"observation.state", "observation.environment_state"}


def test_what_was_trained_conforms(checkpoint: Path, objects: Path, tmp_path: Path) -> None:
    results = run_checks(load_subject([f"policy={checkpoint}", f"dataset={objects}"], tmp_path))
    assert {result.outcome for result in results} == {Outcome.PASSED}, results


@pytest.mark.slow
def test_it_rolls_out(checkpoint: Path, objects: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rows, whose prompts have different lengths."""
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
