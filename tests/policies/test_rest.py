"""Servers that are asked by HTTP POST."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote import transports as wire
from tests.support.policy_server import RestServer
from tests.support.remote_case import IMPATIENT, batch, free_port, make, pictures


def _act(question: dict[str, Any]) -> tuple[int, str]:
    chunk = np.zeros((8, 7))
    chunk[:, 6] = [0.0, 0.2, 0.49, 0.51, 0.9, 1.0, 1.0, 1.0]
    return 200, wire.to_json(list(chunk))


def test_openvla_oft() -> None:
    with RestServer(_act) as server:
        policy = make(server, dialect="openvla_oft", n_action_steps=5)
        actions = torch.cat([policy.select_action(batch(step)) for step in range(5)])
        policy.select_action(batch(*[9] * 2, task="two at a time"))
    # 0 closes and 1 opens there; here 1 closes and -1 opens.
    assert actions[:, 6].tolist() == [1, 1, 1, -1, -1]
    path, question = server.heard[0]
    assert path == "/act"
    sent = wire.from_json(question["json"])
    assert set(sent) == {"full_image", "wrist_image", "state", "instruction"}
    assert np.array_equal(sent["full_image"], pictures(0))
    assert sent["instruction"] == "do it"


@pytest.mark.parametrize(
    ("reply", "told"),
    [
        ((200, '"error"'), "which is no list of actions; its own log tells why"),
        ((500, "Internal Server Error"), "answered /act with HTTP state 500: Internal Server Error"),
        ((404, '{"detail":"Not Found"}'), "HTTP state 404"),
    ],
)
def test_openvla_oft_fails(reply: tuple[int, str], told: str) -> None:
    with RestServer(lambda question: reply) as server:
        policy = make(server, dialect="openvla_oft")
        with pytest.raises(MemobenchError, match=told):
            policy.select_action(batch(0))


def test_a_rest_server_that_is_not_there_is_told() -> None:
    with pytest.raises(MemobenchError, match=r"no policy server answered at http://127.0.0.1:\d+ within 0.3 s"):
        make(free_port(), dialect="memoryvla", **IMPATIENT)


ROWS = [[0.1 * k, 0, 0, 0, 0, 0, k % 2] for k in range(8)]


@pytest.mark.parametrize(
    "response",
    [ROWS, ";".join(" ".join(map(str, row)) for row in ROWS)],
    ids=["MemoryVLA", "RoboMME's MemoryVLA"],
)
def test_memoryvla(response: Any) -> None:
    with RestServer(lambda question: (200, json.dumps({"response": response}))) as server:
        policy = make(server, dialect="memoryvla", n_action_steps=4)
        shown = [policy.select_action(batch(step, phase=0)) for step in range(5)]
        actions = torch.cat([policy.select_action(batch(step)) for step in range(5, 8)])
        policy.reset()
        policy.select_action(batch(0))
    assert not torch.cat(shown).any()
    torch.testing.assert_close(actions[:, 0], torch.tensor([0.0, 0.1, 0.2]))
    assert actions[:, 6].tolist() == [1, -1, 1]
    assert {path for path, _ in server.heard} == {"/process_frame"}
    questions = [question for _, question in server.heard]
    assert [question["episode_first_frame"] for question in questions] == [b"True", b"False", b"False", b"True"]
    assert questions[0]["text"] == b"do it"
    seen = np.asarray(Image.open(io.BytesIO(questions[0]["image"])).convert("RGB")).astype(int)
    assert np.abs(seen[16:, 16:] - pictures(0)[16:, 16:]).max() <= 3
    assert seen[0, 0, 2] > seen[0, 0, 0] + 10  # its one blue pixel: the channels are in the order that PIL reads


def test_memoryvla_that_comes_back_sees_the_episode_again() -> None:
    def reply(question: dict[str, Any]) -> tuple[int, str]:
        return 200, json.dumps({"response": ROWS})

    with RestServer(reply) as first:
        policy = make(first, dialect="memoryvla", n_action_steps=2)
        for step in range(4):
            policy.select_action(batch(step))
    # Its threads may answer open connections for as long as this process lives: cut ours.
    policy._actors[0].session.close()
    with RestServer(reply, port=first.port) as second:
        policy.select_action(batch(4))
    assert [question["episode_first_frame"] for _, question in second.heard] == [b"True", b"False", b"False"]
    assert [question["image"] for _, question in second.heard[:2]] == [question["image"] for _, question in first.heard]
