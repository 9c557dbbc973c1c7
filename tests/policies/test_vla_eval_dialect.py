"""vla-evaluation-harness's model servers as policies: what they are sent, and what is said of servers that do wrong."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
import torch
from vla_eval import serve_background

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from tests.support.policy_server import PolicyServer
from tests.support.remote_case import IMPATIENT, batch, make, pictures
from tests.support.vla_eval_server import DigestServer, ScriptedServer, action, hello


def test_an_episode_with_a_prompt() -> None:
    server = DigestServer(steps=2)
    with serve_background(server) as handle:
        policy = make(handle.port, dialect="vla_eval")
        shown = [policy.select_action(batch(step, phase=0)) for step in range(3)]
        acted = [policy.select_action(batch(step)) for step in range(4)]
        policy.reset()
        policy.select_action(batch(0))
    assert not torch.cat(shown).any()
    assert len({tuple(action[0].tolist()) for action in acted}) == 4
    assert server.tasks == [{"name": "do it"}] * 2
    assert server.ended == 2
    (_, first), (_, second), (_, third) = [(step, obs) for _, step, obs in server.heard]
    assert list(first["images"]) == ["agentview", "wrist"]  # servers take them by their order
    assert np.array_equal(first["images"]["agentview"], pictures(0))
    assert np.array_equal(first["images"]["wrist"], pictures(0)[:, ::-1])
    assert first["states"].dtype == np.float32
    assert first["states"].tolist() == list(range(1, 9))
    assert first["task_description"] == "do it"
    assert first["episode_restart"] is True
    assert all(np.array_equal(found, pictures(step)) for step, found in enumerate(first["video_history"]))
    assert [len(first[name]) for name in ("video_history", "wrist_video_history", "state_history")] == [3, 3, 3]
    # The server asks for the third action by itself: it plans two at a time.
    assert [step for _, step, _ in server.heard] == [0, 2, 0]
    for later in (second, third):
        assert set(later) == {"images", "states", "task_description", "step"}


def test_the_prompt_is_thinned_or_left_out() -> None:
    for settings, steps in (({"history_every": 2}, [0, 2, 4]), ({"send_prompt": False}, None)):
        server = DigestServer()
        with serve_background(server) as handle:
            policy = make(handle.port, dialect="vla_eval", **settings)
            for step in range(5):
                policy.select_action(batch(step, phase=0))
            policy.select_action(batch(0))
        ((_, _, found),) = server.heard
        history = found.get("video_history")
        assert (history and [int(frame[0, 0, 0]) for frame in history]) == steps


def test_environments_have_sessions_of_their_own() -> None:
    server = DigestServer(steps=1)
    with serve_background(server) as handle:
        policy = make(handle.port, dialect="vla_eval")
        for step in range(2):
            policy.select_action(batch(step, step))
    rows = {(session, int(obs["images"]["agentview"][0, 0, 1])) for session, _, obs in server.heard}
    assert len(rows) == 2


def test_other_conventions_are_told(caplog: pytest.LogCaptureFixture) -> None:
    with serve_background(DigestServer()) as handle, caplog.at_level(logging.WARNING):
        make(handle.port, dialect="vla_eval").select_action(batch(0))
    (told,) = [record.getMessage() for record in caplog.records if record.name.startswith("lerobot_memobench")]
    assert "works with rotation as euler_xyz, and this environment with axis_angle" in told


def test_an_action_is_asked_for_at_every_step_unless_told_otherwise() -> None:
    assert RemoteConfig(dialect="vla_eval").n_action_steps == 1
    assert RemoteConfig(dialect="vla_eval", n_action_steps=4).n_action_steps == 4
    assert RemoteConfig().n_action_steps == 5
    with ScriptedServer(observation=action((6, 7))) as server:
        policy = make(server.port, dialect="vla_eval", n_action_steps=4)
        for step in range(5):
            assert policy.select_action(batch(step)).tolist() == [[0.25] * 7]
    assert [kind for kind, _ in server.heard] == ["hello", "episode_start", "observation", "observation"]


ARRAY = {b"__ndarray__": True, b"data": b"11", b"dtype": "|i1", b"shape": [2]}


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        ({"hello": hello(2)}, r"speaks version 2 of vla-evaluation-harness's protocol, and version 1 .*vla-eval 0\.8"),
        ({"hello": hello(ARRAY)}, "speaks version array"),
        (
            {"hello": [("action", {})]},
            "no policy server with vla-evaluation-harness's protocol .*answered a hello with",
        ),
        ({"hello": b"\x93\x01\x02\x03"}, "its frames have no type and payload"),
        ({"hello": b"\xc1"}, "it is not msgpack with arrays"),
        ({"observation": action((8,))}, r"actions of shape \(1, 8\); expected finite numbers of shape \(steps, 7\)"),
        ({"observation": action((2, 3, 7))}, r"actions of shape \(2, 3, 7\)"),
        ({"observation": [("action", {})]}, "without 'actions'"),
        ({"observation": [("error", {"error": "observation_failed: KeyError: 'images'"})]}, "failed: obs.*'images'"),
        ({"episode_start": [("error", {"error": "episode_start_failed: boom"})]}, "failed: episode_start_failed: boom"),
        ({"observation": hello()}, "answered an observation with 'hello'"),
        ({"observation": 1.0}, r"took more than 0\.3 s for an answer"),
        ({"hello": 1.0}, r"no policy server answered at ws://.* within 0\.3 s"),
    ],
)
def test_a_server_that_does_wrong_is_named(answers: dict[str, Any], told: str) -> None:
    with ScriptedServer(**answers) as server, pytest.raises(MemobenchError, match=told) as caught:
        make(server.port, dialect="vla_eval", **IMPATIENT).select_action(batch(0))
    assert "\n" not in str(caught.value)
    assert f"ws://127.0.0.1:{server.port}" in str(caught.value)


def test_a_server_of_another_kind_is_named() -> None:
    with PolicyServer() as server, pytest.raises(MemobenchError, match="choose another dialect="):
        make(server, dialect="vla_eval")


def test_a_server_that_comes_back_is_told_the_episode_again() -> None:
    with ScriptedServer() as server:
        policy = make(server.port, dialect="vla_eval")
        policy.select_action(batch(0, phase=0))
        for step in range(2):
            policy.select_action(batch(step))
        gone = iter([True])
        server.die = lambda: next(gone, False)
        policy.select_action(batch(2))
    kinds = [kind for kind, _ in server.heard]
    assert kinds == [
        *("hello", "episode_start", "observation", "observation"),
        *("observation", "hello", "episode_start", "observation", "observation", "observation"),
    ]
    observed = [payload for kind, payload in server.heard if kind == "observation"]
    assert observed[0] == observed[3]
    assert "video_history" in observed[3]
    assert observed[2] == observed[5]
