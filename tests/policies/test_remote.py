"""The policy that runs in a server: episodes, prompts, settings, failures, and what goes over the wire."""

from __future__ import annotations

import hashlib
import socket
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote import transports as wire
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.policies.remote.modeling_remote import RemotePolicy
from lerobot_memobench.policies.remote.session import fit
from tests.support import policy_server
from tests.support.policy_server import PolicyServer, robomme, zeros
from tests.support.remote_case import IMPATIENT, batch, counting, frames_of, free_port, make, pictures

# --- an episode ---


def test_a_question_holds_what_openpis_libero_servers_expect() -> None:
    with PolicyServer() as server:
        make(server).select_action(batch(0, task="open the drawer"))
        make(server, image_size=0, mirror=True).select_action(batch(7))
    first, second = server.questions
    assert set(first) == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
    assert first["prompt"] == "open the drawer"
    for name in ("observation/image", "observation/wrist_image"):
        assert first[name].shape == (224, 224, 3)
        assert first[name].dtype == np.uint8
    assert first["observation/state"].dtype == np.float32
    assert np.array_equal(first["observation/state"], np.arange(8) + 1)
    # As rendered: every pixel of the camera survives LeRobot's division by 255.
    assert np.array_equal(second["observation/image"], pictures(7)[:, ::-1])
    assert np.array_equal(second["observation/wrist_image"], pictures(7))


def test_keys_are_renamed_and_others_are_sent_along() -> None:
    with PolicyServer() as server:
        make(server, keys="video.front=image, t=step,language = task", image_size=0).select_action(batch(4))
        policy = make(server, keys="x=gaze")
        with pytest.raises(MemobenchError, match=r"'gaze'.*known are image, phase, state, step, task, wrist_image"):
            policy.select_action(batch(0))
    (question,) = server.questions
    assert question["t"] == [4]
    assert question["language"] == "do it"
    assert np.array_equal(question["video.front"], pictures(4))


def test_the_first_actions_of_each_answer_are_executed() -> None:
    with PolicyServer(counting) as server:
        policy = make(server, n_action_steps=4, image_size=0)
        actions = torch.cat([policy.select_action(batch(step)) for step in range(9)])
    assert actions.dtype == torch.float32
    torch.testing.assert_close(actions[:, 0], torch.tensor([0.0, 0.1, 0.2, 0.3] * 2 + [0.0]))
    torch.testing.assert_close(actions[:, 1], torch.tensor([0.0] * 4 + [0.04] * 4 + [0.08]))
    assert len(server.heard) == 3


def test_each_environment_has_its_own_connection_and_episode() -> None:
    with PolicyServer(counting) as server:
        policy = make(server, n_action_steps=2, image_size=0)
        for steps in ((0, 0, 0), (1, 1, 1), (2, 2, 1), (3, 3, 1), (4, 0, 1)):
            actions = policy.select_action(batch(*steps))
            # Row 2 has ended and stands still at step 1, row 1 begins anew with the last batch.
            rows = [0, 1] if steps[2] == 1 and steps[0] > 1 else [0, 1, 2]
            assert all(round(float(actions[row, 2]) * 100) == row for row in rows)
            if len(rows) == 2:
                assert not actions[2].any()
        policy.reset()
        policy.select_action(batch(0, 0, 0))
    asked: dict[int, list[tuple[int, int]]] = {}
    for connection, question in server.heard:
        step, row = question["observation/image"][0, 0, :2]
        asked.setdefault(connection, []).append((int(row), int(step)))
    assert all(len({row for row, _ in found}) == 1 for found in asked.values())
    episodes = sorted((found[0][0], [step for _, step in found]) for found in asked.values())
    assert episodes == [(0, [0]), (0, [0, 2, 4]), (1, [0]), (1, [0]), (1, [0, 2]), (2, [0]), (2, [0])]


def test_environments_that_are_not_simulated_are_not_asked_about() -> None:
    with PolicyServer(counting) as server:
        policy = make(server, image_size=0)
        for step in range(2):
            actions = policy.select_action(batch(None, step))
    assert len(server.heard) == 1
    assert not actions[0].any()
    assert actions[1].any()


def test_an_environment_that_tells_no_steps_begins_with_the_rollout() -> None:
    with PolicyServer(counting) as server:
        policy = make(server, n_action_steps=3, keys="observation/image=image", image_size=0)
        for _ in range(2):
            policy.reset()
            for step in range(4):
                found = batch(step)
                policy.select_action({key: found[key] for key in found if not key.endswith(("step", "phase"))})
    assert [int(question["observation/image"][0, 0, 0]) for question in server.questions] == [0, 3, 0, 3]


# --- the prompt ---


