"""Source of scenes, and version of their hash, by which evaluations of the same scenes are recognised."""

from __future__ import annotations

from lerobot_memobench.errors import MemobenchError

WORLD, LIBERO, FORMER = "world", "libero", "memobench"
"""Field of logs, datasets and evaluation files that names the source of the scenes; its value; and its value, which
files may omit, for the scenes that version 0.2 modelled in code."""
SCENE_HASH_VERSION = 2
"""Raise it with each change of a scene's hash: of `Simulation.scene_hash`, of states, or of rounding in the simulation.

1: release 0.2.0.
"""


def check_world(found: str | None, what: str, error: type[MemobenchError] = MemobenchError) -> None:
    """Refuse a record of scenes that this version does not have.

    Args:
        found: value of `WORLD`; None if it is omitted.
        what: subject of the message.
        error: type of the error.

    Raises:
        MemobenchError: the record is of the former scenes.
    """
    if found != LIBERO:
        raise error(
            f"{what} is of the scenes that version 0.2 modelled in code; this version has LIBERO's scenes only, use "
            "version 0.2 for it"
        )
