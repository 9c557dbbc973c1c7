"""The whole command with a policy in a server, and the server that the documentation shows."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.episode_log import read_episodes
from tests.support import policy_server
from tests.support.policy_server import PolicyServer
from tests.support.remote_case import TASK, batch, free_port, make


def _evaluate(port: int, out: Path, *words: str) -> int:
    return main(
        [
            *("eval", "env=memobench", "policy=memobench_remote", "host=127.0.0.1", f"port={port}", "replan=10"),
            *(f"tasks={TASK}", "horizon=20", "env.render=fast", "eval.use_async_envs=false", f"output_dir={out}"),
            *words,
        ]
    )


def test_an_evaluation_that_loses_its_server_is_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two episodes of two questions each; the server dies over the second question of the second episode."""
    out = tmp_path / "run"
    with PolicyServer(die_at=3) as server:
        assert _evaluate(server.port, out, "episodes=2", "batch_size=1", "policy.retry=0.5") == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("lerobot:")]
    assert len(told) == 1
    assert "went away and did not come back within 0.5 s" in told[0]
    before = read_episodes(out)
    assert [(record["episode"], record["steps"], record["replan_steps"]) for record in before] == [(0, 20, 10)]
    with PolicyServer() as server:
        assert _evaluate(server.port, out, "episodes=2", "batch_size=1", "resume=true") == 0
    assert len(server.heard) == 2
    after = read_episodes(out)
    assert [record["episode"] for record in after] == [0, 1]
    assert after[0] == before[0]
    assert json.loads((out / "report.json").read_text())["tasks"][TASK]["n"] == 2


def test_no_server_no_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert _evaluate(free_port(), out, "episodes=1", "policy.connect_timeout=0.2") == 2
    assert "no policy server answered" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_a_killed_server_that_is_started_again(tmp_path: Path) -> None:
    """A process of its own that dies in the middle of an episode, of several environments in workers."""
    port, out = free_port(), tmp_path / "run"
    script = policy_server.__file__
    keeper = subprocess.Popen(
        ["bash", "-c", f"{sys.executable} {script} {port} 3; exec {sys.executable} {script} {port}"]
    )
    try:
        words = ("episodes=2", "batch_size=2", "eval.use_async_envs=true")
        assert _evaluate(port, out, *words) == 0
    finally:
        keeper.kill()
        keeper.wait()
    assert [record["steps"] for record in read_episodes(out)] == [20, 20]


def test_the_server_in_the_docs_serves() -> None:
    text = (Path(__file__).parents[2] / "docs" / "guides" / "remote.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    port = free_port()
    server = subprocess.Popen([sys.executable, "-c", program.replace("8000", str(port))])
    try:
        policy = make(port, connect_timeout=60.0, n_action_steps=50)
        assert not policy.select_action(batch(0)).any()
    finally:
        server.kill()
        server.wait()
