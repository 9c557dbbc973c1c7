"""Connections to policy servers: websockets, msgpack, and one class for each dialect of a server.

Their packages are not imported: openpi-client needs NumPy 1 and LeRobot NumPy 2. Messages are msgpack, which cannot
carry code.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from typing import Any, ClassVar

import msgpack
import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from lerobot_memobench.errors import MemobenchError, cut, short
from lerobot_memobench.sim.convention import STATED
from lerobot_memobench.untrusted import LONGEST_REASON, Malformed, refusing

logger = logging.getLogger(__name__)

IMAGE, WRIST_IMAGE, STATE, TASK, STEP = "image", "wrist_image", "state", "task", "step"
"""Names of observations to send: both cameras (H, W, 3) uint8, proprioception (8,) float32, the instruction, and the
control step (1,) float32. Other observations have the environment's names (``phase``)."""
REFUSED = "VOc"
"""Kinds of arrays that openpi's format excludes: structures, Python objects and complex numbers."""
LARGEST_ANSWER = 8 << 20
"""Largest size of an answer, bytes."""
LONGEST_LIST = 1 << 16
"""Largest number of entries of a list or map: the unpacker allocates memory for the number in its header."""
PAUSE = 0.5
"""Time between two attempts to connect, s."""

NamedValues = Mapping[str, Any]
"""Observations of one control step by our names."""


class ServerAway(Exception):
    """The server cannot be reached."""


