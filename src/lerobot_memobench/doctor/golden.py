"""The golden frame: a small reference picture of a scene.

Rendering gives equal bits on every machine; a difference above the tolerance means wrong pictures.
``python -m lerobot_memobench.doctor.golden`` writes the frame again; check it by eye before committing it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of

Frame = NDArray[np.uint8]

GOLDEN_FILE = Path(__file__).with_name("golden.png")
TASK = "turn_on_the_stove_and_turn_it_off"
SEED = 7
SIDE = 64
"""Side of the golden frame, pixels: 256 averaged 4 × 4, which reduces differences at edges."""

TOLERANCE = 2.0
"""Largest accepted mean absolute difference, of 255. Scenes of different MuJoCo versions differ by far less."""


def render_golden() -> Frame:
    """Render the golden scene, (64, 64, 3) uint8."""
    from lerobot_memobench.sim.simulation import Simulation
    from lerobot_memobench.tasks.catalogue import get_task

    simulation = Simulation(get_task(TASK))
    simulation.reset(SEED)
    return shrink(simulation.render("agentview"))


def shrink(image: Frame) -> Frame:
    """Average an image (64 k, 64 k, 3) to (64, 64, 3)."""
    factor = image.shape[0] // SIDE
    blocks = image.reshape(SIDE, factor, SIDE, factor, 3).astype(np.float64)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def read_golden() -> Frame:
    """Return the golden frame of the package, (64, 64, 3) uint8."""
    if not GOLDEN_FILE.is_file():
        raise MemobenchError(f"{GOLDEN_FILE} is missing; install the package again")
    with Image.open(GOLDEN_FILE) as image:
        return np.asarray(image.convert("RGB"))


def difference(a: Frame, b: Frame) -> float:
    """Return the mean absolute difference of two frames, of 255."""
    return float(np.abs(a.astype(np.float64) - b.astype(np.float64)).mean())


if __name__ == "__main__":
    with draft_of(GOLDEN_FILE) as draft:
        Image.fromarray(render_golden()).save(draft, optimize=True)
    print(GOLDEN_FILE)
