"""What is done when a policy server answers wrongly, goes away, or never comes."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from tests.support import policy_server
from tests.support.policy_server import PolicyServer, RestServer, zeros
from tests.support.remote_case import IMPATIENT, batch, counting, frames_of, free_port, make


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (
            "Traceback (most recent call last):\n  File …\nKeyError: 'observation/joints'\n",
            "KeyError: 'observation/joi",
        ),
        ({"actions": np.zeros((10, 8))}, r"actions of shape \(10, 8\); expected finite numbers of shape \(steps, 7\)"),
        ({"actions": np.zeros((2, 10, 7))}, r"actions of shape \(2, 10, 7\)"),
        ({"actions": ["a"]}, "no numbers"),
        ({"action": 1}, r"without 'actions' \(it holds action\)"),
        ({"actions": np.zeros((3, 7))}, "answers 3 actions at a time, fewer than the 5.*replan=3 or less"),
        ([1], "answered a list, no map"),
    ],
)
def test_a_wrong_answer_is_named(answer: Any, told: str) -> None:
    with PolicyServer(lambda question: answer) as server:
        policy = make(server)
        with pytest.raises(MemobenchError, match=told) as caught:
            policy.select_action(batch(0))
    assert "\n" not in str(caught.value)
    assert f"ws://127.0.0.1:{server.port}" in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("gripper", ["rlds", None])
def test_what_is_not_finite_is_passed_on(value: float, gripper: str | None) -> None:
    """The environment ends the episode with it; here it would end all of them."""
    with PolicyServer(lambda question: {"actions": np.full((10, 7), value)}) as server:
        action = make(server, gripper=gripper).select_action(batch(0))
    assert action.shape == (1, 7)
    assert not torch.isfinite(action).any()


def test_a_server_that_is_not_there_is_told() -> None:
    with pytest.raises(MemobenchError, match=r"no policy server answered at ws://127.0.0.1:\d+ within 0.3 s"):
        make(free_port(), **IMPATIENT)


def test_a_server_that_starts_late_is_waited_for() -> None:
    port = free_port()
    late = subprocess.Popen([sys.executable, policy_server.__file__, str(port)], stdout=subprocess.DEVNULL)
    try:
        assert not make(port, connect_timeout=60.0).select_action(batch(0)).any()
    finally:
        late.kill()
        late.wait()


def test_what_speaks_another_protocol_is_told() -> None:
    with (
        RestServer(lambda question: (200, "{}")) as server,
        pytest.raises(MemobenchError, match=r"no policy server with openpi's websocket protocol .*another dialect"),
    ):
        make(server)


def test_an_answer_that_takes_too_long_is_told() -> None:
    def slow(question: dict[str, Any]) -> dict[str, Any]:
        time.sleep(1.0)
        return zeros(question)

    with PolicyServer(slow) as server:
        policy = make(server, timeout=0.2)
        with pytest.raises(MemobenchError, match=r"took more than 0.2 s for an answer; .*policy.timeout="):
            policy.select_action(batch(0))


def test_a_server_that_comes_back_goes_on_with_the_episode() -> None:
    with PolicyServer(counting, die_at=2) as dying:
        policy = make(dying, n_action_steps=2, image_size=0)
        for step in range(4):
            policy.select_action(batch(step))
        with PolicyServer(counting, port=_again(dying)) as server:
            actions = [policy.select_action(batch(step)) for step in range(4, 8)]
    torch.testing.assert_close(torch.cat(actions)[:, 1], torch.tensor([0.04, 0.04, 0.06, 0.06]))
    assert [int(question["observation/image"][0, 0, 0]) for question in server.questions] == [4, 6]


def _again(dying: PolicyServer) -> int:
    """Let a server die now and return its port."""
    dying.die()
    return dying.port


def test_a_memory_that_was_lost_is_told_the_episode_again() -> None:
    with PolicyServer(counting) as dying:
        policy = make(dying, dialect="robomme", n_action_steps=2)
        for step in range(5):
            policy.select_action(batch(step, phase=int(step >= 2)))
        with PolicyServer(counting, port=_again(dying)) as server:
            for step in range(5, 8):
                policy.select_action(batch(step))
    assert [next(iter(question)) for question in server.questions] == [
        *("reset", "images", "images"),
        *("images", "observation/image"),
    ]
    assert [frames_of(question) for question in server.questions[1:4]] == [[0, 1, 2], [3, 4], [5, 6]]
    assert {question["exec_start_idx"] for question in server.questions[1:4]} == {2}


def test_an_openpi_server_with_a_memory_is_told_the_episode_again() -> None:
    with PolicyServer(counting) as dying:
        policy = make(dying, n_action_steps=2, image_size=0, memory=True)
        for step in range(4):
            policy.select_action(batch(step))
        with PolicyServer(counting, port=_again(dying)) as server:
            policy.select_action(batch(4))
    assert [int(question["observation/image"][0, 0, 0]) for question in server.questions] == [0, 2, 4]


def test_a_server_that_dies_over_every_question_is_told() -> None:
    with PolicyServer() as server:
        policy = make(server, retry=0.4)
        server.answer = lambda question: server.connections[-1].socket.shutdown(socket.SHUT_RDWR)
        with pytest.raises(MemobenchError, match=r"did not come back within 0\.4 s"):
            policy.select_action(batch(0))