class Connection:
    """A connection of one environment to a server. This class has openpi's protocol, its subclasses have others.

    A server first sends its metadata. Then it answers each binary frame with a binary frame, or with a traceback as a
    text frame. An episode that loses its server is not continued, because a server that starts again has lost its
    memory and its random state: the evaluation stops, and resuming it repeats the episode.
    """

    # openpi: examples/libero/main.py, src/openpi/serving/websocket_policy_server.py, openpi-client 0.1.2
    protocol: ClassVar[str] = "openpi's websocket protocol"
    port: ClassVar[int] = 8000
    keys: Mapping[str, str] = {  # the server's name of each observation -> our name
        "observation/image": IMAGE,
        "observation/wrist_image": WRIST_IMAGE,
        "observation/state": STATE,
        "prompt": TASK,
    }
    image_size: ClassVar[int | None] = 224  # side of sent images, pixels; None: as rendered, the server resizes them
    n_action_steps: ClassVar[int] = 5  # default number of executed actions of each answer
    prompt_stride: ClassVar[int | None] = None  # default steps between sent frames of the prompt; None: n_action_steps
    buffers: ClassVar[bool] = False
    """The server receives every frame, in a memory that all of its connections share: one environment at a time."""
    queues: ClassVar[bool] = False
    """The server answers one action and queues the rest of its plan."""

    def __init__(self, address: str, timeout: float, keys: Mapping[str, str] | None = None) -> None:
        self.address, self.timeout, self.keys = address, timeout, keys or self.keys
        self._connection: ClientConnection | None = None
        self._stack = ExitStack()  # websockets 17 expects a context

    # --- an episode ---

    def begin(self, task: str) -> None:
        """Begin an episode, on a new connection."""

    def show(self, frame: NamedValues) -> None:
        """Send a frame of the prompt."""
        self.plan(frame)

    def watch(self, frame: NamedValues) -> None:
        """Keep a frame of the execution whose action is planned already."""

    def plan(self, frame: NamedValues) -> dict[str, Any]:
        """Return the server's answer to an observation."""
        return self.ask({theirs: frame[ours] for theirs, ours in self.keys.items()})

    # --- messages ---

    def open(self, patience: float) -> dict[str, Any]:
        """Connect within ``patience`` seconds; return the server's metadata. Refuse another protocol."""
        deadline, warned = time.monotonic() + patience, False
        while True:
            try:
                return self._connect(max(deadline - time.monotonic(), 1.0))
            except ServerAway as error:
                if time.monotonic() >= deadline:
                    raise MemobenchError(
                        f"no policy server answered at {self.address} within {patience:g} s ({error}); start it, or "
                        "give its address by host= and port="
                    ) from error
                if not warned:
                    logger.warning("waiting for the policy server at %s (%s)", self.address, error)
                warned = True
            time.sleep(min(PAUSE, max(0.0, deadline - time.monotonic())))

    def _connect(self, patience: float) -> dict[str, Any]:
        self.close()
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
            return self._greet(patience)
        except (OSError, WebSocketException) as error:
            away = not isinstance(error, InvalidHandshake) or isinstance(error, InvalidMessage)
            if isinstance(error, InvalidStatus):
                away = error.response.status_code >= 500  # of a proxy, or of a server that starts
            raise (ServerAway(reason(error)) if away else self._foreign(reason(error))) from error

    def _greet(self, patience: float) -> dict[str, Any]:
        metadata = self._receive(patience)
        return metadata if isinstance(metadata, dict) else {}

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return the answer; a `MemobenchError` if the server fails, is too slow or has another protocol."""
        try:
            answer = self._exchange(question)
        except TimeoutError as error:
            raise MemobenchError(
                f"the policy server at {self.address} took more than {self.timeout:g} s for an answer; set a longer "
                "policy.timeout="
            ) from error
        except (ConnectionClosed, OSError) as error:
            raise MemobenchError(
                f"the policy server at {self.address} disconnected ({reason(error)}); its episode is not counted: "
                "start the server, and resume the evaluation by resume=true output_dir=<this run's folder>"
            ) from error
        if not isinstance(answer, dict):
            raise self._foreign(f"it answered a {type(answer).__name__} instead of a map")
        return answer

    def _exchange(self, question: dict[str, Any]) -> Any:
        self._send(pack(question))
        return self._receive(self.timeout)

    def _send(self, frame: bytes) -> None:
        if self._connection is None:
            raise ConnectionError("not connected")
        self._connection.send(frame)

    def _receive(self, patience: float) -> Any:
        assert self._connection is not None
        try:
            frame = self._connection.recv(timeout=patience)
        except ConnectionClosed as error:
            if error.sent is not None and not error.rcvd_then_sent:  # this side closed the connection
                raise self._foreign(reason(error)) from error
            raise
        if isinstance(frame, str):
            raise self._failed(frame)
        try:
            return unpack_message(frame)
        except ValueError as error:
            raise self._foreign(str(error)) from error

    def _foreign(self, problem: str) -> MemobenchError:
        return MemobenchError(
            f"the server at {self.address} is no policy server with {self.protocol} ({problem}); check "
            "host= and port=, or choose another dialect="
        )

    def _failed(self, traceback: str) -> MemobenchError:
        lines = [line for line in traceback.splitlines() if line.strip()]
        last = reason(lines[-1]) if lines else "without a reason"
        return MemobenchError(f"the policy server at {self.address} failed: {last}")

    def close(self) -> None:
        """Disconnect."""
        self._stack.close()
        self._connection = None


def reason(error: BaseException | str) -> str:
    """Return the message of an error in one short line of printable characters."""
    words = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())
    return cut(words, LONGEST_REASON) or type(error).__name__


class RoboMMEConnection(Connection):
    """A connection by openpi's protocol, in which a message before each question holds all frames since the last."""

    # RoboMME/robomme_policy_learning: examples/robomme/{eval,utils}.py, serving/websocket_policy_server.py
    port, image_size, prompt_stride, buffers = 8011, None, 1, True

    def begin(self, task: str) -> None:
        self._frames: list[NamedValues] = []
        self._execution_starts = 0
        self.ask({"reset": True})

    def show(self, frame: NamedValues) -> None:
        self.watch(frame)
        self._execution_starts += 1

    def watch(self, frame: NamedValues) -> None:
        self._frames.append(frame)

    def plan(self, frame: NamedValues) -> dict[str, Any]:
        frames, self._frames = [*self._frames, frame], []
        self.ask(
            {
                "images": np.stack([frame[IMAGE] for frame in frames])[:, None],
                "state": np.stack([frame[STATE] for frame in frames]),
                "add_buffer": True,
                "exec_start_idx": self._execution_starts,
            }
        )
        return super().plan(frame)


