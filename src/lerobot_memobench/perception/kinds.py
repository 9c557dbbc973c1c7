"""The kinds of things that eyes tell apart: each drawer of a cabinet for itself, other moving parts, and classes."""

from __future__ import annotations

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.assets.registry import known_classes
from lerobot_memobench.sim.object_slots import Thing, classes
from lerobot_memobench.sim.simulation import Simulation

DRAWERS = ("top_drawer", "middle_drawer", "bottom_drawer")
"""They stand above one another, nearer than two things of a kind can be told apart."""
PARTS = (*DRAWERS, "door", "knob")
"""Kinds that have a joint; they come first."""


def kinds() -> tuple[str, ...]:
    """Return the names of the kinds, in the order of their indices."""
    return (*PARTS, *known_classes())


def kinds_of(sim: Simulation, things: tuple[Thing, ...]) -> list[int]:
    """Return the index of the kind of each thing of a scene.

    Raises:
        MemobenchError: a drawer of a fixture that was registered from outside is none of the three.
    """
    regions = {
        int(sim.model.joint(part.joint).qposadr[0]): region
        for asset in sim.assets.values()
        for region, part in asset.articulations.items()
    }
    names = [
        regions[thing.joint].replace("_region", "_drawer")
        if thing.joint is not None and classes()[thing.kind] == "drawer"
        else classes()[thing.kind]
        for thing in things
    ]
    for name in names:
        if name not in kinds():
            raise MemobenchError(f"eyes tell {', '.join(DRAWERS)} apart, and {name!r} is none; leave its task out")
    return [kinds().index(name) for name in names]
