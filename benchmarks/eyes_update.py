"""An update of eyes in a process that keeps freed memory, as training does, beside one in a process that does not.

    python benchmarks/eyes_update.py [--batch 32] [--updates 20] [--repeats 3]

Each side runs in processes of its own, by turns, on all cores, from pictures of noise. Prints one JSON line: ratio
(memory given back / kept) and seconds of an update, medians.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

SIDES = ("kept", "given_back")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--updates", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--side", choices=SIDES, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.side:
        print(seconds(asked.side, asked.batch, asked.updates))
        return
    took: dict[str, list[float]] = {side: [] for side in SIDES}
    for _ in range(asked.repeats):
        for side in SIDES:
            command = [sys.executable, __file__, "--side", side]
            command += ["--batch", str(asked.batch), "--updates", str(asked.updates)]
            took[side].append(float(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    middle = {side: median(values) for side, values in took.items()}
    result = {"benchmark": "eyes_update", "ratio": round(middle["given_back"] / middle["kept"], 3)}
    print(json.dumps(result | {f"{side}_s": round(value, 4) for side, value in middle.items()}))


def seconds(side: str, batch: int, updates: int) -> float:
    """Return how long an update takes, after ten that warm up."""
    import numpy as np

    from lerobot_memobench.eyes import training
    from lerobot_memobench.eyes.kinds import kinds
    from lerobot_memobench.eyes.labels import PICTURE
    from lerobot_memobench.eyes.pictures import Pictures

    if side == "given_back":
        training.keep_freed_memory = lambda: None
    times: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder, rows = Path(name), np.zeros(2 * batch, PICTURE)
        rows["pixels"] = np.random.default_rng(0).integers(0, 256, rows["pixels"].shape)
        np.save(folder / "pictures.npy", rows)
        training.DOUBT_UPDATES = 1
        settings = training.Training(updates=training.WINDOW + updates, batch=batch)
        training.train(
            Pictures([folder / "pictures.npy"]),
            kinds(),
            folder,
            settings,
            save_every=settings.updates + 1,
            progress=lambda *_: times.append(time.perf_counter()),
        )
    windows = -(-updates // training.WINDOW)
    return (times[windows] - times[0]) / (windows * training.WINDOW)


if __name__ == "__main__":
    main()
