"""Layout of an object observation, importable without the simulator."""

from __future__ import annotations

import itertools
from typing import Any

SLOTS = 16  # number of slots. The catalogue's largest scene needs ten.

FIELDS = {"present": 1, "class": 1, "position": 3, "rotation": 6, "joint": 1, "highlighted": 1}
"""Field -> size, in the order of a slot.

``present``: 1, or 0 for an empty slot, which is all zeros. ``class``: index into `object_slots.classes`.
``position``: origin in the world, m; the handle's position for parts without their own origin (LIBERO's drawers and
knob). ``rotation``: first two columns of the rotation matrix. ``joint``: position of a drawer (m), door or knob (rad),
else 0. ``highlighted``: 1 inside a highlight of the prompt.
"""

BOUNDS = {
    "present": (0, 1),
    "class": (0, 99),
    "position": (-10, 10),
    "rotation": (-1, 1),
    "joint": (-7, 7),
    "highlighted": (0, 1),
}
"""Field -> lower and upper bound of its values. Visible objects are within the room, which is 5 m wide."""

WIDTH = sum(FIELDS.values())
SIZE = SLOTS * WIDTH  # length of the observation

NAMES = [
    f"object_{slot}.{name}" + (f"_{k}" if size > 1 else "")
    for slot in range(SLOTS)
    for name, size in FIELDS.items()
    for k in range(size)
]
"""Name of each number."""

STARTS = dict(zip(FIELDS, itertools.accumulate(FIELDS.values(), initial=0), strict=False))
"""Field -> offset in its slot."""


def field[Numbers: Any](slots: Numbers, name: str) -> Numbers:
    """Return a view of a field (..., size) of slots (..., WIDTH), an array or a tensor."""
    return slots[..., STARTS[name] : STARTS[name] + FIELDS[name]]
