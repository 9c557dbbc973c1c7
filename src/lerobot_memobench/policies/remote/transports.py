"""Transports to policy servers: openpi's websocket, and the REST interfaces of OpenVLA and MemoryVLA.

openpi's websocket is written anew, since the package openpi-client needs NumPy 1 and LeRobot NumPy 2. A server first
sends its metadata. Then each binary frame is a question and gets a binary frame, or a text frame with a traceback where
the server failed. Arrays go as msgpack to openpi's servers and as JSON to OpenVLA's; neither can carry code.
"""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack, closing, suppress
from functools import partial
from socket import SHUT_RDWR
from typing import Any

import httpx
import msgpack
import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import LONGEST_REASON, Malformed, cut, in_words, refusing

JPEG_QUALITY = 95
AWAY = (502, 503, 504)
"""HTTP states by which a proxy or a starting server says that it will be there later."""
TURNS: dict[str, threading.Lock] = {}
"""Address -> whose turn it is: web frameworks answer in threads, models do not."""
REFUSED = "VOc"
"""Kinds of arrays that openpi's format leaves out: structures, Python objects and complex numbers."""
LARGEST_ANSWER = 8 << 20
"""Bytes of an answer, on the wire. A thousand actions take 200 kB as JSON."""
LONGEST_LIST = 1 << 16
"""Entries of a list or map in msgpack: the unpacker reserves memory for the number that a header names."""


class ServerAway(Exception):
    """The server cannot be reached, or went away; it may come back."""


def within[Result](seconds: float, call: Callable[[], Result]) -> Result:
    """Return the result of a call that may wait on a server.

    Libraries bound each read or write and not their sum: a server that sends a byte per second would be read for hours.

    Raises:
        TimeoutError: the call lasts longer. Its thread ends with the process at the latest.
    """
    done: Future[Result] = Future()

    def work() -> None:
        try:
            done.set_result(call())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return done.result(seconds)


def last_line(text: str) -> str:
    """Return the line of a traceback that says what was wrong, printable and short."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return reason(lines[-1]) if lines else "it does not say why"


def too_slow(address: str, timeout: float) -> MemobenchError:
    """Return the error of a server that thinks for too long."""
    return MemobenchError(
        f"the policy server at {address} took more than {timeout:g} s for an answer; give it longer by policy.timeout="
    )


def reason(error: BaseException | str) -> str:
    """Return the message of an error in one short line of printable characters."""
    words = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())
    return cut(words, LONGEST_REASON) or type(error).__name__


class Websocket:
    """openpi's protocol; a subclass greets and asks in another.

    Args:
        address: ``ws://host:port``. timeout: how long an answer may take, s.
    """

    protocol = "openpi's websocket protocol"

    def __init__(self, address: str, timeout: float) -> None:
        self.address, self.timeout = address, timeout
        self._stack = ExitStack()
        self._connection: ClientConnection | None = None

    def open(self, patience: float) -> dict[str, Any]:
        """Connect anew within ``patience`` seconds, and return the metadata that the server sends first.

        Raises:
            ServerAway: nobody is there.
            MemobenchError: it is no server of this kind.
        """
        self.close()
        try:
            return self._bounded(patience := max(patience, 1.0), partial(self._connect, patience))
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

    def _bounded[Result](self, seconds: float, call: Callable[[], Result]) -> Result:
        """Return the result of a call; hang up where it lasts longer than that many seconds."""
        try:
            return within(seconds, call)
        except TimeoutError:
            if self._connection is not None:
                with suppress(OSError):
                    self._connection.socket.shutdown(SHUT_RDWR)  # close() would wait for a write that never ends
            raise

    def _connect(self, patience: float) -> dict[str, Any]:
        # No pings: openpi's servers answer none while they think, and the first thought can take minutes.
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

    def greet(self, patience: float) -> dict[str, Any]:
        """Return what the server says of itself, within ``patience`` seconds."""
        metadata = self.receive(patience)
        return metadata if isinstance(metadata, dict) else {}

    def foreign(self, what: str) -> MemobenchError:
        """Return the error of what does not speak this protocol."""
        return MemobenchError(
            f"what listens at {self.address} is no policy server with {self.protocol} ({what}); check "
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
            if error.sent is not None and not error.rcvd_then_sent:  # this side refused the frame
                raise self.foreign(reason(error)) from error
            raise
        if isinstance(frame, str):
            raise MemobenchError(f"the policy server at {self.address} failed: {last_line(frame)}")
        try:
            return unpack(frame)
        except ValueError as error:
            raise self.foreign(str(error)) from error

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Send a frame and return the one that comes back.

        Raises:
            ServerAway: the connection broke.
            MemobenchError: the server failed, took too long, or is none of this kind.
        """
        try:
            answer = self._bounded(self.timeout, partial(self.exchange, question))
        except TimeoutError as error:
            raise too_slow(self.address, self.timeout) from error
        except (ConnectionClosed, OSError) as error:
            raise ServerAway(reason(error)) from error
        if not isinstance(answer, dict):
            raise self.foreign(f"it answered a {type(answer).__name__}, no map")
        return answer

    def exchange(self, question: dict[str, Any]) -> Any:
        """Send a question and return the answer."""
        self.send(pack(question))
        return self.receive(self.timeout)

    def close(self) -> None:
        """Hang up."""
        self._connection = None
        self._stack.close()


