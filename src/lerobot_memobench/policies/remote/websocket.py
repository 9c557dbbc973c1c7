"""openpi's websocket, written anew: the package openpi-client asks for NumPy 1, LeRobot for NumPy 2.

A server first sends its metadata; then each binary frame is a question and gets a binary frame, or a text frame with a
traceback where the server failed.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote import wire
from lerobot_memobench.policies.remote.transport import ServerAway, last_line, reason, too_slow


class Websocket:
    """openpi's protocol.

    Args:
        address: ``ws://host:port``. timeout: how long an answer may take, s.
    """

    def __init__(self, address: str, timeout: float) -> None:
        self.address, self.timeout = address, timeout
        self._stack = ExitStack()
        self._connection: ClientConnection | None = None

    def open(self, patience: float) -> dict[str, Any]:
        """Connect, and return the metadata that the server sends first."""
        self.close()
        try:
            return self._connect(max(patience, 1.0))
        except InvalidStatus as error:
            code = error.response.status_code
            if code >= 500:
                raise ServerAway(f"HTTP state {code}") from error
            raise self._foreign(f"it answered with HTTP state {code}") from error
        except InvalidMessage as error:
            raise ServerAway(str(error)) from error
        except InvalidHandshake as error:
            raise self._foreign(str(error)) from error
        except (OSError, TimeoutError, WebSocketException) as error:
            raise ServerAway(reason(error)) from error

    def _connect(self, patience: float) -> dict[str, Any]:
        # No pings: openpi's servers answer none while they think, and the first thought can take minutes.
        connection = connect(
            self.address,
            compression=None,
            max_size=None,
            open_timeout=patience,
            ping_interval=None,
            close_timeout=1.0,
            proxy=None,
        )
        self._connection = self._stack.enter_context(connection)
        metadata = self._receive(patience)
        return metadata if isinstance(metadata, dict) else {}

    def _foreign(self, what: str) -> MemobenchError:
        return MemobenchError(
            f"what listens at {self.address} is no policy server with openpi's websocket protocol ({what}); check "
            "host= and port=, or choose another dialect="
        )

    def _receive(self, patience: float) -> Any:
        assert self._connection is not None
        frame = self._connection.recv(timeout=patience)
        if isinstance(frame, str):
            raise MemobenchError(f"the policy server at {self.address} failed: {last_line(frame)}")
        try:
            return wire.unpack(frame)
        except ValueError as error:
            raise self._foreign(str(error)) from error

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Send a frame and return the one that comes back."""
        if self._connection is None:
            raise ServerAway("not connected")
        try:
            self._connection.send(wire.pack(question))
            answer = self._receive(self.timeout)
        except TimeoutError as error:
            raise too_slow(self.address, self.timeout) from error
        except (ConnectionClosed, OSError) as error:
            raise ServerAway(reason(error)) from error
        if not isinstance(answer, dict):
            raise self._foreign(f"it answered a {type(answer).__name__}, no map")
        return answer

    def close(self) -> None:
        """Hang up."""
        self._connection = None
        self._stack.close()
