"""Demonstrations as a LeRobotDataset v3.0.

Two ways in: :func:`write_dataset` takes demonstrations; :func:`assemble` takes episodes that workers have
staged, already encoded. Both give the same bytes for the same episodes. LeRobot's own metadata writer and
feature schema are used; its frame-by-frame recording loop is not, because it writes every image as PNG first
and copies a growing video again for every episode, and because it drops language rows, which a second pass
has to add. Here a table holds them from the start, so there is no state in which a dataset lacks a column.

The dataset is built in the hidden folder ``.staging`` of its destination and moved up, ``meta`` last: a
folder without ``meta/info.json`` is not a dataset to anybody.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.card import write_card
from lerobot_memobench.datasets.demonstration import (
    ACTION_DIM,
    CAMERAS,
    FPS,
    MAX_CHECKPOINTS,
    PROPRIO_DIM,
    Demonstration,
)
from lerobot_memobench.datasets.hdf5 import SUFFIX, write_task_file
from lerobot_memobench.datasets.staging import (
    HDF5,
    LEROBOT,
    TEMPORARY,
    StagedEpisode,
    clean_temporaries,
    flush_to_disk,
    stage_demonstration,
    write_json,
)
from lerobot_memobench.datasets.video import Stats, join_videos, numeric_stats, video_info
from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    import pyarrow as pa
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

DEFAULT_REPO_ID = "memobench/memobench"
ROBOT_TYPE = "panda"
STAGING = ".staging"
HDF5_FOLDER = "hdf5"
MANIFEST_FILE = "manifest.json"
STATES_PATH = "states/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PER_STATES_FILE = 100

PROPRIO_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right"]
ACTION_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "gripper"]

# Moved in this order; with `meta` the folder becomes a dataset, without it the manifest is the last.
TOP_LEVEL = (HDF5_FOLDER, "videos", "states", "data", "README.md", MANIFEST_FILE, "meta")


def image_key(camera: str) -> str:
    """Return the column name of a camera; the env's observations arrive at a policy under the same name."""
    return f"observation.images.{camera}"


