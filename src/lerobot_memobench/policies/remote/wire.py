"""Arrays on the wire: msgpack as openpi's servers speak it, JSON as OpenVLA's do. Neither can carry code."""

from __future__ import annotations

import base64
import binascii
import json
from typing import Any

import msgpack
import numpy as np

REFUSED = "VOc"
"""Kinds of arrays that openpi's format leaves out: structures, Python objects and complex numbers."""


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in REFUSED:
        raise ValueError(f"arrays of type {value.dtype} cannot be sent")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def _unpack(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" in found:
        return _array(found[b"data"], found[b"dtype"], found[b"shape"])
    if b"__npgeneric__" in found:
        return _array(np.array(found[b"data"], _dtype(found[b"dtype"])).tobytes(), found[b"dtype"], ())[()]
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
    try:
        return msgpack.unpackb(data, object_hook=_unpack)
    except (msgpack.UnpackException, TypeError, KeyError) as error:
        raise ValueError(f"it is not msgpack with arrays ({error})") from error


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
    try:
        return json.loads(text, object_hook=_decode)
    except (TypeError, KeyError, binascii.Error) as error:
        raise ValueError(f"it is not JSON with arrays ({error})") from error