# --- openpi's format ---

_VLA_EVALS = "__ndarray__", "data", "dtype", "shape"
_OPENPIS = b"__ndarray__", b"data", b"dtype", b"shape"
"""Keys of a packed array."""


def pack(message: dict[str, Any]) -> bytes:
    """Pack a message as openpi-client does: arrays are maps of their bytes, type and shape."""
    return msgpack.packb(message, default=_pack)


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in REFUSED:
        raise ValueError(f"arrays of type {value.dtype} cannot be sent")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def unpack_message(data: bytes) -> Any:
    """Return the message in a frame of openpi or of vla-evaluation-harness; raise `ValueError` if it is none."""
    with refusing(lambda why: Malformed(f"it is not msgpack with arrays ({why})")):
        return msgpack.unpackb(data, object_hook=_unpack, max_array_len=LONGEST_LIST, max_map_len=LONGEST_LIST)


def _unpack(packed: dict[Any, Any]) -> Any:
    for mark, data, dtype, shape in (_OPENPIS, _VLA_EVALS):
        if mark in packed:
            return np.frombuffer(packed[data], _dtype(packed[dtype])).reshape(tuple(packed[shape]))
    if b"__npgeneric__" in packed:
        return _dtype(packed[b"dtype"]).type(packed[b"data"])  # of the data's length, whatever length dtype names
    return packed


def _dtype(text: Any) -> np.dtype[Any]:
    dtype = np.dtype(text)
    if dtype.kind in REFUSED:
        raise ValueError(f"arrays of type {dtype} are not accepted")
    return dtype


# --- vla-evaluation-harness ---

VERSION, PROTOCOL = "0.8.0", 1
"""The supported version of vla-eval, and of its protocol."""
HISTORY = {IMAGE: "video_history", WRIST_IMAGE: "wrist_video_history", STATE: "state_history"}
"""Our name of an observation -> vla-eval's name of its frames in the demonstration prompt."""
FORMATS = {
    "position": "delta_xyz",
    "rotation": "axis_angle",
    "gripper": "binary_close_positive",
    "state": "eef_pos3_axisangle3_gripper2",
}
"""vla-eval's names of this environment's conventions; a server's hello may list others."""
ANY_FORMAT = "raw"


