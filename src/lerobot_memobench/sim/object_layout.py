"""The layout of an object observation: numbers alone, without the simulator, for all who read it."""

from __future__ import annotations

import itertools
from typing import Any

SLOTS = 16
"""Things that an observation has room for. The catalogue's fullest scene has ten."""

FIELDS = {"present": 1, "class": 1, "position": 3, "rotation": 6, "joint": 1, "highlighted": 1}
"""Numbers of a slot, in order.

``present``: 1, or 0 for an empty slot, which is all zeros. ``class``: index into `object_slots.classes`.
``position``: of the thing's origin in the world, m; of its handle where a part has no origin of its own, as LIBERO's
drawers and knob. ``rotation``: the first two columns of its rotation matrix.
``joint``: position of a drawer (m), door or knob (rad), else 0. ``highlighted``: 1 while it stands in a highlight of
the prompt.
"""

BOUNDS = {
    "present": (0, 1),
    "class": (0, 99),
    "position": (-10, 10),
    "rotation": (-1, 1),
    "joint": (-7, 7),
    "highlighted": (0, 1),
}
"""Field -> between which values its numbers lie. A position is that of a visible thing: the room is 5 m wide."""

WIDTH = sum(FIELDS.values())
SIZE = SLOTS * WIDTH
"""Length of the observation."""

STARTS = dict(zip(FIELDS, itertools.accumulate(FIELDS.values(), initial=0), strict=False))
"""Field -> where it begins in its slot."""


def field[Numbers: Any](slots: Numbers, name: str) -> Numbers:
    """Return a field (..., size) of slots (..., WIDTH), an array or a tensor; a view."""
    return slots[..., STARTS[name] : STARTS[name] + FIELDS[name]]
