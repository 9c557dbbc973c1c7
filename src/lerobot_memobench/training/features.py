"""Cache the outputs of frozen encoders for every frame of a dataset: one safetensors file per episode.

A memory reads up to 32 earlier frames per sample, and a frozen encoder's tokens are needed at every update. They are
computed once, in ``feature_cache/<name>/`` in the dataset's folder; the name ends with a hash of frames, encoder
weights, camera and stride. A file that exists is complete. With several processes, each encodes a part of the episodes.
The features of a scene at rest are those of its first frame, although a decoded video changes a little.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from lerobot_memobench.datasets.episodes import read_info
from lerobot_memobench.datasets.frames import read_frame_table, read_recorded, repeated
from lerobot_memobench.datasets.video import FrameReader, frame_reader
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import explaining_disk_errors, files_below, free_bytes, in_words, write_file
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.perception.detector import load_detector, load_visual_encoder
from lerobot_memobench.perception.visual_encoder import GRID, POOLED, WIDTH, VisualEncoder
from lerobot_memobench.policies.checkpoint import undamaged_tensors
from lerobot_memobench.policies.memobench_mem.checkpoints import load_exactly, read_weights
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    THUMBNAIL,
    THUMBNAILS,
    VISION_SEED,
    ImageTowerEncoder,
    VisualTokenEncoder,
    seed_parameters,
    thumbnails,
)
from lerobot_memobench.policies.memobench_mem.losses import rank_of_world
from lerobot_memobench.policies.memobench_mem.memory import NONE
from lerobot_memobench.policies.memobench_mem.network import make_backbone
from lerobot_memobench.policies.memobench_mem.objects import VIEWS, ObjectsFromImages
from lerobot_memobench.sim.convention import MIRRORED, UPRIGHT, convention_of
from lerobot_memobench.sim.object_layout import SIZE

logger = logging.getLogger(__name__)

FOLDER = "feature_cache"
TOKENS = "tokens"
"""Name of the tensor (n, P, D) in each file."""
MOST_THREADS = 8
_SAMPLE = 1 << 16
"""Bytes of a video that are hashed at each of its start, middle and end."""
_VISION_PREFIX = "paligemma_with_expert.paligemma.model."


class Features(NamedTuple):
    """An encoder of frames."""

    key: str  # identity: weights and input size
    size: int  # numbers of a frame
    make: Callable[..., Tensor]  # maps images (N, 3, H, W) in [0, 1], or other input, to features (N, P, D) bfloat16


class EpisodeFeatures:
    """Stored features of every ``stride``-th frame of each episode, read through memory maps."""

    def __init__(self, folder: Path, episodes: np.ndarray, stride: int) -> None:
        self.folder, self._episodes, self._stride = folder, episodes, stride
        self._opened: dict[int, Tensor] = {}

    def episode(self, number: int) -> Tensor:
        """Return the features (n, P, D) bfloat16 of an episode's stored frames."""
        if number not in self._opened:
            path = episode_file(self.folder, number)
            with undamaged_tensors(path), safe_open(path, framework="pt") as file:
                self._opened[number] = file.get_tensor(TOKENS)
        return self._opened[number]

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Return the features (n, P, D) of an episode's slots; slot k is frame k * stride."""
        return self.episode(episode)[torch.as_tensor(slots, dtype=torch.long)]

    def of_frames(self, indices: Sequence[int]) -> Tensor:
        """Return the features (n, P, D) of stored frames by their global indices."""
        numbers = np.searchsorted(self._episodes, indices, "right") - 1
        slots = (np.asarray(indices) - self._episodes[numbers]) // self._stride
        return torch.stack(
            [self.episode(number)[slot] for number, slot in zip(numbers.tolist(), slots.tolist(), strict=True)]
        )

    def all_frames(self) -> Tensor:
        """Return the features of all stored frames, in main memory."""
        return torch.cat([self.episode(number) for number in range(len(self._episodes) - 1)])


def episode_file(folder: Path, number: int) -> Path:
    """Return the file of an episode's features."""
    return folder / f"episode_{number:06d}.safetensors"


def features_folder(root: Path, prefix: str, features: Features, camera: str, stride: int) -> Path:
    """Return the folder of a dataset's features: a readable prefix and a hash of all inputs."""
    parts = (dataset_fingerprint(root, camera), features.key, camera, str(stride), "rest once")
    return root / FOLDER / f"{prefix}-{hashlib.blake2b(chr(10).join(parts).encode(), digest_size=8).hexdigest()}"


