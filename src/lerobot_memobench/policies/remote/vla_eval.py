"""The protocol of vla-evaluation-harness (vla-eval) for its model servers, without a dependency on the package.

A frame is a map of ``type``, ``payload``, ``seq`` and ``timestamp``. Both sides send ``hello``. The server does not
answer an ``episode_start``; it answers an ``observation`` with an ``action`` or an ``error``. The first observation of
an episode includes the demonstration prompt.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import short
from lerobot_memobench.policies.remote.transports import ServerAway, Websocket, last_line, reason
from lerobot_memobench.sim.convention import STATED

logger = logging.getLogger(__name__)

HELLO, EPISODE_START, OBSERVATION, ACTION, EPISODE_END, ERROR = (
    *("hello", "episode_start", "observation", "action", "episode_end", "error"),
)
"""Types of frames."""
VERSION, PROTOCOL = "0.8.0", 1
"""The supported version of vla-eval, and of its protocol."""
FORMATS = {
    "position": "delta_xyz",
    "rotation": "axis_angle",
    "gripper": "binary_close_positive",
    "state": "eef_pos3_axisangle3_gripper2",
}
"""vla-eval's names of this environment's conventions; a server's hello may list others."""
ANY_FORMAT = "raw"


class VlaEval(Websocket):
    """A connection by vla-evaluation-harness's protocol; questions are `episode_start` and `observation`."""

    protocol = "vla-evaluation-harness's protocol"

    def __init__(self, address: str, timeout: float) -> None:
        super().__init__(address, timeout)
        self._number, self._in_episode, self._warned = 0, False, False

    def greet(self, patience: float) -> dict[str, Any]:
        """Send hello; return the server's name and version from its answer, and the convention that it states."""
        hello = {"harness_version": VERSION, "protocol_version": PROTOCOL, "benchmark": "MEMOBench"}
        self._say(HELLO, hello)
        kind, found = self._hear(patience)
        if kind != HELLO:
            raise self.foreign(f"it answered a hello with {short(kind)}")
        if (version := short(found.get("protocol_version"))) != str(PROTOCOL):
            raise MemobenchError(
                f"the policy server at {self.address} has version {version} of {self.protocol}; expected version "
                f"{PROTOCOL}: serve the policy with vla-eval {VERSION}"
            )
        if not self._warned and (others := other_formats(found)):
            logger.warning("the policy server at %s works with %s", self.address, "; ".join(others))
        self._warned = True
        asked = found.get("observation_params")
        stated = {STATED: asked[STATED]} if isinstance(asked, dict) and STATED in asked else {}
        return stated | {name: found[name] for name in ("model_server", "harness_version") if name in found}

    def exchange(self, question: dict[str, Any]) -> dict[str, Any]:
        """Send a question and return the payload of the answer."""
        self._say(question["type"], question["payload"])
        if question["type"] == EPISODE_START:
            self._in_episode = True
            return {}
        kind, found = self._hear(self.timeout)
        if kind != ACTION:
            raise self.foreign(f"it answered an observation with {short(kind)}")
        return {"actions": found["action"], **found} if "action" in found else found

    def _say(self, kind: str, payload: dict[str, Any]) -> None:
        self._number += 1
        message = {"type": kind, "payload": payload, "seq": self._number, "timestamp": time.time()}
        self.send(msgpack.packb(message, default=_pack))

    def _hear(self, patience: float) -> tuple[str, dict[str, Any]]:
        """Return type and payload of the next frame."""
        found = self.receive(patience)
        kind, payload = (found.get("type"), found.get("payload")) if isinstance(found, dict) else (None, None)
        if not isinstance(kind, str) or not isinstance(payload, dict):
            raise self.foreign("its frames have no type and payload")
        if kind == ERROR:
            message = str(payload.get("error") or payload)
            raise MemobenchError(f"the policy server at {self.address} failed: {last_line(message)}")
        return kind, payload

    def close(self) -> None:
        """Send the end of the episode, and disconnect."""
        if self._in_episode:
            self._in_episode = False
            with suppress(ServerAway, ConnectionClosed, OSError):
                self._say(EPISODE_END, {})
        super().close()


def episode_start(task: str) -> dict[str, Any]:
    """Return the message that begins an episode; of its task the server learns the instruction alone."""
    return {"type": EPISODE_START, "payload": {"task": {"name": task}}}


def observation(named: Mapping[str, Any], history: Mapping[str, Any]) -> dict[str, Any]:
    """Return the message of an observation.

    Args:
        named: by the server's names; ``images.wrist`` is ``wrist`` within ``images``.
        history: the demonstration prompt as lists of pictures; {} if it is not sent now.
    """
    payload: dict[str, Any] = {}
    for name, value in named.items():
        outer, point, inner = name.partition(".")
        if point:
            payload.setdefault(outer, {})[inner] = value
        else:
            payload[name] = value
    return {"type": OBSERVATION, "payload": payload | ({**history, "episode_restart": True} if history else {})}


def png_map(image: NDArray[np.uint8]) -> dict[str, Any]:
    """Encode an RGB picture for a frame: as PNG, without loss."""
    import cv2

    done, data = cv2.imencode(".png", image[..., ::-1])
    assert done
    return {"__image__": True, "format": "png", "data": data.tobytes(), "shape": list(image.shape)}


def other_formats(hello: Mapping[str, Any]) -> list[str]:
    """Return a phrase for each convention of a server's hello that differs from this environment."""
    return [
        f"{name} as {reason(str(spec.get('format')))}, and this environment with {FORMATS[name]}"
        for specs in (hello.get("action_spec"), hello.get("observation_spec"))
        for name, spec in (specs.items() if isinstance(specs, dict) else ())
        if name in FORMATS and isinstance(spec, dict)
        if str(spec.get("format")) not in (FORMATS[name], ANY_FORMAT) and FORMATS[name] not in str(spec.get("accepts"))
    ]


def _pack(value: Any) -> Any:
    """Encode an array for a frame; unlike openpi's, the keys of its map are text."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": value.shape}
    raise TypeError(f"a {type(value).__name__} cannot be sent")