class Rest:
    """A server that is asked by HTTP POST, as `Websocket` is; a subclass knows the path and both formats."""

    path = ""

    def __init__(self, address: str, timeout: float) -> None:
        self.address, self.timeout = address, timeout
        self._turn = TURNS.setdefault(address, threading.Lock())
        self._client: httpx.Client | None = None

    def open(self, patience: float) -> dict[str, Any]:
        """Find out whether somebody is there."""
        self.close()
        self._client = httpx.Client(
            base_url=self.address,
            timeout=httpx.Timeout(self.timeout, connect=max(patience, 1.0)),
            headers={"Accept-Encoding": "identity"},
            trust_env=False,
        )
        try:
            request = self._client.build_request("GET", "/")
            # Any answer, 404 mostly, shows that a server listens; it is left unread.
            within(max(patience, 1.0), partial(self._client.send, request, stream=True)).close()
        except (httpx.TransportError, TimeoutError) as error:
            raise ServerAway(reason(error)) from error
        return {}

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Post a question and return the actions of its answer."""
        state, body = self._post(question)
        if state in AWAY:
            raise ServerAway(f"HTTP state {state}")
        text = body.decode(errors="replace")
        if state != httpx.codes.OK:
            raise MemobenchError(
                f"the policy server at {self.address} answered {self.path} with HTTP state {state}: {last_line(text)}"
            )
        try:
            return {"actions": self.decode(text)}
        except ValueError as error:
            raise self._no_actions(repr(cut(last_line(text))) if text.strip() else "an empty body") from error

    def _post(self, question: dict[str, Any]) -> tuple[int, bytes]:
        if self._client is None:
            raise ServerAway("not connected")
        request = self._client.build_request("POST", self.path, **self.encode(question))
        try:
            with self._turn:
                return within(self.timeout, partial(self._answer, self._client, request))
        except (TimeoutError, httpx.ReadTimeout, httpx.WriteTimeout) as error:
            raise too_slow(self.address, self.timeout) from error
        except httpx.TransportError as error:
            raise ServerAway(reason(error)) from error

    def _answer(self, client: httpx.Client, request: httpx.Request) -> tuple[int, bytes]:
        """Return state and body of an answer, read as it is sent: a small compressed one may become a large text."""
        with closing(client.send(request, stream=True)) as response:
            if (encoding := response.headers.get("Content-Encoding", "identity")) != "identity":
                raise self._no_actions(f"a body compressed by {reason(encoding)}, which was not asked for")
            body = bytearray()
            for part in response.iter_raw():
                body += part
                if len(body) > LARGEST_ANSWER:
                    raise self._no_actions(f"more than {in_words(LARGEST_ANSWER)}")
            return response.status_code, bytes(body)

    def _no_actions(self, found: str) -> MemobenchError:
        return MemobenchError(
            f"the policy server at {self.address} answered {found}, which is no list of actions; its own log tells why"
        )

    def encode(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return httpx's arguments for the question."""
        raise NotImplementedError

    def decode(self, text: str) -> NDArray[np.floating]:
        """Return the actions in an answer; `ValueError` where there are none."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of the connections."""
        if self._client is not None:
            self._client.close()
            self._client = None


