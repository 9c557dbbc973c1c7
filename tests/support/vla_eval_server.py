"""Model servers for vla-evaluation-harness's protocol: its own classes, and one written apart that does wrong."""

from __future__ import annotations

import hashlib
import threading
import time
from typing import Any

import msgpack
import numpy as np
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.specs import ROTATION_EULER, DimSpec
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve


class DigestServer(PredictModelServer):
    """Answers chunks that are drawn by a digest of all that it was sent: other observations, other actions.

    Attributes:
        heard: (session, step of its episode, observation), in the order of arrival.
    """

    def __init__(self, steps: int = 3) -> None:
        super().__init__(chunk_size=steps)
        self.steps = steps
        self.heard: list[tuple[str, int, dict[str, Any]]] = []
        self.tasks: list[Any] = []
        self.ended = 0

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"rotation": ROTATION_EULER}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        self.tasks.append(config["task"])
        await super().on_episode_start(config, ctx)

    async def on_episode_end(self, result: dict[str, Any], ctx: SessionContext) -> None:
        self.ended += 1
        await super().on_episode_end(result, ctx)

    def predict(self, obs: dict[str, Any], ctx: SessionContext) -> dict[str, Any]:
        self.heard.append((ctx.session_id, ctx.step, obs))
        seed = int.from_bytes(hashlib.blake2b(canonical(obs), digest_size=8).digest(), "big")
        return {"actions": np.random.default_rng(seed).uniform(-1, 1, (self.steps, 7))}


def canonical(value: Any) -> bytes:
    """Return bytes that are equal for equal observations only."""
    if isinstance(value, dict):
        return b"{%s}" % b",".join(repr(key).encode() + canonical(value[key]) for key in sorted(value))
    if isinstance(value, list):
        return b"[%s]" % b",".join(map(canonical, value))
    if isinstance(value, np.ndarray):
        return repr((value.shape, value.dtype.str)).encode() + value.tobytes()
    return repr(value).encode()


Frames = list[tuple[str, dict[str, Any]]]


def hello(version: Any = 1) -> Frames:
    return [("hello", {"harness_version": "0.8.0", "protocol_version": version})]


def action(shape: tuple[int, ...] = (7,)) -> Frames:
    values = np.full(shape, 0.25, np.float32)
    array = {"__ndarray__": True, "data": values.tobytes(), "dtype": "<f4", "shape": list(shape)}
    return [("action", {"actions": array})]


class ScriptedServer:
    """Answers each kind of frame by a script, in frames that it packs itself.

    Args:
        answers: type of a frame -> frames (type, payload) that are sent in answer, or bytes, or seconds to wait.

    Attributes:
        heard: (type, payload) of every frame.
    """

    def __init__(self, **answers: Frames | bytes | float) -> None:
        self.answers: dict[str, Frames | bytes | float] = {"hello": hello(), "observation": action(), **answers}
        self.heard: list[tuple[str, dict[str, Any]]] = []
        self._server = serve(self._talk, "127.0.0.1", 0, compression=None, max_size=None)
        self.port = int(self._server.socket.getsockname()[1])
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _talk(self, connection: ServerConnection) -> None:
        try:
            for frame in connection:
                found = msgpack.unpackb(frame)
                self.heard.append((found["type"], found["payload"]))
                answer = self.answers.get(found["type"], [])
                if isinstance(answer, bytes):
                    connection.send(answer)
                elif isinstance(answer, float):
                    time.sleep(answer)
                else:
                    for kind, payload in answer:
                        answered = {"type": kind, "payload": payload, "seq": found["seq"], "timestamp": 0.0}
                        connection.send(msgpack.packb(answered))
        except (ConnectionClosed, OSError):
            pass

    def __enter__(self) -> ScriptedServer:
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