def dataset_features(image_size: tuple[int, int] | None) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of the columns; ``image_size`` is (height, width), None without images."""

    def feature(dtype: str, shape: tuple[int, ...] = (1,), names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": shape, "names": names}

    features: dict[str, dict[str, Any]] = {}
    if image_size is not None:
        for camera in CAMERAS:
            features[image_key(camera)] = feature("video", (*image_size, 3), ["height", "width", "channels"])
    completed = [f"checkpoint_{k}" for k in range(MAX_CHECKPOINTS)]
    return features | {
        "observation.state": feature("float32", (PROPRIO_DIM,), PROPRIO_NAMES),
        "action": feature("float32", (ACTION_DIM,), ACTION_NAMES),
        "phase": feature("int64"),
        "checkpoint.index": feature("int64"),
        "checkpoint.operation": feature("int64"),
        "checkpoint.completed": feature("bool", (MAX_CHECKPOINTS,), completed),
        "checkpoint.event": feature("bool"),
        "simple_subgoal": feature("string"),
        "grounded_subgoal": feature("string"),
        "coarse_subgoal": feature("string"),
        "memory": feature("string"),
        "language_persistent": feature("language"),
    }


def write_dataset(
    demonstrations: Iterable[Demonstration],
    out: Path | str,
    *,
    repo_id: str = DEFAULT_REPO_ID,
    made_by: str = "",
) -> Path:
    """Write demonstrations, in their order, as a dataset in ``out`` (absent or empty); one is in memory at a
    time.

    All have images, or none has. ``made_by`` is a sentence for the card.
    """
    out = Path(out)
    check_destination(out)
    staging = out / STAGING
    shutil.rmtree(staging, ignore_errors=True)
    try:
        staged = [
            stage_demonstration(demo, staging / "episodes" / f"{number:06d}")
            for number, demo in enumerate(demonstrations)
        ]
        return assemble(staged, out, repo_id=repo_id, made_by=made_by)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if out.is_dir() and not any(out.iterdir()):
            out.rmdir()


def is_dataset(folder: Path) -> bool:
    """Whether ``folder`` holds a finished LeRobotDataset."""
    return (folder / "meta" / "info.json").is_file()


def check_destination(out: Path) -> None:
    """Raise unless ``out`` is absent, empty, or holds nothing but an unfinished run."""
    if is_dataset(out):
        raise MemobenchError(f"{out} already holds a finished dataset; name another folder or delete this one first")
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"{out} is a file, expected a folder to write a dataset to; name another path")
    # What an interrupted move left beside the staging folder will be replaced.
    strangers = [p.name for p in out.iterdir() if p.name != STAGING] if out.is_dir() else []
    if strangers and not ((out / STAGING).is_dir() and set(strangers) <= set(TOP_LEVEL)):
        raise MemobenchError(
            f"{out} holds {', '.join(sorted(strangers)[:3])}, no part of a dataset being made; name an empty folder"
        )


def assemble(
    episodes: Sequence[StagedEpisode],
    out: Path | str,
    *,
    formats: Collection[str] = (LEROBOT,),
    repo_id: str = DEFAULT_REPO_ID,
    made_by: str = "",
    manifest: dict[str, Any] | None = None,
    left_out: Sequence[str] = (),
) -> Path:
    """Build what ``formats`` says of the staged ``episodes`` in ``out``; failed ones are named, not written.

    Deterministic: the same episodes give the same files. ``manifest`` is added to manifest.json, ``left_out`` says
    on the card what else is missing and why.
    """
    out = Path(out)
    written = [episode for episode in episodes if episode.failure is None]
    if not written:
        raise MemobenchError(f"there is no successful demonstration to write to {out}; see the failures reported")
    if len({episode.has_images for episode in written}) > 1:
        raise MemobenchError(f"some episodes for {out} have images and some have none; make them all alike")
    for episode in written:
        episode.check()

    build = out / STAGING / f"{TEMPORARY}dataset"
    shutil.rmtree(build, ignore_errors=True)
    build.mkdir(parents=True)
    features = _write_lerobot(written, build, repo_id) if LEROBOT in formats else {}
    if HDF5 in formats:
        _write_hdf5(written, build / HDF5_FOLDER)
    _write_manifest(episodes, manifest or {}, build)
    if LEROBOT in formats:
        write_card(build, episodes, features, repo_id=repo_id, made_by=made_by, left_out=left_out)
    _move(build, out)
    return out


def _write_lerobot(written: Sequence[StagedEpisode], build: Path, repo_id: str) -> dict[str, dict[str, Any]]:
    """Write the LeRobotDataset of the episodes into ``build``; return its features."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    part = build.with_name(f"{build.name}-lerobot")  # LeRobot wants a folder that is not there yet
    shutil.rmtree(part, ignore_errors=True)
    meta = LeRobotDatasetMetadata.create(
        repo_id=repo_id,
        fps=FPS,
        features=dataset_features(_image_size(written[0])),
        root=part,
        robot_type=ROBOT_TYPE,
        use_videos=written[0].has_images,
        metadata_buffer_size=len(written) + 1,  # one table: types of its columns come from all episodes
    )
    places = _join_videos(meta, written, part)
    _write_frames(meta, written, places, part)
    meta.finalize()
    for path in part.iterdir():
        path.replace(build / path.name)
    part.rmdir()
    return dict(meta.features)


def _write_hdf5(written: Sequence[StagedEpisode], folder: Path) -> None:
    """Write a file per task, in the order in which the tasks first appear."""
    by_task: dict[str, list[StagedEpisode]] = {}
    for episode in written:
        by_task.setdefault(episode.info["task_name"], []).append(episode)
    for name, chosen in by_task.items():
        attributes = chosen[0].hdf5_attributes
        assert attributes is not None
        write_task_file(folder / f"{name}{SUFFIX}", attributes, [episode.hdf5 for episode in chosen])


def _image_size(episode: StagedEpisode) -> tuple[int, int] | None:
    if not episode.has_images:
        return None
    import av

    with av.open(str(episode.video(CAMERAS[0]))) as container:
        stream = container.streams.video[0]
        return stream.height, stream.width


# --- videos -------------------------------------------------------------------------------------------------