class Act(Rest):
    """OpenVLA-OFT's ``/act``: JSON with arrays in, a list of actions out, or the word "error"."""

    path = "/act"

    def encode(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return JSON with arrays."""
        return {"content": to_json(question), "headers": {"Content-Type": "application/json"}}

    def decode(self, text: str) -> NDArray[np.floating]:
        """Return the actions in a list, or in a string that holds one."""
        answer = from_json(text)
        if isinstance(answer, str):  # where json-numpy was patched in late, its JSON arrives as a string
            answer = from_json(answer)
        return numbers(answer)


class ProcessFrame(Rest):
    """MemoryVLA's ``/process_frame``: a form with JPEG images in, nested lists or rows of text out."""

    path = "/process_frame"

    def encode(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return a form, with JPEG images as files."""
        texts = {key: str(value) for key, value in question.items() if not isinstance(value, np.ndarray)}
        arrays = {key: value for key, value in question.items() if isinstance(value, np.ndarray)}
        files = {key: (key, jpeg(value) if value.ndim == 3 else value.tobytes()) for key, value in arrays.items()}
        return {"data": texts, "files": files}

    def decode(self, text: str) -> NDArray[np.floating]:
        """Return the actions in nested lists, or in rows of text."""
        answer = from_json(text)
        actions = answer.get("response") if isinstance(answer, dict) else None
        if isinstance(actions, str):
            actions = [[float(number) for number in row.split()] for row in actions.split(";")]
        return numbers(actions)


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """Return an RGB image as JPEG, by the encoder and at the quality that MemoryVLA's clients use."""
    import cv2

    done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done
    return data.tobytes()


def numbers(found: Any) -> NDArray[np.floating]:
    """Return nested lists, or a list of arrays, as an array of floats; `ValueError` where they are none."""
    try:
        array = np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError("no numbers") from error
    if array.ndim == 0:
        raise ValueError("no numbers")
    return array


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
        return _dtype(found[b"dtype"]).type(found[b"data"])  # of the data's length, not of the one that dtype names
    return found


def _dtype(text: Any) -> np.dtype[Any]:
    dtype = np.dtype(text)
    if dtype.kind in REFUSED:
        raise ValueError(f"arrays of type {dtype} are not taken")
    return dtype


def _array(data: bytes, dtype: Any, shape: Any) -> np.ndarray:
    return np.frombuffer(data, _dtype(dtype)).reshape(tuple(shape))


def pack(message: dict[str, Any]) -> bytes:
    """Return a message as openpi-client packs it: arrays as maps of their bytes, type and shape."""
    packed: bytes = msgpack.packb(message, default=_pack)
    return packed


def unpack(data: bytes) -> Any:
    """Return the message in a frame.

    Raises:
        ValueError: it is none.
    """
    with refusing(lambda why: Malformed(f"it is not msgpack with arrays ({why})")):
        return msgpack.unpackb(data, object_hook=_unpack, max_array_len=LONGEST_LIST, max_map_len=LONGEST_LIST)


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        data = base64.b64encode(value.tobytes()).decode()
        return {"__numpy__": data, "dtype": value.dtype.str, "shape": value.shape}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def _decode(found: dict[str, Any]) -> Any:
    if "__numpy__" in found:
        return _array(base64.b64decode(found["__numpy__"]), found["dtype"], found["shape"])
    return found


def to_json(message: Any) -> str:
    """Return a message as the package json-numpy writes it, which OpenVLA's servers use."""
    return json.dumps(message, default=_encode)


def from_json(text: str) -> Any:
    """Return the message in a JSON text.

    Raises:
        ValueError: it is none.
    """
    with refusing(lambda why: Malformed(f"it is not JSON with arrays ({why})")):
        return json.loads(text, object_hook=_decode)
