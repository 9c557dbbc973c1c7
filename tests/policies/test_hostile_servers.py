"""Policy servers that answer badly: each ends in one sentence, in time, without more memory than was sent."""

from __future__ import annotations

import re
import socket
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import msgpack
import pytest
from websockets.frames import Frame, Opcode
from websockets.utils import accept_key

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote import transports as wire
from lerobot_memobench.policies.remote.session import MOST_ACTIONS
from tests.support.remote_case import batch, make

TIMEOUT = 0.5
Raw = Callable[[socket.socket], None]
"""Write an answer to a connection whose question has been read."""


@contextmanager
def listening(answer: Raw, reads: bool = True) -> Iterator[int]:
    """Speak openpi's protocol up to the answer; return the port.

    Args:
        answer: writes what a library would not. reads: whether the question is read.
    """

    def question_of(connection: socket.socket) -> None:
        if not reads:
            time.sleep(3 * TIMEOUT)
            raise ConnectionError
        connection.settimeout(0.05)
        with suppress(TimeoutError):
            while connection.recv(1 << 16):
                pass
        connection.settimeout(None)

    def talk(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            key = re.search("Sec-WebSocket-Key: (.*?)\r\n", connection.recv(1 << 12).decode("latin-1"))
            assert key is not None
            greeting = f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept_key(key[1])}"
            connection.sendall(f"HTTP/1.1 101 X\r\n{greeting}\r\n\r\n".encode() + frame(msgpack.packb({})))
            question_of(connection)
            answer(connection)

    def listen() -> None:
        with suppress(OSError):
            while True:
                threading.Thread(target=talk, args=(listener.accept()[0],), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=listen, daemon=True).start()
        yield int(listener.getsockname()[1])
        listener.shutdown(socket.SHUT_RDWR)


def frame(content: bytes, opcode: Opcode = Opcode.BINARY, fin: bool = True) -> bytes:
    return Frame(opcode, content, fin).serialize(mask=False)


def whole(answer: bytes) -> Raw:
    return lambda connection: connection.sendall(answer)


def drip(connection: socket.socket) -> None:
    """Send a sound answer byte by byte."""
    for byte in actions([[0.0] * 7] * 40):
        connection.sendall(bytes([byte]))
        time.sleep(TIMEOUT / 10)


def fragments(connection: socket.socket) -> None:
    connection.sendall(frame(b"\x81", fin=False))
    while True:
        connection.sendall(frame(b"\xc0", Opcode.CONT, fin=False))
        time.sleep(TIMEOUT / 10)


def actions(found: Any) -> bytes:
    return frame(msgpack.packb({"actions": found}))


def array(shape: Any, data: bytes = bytes(28)) -> bytes:
    """Return an answer whose array has such a header."""
    return actions({b"__ndarray__": True, b"data": data, b"dtype": "<f4", b"shape": shape})


def scalar(data: Any, dtype: str) -> bytes:
    return actions({b"__npgeneric__": True, b"data": data, b"dtype": dtype})


def refused(answer: Raw, *, reads: bool = True, **settings: Any) -> str:
    """Return the sentence in which an answer ends; it may take neither longer nor more memory than it should."""
    with listening(answer, reads) as port:
        policy = make(port, n_action_steps=1, retry=0.5, timeout=TIMEOUT, **settings)
        question, start = batch(0), time.monotonic()
        tracemalloc.start()
        try:
            with pytest.raises(MemobenchError) as caught:
                policy.select_action(question)
            assert time.monotonic() - start < 6 * TIMEOUT
            assert tracemalloc.get_traced_memory()[1] < 16 * wire.LARGEST_ANSWER
        finally:
            tracemalloc.stop()
    text = str(caught.value)
    assert len(text) < 500
    assert text.isprintable()
    assert f"127.0.0.1:{port}" in text
    return text


HALF = wire.LARGEST_ANSWER // 2
BAD: dict[str, bytes] = {
    "deep": frame(b"\x81\xa7actions" + b"\x91" * 100_000),
    "a huge shape": array([10**9, 7]),
    "a shape beyond any": array([2**64 - 1, 7]),
    "no rows": array([0, 7], b""),
    "no number": actions([["x"] * 7]),
    "objects": actions([[{}] * 7]),
    "no action": actions([]),
    "too many actions": actions([[0.0] * 7] * (MOST_ACTIONS + 1)),
    "too large": frame(bytes(wire.LARGEST_ANSWER + 1)),
    "another format": frame(b"\xc1"),
    "nothing": frame(b""),
    "a long error": frame(b"Traceback\n\x1b[2Jboom" + b"!" * 100_000, Opcode.TEXT),
    "lists that reserve memory": frame(b"\x81\xa7actions" + (b"\xdd" + HALF.to_bytes(4)) * 500 + bytes(HALF)),
    "a text that reserves memory": scalar("x", "<U900000000"),
    "bytes that reserve memory": scalar(b"x", "|S900000000"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_answer_ends_in_a_sentence(kind: str) -> None:
    assert "went away" not in refused(whole(BAD[kind]))  # the question is not repeated: the answer would be the same


@pytest.mark.parametrize(
    ("answer", "settings"),
    [(drip, {}), (fragments, {}), (whole(b""), {"reads": False, "image_size": 1800})],
    ids=["drips", "fragments", "does not read"],
)
def test_a_slow_server_is_bounded_as_a_whole(answer: Raw, settings: dict[str, Any]) -> None:
    assert f"more than {TIMEOUT:g} s" in refused(answer, **settings)


def test_as_many_actions_as_an_answer_may_have_are_taken() -> None:
    with listening(whole(actions([[0.0] * 7] * MOST_ACTIONS))) as port:
        assert make(port).select_action(batch(0)).shape == (1, 7)
