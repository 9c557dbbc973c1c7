"""The attributes of a demonstration that only this package writes, each of the type that it was written as."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import numpy as np
from annotated_types import Len

from lerobot_memobench.datasets.hdf5.layout import EXTRAS, Unusable
from lerobot_memobench.io import Count, Malformed, Number, Whole, checked, parsed

if TYPE_CHECKING:
    import h5py

AS_JSON = ("fixture_poses", "satisfied_intervals")
"""Attributes that hold JSON text."""


class Extras(TypedDict, total=False):
    """`EXTRAS`, with what the JSON texts among them say: fixture to pose (7,), checkpoint to [start, stop) pairs."""

    seed: Whole
    referent: str
    variant: Count
    success: bool
    fixture_poses: dict[str, Annotated[list[Number], Len(7, 7)]]
    scene_hash: str
    satisfied_intervals: list[list[Annotated[list[Count], Len(2, 2)]]]
    digest: str


def read_extras(group: h5py.Group) -> dict[str, Any]:
    """Return those of `EXTRAS` that a group has.

    Raises:
        Unusable: one of them is of another type, or no JSON.
    """
    found = {key: _plain(group.attrs[key]) for key in EXTRAS if key in group.attrs}
    for key in AS_JSON:
        if isinstance(found.get(key), str):
            try:
                found[key] = parsed(found[key])
            except Malformed as error:
                raise Unusable(f"the attribute {key!r}: {error}") from None
    try:
        return dict(checked(found, Extras))
    except Malformed as error:
        raise Unusable(f"its attributes: {error}") from None


def _plain(value: Any) -> Any:
    """Return an attribute as a Python value: HDF5 has numbers of many types, and texts as bytes or arrays of one."""
    if isinstance(value, np.ndarray) and value.shape == (1,):
        value = value[0]
    if isinstance(value, np.generic):
        value = value.item()
    return value.decode("utf-8", errors="replace") if isinstance(value, bytes) else value