def test_the_prompt_reaches_the_server_and_its_answers_are_not_executed() -> None:
    with PolicyServer(counting) as server:
        policy = make(server, n_action_steps=4, image_size=0, history_every=3)
        shown = [policy.select_action(batch(step, phase=0)) for step in range(8)]
        action = policy.select_action(batch(8))
    assert not torch.cat(shown).any()
    assert float(action[0, 1]) == pytest.approx(0.08)
    assert [int(question["observation/image"][0, 0, 0]) for question in server.questions] == [0, 3, 6, 8]


def test_the_prompt_can_be_left_out() -> None:
    with PolicyServer() as server:
        policy = make(server, send_prompt=False)
        for step in range(8):
            policy.select_action(batch(step, phase=0))
        assert not server.heard
        policy.select_action(batch(8))
    assert len(server.heard) == 1


def test_a_robomme_server_gets_every_frame() -> None:
    with PolicyServer(counting) as server:
        policy = make(server, dialect="robomme", n_action_steps=4)
        for _ in range(2):
            policy.reset()
            for step in range(14):
                policy.select_action(batch(step, phase=int(step >= 5)))
    half = server.questions[: len(server.heard) // 2]
    assert [next(iter(question)) for question in half] == [
        "reset",
        *["images", "observation/image"] * 3,
    ]
    buffers = half[1::2]
    assert [frames_of(question) for question in buffers] == [
        [0, 1, 2, 3, 4, 5],
        [6, 7, 8, 9],
        [10, 11, 12, 13],
    ]
    # As in RoboMME's client: the index of the frame with which execution begins.
    assert [question["exec_start_idx"] for question in buffers] == [5, 5, 5]
    assert [list(question) for question in server.questions[len(half) :]] == [list(question) for question in half]


def test_a_server_with_one_memory_serves_one_environment() -> None:
    with PolicyServer(robomme) as one, PolicyServer(robomme) as other:
        policy = make(one, dialect="robomme")
        with pytest.raises(MemobenchError, match="2 environments would share 1; use batch_size=1"):
            policy.select_action(batch(0, 0))
        policy = make(one, dialect="robomme", servers=f"127.0.0.1:{one.port},127.0.0.1:{other.port}")
        policy.select_action(batch(0, 0))
    assert len(one.heard) == len(other.heard) == 3


# --- settings ---


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"dialect": "openpy"}, "did you mean 'openpi'"),
        ({"gripper": "closed"}, "policy.gripper is 'closed'"),
        ({"host": "10.0.0.5/policy"}, "expected a host and a port"),
        ({"port": 70_000}, "expected a host and a port"),
        ({"servers": "gpu1:8000,gpu2"}, "found 'gpu2' as"),
        ({"host": "http://gpu1"}, "reached by ws:// or wss://"),
        ({"keys": "image"}, "expected pairs"),
        ({"n_action_steps": 0}, "policy.n_action_steps is 0"),
        ({"retry": 0.0}, "policy.retry is 0.0"),
        ({"image_size": -1}, "policy.image_size is -1"),
    ],
)
def test_wrong_settings_are_named(settings: dict[str, Any], told: str) -> None:
    with pytest.raises(MemobenchError, match=told):
        RemoteConfig(**settings)


def test_addresses() -> None:
    assert RemoteConfig().addresses() == ["ws://127.0.0.1:8000"]
    assert RemoteConfig(host="wss://gpu1", port=443).addresses() == ["wss://gpu1:443"]
    assert RemoteConfig(servers="a:1, b:2").addresses() == ["ws://a:1", "ws://b:2"]
    assert RemoteConfig(servers="a:1, b:2", dialect="robomme").max_environments == 2
    assert RemoteConfig().max_environments is None


def test_lerobot_finds_it_and_it_refuses_to_train() -> None:
    assert get_policy_class("memobench_remote") is RemotePolicy
    policy = RemotePolicy(RemoteConfig())
    with pytest.raises(MemobenchError, match="cannot be trained here"):
        policy.forward({})
    before, after = make_pre_post_processors(policy.config)
    found = before(batch(3))
    assert torch.equal(found["observation.images.image"], batch(3)["observation.images.image"])
    assert torch.equal(after(torch.ones(1, 7)), torch.ones(1, 7))


# --- failures ---


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
        ({"action": 1}, r"without 'actions' \(it holds \['action'\]\)"),
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


def test_a_gripper_of_rlds_is_turned() -> None:
    """0 closes and 1 opens there; here 1 closes and -1 opens."""
    chunk = np.zeros((5, 7))
    chunk[:, 6] = [0.0, 0.2, 0.49, 0.51, 1.0]
    with PolicyServer(lambda question: {"actions": chunk}) as server:
        policy = make(server, gripper="rlds")
        actions = torch.cat([policy.select_action(batch(step)) for step in range(5)])
    assert actions[:, 6].tolist() == [1, 1, 1, -1, -1]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("gripper", ["rlds", "libero"])
def test_what_is_not_finite_is_passed_on(value: float, gripper: str) -> None:
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


