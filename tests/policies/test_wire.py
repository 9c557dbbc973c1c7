"""What goes over the wire is what openpi's client and json-numpy send."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from lerobot_memobench.policies.remote import transports as wire
from lerobot_memobench.policies.remote.session import fit
from tests.support.policy_server import PolicyServer
from tests.support.remote_case import batch, counting, make

#: Packed by openpi-client 0.1.2 and json-numpy 2.1.1.
OPENPI_FRAME = (
    "84b16f62736572766174696f6e2f737461746584c40b5f5f6e6461727261795f5fc3c40464617461c40c000000000000803f00000040c4"
    "056474797065a33c6634c40573686170659103b16f62736572766174696f6e2f696d61676584c40b5f5f6e6461727261795f5fc3c40464"
    "617461c40c000102030405060708090a0bc4056474797065a37c7531c405736861706593020203a16e83c40d5f5f6e7067656e65726963"
    "5f5fc3c40464617461cb3ff8000000000000c4056474797065a33c6634a670726f6d7074a673617920c3a4"
)
JSON_NUMPY = (
    '{"state": {"__numpy__": "AAAAAAAAgD8AAABA", "dtype": "<f4", "shape": [3]}, '
    '"b": {"__numpy__": "AQE=", "dtype": "|u1", "shape": [1, 2]}, "instruction": "go"}'
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


def test_json_is_that_of_json_numpy() -> None:
    message = {"state": np.arange(3, dtype=np.float32), "b": np.ones((1, 2), np.uint8), "instruction": "go"}
    assert wire.to_json(message) == JSON_NUMPY
    back = wire.from_json(JSON_NUMPY)
    assert np.array_equal(back["state"], message["state"])
    assert back["b"].shape == (1, 2)


def test_nothing_that_could_carry_code_is_packed_or_taken() -> None:
    with pytest.raises(ValueError, match="cannot be sent"):
        wire.pack({"x": np.array([object()])})
    foreign = wire.pack({"x": np.zeros(1)}).replace(b"<f8", b"|O8")
    with pytest.raises(ValueError, match="not taken"):
        wire.unpack(foreign)
    with pytest.raises(ValueError, match="not msgpack"):
        wire.unpack(b"\xc1")


def test_openpis_own_client_and_ours_say_the_same() -> None:
    theirs = pytest.importorskip("openpi_client.websocket_client_policy")
    with PolicyServer(counting) as server:
        policy = make(server, image_size=0)
        policy.select_action(batch(3))
        question = server.questions[-1]
        answer = theirs.WebsocketClientPolicy("127.0.0.1", server.port).infer(question)
    assert server.questions[-1].keys() == question.keys()
    assert all(np.array_equal(server.questions[-1][key], value) for key, value in question.items())
    assert answer["actions"].shape == (10, 7)


@pytest.mark.parametrize(
    ("height", "width", "digest"),
    [(256, 256, "6bc21716ac445bdb"), (120, 200, "a2d0d2674df3d7d5"), (200, 90, "65a85f1d1a04eee5")],
)
def test_images_are_resized_as_openpis_client_does(height: int, width: int, digest: str) -> None:
    y, x = np.mgrid[:height, :width]
    image = np.stack([x * 255 // width, y * 255 // height, (x * y) % 256], -1).astype(np.uint8)
    assert hashlib.sha256(fit(image, 224).tobytes()).hexdigest()[:16] == digest
    assert np.array_equal(fit(image, None, mirror=True), image[:, ::-1])
