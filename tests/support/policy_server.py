"""openpi's policy server, written after the deployed servers, a policy that runs in it, and its observations.

The server packs frames itself, so that an error in the client's packing does not cancel out.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import torch
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from lerobot_memobench.policies.remote import RemoteConfig, RemotePolicy

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
            which the server dies.

    Attributes:
        heard: (number of the connection, question), in the order of arrival.
    """

    def __init__(
        self, answer: Answer = zeros, *, die_at: int | None = None, metadata: dict[str, Any] | None = None
    ) -> None:
        self.answer, self.die_at, self.metadata = answer, die_at, metadata or {"served": "zeros"}
        self.heard: list[tuple[int, dict[str, Any]]] = []
        self.connections: list[ServerConnection] = []
        self._server = serve(self._talk, "127.0.0.1", 0, compression=None, max_size=None)
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


TASK = "turn_on_the_stove_and_turn_it_off"
SIDE = 32
PATIENT = {"connect_timeout": 5.0, "timeout": 5.0}
IMPATIENT = {"connect_timeout": 0.3, "timeout": 0.3}


def numbered_image(step: int, row: int = 0) -> np.ndarray:
    """(SIDE, SIDE, 3) uint8 with step and row in their first pixel."""
    array = np.full((SIDE, SIDE, 3), 90, np.uint8)
    array[0, 0] = step, row, 255
    return array


def batch(*steps: int | None, phase: int = 1, task: str = "do it") -> dict[str, Any]:
    """What LeRobot hands a policy for environments at these steps; None is one that is not simulated."""
    images = np.stack([numbered_image(step or 0, row) for row, step in enumerate(steps)])
    images[[step is None for step in steps]] = 0
    tensor = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
    state = torch.arange(8.0).repeat(len(steps), 1) + 1
    state[[step is None for step in steps]] = 0
    return {
        "observation.images.image": tensor,
        "observation.images.wrist_image": tensor.flip(-1),
        "observation.state": state,
        "observation.step": torch.tensor([float(step or 0) for step in steps]),
        "observation.phase": torch.full((len(steps),), float(phase)),
        "task": [task] * len(steps),
    }


def make(server: PolicyServer | int, **settings: Any) -> RemotePolicy:
    port = server if isinstance(server, int) else server.port
    policy = RemotePolicy(RemoteConfig(port=port, **{**PATIENT, **settings}))
    policy.reset()
    return policy


def counting(question: dict[str, Any]) -> dict[str, Any]:
    """Ten actions whose first number is their place and whose second the step that was asked about, over 100."""
    if "observation/image" not in question:
        return robomme(question)
    actions = np.zeros((10, 7), np.float32)
    actions[:, 0] = np.arange(10) / 10
    actions[:, 1:3] = question["observation/image"][0, 0, :2] / 100
    return {"actions": actions}


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def frames_of(question: dict[str, Any]) -> list[int]:
    """Steps of the frames in a message to a buffer."""
    assert question["images"].shape[1:] == (1, SIDE, SIDE, 3)
    assert question["state"].shape == (len(question["images"]), 8)
    assert question["state"].dtype == np.float32
    return [int(step) for step in question["images"][:, 0, 0, 0, 0]]
