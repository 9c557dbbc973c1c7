"""OpenVLA's and MemoryVLA's REST: questions by HTTP POST."""

from __future__ import annotations

import threading
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote import wire
from lerobot_memobench.policies.remote.transport import ServerAway, last_line, reason, too_slow

JPEG_QUALITY = 95
AWAY = (502, 503, 504)
"""HTTP states by which a proxy or a starting server says that it will be there later."""
TURNS: dict[str, threading.Lock] = {}
"""Address -> whose turn it is: web frameworks answer in threads, models do not."""


class Rest:
    """A server that is asked by HTTP POST; a subclass knows the path and both formats."""

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
            trust_env=False,
        )
        try:
            self._client.get("/")  # any answer, 404 mostly, says that somebody is there
        except httpx.TransportError as error:
            raise ServerAway(reason(error)) from error
        return {}

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Post a question and return the actions of its answer."""
        response = self._post(question)
        if response.status_code in AWAY:
            raise ServerAway(f"HTTP state {response.status_code}")
        if response.status_code != httpx.codes.OK:
            raise MemobenchError(
                f"the policy server at {self.address} answered {self.path} with HTTP state {response.status_code}: "
                f"{last_line(response.text)[:200]}"
            )
        try:
            return {"actions": self.decode(response.text)}
        except ValueError as error:
            raise MemobenchError(
                f"the policy server at {self.address} answered {last_line(response.text)[:80]!r}, which is no list of "
                "actions; its own log tells why"
            ) from error

    def _post(self, question: dict[str, Any]) -> httpx.Response:
        if self._client is None:
            raise ServerAway("not connected")
        try:
            with self._turn:
                return self._client.post(self.path, **self.encode(question))
        except httpx.ReadTimeout as error:
            raise too_slow(self.address, self.timeout) from error
        except httpx.TransportError as error:
            raise ServerAway(reason(error)) from error

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
        return {"content": wire.to_json(question), "headers": {"Content-Type": "application/json"}}

    def decode(self, text: str) -> NDArray[np.floating]:
        """Return the actions in a list, or in a string that holds one."""
        answer = wire.from_json(text)
        if isinstance(answer, str):  # where json-numpy was patched in late, its JSON arrives as a string
            answer = wire.from_json(answer)
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
        answer = wire.from_json(text)
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
    except (TypeError, ValueError) as error:
        raise ValueError("no numbers") from error
    if array.ndim == 0:
        raise ValueError("no numbers")
    return array