def test_an_answer_that_takes_too_long_is_told() -> None:
    def slow(question: dict[str, Any]) -> dict[str, Any]:
        time.sleep(1.0)
        return zeros(question)

    with PolicyServer(slow) as server:
        policy = make(server, timeout=0.2)
        with pytest.raises(MemobenchError, match=r"took more than 0.2 s for an answer; .*policy.timeout="):
            policy.select_action(batch(0))


def _again(dying: PolicyServer) -> int:
    """Let a server die now and return its port."""
    dying.die()
    return dying.port


@pytest.mark.parametrize(("memory", "asked"), [(False, [4, 6]), (True, [0, 2, 4, 6])])
def test_a_server_that_comes_back_goes_on_with_the_episode(memory: bool, asked: list[int]) -> None:
    with PolicyServer(counting) as dying:
        policy = make(dying, n_action_steps=2, image_size=0, memory=memory)
        for step in range(4):
            policy.select_action(batch(step))
        with PolicyServer(counting, port=_again(dying)) as server:
            actions = [policy.select_action(batch(step)) for step in range(4, 8)]
    torch.testing.assert_close(torch.cat(actions)[:, 1], torch.tensor([0.04, 0.04, 0.06, 0.06]))
    assert [int(question["observation/image"][0, 0, 0]) for question in server.questions] == asked


def test_a_robomme_server_that_comes_back_gets_every_frame_again() -> None:
    with PolicyServer(counting) as dying:
        policy = make(dying, dialect="robomme", n_action_steps=2)
        for step in range(5):
            policy.select_action(batch(step, phase=int(step >= 2)))
        with PolicyServer(counting, port=_again(dying)) as server:
            for step in range(5, 8):
                policy.select_action(batch(step))
    order = [next(iter(question)) for question in server.questions]
    assert order == ["reset", "images", "images", "images", "observation/image"]
    assert [frames_of(question) for question in server.questions[1:4]] == [[0, 1, 2], [3, 4], [5, 6]]
    assert {question["exec_start_idx"] for question in server.questions[1:4]} == {2}


def test_a_server_that_dies_over_every_question_is_told() -> None:
    with PolicyServer() as server:
        policy = make(server, retry=0.4)
        server.answer = lambda question: server.connections[-1].socket.shutdown(socket.SHUT_RDWR)
        with pytest.raises(MemobenchError, match=r"did not come back within 0\.4 s"):
            policy.select_action(batch(0))


# --- the wire ---

#: Packed by openpi-client 0.1.2.
OPENPI_FRAME = (
    "84b16f62736572766174696f6e2f737461746584c40b5f5f6e6461727261795f5fc3c40464617461c40c000000000000803f00000040c4"
    "056474797065a33c6634c40573686170659103b16f62736572766174696f6e2f696d61676584c40b5f5f6e6461727261795f5fc3c40464"
    "617461c40c000102030405060708090a0bc4056474797065a37c7531c405736861706593020203a16e83c40d5f5f6e7067656e65726963"
    "5f5fc3c40464617461cb3ff8000000000000c4056474797065a33c6634a670726f6d7074a673617920c3a4"
)


def test_frames_are_those_of_openpis_client() -> None:
    message = {
        "observation/state": np.arange(3, dtype=np.float32),
        "observation/image": np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
        "n": np.float32(1.5),
        "prompt": "say ä",
    }
    assert wire.pack(message).hex() == OPENPI_FRAME
    back = wire.unpack(bytes.fromhex(OPENPI_FRAME))
    assert back["n"] == 1.5
    assert back["n"].dtype == np.float32
    assert back["observation/image"].dtype == np.uint8
    assert np.array_equal(back["observation/image"], message["observation/image"])


def test_nothing_that_could_carry_code_is_packed_or_taken() -> None:
    with pytest.raises(ValueError, match="cannot be sent"):
        wire.pack({"x": np.array([object()])})
    foreign = wire.pack({"x": np.zeros(1)}).replace(b"<f8", b"|O8")
    with pytest.raises(ValueError, match="not taken"):
        wire.unpack(foreign)
    with pytest.raises(ValueError, match="not msgpack"):
        wire.unpack(b"\xc1")


@pytest.mark.parametrize(
    ("height", "width", "digest"),
    [(256, 256, "6bc21716ac445bdb"), (120, 200, "a2d0d2674df3d7d5"), (200, 90, "65a85f1d1a04eee5")],
)
def test_images_are_resized_as_openpis_client_does(height: int, width: int, digest: str) -> None:
    y, x = np.mgrid[:height, :width]
    image = np.stack([x * 255 // width, y * 255 // height, (x * y) % 256], -1).astype(np.uint8)
    assert hashlib.sha256(fit(image, 224).tobytes()).hexdigest()[:16] == digest
    assert np.array_equal(fit(image, None, mirror=True), image[:, ::-1])
