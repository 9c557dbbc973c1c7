"""The policy in a server, for each dialect: messages, prompts, settings, wrong answers, lost servers."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import torch
from lerobot.envs import preprocess_observation
from lerobot.policies import make_policy
from lerobot.utils.constants import OBS_IMAGES
from vla_eval import serve_background

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies import remote_connection as wire
from lerobot_memobench.policies.remote import MOST_ACTIONS, RemoteConfig, RemotePolicy, fit
from tests.support.policy_server import (
    IMPATIENT,
    PATIENT,
    TASK,
    PolicyServer,
    batch,
    counting,
    frames_of,
    free_port,
    make,
    numbered_image,
    robomme,
)
from tests.support.vla_eval_server import DigestServer, ScriptedServer, action, hello


def steps_of(questions: list[dict[str, Any]]) -> list[int]:
    return [int(question["observation/image"][0, 0, 0]) for question in questions]


# --- openpi ---


def test_openpi_gets_liberos_images_under_its_names_whatever_the_environment_calls_them() -> None:
    """And parts of ``robot_state`` where ``keys`` asks for them."""
    sent = [f"{theirs}={ours}" for theirs, ours in RemoteConfig().sent().items()]
    keys = ",".join([*sent, "joints=robot_state.joints.pos"])
    mapping = {"agentview_image": "second", "robot0_eye_in_hand_image": "first"}
    config = MemobenchEnvConfig(tasks=TASK, convention="libero", camera_name_mapping=mapping, robot_state=True)
    (env,) = config.create_envs(1)["temporal"].values()
    observed = preprocess_observation(env.reset(seed=[20_000])[0]) | {"task": ["do it"]}
    with PolicyServer() as server:
        policy = make_policy(RemoteConfig(port=server.port, image_size=0, keys=keys, **PATIENT), env_cfg=config)
        policy.reset()
        policy.select_action(observed)
    (question,) = server.questions
    joints = question.pop("joints")
    assert set(question) == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
    (episode,) = env.get_attr("episode")
    for name, image in episode.images().items():
        assert np.array_equal(question[f"observation/{name}"], image[:, ::-1])
    assert np.array_equal(joints, np.float32(episode.sim.robot_state()["joints"]["pos"]))


def test_openpi_questions_hold_the_inputs_of_its_libero_servers() -> None:
    with PolicyServer() as server:
        make(server).select_action(batch(0, task="open the drawer"))
        libero = batch(7)
        libero[f"{OBS_IMAGES}.image2"] = libero.pop(f"{OBS_IMAGES}.wrist_image")  # with convention=libero
        make(server, image_size=0).select_action(libero)
        make(server, keys="video.front=image, t=step,language = task", image_size=0).select_action(batch(4))
        with pytest.raises(MemobenchError, match=r"'gaze'.*image, phase, state, step, task, wrist_image"):
            make(server, keys="x=gaze").select_action(batch(0))
    first, second, third = server.questions
    assert set(first) == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
    assert first["prompt"] == "open the drawer"
    for name in ("observation/image", "observation/wrist_image"):
        assert (first[name].shape, first[name].dtype) == ((224, 224, 3), np.uint8)
    assert first["observation/state"].dtype == np.float32
    assert np.array_equal(first["observation/state"], np.arange(8) + 1)
    # As rendered: every pixel survives LeRobot's division by 255.
    assert np.array_equal(second["observation/image"], numbered_image(7))
    assert np.array_equal(second["observation/wrist_image"], numbered_image(7)[:, ::-1])
    assert (third["t"], third["language"]) == ([4], "do it")
    assert np.array_equal(third["video.front"], numbered_image(4))


def test_a_server_states_the_convention_of_its_policy() -> None:
    libero = batch(0)
    libero[f"{OBS_IMAGES}.image2"] = libero.pop(f"{OBS_IMAGES}.wrist_image")
    for stated, runs, refused in (("libero", libero, batch(0)), ("upright", batch(0), libero)):
        asks_for = f"expects images of convention={stated}, and found .*; give convention={stated}"
        frames: list[Any] = [("hello", {**hello()[0][1], "observation_params": {"trained_convention": stated}})]
        openpi, scripted = PolicyServer(metadata={"trained_convention": stated}), ScriptedServer(hello=frames)
        with openpi, scripted:
            for settings in ({"port": openpi.port}, {"port": scripted.port, "dialect": "vla_eval"}):
                RemotePolicy(RemoteConfig(**settings)).select_action(runs)  # type: ignore[arg-type]
                with pytest.raises(MemobenchError, match=asks_for):
                    RemotePolicy(RemoteConfig(**settings)).select_action(refused)  # type: ignore[arg-type]
    with PolicyServer(metadata={"trained_convention": ["of", "another", "kind"]}) as server:
        make(server).select_action(batch(0))


def test_each_environment_has_its_own_connection_and_episode() -> None:
    """Row 2 ends and repeats step 1; row 1 begins another episode with the last batch."""
    with PolicyServer(counting) as server:
        policy = make(server, n_action_steps=2, image_size=0)
        for steps in ((0, 0, 0), (1, 1, 1), (2, 2, 1), (3, 3, 1), (4, 0, 1)):
            actions = policy.select_action(batch(*steps))
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


@pytest.mark.parametrize(
    ("settings", "sent"), [({"history_every": 3}, [0, 3, 6, 8]), ({}, [0, 4, 8]), ({"send_prompt": False}, [8])]
)
def test_openpi_servers_see_frames_of_the_prompt(settings: dict[str, Any], sent: list[int]) -> None:
    with PolicyServer(counting) as server:
        policy = make(server, n_action_steps=4, image_size=0, **settings)
        shown = [policy.select_action(batch(step, phase=0)) for step in range(8)]
        acted = policy.select_action(batch(8))
    assert not torch.cat(shown).any()
    assert float(acted[0, 1]) == pytest.approx(0.08)
    assert steps_of(server.questions) == sent


def test_robomme_servers_receive_every_frame() -> None:
    with PolicyServer(counting) as server:
        policy = make(server, dialect="robomme", n_action_steps=4)
        for _ in range(2):
            policy.reset()
            for step in range(14):
                policy.select_action(batch(step, phase=int(step >= 5)))
    half = server.questions[: len(server.heard) // 2]
    assert [next(iter(question)) for question in half] == ["reset", *["images", "observation/image"] * 3]
    assert [frames_of(question) for question in half[1::2]] == [[*range(6)], [*range(6, 10)], [*range(10, 14)]]
    # As in RoboMME's client: the index of the first execution frame.
    assert [question["exec_start_idx"] for question in half[1::2]] == [5, 5, 5]
    assert [list(question) for question in server.questions[len(half) :]] == [list(question) for question in half]


def test_robomme_servers_serve_one_environment_each() -> None:
    with PolicyServer(robomme) as one, PolicyServer(robomme) as other:
        policy = make(one, dialect="robomme")
        with pytest.raises(MemobenchError, match="batch_size=1"):
            policy.select_action(batch(0, 0))
        policy = make(one, dialect="robomme", servers=f"127.0.0.1:{one.port},127.0.0.1:{other.port}")
        policy.select_action(batch(0, 0))
    assert len(one.heard) == len(other.heard) == 3


# --- vla-eval ---


def test_vla_eval_episode_with_a_prompt() -> None:
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
    (_, first), (_, second), (_, third) = [(step, observed) for _, step, observed in server.heard]
    assert list(first["images"]) == ["agentview", "wrist"]  # servers use their order
    assert np.array_equal(first["images"]["agentview"], numbered_image(0))
    assert np.array_equal(first["images"]["wrist"], numbered_image(0)[:, ::-1])
    assert (first["states"].dtype, first["states"].tolist()) == (np.float32, list(range(1, 9)))
    assert (first["task_description"], first["episode_restart"]) == ("do it", True)
    assert all(np.array_equal(found, numbered_image(step)) for step, found in enumerate(first["video_history"]))
    assert [len(first[name]) for name in ("video_history", "wrist_video_history", "state_history")] == [3, 3, 3]
    # The server plans two actions at a time and needs no observation for the second.
    assert [step for _, step, _ in server.heard] == [0, 2, 0]
    assert all(set(later) == {"images", "states", "task_description", "step"} for later in (second, third))


# --- settings ---


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"dialect": "openpy"}, "'openpi'"),
        ({"gripper": "closed"}, "policy.gripper"),
        ({"host": "10.0.0.5/policy"}, "host=.* port="),
        ({"port": 70_000}, "host=.* port="),
        ({"servers": "gpu1:8000,gpu2"}, "'gpu2'"),
        ({"host": "http://gpu1"}, "ws:// or wss://"),
        ({"keys": "image"}, "policy.keys"),
        ({"n_action_steps": 0}, "policy.n_action_steps"),
        ({"timeout": 0.0}, "policy.timeout"),
        ({"image_size": -1}, "policy.image_size"),
    ],
)
def test_wrong_settings_are_named(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(MemobenchError, match=named):
        RemoteConfig(**settings)


# --- answers ---


def test_rlds_grippers_are_converted() -> None:
    """In RLDS 0 closes and 1 opens; in this environment 1 closes and -1 opens."""
    chunk = np.zeros((5, 7))
    chunk[:, 6] = [0.0, 0.2, 0.49, 0.51, 1.0]
    with PolicyServer(lambda question: {"actions": chunk}) as server:
        policy = make(server, gripper="rlds")
        actions = torch.cat([policy.select_action(batch(step)) for step in range(5)])
    assert actions[:, 6].tolist() == [1, 1, 1, -1, -1]


def test_infinite_actions_reach_the_environment() -> None:
    """The environment ends its own episode with them; an error here would end all episodes."""
    with PolicyServer(lambda question: {"actions": np.full((10, 7), np.nan)}) as server:
        assert make(server, gripper="rlds").select_action(batch(0)).isnan().all()


ARRAY = {b"__ndarray__": True, b"data": b"11", b"dtype": "|i1", b"shape": [2]}
WRONG: list[tuple[Any, str]] = [
    ("Traceback (most recent call last):\n  File …\nKeyError: 'observation/joints'\n", "KeyError: 'observation/joi"),
    ({"actions": np.zeros((10, 8))}, r"\(10, 8\).* \(steps, 7\)"),
    ({"actions": ["a"]}, "no numbers"),
    ({"action": 1}, r"'actions' .*\['action'\]"),
    ({"actions": np.zeros((3, 7))}, "replan=3"),
    ([1], "answered a list"),
]
WRONG_VLA_EVAL: list[tuple[dict[str, Any], str]] = [
    ({"hello": hello(2)}, r"version 2 .*version 1.*vla-eval 0\.8"),
    ({"hello": hello(ARRAY)}, "version array"),
    ({"hello": [("action", {})]}, "answered a hello"),
    ({"hello": b"\x93\x01\x02\x03"}, "type and payload"),
    ({"hello": b"\xc1"}, "not msgpack"),
    ({"observation": action((8,))}, r"\(1, 8\)"),
    ({"observation": [("action", {})]}, "without 'actions'"),
    ({"observation": [("error", {"error": "observation_failed: KeyError: 'images'"})]}, "'images'"),
    ({"episode_start": [("error", {"error": "episode_start_failed: boom"})]}, "boom"),
    ({"observation": hello()}, "answered an observation with 'hello'"),
    ({"observation": 1.0}, r"more than 0\.3 s"),
    ({"hello": 1.0}, r"within 0\.3 s"),
]


@pytest.mark.parametrize(
    ("dialect", "answer", "named"),
    [*(("openpi", *case) for case in WRONG), *(("vla_eval", *case) for case in WRONG_VLA_EVAL)],
)
def test_wrong_answers_are_named(dialect: str, answer: Any, named: str) -> None:
    server: Any = PolicyServer(lambda question: answer) if dialect == "openpi" else ScriptedServer(**answer)
    with server, pytest.raises(MemobenchError, match=named) as caught:
        make(server.port, dialect=dialect, **IMPATIENT if dialect == "vla_eval" else {}).select_action(batch(0))
    assert "\n" not in str(caught.value)
    assert f"ws://127.0.0.1:{server.port}" in str(caught.value)


# --- servers that stop ---


def test_missing_servers_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, port = tmp_path / "run", free_port()
    assert evaluate(port, out, "episodes=1", "policy.connect_timeout=0.2") == 2
    assert f"ws://127.0.0.1:{port} within 0.2 s" in capsys.readouterr().err
    assert not out.exists()


# --- malformed answers ---


class Raw(PolicyServer):
    """Answer the first question with bytes that no packer writes."""

    def __init__(self, answer: bytes) -> None:
        super().__init__(lambda _: self.connections[-1].send(answer))


def actions(found: Any) -> bytes:
    return msgpack.packb({"actions": found})


def array(shape: Any, data: bytes = bytes(28)) -> bytes:
    return actions({b"__ndarray__": True, b"data": data, b"dtype": "<f4", b"shape": shape})


HALF = wire.LARGEST_ANSWER // 2
MALFORMED: dict[str, bytes] = {
    "deep": b"\x81\xa7actions" + b"\x91" * 100_000,
    "huge shape": array([10**9, 7]),
    "no rows": array([0, 7], b""),
    "objects": actions([[{}] * 7]),
    "too many actions": actions([[0.0] * 7] * (MOST_ACTIONS + 1)),
    "too large": bytes(wire.LARGEST_ANSWER + 1),
    "empty": b"",
    "lists that reserve memory": b"\x81\xa7actions" + (b"\xdd" + HALF.to_bytes(4)) * 500 + bytes(HALF),
    "text that reserves memory": actions({b"__npgeneric__": True, b"data": "x", b"dtype": "<U900000000"}),
}


@pytest.mark.parametrize("kind", MALFORMED)
def test_malformed_answers_are_refused_without_much_memory(kind: str) -> None:
    with Raw(MALFORMED[kind]) as server:
        policy = make(server, n_action_steps=1)
        tracemalloc.start()
        try:
            with pytest.raises(MemobenchError, match=f"127.0.0.1:{server.port}") as caught:
                policy.select_action(batch(0))
            assert tracemalloc.get_traced_memory()[1] < 16 * wire.LARGEST_ANSWER
        finally:
            tracemalloc.stop()
    assert len(str(caught.value)) < 500
    assert str(caught.value).isprintable()


# --- the format ---

#: Packed by openpi-client 0.1.2.
OPENPI_FRAME = (
    "84b16f62736572766174696f6e2f737461746584c40b5f5f6e6461727261795f5fc3c40464617461c40c000000000000803f00000040c4"
    "056474797065a33c6634c40573686170659103b16f62736572766174696f6e2f696d61676584c40b5f5f6e6461727261795f5fc3c40464"
    "617461c40c000102030405060708090a0bc4056474797065a37c7531c405736861706593020203a16e83c40d5f5f6e7067656e65726963"
    "5f5fc3c40464617461cb3ff8000000000000c4056474797065a33c6634a670726f6d7074a673617920c3a4"
)


def test_frames_equal_those_of_openpis_client() -> None:
    message = {
        "observation/state": np.arange(3, dtype=np.float32),
        "observation/image": np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
        "n": np.float32(1.5),
        "prompt": "say ä",
    }
    assert wire.pack(message).hex() == OPENPI_FRAME
    back = wire.unpack_message(bytes.fromhex(OPENPI_FRAME))
    assert (back["n"], back["n"].dtype) == (1.5, np.float32)
    assert back["observation/image"].dtype == np.uint8
    assert np.array_equal(back["observation/image"], message["observation/image"])


def test_objects_are_neither_packed_nor_unpacked() -> None:
    with pytest.raises(ValueError, match="object"):
        wire.pack({"x": np.array([object()])})
    foreign = wire.pack({"x": np.zeros(1)}).replace(b"<f8", b"|O8")
    with pytest.raises(ValueError, match="object"):
        wire.unpack_message(foreign)


@pytest.mark.parametrize(
    ("height", "width", "digest"),
    [(256, 256, "6bc21716ac445bdb"), (120, 200, "a2d0d2674df3d7d5"), (200, 90, "65a85f1d1a04eee5")],
)
def test_images_are_resized_as_by_openpis_client(height: int, width: int, digest: str) -> None:
    y, x = np.mgrid[:height, :width]
    image = np.stack([x * 255 // width, y * 255 // height, (x * y) % 256], -1).astype(np.uint8)
    assert hashlib.sha256(fit(image, 224).tobytes()).hexdigest()[:16] == digest


# --- the command ---


def evaluate(port: int, out: Path, *words: str) -> int:
    policy = ("policy=memobench_remote", "host=127.0.0.1", f"port={port}", "replan=10")
    usual = (f"tasks={TASK}", "horizon=20", "eval.use_async_envs=false", f"output_dir={out}")
    return main(["eval", "env=memobench", *policy, *usual, *words])


def test_evaluations_resume_after_their_server_stopped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two episodes of two questions each; the server stops at the second question of the second episode."""
    out = tmp_path / "run"
    with PolicyServer(die_at=3) as server:
        assert evaluate(server.port, out, "episodes=2", "batch_size=1") == 2
    assert "resume=true" in capsys.readouterr().err
    before = read_episodes(out)
    assert [(record["episode"], record["steps"], record["replan_steps"]) for record in before] == [(0, 20, 10)]
    with PolicyServer() as server:
        assert evaluate(server.port, out, "episodes=2", "batch_size=1", "resume=true") == 0
    assert len(server.heard) == 2
    after = read_episodes(out)
    assert [record["episode"] for record in after] == [0, 1]
    assert after[0] == before[0]
    assert json.loads((out / "report.json").read_text())["tasks"][TASK]["n"] == 2


def test_server_of_the_guide_answers_and_is_waited_for() -> None:
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
