"""Assemble a LeRobotDataset v3.0 from finished episodes.

It is built in the hidden folder ``.staging`` of its destination and moved up, ``meta`` last: without
``meta/info.json`` a folder is not a dataset.

:func:`assemble` takes episodes that workers have staged, already encoded; :func:`write_dataset` stages demonstrations
that are in memory first. LeRobot's own metadata writer and feature schema are used; its frame-by-frame recording loop
is not, because it writes every image as PNG first, copies a growing video again for every episode, and drops language
rows, which a second pass has to add.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import CLOCK, CONTROL_HZ
from lerobot_memobench.datasets.card import write_card
from lerobot_memobench.datasets.demonstration import HELD_COLUMN, Demonstration
from lerobot_memobench.datasets.layout import (
    DEFAULT_REPO_ID,
    EPISODE_INFO,
    EXECUTED_ACTION,
    LANGUAGE,
    MANIFEST_FILE,
    STAGING,
    TOP_LEVEL,
    dataset_features,
    dataset_files,
    image_key,
    objects_column,
)
from lerobot_memobench.datasets.stage import (
    TEMPORARY,
    StagedEpisode,
    check_destination,
    stage_demonstration,
)
from lerobot_memobench.datasets.video import QUANTILES, Stats, join_videos, video_info
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash, files_below, flush_to_disk, write_file
from lerobot_memobench.sim.convention import UPRIGHT

if TYPE_CHECKING:
    import pyarrow as pa
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

ROBOT_TYPE = "panda"
STATES_PATH = "states/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PER_STATES_FILE = 100
BLOCK = 16  # columns per pass of statistics: a float64 copy of all columns of thousands of episodes takes gigabytes


def write_dataset(
    demonstrations: Iterable[Demonstration],
    out: Path | str,
    *,
    repo_id: str = DEFAULT_REPO_ID,
    convention: str = UPRIGHT,
) -> Path:
    """Write demonstrations, in their order, as a dataset in ``out`` (absent or empty); one is in memory at a time.

    Either all of them have images or none; ``convention`` is that of the images.
    """
    out = Path(out)
    check_destination(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as staging:
        numbered = enumerate(demonstrations)
        staged = [stage_demonstration(demo, Path(staging) / f"{k:06d}", convention) for k, demo in numbered]
        assemble(staged, out, repo_id=repo_id)
    shutil.rmtree(out / STAGING)
    return out


def assemble(
    episodes: Sequence[StagedEpisode],
    out: Path | str,
    *,
    repo_id: str = DEFAULT_REPO_ID,
    made_by: str = "",
    manifest: dict[str, Any] | None = None,
    left_out: Sequence[str] = (),
) -> Path:
    """Build the dataset of the staged ``episodes`` in ``out``; failed ones are listed, but not written.

    Deterministic: equal episodes give equal files.

    ``made_by`` is a sentence for the card, ``left_out`` its reasons why further episodes are missing; ``manifest`` is
    further content of manifest.json.
    """
    out = Path(out)
    written = [episode for episode in episodes if episode.failure is None]
    if len({tuple(episode.image_stats) for episode in written}) > 1:
        raise MemobenchError(
            f"some episodes for {out} have images and some have none, or others; record all of them with equal settings"
        )
    build = out / STAGING / f"{TEMPORARY}dataset"
    shutil.rmtree(build, ignore_errors=True)
    versions = (manifest or {}).get("request", {}).get("versions")
    features = _write_lerobot(written, build, repo_id, versions)  # makes the folder
    _write_manifest(episodes, manifest or {}, build)
    failed = [episode for episode in episodes if episode.failure is not None]
    described = [(episode.record(), episode.length) for episode in written]
    write_card(build, described, failed, features, repo_id=repo_id, made_by=made_by, left_out=left_out)
    _move(build, out)
    return out


def _write_lerobot(
    written: Sequence[StagedEpisode], build: Path, repo_id: str, versions: dict[str, str] | None
) -> dict[str, dict[str, Any]]:
    from lerobot.datasets.compute_stats import aggregate_stats
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.io_utils import write_stats

    cameras, image_size = written[0].image_stats, None
    if cameras:
        video = video_info(written[0].video(next(iter(cameras))))
        image_size = (video["video.height"], video["video.width"])
    meta = LeRobotDatasetMetadata.create(
        repo_id=repo_id,
        fps=CONTROL_HZ,
        features=dataset_features(image_size, cameras),
        root=build,
        robot_type=ROBOT_TYPE,
        use_videos=bool(cameras),
        metadata_buffer_size=len(written) + 1,  # one table: types of its columns come from all episodes
    )
    numbers = _write_frames(meta, written, versions)
    of_images = aggregate_stats([episode.camera_stats() for episode in written]) if cameras else {}
    # LeRobot's come in the order of a set, another one in each process.
    meta.stats = numbers | {key: of_images[key] for key in map(image_key, cameras)}
    write_stats(meta.stats, meta.root)
    meta.finalize()
    return dict(meta.features)


def _write_manifest(episodes: Sequence[StagedEpisode], extra: dict[str, Any], build: Path) -> None:
    keys = ("task_name", "seed", "referent", "variant", "success", "frames", "scene_hash", "digest")
    rows, indices = [], iter(range(len(episodes)))
    for episode in episodes:
        row = {key: episode.info.get(key) for key in keys}
        row |= {key: episode.info[key] for key in ("world", "stand_ins") if key in episode.info}
        index = next(indices) if episode.failure is None else None
        rows.append(row | {"episode_index": index, "failure": episode.failure})
    files = {
        name: {"bytes": (build / name).stat().st_size, "sha256": file_hash(build / name)}
        for name in dataset_files(build)
    }
    write_file(build / MANIFEST_FILE, json.dumps(extra | {"episodes": rows, "files": files}, indent=1), durable=True)


def _move(build: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flush_to_disk(*files_below(build))  # `meta` must not arrive before the files that it names
    for name in TOP_LEVEL:
        target = out / name
        if target.is_dir():
            shutil.rmtree(target)  # of an interrupted move: `meta` is not there yet
        if (build / name).exists():
            os.replace(build / name, target)  # `meta` last: with it the folder is a dataset
    flush_to_disk(out)
    build.rmdir()


# --- frames, states and metadata ---


def _write_frames(
    meta: LeRobotDatasetMetadata, episodes: Sequence[StagedEpisode], versions: dict[str, str] | None
) -> dict[str, Stats]:
    """Write data/, states/, videos/ and meta/; return exact statistics of numbers."""
    data, states = ParquetFiles(meta.root, meta.data_path), ParquetFiles(meta.root, STATES_PATH)
    numbers: dict[str, list[NDArray]] = {}
    start = 0
    for number, (episode, videos) in enumerate(zip(episodes, _write_videos(meta, episodes), strict=True)):
        if number and data.path.stat().st_size >= meta.data_files_size_in_mb * 1024**2:
            data.next(meta.chunks_size)
        if number and number % EPISODES_PER_STATES_FILE == 0:
            states.next(meta.chunks_size)
        task, length = str(episode.info["language"]), episode.length
        meta.save_episode_tasks([task])
        arrays, record = episode.arrays(), episode.record(versions)
        numbering = {
            "timestamp": (np.arange(length) / CONTROL_HZ).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": start + np.arange(length),
            "task_index": np.full(length, meta.get_task_index(task)),
        }
        info = np.full(length, "", dtype=object)
        info[0] = record.model_dump_json(exclude_none=True)
        columns = {
            "observation.state": arrays["proprio"],
            "action": arrays["actions"],
            EXECUTED_ACTION: arrays.get("executed", arrays["actions"]),
            **numbering,
            EPISODE_INFO: info,
            objects_column(meta.features): arrays["objects"],
            **{key: arrays[key] for key in meta.features if key in arrays},
        }
        data.write(_frames_table(columns, episode, meta.features))
        states.write(_states_table(arrays["states"], number))
        # LeRobot does not normalise columns without statistics: phase and step reach a policy as in a rollout.
        numeric = {key: value for key, value in columns.items() if value.dtype.kind in "bif" and key not in CLOCK}
        # Held frames do not count: nothing is learned from them, and they may be most frames.
        counted = {key: value[~arrays[HELD_COLUMN]] for key, value in numeric.items()}
        for key, value in counted.items():
            numbers.setdefault(key, []).append(value)
        stats = {key: numeric_stats(value) for key, value in counted.items()} | episode.camera_stats()
        files = {
            "data/chunk_index": data.chunk,
            "data/file_index": data.file,
            "dataset_from_index": start,
            "dataset_to_index": start + length,
        }
        meta.save_episode(number, length, [task], stats, files | videos | record.in_meta())
        start += length
    data.close()
    states.close()
    return {key: numeric_stats(np.concatenate(values)) for key, values in numbers.items()}


def numeric_stats(values: NDArray) -> Stats:
    """Return exact statistics of (T,) or (T, n) numbers over T: each (n,) (n = 1 for (T,)), and ``count`` (1,).

    LeRobot averages the quantiles of episodes, which is not a quantile of the dataset. pi0.5 normalises by q01 and q99,
    so they are computed from all frames.
    """
    flat, blocks = values.reshape(len(values), -1), []
    for start in range(0, flat.shape[1], BLOCK):
        block = flat[:, start : start + BLOCK].astype(np.float64)
        stats = {"min": block.min(0), "max": block.max(0), "mean": block.mean(0), "std": block.std(0)}
        quantiles = np.quantile(block, QUANTILES, axis=0, overwrite_input=True)
        blocks.append(stats | {f"q{int(q * 100):02d}": row for q, row in zip(QUANTILES, quantiles, strict=True)})
    joined = {name: np.concatenate([stats[name] for stats in blocks]) for name in blocks[0]}
    return joined | {"count": np.array([len(values)])}


# --- tables and their files ---


def _frames_table(columns: dict[str, NDArray], episode: StagedEpisode, features: dict[str, Any]) -> pa.Table:
    import pyarrow as pa
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    typed = get_hf_features_from_features(features)
    arrays = [
        _language(episode, typed[LANGUAGE]) if field.name == LANGUAGE else _array(columns[field.name], field.type)
        for field in typed.arrow_schema
    ]
    return pa.Table.from_arrays(arrays, schema=typed.arrow_schema)


def _array(values: NDArray, kind: pa.DataType) -> pa.Array:
    import pyarrow as pa

    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), type=kind.value_type), type=kind)
    return pa.array(values.tolist() if values.dtype.kind in "UO" else values, type=kind)


def _language(episode: StagedEpisode, feature: Any) -> pa.Array:
    import datasets

    # The rows are equal at every frame: built once and repeated by index.
    once = datasets.Dataset.from_dict(
        {LANGUAGE: [episode.language_persistent]}, features=datasets.Features({LANGUAGE: feature})
    ).with_format("arrow")[:]
    return once.column(LANGUAGE).combine_chunks().take(np.zeros(episode.length, dtype=np.int64))


def _states_table(states: NDArray[np.float64], number: int) -> pa.Table:
    import pyarrow as pa

    numbers = {"episode_index": np.full(len(states), number), "frame_index": np.arange(len(states))}
    return pa.table(numbers | {"state": pa.array(list(states))})


class ParquetFiles:
    """Parquet files in LeRobot's chunk and file numbering; each write is a row group."""

    def __init__(self, build: Path, template: str) -> None:
        self.build, self.template = build, template
        self.chunk, self.file = 0, 0
        self._writer: Any = None

    @property
    def path(self) -> Path:
        """The current file."""
        return self.build / self.template.format(chunk_index=self.chunk, file_index=self.file)

    def write(self, table: pa.Table) -> None:
        """Append a row group to the current file."""
        import pyarrow.parquet as pq

        if self._writer is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(self.path, table.schema, compression="snappy", use_dictionary=True)
        self._writer.write_table(table)

    def next(self, chunks_size: int) -> None:
        """Begin the next file."""
        from lerobot.datasets.utils import update_chunk_file_indices

        self.close()
        self.chunk, self.file = update_chunk_file_indices(self.chunk, self.file, chunks_size)

    def close(self) -> None:
        """End the current file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


# --- videos ---


def _write_videos(meta: LeRobotDatasetMetadata, episodes: Sequence[StagedEpisode]) -> list[dict[str, Any]]:
    # Joins the episodes' videos; returns each episode's columns of meta/episodes.
    from lerobot.datasets.io_utils import write_info
    from lerobot.datasets.utils import update_chunk_file_indices

    columns: list[dict[str, Any]] = [{} for _ in episodes]
    limit = meta.video_files_size_in_mb * 1024**2
    for camera in episodes[0].image_stats:
        key, chunk, file = image_key(camera), 0, 0
        groups: list[list[int]] = []  # consecutive episodes of at most `limit` bytes; a larger one forms its own group
        total = 0
        for number, episode in enumerate(episodes):
            size = episode.video(camera).stat().st_size
            if not groups or total + size > limit:
                groups.append([])
                total = 0
            groups[-1].append(number)
            total += size
        for group in groups:
            path = meta.root / str(meta.video_path).format(video_key=key, chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            join_videos([(episodes[number].video(camera), episodes[number].length) for number in group], path)
            frames = 0
            for number in group:
                start, frames = frames, frames + episodes[number].length
                columns[number] |= {
                    f"videos/{key}/chunk_index": chunk,
                    f"videos/{key}/file_index": file,
                    f"videos/{key}/from_timestamp": start / CONTROL_HZ,
                    f"videos/{key}/to_timestamp": frames / CONTROL_HZ,
                }
            chunk, file = update_chunk_file_indices(chunk, file, meta.chunks_size)
            meta.features[key].setdefault("info", video_info(path))
        write_info(meta.info, meta.root)
    return columns
