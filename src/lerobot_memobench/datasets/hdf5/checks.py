"""Parts of an HDF5 file, each of the type that the layout says, or a sentence that says what was found."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.hdf5.layout import Unusable
from lerobot_memobench.io import Malformed, parsed

if TYPE_CHECKING:
    import h5py

LARGEST = 1e10
"""MuJoCo takes a state with a larger number for an unstable simulation, and puts the initial one in its place."""


def demo_number(name: str) -> int | None:
    """Return k of a group demo_k, None for other names."""
    found = re.fullmatch(r"demo_(\d+)", name)
    return int(found.group(1)) if found else None


def text_attribute(group: h5py.Group, key: str, required: bool = False) -> Any:
    """Return a text, None where there is none and none is required."""
    value = group.attrs.get(key)
    if value is None:
        if required:
            raise Unusable(f"the attribute {key!r} is missing")
        return None
    if isinstance(value, np.ndarray) and value.shape == (1,):
        value = value[0]
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    if not isinstance(value, str):
        raise Unusable(f"the attribute {key!r} is of type {type(value).__name__}, expected text")
    return value


def json_object(text: str, what: str) -> dict[str, Any]:
    """Return the JSON object that ``text`` holds; ``what`` it is goes into the message."""
    try:
        value = parsed(text)
    except Malformed as error:
        raise Unusable(f"{what} is no valid JSON: {error}") from None
    if not isinstance(value, dict):
        raise Unusable(f"{what} holds a {type(value).__name__}, expected a JSON object")
    return value


def array(group: h5py.Group, name: str, shape: tuple[int | None, ...], *dtypes: Any) -> h5py.Dataset:
    """Return an array of one of the types and of a shape in which None stands for any length."""
    import h5py

    found = group.get(name)
    if not isinstance(found, h5py.Dataset):
        raise Unusable(f"the array {name!r} is missing")
    if found.dtype not in [np.dtype(dtype) for dtype in dtypes]:
        expected = " or ".join(str(np.dtype(dtype)) for dtype in dtypes)
        raise Unusable(f"{name} has type {found.dtype}, expected {expected}")
    matches = len(found.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(found.shape, shape, strict=True)
    )
    if not matches:
        want = ", ".join("any" if n is None else str(n) for n in shape)
        raise Unusable(f"{name} has shape {found.shape}, expected ({want})")
    return found


def finite(name: str, values: NDArray) -> NDArray:
    """Return (T, n) numbers after checking that none is infinite, missing, or too large."""
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if bad.size:
        raise Unusable(f"{name} holds a value that is not finite at frame {bad[0]}")
    bad = np.flatnonzero((np.abs(values) > LARGEST).any(axis=1))
    if bad.size:
        raise Unusable(f"{name} holds a value beyond {LARGEST:g} at frame {bad[0]}, more than the simulator takes")
    return values


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its name."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
