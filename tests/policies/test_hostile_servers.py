"""Policy servers that answer badly: each ends in one sentence, in time, without more memory than was sent."""

from __future__ import annotations

import base64
import json
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

WEBSOCKET, REST = "openpi", "openvla_oft"
TIMEOUT = 0.5
Raw = Callable[[socket.socket], None]
"""Write an answer to a connection whose question has been read."""


@contextmanager
def listening(answer: Raw, reads: bool = True) -> Iterator[int]:
    """Speak openpi's protocol or HTTP, whichever is asked for, up to the answer; return the port.

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
            head = connection.recv(1 << 12).decode("latin-1")
            if (key := re.search("Sec-WebSocket-Key: (.*?)\r\n", head)) is not None:
                greeting = f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept_key(key[1])}"
                connection.sendall(f"HTTP/1.1 101 X\r\n{greeting}\r\n\r\n".encode() + frame(msgpack.packb({})))
            elif head.startswith("GET"):
                connection.sendall(page(b""))
                return
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


def page(content: bytes, header: str = "", state: str = "200 OK") -> bytes:
    return f"HTTP/1.1 {state}\r\n{header}Content-Length: {len(content)}\r\n\r\n".encode() + content


def whole(answer: bytes) -> Raw:
    return lambda connection: connection.sendall(answer)


def drip(answer: bytes, start: int = 0) -> Raw:
    def send(connection: socket.socket) -> None:
        connection.sendall(answer[:start])
        for byte in answer[start:]:
            connection.sendall(bytes([byte]))
            time.sleep(TIMEOUT / 10)

    return send


def fragments(connection: socket.socket) -> None:
    connection.sendall(frame(b"\x81", fin=False))
    while True:
        connection.sendall(frame(b"\xc0", Opcode.CONT, fin=False))
        time.sleep(TIMEOUT / 10)


def actions(found: Any) -> dict[str, bytes]:
    """Return the same answer for both transports."""
    return {
        WEBSOCKET: frame(msgpack.packb({"actions": found})),
        REST: page(json.dumps(found).encode()),
    }


def array(shape: Any, data: bytes = bytes(28)) -> dict[str, bytes]:
    """Return an array with such a header for both transports."""
    packed = {b"__ndarray__": True, b"data": data, b"dtype": "<f4", b"shape": shape}
    text = {"__numpy__": base64.b64encode(data).decode(), "dtype": "<f4", "shape": shape}
    return {WEBSOCKET: frame(msgpack.packb({"actions": packed})), REST: page(json.dumps(text).encode())}


def refused(dialect: str, answer: Raw, *, reads: bool = True, **settings: Any) -> str:
    """Return the sentence in which an answer ends; it may take neither longer nor more memory than it should."""
    with listening(answer, reads) as port:
        policy = make(port, dialect=dialect, n_action_steps=1, retry=0.5, timeout=TIMEOUT, **settings)
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


BAD: dict[str, dict[str, bytes]] = {
    "deep": {WEBSOCKET: frame(b"\x81\xa7actions" + b"\x91" * 100_000), REST: page(b"[" * 100_000)},
    "a huge shape": array([10**9, 7]),
    "a shape beyond any": array([2**64 - 1, 7]),
    "no rows": array([0, 7], b""),
    "no number": actions([["x"] * 7]),
    "a huge number": {**actions([[{}] * 7]), REST: page(json.dumps([[10**400] * 7]).encode())},
    "no action": actions([]),
    "too many actions": actions([[0.0] * 7] * (MOST_ACTIONS + 1)),
    "too large": {
        WEBSOCKET: frame(bytes(wire.LARGEST_ANSWER + 1)),
        REST: page(b" " * wire.LARGEST_ANSWER + b"[[0,0,0,0,0,0,0]]"),
    },
    "another format": {WEBSOCKET: frame(b"\xc1"), REST: page(b"\xff\xfe")},
    "nothing": {WEBSOCKET: frame(b""), REST: page(b"")},
    "a long error": {
        WEBSOCKET: frame(b"Traceback\n\x1b[2Jboom" + b"!" * 100_000, Opcode.TEXT),
        REST: page(b"Traceback\n\x1b[2Jboom" + b"!" * 100_000, state="500 X"),
    },
}


@pytest.mark.parametrize("dialect", [WEBSOCKET, REST])
@pytest.mark.parametrize("kind", BAD)
def test_a_bad_answer_ends_in_a_sentence(kind: str, dialect: str) -> None:
    said = refused(dialect, whole(BAD[kind][dialect]))
    assert "went away" not in said  # the question is not repeated: the server would answer the same


@pytest.mark.parametrize(
    ("dialect", "answer"),
    [
        (WEBSOCKET, drip(actions([[0.0] * 7] * 40)[WEBSOCKET])),
        (WEBSOCKET, fragments),
        (REST, drip(actions([[0.0] * 7] * 40)[REST])),
        (REST, drip(actions([[0.0] * 7] * 40)[REST], start=99)),
    ],
    ids=["a frame", "fragments", "a header", "a body"],
)
def test_an_answer_that_drips_is_bounded_as_a_whole(dialect: str, answer: Raw) -> None:
    assert f"more than {TIMEOUT:g} s" in refused(dialect, answer)


@pytest.mark.parametrize("dialect", [WEBSOCKET, REST])
def test_a_server_that_does_not_read_is_bounded(dialect: str) -> None:
    assert f"more than {TIMEOUT:g} s" in refused(dialect, whole(b""), reads=False, image_size=1800)


@pytest.mark.parametrize(
    "content",
    [
        b"\x81\xa7actions" + (b"\xdd" + (wire.LARGEST_ANSWER // 2).to_bytes(4)) * 500 + bytes(wire.LARGEST_ANSWER // 2),
        msgpack.packb({"actions": {b"__npgeneric__": True, b"data": "x", b"dtype": "<U900000000"}}),
        msgpack.packb({"actions": {b"__npgeneric__": True, b"data": b"x", b"dtype": "|S900000000"}}),
    ],
    ids=["lists in lists", "text", "bytes"],
)
def test_a_number_in_a_frame_reserves_no_memory(content: bytes) -> None:
    refused(WEBSOCKET, whole(frame(content)))


def test_a_compressed_answer_is_not_unpacked() -> None:
    assert "gzip" in refused(REST, whole(page(b"\x1f\x8b", "Content-Encoding: gzip\r\n")))


def test_as_many_actions_as_an_answer_may_have_are_taken() -> None:
    for dialect, answer in actions([[0.0] * 7] * MOST_ACTIONS).items():
        with listening(whole(answer)) as port:
            assert make(port, dialect=dialect).select_action(batch(0)).shape == (1, 7)