class VlaEvalConnection(Connection):
    """A connection to a model server of vla-evaluation-harness (vla-eval).

    Both sides send ``hello``. The server does not answer an ``episode_start``; it answers an ``observation`` with an
    ``action`` or an ``error``. The first observation of an episode includes the demonstration prompt.
    """

    # vla-eval 0.8: protocol/{messages,numpy_codec,image_codec}.py, connection.py, model_servers/{serve,predict}.py
    protocol = "vla-evaluation-harness's protocol"
    # A dot separates levels.
    keys = {"images.agentview": IMAGE, "images.wrist": WRIST_IMAGE, "states": STATE, "task_description": TASK}
    image_size, n_action_steps, prompt_stride, queues = None, 1, 1, True

    _number, _in_episode, _warned = 0, False, False

    def begin(self, task: str) -> None:
        """Begin an episode; of its task the server learns the instruction alone."""
        self._frames: list[NamedValues] = []
        self.ask({"type": "episode_start", "payload": {"task": {"name": task}}})

    def show(self, frame: NamedValues) -> None:
        self._frames.append({name: _as_png(frame[name]) for name in HISTORY if name in self.keys.values()})

    def plan(self, frame: NamedValues) -> dict[str, Any]:
        """Return the server's answer, with ``actions``; the first question of an episode has its prompt."""
        payload: dict[str, Any] = {}
        for theirs, ours in [*self.keys.items(), *([(STEP, STEP)] if STEP in frame else [])]:
            outer, point, inner = theirs.partition(".")
            if point:
                payload.setdefault(outer, {})[inner] = _as_png(frame[ours])
            else:
                payload[theirs] = _as_png(frame[ours])
        frames, self._frames = self._frames, []
        if frames and frames[0]:
            payload |= {HISTORY[name]: [past[name] for past in frames] for name in frames[0]}
            payload["episode_restart"] = True
        return self.ask({"type": "observation", "payload": payload})

    def _greet(self, patience: float) -> dict[str, Any]:
        """Send hello; return the server's name and version from its answer, and the convention that it states."""
        self._say("hello", {"harness_version": VERSION, "protocol_version": PROTOCOL, "benchmark": "MEMOBench"})
        kind, payload = self._hear(patience)
        if kind != "hello":
            raise self._foreign(f"it answered a hello with {short(kind)}")
        if (version := short(payload.get("protocol_version"))) != str(PROTOCOL):
            raise MemobenchError(
                f"the policy server at {self.address} has version {version} of {self.protocol}; expected version "
                f"{PROTOCOL}: serve the policy with vla-eval {VERSION}"
            )
        if not self._warned and (formats := _other_formats(payload)):
            logger.warning("the policy server at %s works with %s", self.address, "; ".join(formats))
        self._warned = True
        params = payload.get("observation_params")
        stated = {STATED: params[STATED]} if isinstance(params, dict) and STATED in params else {}
        return stated | {name: payload[name] for name in ("model_server", "harness_version") if name in payload}

    def _exchange(self, question: dict[str, Any]) -> dict[str, Any]:
        self._say(question["type"], question["payload"])
        if question["type"] == "episode_start":
            self._in_episode = True
            return {}
        kind, payload = self._hear(self.timeout)
        if kind != "action":
            raise self._foreign(f"it answered an observation with {short(kind)}")
        return {"actions": payload["action"], **payload} if "action" in payload else payload

    def _say(self, kind: str, payload: dict[str, Any]) -> None:
        self._number += 1
        message = {"type": kind, "payload": payload, "seq": self._number, "timestamp": time.time()}
        self._send(msgpack.packb(message, default=_pack_vla_eval))

    def _hear(self, patience: float) -> tuple[str, dict[str, Any]]:
        frame = self._receive(patience)
        kind, payload = (frame.get("type"), frame.get("payload")) if isinstance(frame, dict) else (None, None)
        if not isinstance(kind, str) or not isinstance(payload, dict):
            raise self._foreign("its frames have no type and payload")
        if kind == "error":
            raise self._failed(str(payload.get("error") or payload))
        return kind, payload

    def close(self) -> None:
        if self._in_episode:
            self._in_episode = False
            with suppress(ConnectionClosed, OSError):
                self._say("episode_end", {})
        super().close()


def _as_png(value: Any) -> Any:
    """Encode an image without loss; other values are unchanged."""
    if not (isinstance(value, np.ndarray) and value.ndim == 3):
        return value
    import cv2

    image: NDArray[np.uint8] = value
    done, data = cv2.imencode(".png", image[..., ::-1])
    assert done
    return {"__image__": True, "format": "png", "data": data.tobytes(), "shape": list(image.shape)}


def _other_formats(hello: Mapping[str, Any]) -> list[str]:
    """Return a phrase for each convention of a server's hello that differs from this environment."""
    return [
        f"{name} as {reason(str(spec.get('format')))}, and this environment with {FORMATS[name]}"
        for specs in (hello.get("action_spec"), hello.get("observation_spec"))
        for name, spec in (specs.items() if isinstance(specs, dict) else ())
        if name in FORMATS and isinstance(spec, dict)
        if str(spec.get("format")) not in (FORMATS[name], ANY_FORMAT) and FORMATS[name] not in str(spec.get("accepts"))
    ]


def _pack_vla_eval(value: Any) -> Any:
    """Encode an array for a frame; unlike openpi's, the keys of its map are text."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": value.shape}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


DIALECTS: dict[str, type[Connection]] = {
    "openpi": Connection,
    "robomme": RoboMMEConnection,
    "vla_eval": VlaEvalConnection,
}
