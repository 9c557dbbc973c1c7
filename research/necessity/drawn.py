"""Pictures drawn by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from research.necessity.demonstrations import Picture


def scene(**changes: Any) -> Picture:
    """A grey wall with a red square of 10 pixels, moved by (dy, dx), or gone."""
    picture = np.full((64, 64, 3), 128, dtype=np.uint8)
    if not changes.get("gone"):
        y, x = 20 + changes.get("dy", 0), 30 + changes.get("dx", 0)
        picture[y : y + 10, x : x + 10] = changes.get("colour", (200, 30, 30))
    return picture
