"""openpi's websocket protocol. Its package openpi-client needs NumPy 1 and LeRobot NumPy 2, so it cannot be used here.

A server first sends its metadata. Then it answers each binary frame with a binary frame, or with a traceback as a text
frame. Messages are msgpack, which cannot carry code.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import LONGEST_REASON, Malformed, cut, refusing

REFUSED = "VOc"
"""Kinds of arrays that openpi's format excludes: structures, Python objects and complex numbers."""
LARGEST_ANSWER = 8 << 20
"""Largest size of an answer, bytes."""
LONGEST_LIST = 1 << 16
"""Largest number of entries of a list or map: the unpacker allocates memory for the number in its header."""


class ServerAway(Exception):
    """The server cannot be reached, or disconnected."""


def last_line(text: str) -> str:
    """Return the last line of a traceback, printable and short."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return reason(lines[-1]) if lines else "without a reason"


def reason(error: BaseException | str) -> str:
    """Return the message of an error in one short line of printable characters."""
    words = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())
    return cut(words, LONGEST_REASON) or type(error).__name__


class Websocket:
    """A connection by openpi's protocol; subclasses implement other protocols.

    Args:
        address: ``ws://host:port``. timeout: longest time of an answer, s.
    """

    protocol = "openpi's websocket protocol"

    def __init__(self, address: str, timeout: float) -> None:
        self.address, self.timeout = address, timeout
        self._stack = ExitStack()
        self._connection: ClientConnection | None = None

    def open(self, patience: float) -> dict[str, Any]:
        """Connect within ``patience`` seconds; return the server's metadata.

        Raises:
            ServerAway: no server answers.
            MemobenchError: the server has another protocol.
        """
        self.close()
        patience = max(patience, 1.0)
        try:
            # No pings: openpi's servers do not answer them during inference, and the first one can take minutes.
            connection = connect(
                self.address,
                compression=None,
                max_size=LARGEST_ANSWER,
                open_timeout=patience,
                ping_interval=None,
                close_timeout=1.0,
                proxy=None,
            )
            self._connection = self._stack.enter_context(connection)
            return self.greet(patience)
        except InvalidStatus as error:
            code = error.response.status_code
            if code >= 500:
                raise ServerAway(f"HTTP state {code}") from error
            raise self.foreign(f"it answered with HTTP state {code}") from error
        except InvalidMessage as error:
            raise ServerAway(reason(error)) from error
        except InvalidHandshake as error:
            raise self.foreign(reason(error)) from error
        except (OSError, TimeoutError, WebSocketException) as error:
            raise ServerAway(reason(error)) from error

    def greet(self, patience: float) -> dict[str, Any]:
        """Return the server's metadata, within ``patience`` seconds."""
        metadata = self.receive(patience)
        return metadata if isinstance(metadata, dict) else {}

    def foreign(self, problem: str) -> MemobenchError:
        """Return the error of a server with another protocol."""
        return MemobenchError(
            f"the server at {self.address} is no policy server with {self.protocol} ({problem}); check "
            "host= and port=, or choose another dialect="
        )

    def send(self, frame: bytes) -> None:
        """Send a frame."""
        if self._connection is None:
            raise ServerAway("not connected")
        self._connection.send(frame)

    def receive(self, patience: float) -> Any:
        """Return the next frame's message, within ``patience`` seconds."""
        assert self._connection is not None
        try:
            frame = self._connection.recv(timeout=patience)
        except ConnectionClosed as error:
            if error.sent is not None and not error.rcvd_then_sent:  # this side closed the connection
                raise self.foreign(reason(error)) from error
            raise
        if isinstance(frame, str):
            raise MemobenchError(f"the policy server at {self.address} failed: {last_line(frame)}")
        try:
            return unpack(frame)
        except ValueError as error:
            raise self.foreign(str(error)) from error

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Send a message and return the answer.

        Raises:
            ServerAway: the connection broke.
            MemobenchError: the server failed, took too long, or has another protocol.
        """
        try:
            answer = self.exchange(question)
        except TimeoutError as error:
            raise MemobenchError(
                f"the policy server at {self.address} took more than {self.timeout:g} s for an answer; set a longer "
                "policy.timeout="
            ) from error
        except (ConnectionClosed, OSError) as error:
            raise ServerAway(reason(error)) from error
        if not isinstance(answer, dict):
            raise self.foreign(f"it answered a {type(answer).__name__} instead of a map")
        return answer

    def exchange(self, question: dict[str, Any]) -> Any:
        """Send a question and return the answer."""
        self.send(pack(question))
        return self.receive(self.timeout)

    def close(self) -> None:
        """Disconnect."""
        self._connection = None
        self._stack.close()


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in REFUSED:
        raise ValueError(f"arrays of type {value.dtype} cannot be sent")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def _unpack(found: dict[Any, Any]) -> Any:
    if "__ndarray__" in found:
        return _array(found["data"], found["dtype"], found["shape"])
    if b"__ndarray__" in found:
        return _array(found[b"data"], found[b"dtype"], found[b"shape"])
    if b"__npgeneric__" in found:
        return _dtype(found[b"dtype"]).type(found[b"data"])  # of the data's length, whatever length dtype names
    return found


def _dtype(text: Any) -> np.dtype[Any]:
    dtype = np.dtype(text)
    if dtype.kind in REFUSED:
        raise ValueError(f"arrays of type {dtype} are not accepted")
    return dtype


def _array(data: bytes, dtype: Any, shape: Any) -> np.ndarray:
    return np.frombuffer(data, _dtype(dtype)).reshape(tuple(shape))


def pack(message: dict[str, Any]) -> bytes:
    """Pack a message as openpi-client does: arrays are maps of their bytes, type and shape."""
    packed: bytes = msgpack.packb(message, default=_pack)
    return packed


def unpack(data: bytes) -> Any:
    """Return the message in a frame.

    Raises:
        ValueError: the frame is not a message.
    """
    with refusing(lambda why: Malformed(f"it is not msgpack with arrays ({why})")):
        return msgpack.unpackb(data, object_hook=_unpack, max_array_len=LONGEST_LIST, max_map_len=LONGEST_LIST)
