"""Compare the writing of LeRobot datasets with LeRobot's own recording loop on the same frames.

    python benchmarks/dataset_writing.py [--episodes 2] [--repeats 3] [--ways write convert generate] [--workers 1]

Episodes are recorded once, with images. Three ways to write a dataset are timed, each in turns with LeRobot's
loop (``create``, ``add_frame`` per frame, ``save_episode``, ``finalize``; its default encoder):

- ``write``: staging and assembly of demonstrations in memory;
- ``convert``: an HDF5 file in the published layout, with proprioception and checks; the loop reads the same file;
- ``generate``: expert, simulator and renderer too; the time of recording the same episodes is added to the loop's.
  ``--workers 2`` includes the start of the processes, so give more episodes.

Prints one JSON line: ratios of the best times (above 1: faster than LeRobot's loop), and for both sides image quality
(PSNR of decoded frames, dB) and the video bytes per frame.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import av
import numpy as np

from lerobot_memobench.constants import CAMERAS, CONTROL_HZ, DEMONSTRATION_SEED
from lerobot_memobench.datasets.convert import convert
from lerobot_memobench.datasets.demonstration import Demonstration, labels
from lerobot_memobench.datasets.generate import generate
from lerobot_memobench.datasets.hdf5 import PublishedFile
from lerobot_memobench.datasets.layout import (
    EPISODE_INFO,
    EXECUTED_ACTION,
    PRIVILEGED,
    dataset_features,
    image_key,
)
from lerobot_memobench.datasets.write import write_dataset
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.libero_layout import write_published
from tests.support.short_demonstrations import record_demonstration

TASK = "turn_on_the_stove_and_turn_it_off"
WAYS = ("write", "convert", "generate")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--workers", type=int, default=1, help="processes that generate")
    args = parser.parse_args()
    import lerobot.datasets  # noqa: F401  (do not time the import)

    task = get_task(TASK)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record_demonstration(task, DEMONSTRATION_SEED, images=True)  # compiles the scene and opens the renderer
        started = time.perf_counter()
        demos = [record_demonstration(task, DEMONSTRATION_SEED + i, images=True) for i in range(args.episodes)]
        recording = time.perf_counter() - started
        source = write_published(folder / "task.hdf5", demos)

        def loop_from_file(out: Path) -> None:
            with PublishedFile(source) as file:
                plain_loop(((demo, file.images(f"demo_{i}")) for i, demo in enumerate(demos)), out)

        ways: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any], float]] = {
            "write": (
                lambda out: write_dataset(demos, out),
                lambda out: plain_loop(((demo, frames(demo)) for demo in demos), out),
                0.0,
            ),
            "convert": (lambda out: convert(source, out), loop_from_file, 0.0),
            "generate": (
                lambda out: generate([task], args.episodes, out, workers=args.workers),
                lambda out: plain_loop(((demo, frames(demo)) for demo in demos), out),
                recording,
            ),
        }
        result: dict[str, Any] = {"benchmark": "dataset_writing", "frames": sum(map(len, demos))}
        for way in args.ways:
            ours, theirs, added = ways[way]
            best = {"ours": np.inf, "lerobot": np.inf}
            for _ in range(args.repeats):
                for side, run in (("ours", ours), ("lerobot", theirs)):
                    shutil.rmtree(folder / side, ignore_errors=True)
                    started = time.perf_counter()
                    run(folder / side)
                    best[side] = min(best[side], time.perf_counter() - started)
            best["lerobot"] += added
            result[way] = {"ratio": round(best["lerobot"] / best["ours"], 2)}
            result[way] |= {f"{side}_s": round(seconds, 3) for side, seconds in best.items()}
        for side in ("ours", "lerobot"):
            result[side] = quality(folder / side, demos)
        result["ratio"] = min(result[way]["ratio"] for way in args.ways)
    print(json.dumps(result))


def frames(demo: Demonstration) -> Iterator[dict[str, np.ndarray]]:
    """Yield both cameras' frames."""
    assert demo.images is not None
    for t in range(len(demo)):
        yield {camera: demo.images[camera][t] for camera in CAMERAS}


def plain_loop(episodes: Iterable[tuple[Demonstration, Iterable[dict[str, np.ndarray]]]], out: Path) -> None:
    """Write images, state, action and labels with LeRobot's recording loop, which writes no language rows."""
    from lerobot.datasets import LeRobotDataset

    omitted = ("language_persistent", EPISODE_INFO, EXECUTED_ACTION, PRIVILEGED)
    features = {key: value for key, value in dataset_features((256, 256)).items() if key not in omitted}
    dataset = LeRobotDataset.create("local/plain", fps=CONTROL_HZ, features=features, root=out, use_videos=True)
    for demo, images_of_steps in episodes:
        columns = {"observation.state": demo.proprio, "action": demo.actions, **labels(demo)}
        for t, images in enumerate(images_of_steps):
            frame: dict[str, Any] = {image_key(camera): image for camera, image in images.items()}
            for key, column in columns.items():
                value = column[t]
                frame[key] = value if isinstance(value, str) or np.ndim(value) else np.array([value])
            dataset.add_frame(frame | {"task": demo.task.language})
        dataset.save_episode()
    dataset.finalize()


def quality(folder: Path, demos: list[Demonstration]) -> dict[str, Any]:
    """Return PSNR per camera, dB, and video bytes per frame, both cameras together."""
    result: dict[str, Any] = {}
    for camera in CAMERAS:
        rendered = np.concatenate([(demo.images or {})[camera] for demo in demos])
        errors = []
        for path in sorted((folder / "videos" / image_key(camera)).rglob("*.mp4")):
            with av.open(str(path)) as container:
                for image in container.decode(video=0):
                    decoded = image.to_ndarray(format="rgb24").astype(np.float32)
                    errors.append(float(((decoded - rendered[len(errors)]) ** 2).mean()))
        assert len(errors) == len(rendered), (len(errors), len(rendered))
        result[f"psnr_{camera}"] = round(10 * np.log10(255**2 / float(np.mean(errors))), 2)
    size = sum(path.stat().st_size for path in (folder / "videos").rglob("*.mp4"))
    return result | {"video_bytes_per_frame": round(size / sum(map(len, demos)))}


if __name__ == "__main__":
    main()
