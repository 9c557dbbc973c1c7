"""Hash of a scene, by which evaluations of the same scenes are recognised."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCENE_HASH_VERSION = 2
"""Raise it with each change of a scene's hash: of this function, of states, or of rounding in the simulation.

1: release 0.2.0.
"""


def scene_hash(state: NDArray, fixture_poses: Mapping[str, NDArray]) -> str:
    """Return a short hash of a state and the fixtures' poses, see `Simulation`."""
    digest = hashlib.sha256(state.tobytes())
    for name, pose in sorted(fixture_poses.items()):
        digest.update(name.encode() + pose.tobytes())
    return digest.hexdigest()[:16]
