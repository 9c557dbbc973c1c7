"""Try one thing that may crash the process, in a process of its own; among them the golden frame.

A library that is broken ends the process with a signal, which only its parent can report. The child is
``python -m lerobot_memobench.doctor.probe golden`` and prints JSON.

The golden frame is what the benchmark's scene looks like when it is rendered right; one small image ships with the
package. Pictures are drawn to equal bits everywhere; a machine whose frame differs by more than the tolerance draws
something else. ``python -m lerobot_memobench.doctor.probe --write-golden`` makes it anew.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of

PROBE = "lerobot_memobench.doctor.probe"

Frame = NDArray[np.uint8]

GOLDEN_FILE = Path(__file__).with_name("golden.png")
TASK = "turn_on_the_stove_and_turn_it_off"
SEED = 7
SIDE = 64
"""Side of the golden frame, pixels: the 256 of the benchmark, averaged 4 × 4, so that edges do not count."""

TOLERANCE = 2.0
"""Largest mean absolute difference, of 255: versions of MuJoCo settle a scene in ways that differ by far less."""


def run_probe(name: str, timeout_s: float = 180.0) -> dict[str, Any]:
    """Run a probe in a process of its own; return its answer, or {"error": …} however it ended."""
    command = [sys.executable, "-m", PROBE, name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"no answer in {timeout_s:.0f} s"}
    if done.returncode < 0:
        return {"error": f"the process was killed by {signal.Signals(-done.returncode).name}"}
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        reason = (done.stderr.strip().splitlines() or ["without a message"])[-1]
        return {"error": f"the process ended with status {done.returncode}: {reason}"}
    answer = json.loads(lines[-1])
    assert isinstance(answer, dict)
    return answer


def golden() -> dict[str, Any]:
    """Render the golden scene; return how far it is from the one that ships."""
    return {"difference": difference(render_golden(), read_golden())}


def torchcodec() -> dict[str, Any]:
    """Load torchcodec, which loads FFmpeg's libraries."""
    from torchcodec.decoders import VideoDecoder

    return {"decoder": VideoDecoder.__name__}


def render_golden() -> Frame:
    """Render the golden scene here and now; return it as (64, 64, 3) uint8."""
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
    """Return the frame that ships with the package, (64, 64, 3) uint8."""
    if not GOLDEN_FILE.is_file():
        raise MemobenchError(f"{GOLDEN_FILE} is missing; install the package again")
    with Image.open(GOLDEN_FILE) as image:
        return np.asarray(image.convert("RGB"))


def difference(a: Frame, b: Frame) -> float:
    """Return the mean absolute difference of two frames, of 255."""
    return float(np.abs(a.astype(np.float64) - b.astype(np.float64)).mean())


def write_golden() -> Path:
    """Make what this machine renders the golden frame. Look at it before it is committed."""
    with draft_of(GOLDEN_FILE) as draft:
        Image.fromarray(render_golden()).save(draft, optimize=True)
    return GOLDEN_FILE


PROBES: dict[str, Callable[[], dict[str, Any]]] = {"golden": golden, "torchcodec": torchcodec}


if __name__ == "__main__":
    if sys.argv[1:] == ["--write-golden"]:
        print(write_golden())
    else:
        try:
            print(json.dumps(PROBES[sys.argv[1]]()))
        except Exception as error:
            print(json.dumps({"error": " ".join(f"{type(error).__name__}: {error}".split())[:300]}))