def _join_videos(meta: LeRobotDatasetMetadata, episodes: Sequence[StagedEpisode], build: Path) -> list[dict[str, Any]]:
    """Join the episodes' videos into files of LeRobot's size; return each episode's place in them."""
    from lerobot.datasets.io_utils import write_info
    from lerobot.datasets.utils import update_chunk_file_indices

    places: list[dict[str, Any]] = [{} for _ in episodes]
    limit = meta.video_files_size_in_mb * 1024**2
    for camera in CAMERAS if meta.video_keys else ():
        key, chunk, file = image_key(camera), 0, 0
        for group in _grouped([episode.video(camera).stat().st_size for episode in episodes], limit):
            assert meta.video_path is not None
            path = build / meta.video_path.format(video_key=key, chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            join_videos([(episodes[i].video(camera), int(episodes[i].info["frames"])) for i in group], path)
            frames = 0
            for i in group:
                start, frames = frames, frames + int(episodes[i].info["frames"])
                places[i] |= {
                    f"videos/{key}/chunk_index": chunk,
                    f"videos/{key}/file_index": file,
                    f"videos/{key}/from_timestamp": start / FPS,
                    f"videos/{key}/to_timestamp": frames / FPS,
                }
            chunk, file = update_chunk_file_indices(chunk, file, meta.chunks_size)
            meta.features[key].setdefault("info", video_info(path))
        write_info(meta.info, build)
    return places


def _grouped(sizes: Sequence[int], limit: float) -> list[list[int]]:
    """Consecutive positions whose sizes sum up to at most ``limit`` (a single larger one stands alone)."""
    groups: list[list[int]] = []
    total = 0
    for position, size in enumerate(sizes):
        if not groups or total + size > limit:
            groups.append([])
            total = 0
        groups[-1].append(position)
        total += size
    return groups


# --- frames -------------------------------------------------------------------------------------------------


def _write_frames(
    meta: LeRobotDatasetMetadata, episodes: Sequence[StagedEpisode], places: list[dict[str, Any]], build: Path
) -> None:
    """Write data/, states/ and the metadata; one row group per episode, files of LeRobot's size."""
    from lerobot.datasets.compute_stats import aggregate_stats
    from lerobot.datasets.io_utils import write_stats
    from lerobot.datasets.utils import update_chunk_file_indices

    data = _ParquetFiles(build, meta.data_path)
    states = _ParquetFiles(build, STATES_PATH)
    limit = meta.data_files_size_in_mb * 1024**2
    numeric: dict[str, list[NDArray]] = {}
    start = 0
    for number, episode in enumerate(episodes):
        arrays, length = episode.arrays(), int(episode.info["frames"])
        if data.size() >= limit:
            data.next(update_chunk_file_indices, meta.chunks_size)
        if number and number % EPISODES_PER_STATES_FILE == 0:
            states.next(update_chunk_file_indices, meta.chunks_size)
        task = str(episode.info["language"])
        meta.save_episode_tasks([task])
        task_index = meta.get_task_index(task)
        assert task_index is not None
        columns: dict[str, Any] = {
            "observation.state": arrays["proprio"],
            "action": arrays["actions"],
            "timestamp": np.float32(np.arange(length) / FPS),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": start + np.arange(length),
            "task_index": np.full(length, task_index),
        }
        columns |= {key: arrays[key] for key in meta.features if key in arrays}
        data.write(_table(columns, episode, meta))
        states.write(_states_table(arrays["states"], number))

        numbers = {key: value for key, value in columns.items() if value.dtype.kind in "bif"}
        for key, value in numbers.items():
            numeric.setdefault(key, []).append(value)
        stats: dict[str, Stats] = {key: numeric_stats(value) for key, value in numbers.items()}
        if episode.has_images:
            stats |= {image_key(camera): episode.image_stats(camera) for camera in CAMERAS}
        place = {
            "data/chunk_index": data.chunk,
            "data/file_index": data.file,
            "dataset_from_index": start,
            "dataset_to_index": start + length,
            **places[number],
        }
        meta.save_episode(number, length, [task], stats, place | _episode_columns(episode))
        start += length
    data.close()
    states.close()
    exact = {key: numeric_stats(np.concatenate(values)) for key, values in numeric.items()}
    images = [
        {image_key(camera): episode.image_stats(camera) for camera in CAMERAS}
        for episode in episodes
        if episode.has_images
    ]
    meta.stats = exact | (aggregate_stats(images) if images else {})
    write_stats(meta.stats, build)


def _episode_columns(episode: StagedEpisode) -> dict[str, Any]:
    """Return the project's own columns of meta/episodes."""
    info = episode.info
    plain = ("task_name", "memory_type", "family", "operations", "seed", "referent", "variant", "success")
    return {key: info[key] for key in plain} | {
        "exec_start_index": info["exec_start_index"],
        "key_frames": np.array(info["key_frames"], dtype=np.int64),
        "scene_hash": info["scene_hash"],
        "fixture_poses": json.dumps(info["fixture_poses"]),
        "digest": info["digest"],
    }


def _table(columns: dict[str, Any], episode: StagedEpisode, meta: LeRobotDatasetMetadata) -> pa.Table:
    """Return the frames as a table of exactly the type that LeRobot reads."""
    import pyarrow as pa
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    import datasets

    features = get_hf_features_from_features(meta.features)
    length = int(episode.info["frames"])
    # Built once and repeated by index: an episode's rows are the same on every frame.
    language = datasets.Dataset.from_dict(
        {"language_persistent": [episode.language_rows]},
        features=datasets.Features({"language_persistent": features["language_persistent"]}),
    ).with_format("arrow")[:]
    repeated = language.column("language_persistent").combine_chunks().take(np.zeros(length, dtype=np.int64))
    schema = features.arrow_schema
    arrays = []
    for field in schema:
        if field.name == "language_persistent":
            arrays.append(repeated)
            continue
        if field.name not in columns:
            raise MemobenchError(
                f"{episode.folder} was staged by an older version, without the column {field.name}; delete that folder "
                "and generate again to make this episode anew"
            )
        values = columns[field.name]
        if values.ndim == 2:
            flat = pa.array(values.ravel(), type=field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=field.type))
        else:
            arrays.append(pa.array(values.tolist() if values.dtype.kind == "U" else values, type=field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _states_table(states: NDArray[np.float64], number: int) -> pa.Table:
    """Simulator states beside the dataset, for replay and re-rendering; their width differs between tasks."""
    import pyarrow as pa

    length, width = states.shape
    offsets = pa.array(np.arange(0, (length + 1) * width, width, dtype=np.int32))
    return pa.table(
        {
            "episode_index": pa.array(np.full(length, number)),
            "frame_index": pa.array(np.arange(length)),
            "state": pa.ListArray.from_arrays(offsets, pa.array(states.ravel())),
        }
    )


class _ParquetFiles:
    """A sequence of parquet files in LeRobot's chunk and file numbering; each write is a row group."""

    def __init__(self, build: Path, template: str) -> None:
        self.build, self.template = build, template
        self.chunk, self.file = 0, 0
        self._writer: Any = None
        self._path: Path | None = None

    def write(self, table: pa.Table) -> None:
        import pyarrow.parquet as pq

        if self._writer is None:
            self._path = self.build / self.template.format(chunk_index=self.chunk, file_index=self.file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(self._path, table.schema, compression="snappy", use_dictionary=True)
        self._writer.write_table(table)

    def size(self) -> int:
        """Bytes in the current file so far."""
        return self._path.stat().st_size if self._writer is not None and self._path is not None else 0

    def next(self, advance: Any, chunks_size: int) -> None:
        self.close()
        self.chunk, self.file = advance(self.chunk, self.file, chunks_size)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None


# --- manifest and move --------------------------------------------------------------------------------------


def _write_manifest(episodes: Sequence[StagedEpisode], extra: dict[str, Any], build: Path) -> None:
    """Write the hashes of all episodes asked for; failed ones have a reason in place of an index."""
    keys = ("task_name", "seed", "referent", "variant", "success", "frames", "scene_hash", "digest")
    rows, index = [], 0
    for episode in episodes:
        row = {key: episode.info.get(key) for key in keys}
        row |= {"episode_index": None if episode.failure else index, "failure": episode.failure}
        index += episode.failure is None
        rows.append(row)
    write_json(extra | {"episodes": rows}, build / MANIFEST_FILE)


def _move(build: Path, out: Path) -> None:
    """Move the finished build into ``out``; only with the last move does ``out`` become a dataset."""
    out.mkdir(parents=True, exist_ok=True)
    flush_to_disk(path for path in build.rglob("*") if path.is_file())
    for name in TOP_LEVEL:
        target = out / name
        if target.is_dir():
            shutil.rmtree(target)  # of an interrupted move: `meta` is not there yet
        if (build / name).exists():
            os.replace(build / name, target)
    flush_to_disk([out])
    build.rmdir()
    clean_temporaries(out / STAGING)
