"""History for training samples: gathered from the feature cache, beside decoding the same frames from the videos.

    python benchmarks/history_loading.py [DATASET] [--size pi05] [--frames 1 8 32] [--samples 16] [--repeats 5]

The other side is what LeRobot does for delta timestamps: ``decode_video_frames`` of the sample's timestamps, here
those of exactly the frames that the memory would hold (delta timestamps themselves are fixed offsets and cannot say
that). It yields pixels; running the image tower over them, which the cache has behind it, is not counted. Without a
dataset two episodes are recorded first, 256x256 as generated ones are. The cache holds random tokens of the size's
width, because loading does not depend on their values: ``pi05`` reads 64 KiB per frame without a tower of 400 million
parameters.

Prints one JSON line: samples/s of both sides (CPU seconds) and their ratio per number of frames, how far the resident
memory rose while each side worked for the first time, and its upper bound for the cache: the tensors of a batch, and
the memory-mapped file, whose pages belong to the system, which takes them back when it needs them.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from turns import medians, peak, reset_peak, resident

from lerobot_memobench.datasets.frames import read_frame_table
from lerobot_memobench.datasets.lookup import FrameLookup
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import SIZES, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.frames import sample_frames
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep
from lerobot_memobench.training.features import Features, features_folder, make_features

CAMERA = "observation.images.image"
TASK = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
CACHE = "benchmark"


TOKENS_PER_FRAME = 16


def random_tokens(dim: int) -> Features:
    """Return features of the image tower's shape, whatever the images."""
    return Features(
        "random", TOKENS_PER_FRAME, dim, lambda images: torch.randn(len(images), TOKENS_PER_FRAME, dim).bfloat16()
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument("--size", choices=list(SIZES), default="pi05", help="whose token width is loaded")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--samples", type=int, default=16, help="samples per turn")
    parser.add_argument("--repeats", type=int, default=5)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        root = asked.dataset or record(Path(name) / "dataset")
        try:
            print(json.dumps(measure(root, asked.size, asked.frames, asked.samples, asked.repeats)))
        finally:
            features = random_tokens(SIZES[asked.size].vlm.width)
            shutil.rmtree(features_folder(root, CACHE, features, CAMERA, 1), ignore_errors=True)


def record(root: Path) -> Path:
    """Record two episodes and write them as a dataset."""
    from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
    from lerobot_memobench.datasets.recording import record_demonstration
    from lerobot_memobench.protocol import DEMONSTRATION_SEED
    from lerobot_memobench.tasks.catalogue import get_task

    task = get_task(TASK)
    return write_dataset((record_demonstration(task, DEMONSTRATION_SEED + i, images=True) for i in range(2)), root)


def measure(root: Path, size: str, numbers: list[int], samples: int, repeats: int) -> dict[str, object]:
    """Measure both sides on a dataset, for which a cache is made first."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.video_utils import decode_video_frames

    dim = SIZES[size].vlm.width
    features = make_features(root, CACHE, random_tokens(dim), camera=CAMERA)
    cache = FrameLookup(root, read_frame_table(root), remember=features.tokens)
    meta = LeRobotDatasetMetadata(root.name, root=root)
    rng = np.random.default_rng(0)
    length = int(np.diff(cache.episodes).max())
    # Frames late in their episodes: histories are as long and as spread as they get.
    indices = [int(i) for i in rng.choice(cache.num_frames, samples) if cache.locate(int(i))[1] >= 32]
    height, width, _ = meta.features[CAMERA]["shape"]
    result: dict[str, object] = {
        "benchmark": "history_loading",
        "size": size,
        "image": f"{height}x{width}",
        "longest_episode": length,
        "samples": len(indices),
        "token_files_mib": round(sum(file.stat().st_size for file in features.folder.iterdir()) / 2**20, 1),
    }

    def decode(frames: int) -> None:
        for index in indices:
            episode, frame = cache.locate(index)
            row = meta.episodes[episode]
            start = row[f"videos/{CAMERA}/from_timestamp"]
            times = [start + number / meta.fps for number in sample_frames(frame, frames)]
            decode_video_frames(root / meta.get_video_file_path(episode, CAMERA), times, tolerance_s=1e-4)

    for frames in numbers:
        settings = MemobenchMemConfig(device="cpu", memory_settings={"frames": frames})
        step = GatherMemoryProcessorStep(config=settings, lookup=cache)
        sides = {"cache": lambda step=step: step.gather(cache, indices), "lerobot": lambda n=frames: decode(n)}
        rise = {}
        for name, side in sides.items():
            before = resident()
            reset_peak()
            side()
            rise[name] = round((peak() - before) / 2**20, 1)
        seconds = medians(sides, repeats, warm_up=0)
        result[f"frames_{frames}"] = {
            "ratio": round(seconds["lerobot"] / seconds["cache"], 1),
            **{f"{name}_samples_per_s": round(len(indices) / seconds[name], 1) for name in sides},
            **{f"{name}_peak_rise_mib": rise[name] for name in sides},
            "batch_tensors_mib": round(len(indices) * frames * 16 * dim * 2 / 2**20, 1),
        }
    last = result[f"frames_{numbers[-1]}"]
    assert isinstance(last, dict)
    return result | {"ratio": last["ratio"]}


if __name__ == "__main__":
    main()
