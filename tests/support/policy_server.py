"""openpi's policy server for tests, written after the deployed servers.

It packs frames itself, so that an error in the client's packing does not cancel out.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

Answer = Callable[[dict[str, Any]], Any]


def to_wire(value: Any) -> Any:
    return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}


def from_wire(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in found:
        return found
    return np.ndarray(buffer=found[b"data"], dtype=np.dtype(found[b"dtype"]), shape=found[b"shape"])


def zeros(question: dict[str, Any], steps: int = 10) -> dict[str, Any]:
    return {"actions": np.zeros((steps, 7))}


def robomme(question: dict[str, Any]) -> dict[str, Any]:
    """Answer as RoboMME's server does: two orders besides questions."""
    if question.get("reset"):
        return {"reset_finished": True, "reset_time_ms": 0.1}
    if question.get("add_buffer"):
        return {"add_buffer_finished": True, "add_buffer_time_ms": 0.1}
    return zeros(question, 16)


class PolicyServer:
    """openpi's server: metadata first, then frames; a failure is a traceback as text, then the connection closes.

    Args:
        answer: question -> answer; a `str` is sent as text, as a traceback would be. die_at: the question (from 0) over
            which the server dies. port: 0 for a free one. metadata: of the server.

    Attributes:
        heard: (number of the connection, question), in the order of arrival.
    """

    def __init__(
        self,
        answer: Answer = zeros,
        *,
        die_at: int | None = None,
        port: int = 0,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        self.answer, self.die_at, self.metadata = answer, die_at, metadata or {"served": "zeros"}
        self.heard: list[tuple[int, dict[str, Any]]] = []
        self.connections: list[ServerConnection] = []
        self._server = serve(self._talk, "127.0.0.1", port, compression=None, max_size=None)
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _talk(self, connection: ServerConnection) -> None:
        number = len(self.connections)
        self.connections.append(connection)
        try:
            connection.send(msgpack.packb(self.metadata))
            while True:
                question = msgpack.unpackb(connection.recv(), object_hook=from_wire)
                if self.die_at is not None and len(self.heard) >= self.die_at:
                    self.die()
                    return
                self.heard.append((number, question))
                answer = self.answer(question)
                if isinstance(answer, str):
                    connection.send(answer)
                    connection.close(1011, "Internal server error. Traceback included in previous frame.")
                    return
                connection.send(msgpack.packb(answer, default=to_wire))
        except (ConnectionClosed, OSError):
            pass

    @property
    def questions(self) -> list[dict[str, Any]]:
        return [question for _, question in self.heard]

    def die(self) -> None:
        """Stop listening and cut every connection, without a farewell."""
        # Its own shutdown waits for every conversation, and this may be called from one.
        threading.Thread(target=self._server.shutdown, daemon=True).start()
        self._thread.join()
        for connection in self.connections:
            with contextlib.suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> PolicyServer:
        return self

    def __exit__(self, *error: object) -> None:
        self.die()