def make_features(
    root: Path,
    prefix: str,
    features: Features,
    *,
    camera: str,
    stride: int = 1,
    read: FrameReader | None = None,
    batch_size: int = 64,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    notify: Callable[[str], None] = logger.info,
) -> EpisodeFeatures:
    """Compute missing features, and open those of all episodes.

    Args:
        camera: image column to encode. stride: every ``stride``-th frame is stored.
        read: source of frames; by default the camera's videos. batch_size: frames per pass of the encoder.
        workers: threads that decode videos ahead of the encoder; by default one per core, up to 8.
        progress: called with the numbers of complete and of all episodes.
        notify: called with the folder and its size before anything is encoded.
    """
    folder, table = features_folder(root, prefix, features, camera, stride), read_frame_table(root)
    complete = EpisodeFeatures(folder, table.episodes, stride)
    progress = progress or functools.partial(logger.info, "feature cache: %d of %d episodes")
    counts = -(-np.diff(table.episodes) // stride)
    missing = [number for number in range(table.num_episodes) if not episode_file(folder, number).is_file()]
    progress(table.num_episodes - len(missing), table.num_episodes)
    if not missing:
        return complete
    read = read or frame_reader(root, camera)
    needed, free = int(counts[missing].sum()) * features.size * torch.bfloat16.itemsize, free_bytes(folder)
    notify(f"The feature cache {folder} needs {in_words(needed)}; {in_words(free)} are free.")
    if needed > free:
        raise MemobenchError(
            f"the feature cache {folder} needs {in_words(needed)} and its disk has {in_words(free)} left; free space, "
            f"replace {root / FOLDER} by a link to a folder on another disk, or store fewer frames "
            "(policy.memory_stride=)"
        )
    rank, world = rank_of_world()
    same = repeated(root)
    with explaining_disk_errors(folder), ThreadPoolExecutor(workers or min(cores(), MOST_THREADS)) as pool:
        folder.mkdir(parents=True, exist_ok=True)
        ignored, line = root / ".gitignore", f"/{FOLDER}/"  # which uploads to the hub follow
        lines = ignored.read_text(encoding="utf-8").splitlines() if ignored.is_file() else []
        if line not in lines:
            write_file(ignored, "\n".join([*lines, line]) + "\n")
        for number in [number for number in missing if number % world == rank]:
            first, end = table.episodes[number : number + 2]
            _, slots, image = np.unique(np.cumsum(~same[first:end])[::stride], return_index=True, return_inverse=True)
            frames = (slots * stride).tolist()
            parts = [frames[start : start + batch_size] for start in range(0, len(frames), batch_size)]
            images = pool.map(functools.partial(read, number), parts)
            encoded = torch.cat([features.make(part).to("cpu", torch.bfloat16) for part in images])[image]
            write_file(episode_file(folder, number), save({TOKENS: encoded.contiguous()}))
            progress(sum(episode_file(folder, k).is_file() for k in range(table.num_episodes)), table.num_episodes)
    while not all(episode_file(folder, number).is_file() for number in missing):  # other processes encode these
        time.sleep(1)
    return complete


def dataset_fingerprint(root: Path, camera: str) -> str:
    """Hash the frame tables in full, and the camera's videos by their size and three samples each."""
    digest = hashlib.blake2b(digest_size=12)
    for path in files_below(root / "data", ".parquet"):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    for path in files_below(root / "videos" / camera, ".mp4"):
        size = path.stat().st_size
        digest.update(f"{path.relative_to(root)}{size}".encode())
        with path.open("rb") as file:
            for start in {0, max(0, size // 2), max(0, size - _SAMPLE)}:
                file.seek(start)
                digest.update(file.read(_SAMPLE))
    return digest.hexdigest()


def cameras_of(features: Mapping[str, Any]) -> list[str]:
    """Return the cameras among a dataset's features, in its order."""
    return [name for name, feature in features.items() if feature.get("dtype") in ("video", "image")]


# -- features of each kind of policy -----------------------------------------------------------------------------------


def visual_features(
    root: Path,
    config: MemobenchMemConfig,
    encoder: ImageTowerEncoder | VisualTokenEncoder,
    in_data: Mapping[str, str],
    **how: Any,
) -> tuple[EpisodeFeatures | None, dict[str, EpisodeFeatures]]:
    """Make the features of the memory, None without one, and a visual encoder's tokens of present images.

    ``in_data``: the policy's name of a camera -> the dataset's, where they differ. The present ones have the policy's.
    """
    cameras, remembered, stride = cameras_of(read_info(root)["features"]), encoder.memory_input, config.memory_stride
    present: dict[str, EpisodeFeatures] = {}
    if isinstance(encoder, VisualTokenEncoder):
        whole = Features(encoder.present_key, GRID**2 * WIDTH, encoder.encode)
        for name in dict.fromkeys(encoder.cameras or [*cameras, remembered]):
            camera = in_data.get(name, name)
            present[name] = make_features(root, f"{config.size}-present", whole, camera=camera, **how)
    if config.memory == NONE:
        return None, present
    kind: str = config.size
    read: FrameReader | None = None
    if config.remembers_thumbnails:
        kind, features = "thumbnails", Features(THUMBNAILS, THUMBNAIL**2, thumbnails)
    elif isinstance(encoder, VisualTokenEncoder):
        # From the present tokens, so that no video is decoded twice.
        features, read = Features(encoder.key, POOLED**2 * WIDTH, encoder.pooled), present[remembered].tokens
    else:
        features = Features(encoder.key, encoder.tokens_per_frame * encoder.dim, encoder)
    camera = in_data.get(remembered, remembered) or next(iter(cameras), "")
    name = f"{kind}-stride{stride}"
    return make_features(root, name, features, camera=camera, stride=stride, read=read, **how), present


def detected_slots(
    root: Path, detect: ObjectsFromImages, cameras: dict[str, str], state: str, **how: Any
) -> EpisodeFeatures:
    """Make a detector's object slots for every frame.

    Each number is stored as two bfloat16 numbers, its rounded value and the rest; one alone has errors of 4 mm.
    ``cameras``: the policy's name of each camera -> the dataset's; ``state``: the dataset's name of the state.
    """
    if convention_of(read_info(root)["features"]) == MIRRORED:
        raise MemobenchError(f"{root} has images of convention={MIRRORED}, and a detector reads {UPRIGHT} ones")
    readers = {name: frame_reader(root, of) for name, of in cameras.items()}
    recorded = functools.cache(lambda: read_recorded(root, [state]))  # not needed if the features are complete

    def read(episode: int, numbers: list[int]) -> tuple[dict[str, Tensor], Tensor]:
        columns, table = recorded()
        states = columns[state][[int(table.episodes[episode]) + number for number in numbers]]
        return {name: reader(episode, numbers) for name, reader in readers.items()}, states

    def make(observed: tuple[dict[str, Tensor], Tensor]) -> Tensor:
        slots = detect(*observed)
        rounded = slots.to(torch.bfloat16)
        return torch.stack([rounded, (slots - rounded.float()).to(torch.bfloat16)], dim=1)

    features = Features(detect.key, 2 * SIZE, make)
    return make_features(root, "objects", features, camera=next(iter(cameras.values())), read=read, **how)


# -- encoders without the rest of a policy -----------------------------------------------------------------------------


def load_image_tower(config: MemobenchMemConfig, weights: str | Path | None = None) -> ImageTowerEncoder:
    """Load the frozen image tower of ``config``'s size, without the rest of the model.

    ``weights``: folder or repository of a pi0.5 or memobench_mem checkpoint; None: ``config.base_weights``, or else
    random weights of a fixed seed.
    """
    with torch.device("meta"):  # the language model's weights are never allocated
        model = make_backbone(config).paligemma.model
    towers = type(model.vision_tower)(model.config.vision_config), type(model.multi_modal_projector)(model.config)
    tower, projector = (part.to(torch.float32).eval().requires_grad_(False) for part in towers)
    for part, name in ((tower, "vision_tower."), (projector, "multi_modal_projector.")):
        source = weights or config.base_weights
        if source is None:
            seed_parameters(part, VISION_SEED)
        else:
            load_exactly(part, read_weights(source, _VISION_PREFIX + name), source, optional=set())
        part.to(config.device)
    return ImageTowerEncoder(tower, projector, config.image_size, config.memory_camera or "")


def load_token_encoder(config: MemobenchMemConfig, weights: str | Path | None = None) -> VisualTokenEncoder:
    """Load ``config``'s visual encoder alone, as `load_image_tower`."""
    source = weights or config.base_weights
    if source is None:
        assert config.visual_encoder is not None  # the configuration has one
        tower = load_visual_encoder(config.visual_encoder)
    else:
        tower = VisualEncoder().fold().eval()
        load_exactly(tower, read_weights(source, _VISION_PREFIX + "vision_tower."), source, optional=set())
    width = config.dimensions.vlm.width
    return VisualTokenEncoder(tower.to(config.device), [*config.image_features], config.memory_camera or "", width)


def cache_dataset(root: Path, config: MemobenchMemConfig, *, weights: str | Path | None = None, **how: Any) -> Path:
    """Make or complete the features of a dataset for a policy; return their folder, with a visual encoder the memory's.

    ``weights`` is of `load_image_tower`, ``how`` of `make_features`. A policy that needs no cache is refused.
    """
    config.memory_camera = config.memory_camera or next(iter(cameras_of(read_info(root)["features"])), None)
    if config.detector is not None:
        detect = ObjectsFromImages(load_detector(config.detector))
        return detected_slots(root, detect, {name: name for name in VIEWS}, OBS_STATE, **how).folder
    if config.uses_objects:
        raise MemobenchError(
            "perception=objects needs no feature cache without a detector: training reads the dataset's columns; skip "
            "this command, or name a detector"
        )
    load = load_token_encoder if config.uses_visual_encoder else load_image_tower
    memory, present = visual_features(root, config, load(config, weights), {}, **how)
    return (memory or next(iter(present.values()))).folder
