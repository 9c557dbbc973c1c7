"""Put a dataset together from finished episodes.

It is built in the hidden folder ``.staging`` of its destination and moved up, ``meta`` last: a folder without
``meta/info.json`` is not a dataset to anybody.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.hdf5.layout import SUFFIX
from lerobot_memobench.datasets.hdf5.writing import write_task_file
from lerobot_memobench.datasets.lerobot_format.card import write_card
from lerobot_memobench.datasets.lerobot_format.frames import write_frames
from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    HDF5_FOLDER,
    MANIFEST_FILE,
    TOP_LEVEL,
    check_destination,
    dataset_features,
)
from lerobot_memobench.datasets.lerobot_format.video_files import write_videos
from lerobot_memobench.datasets.staging.episode import HDF5, LEROBOT, StagedEpisode
from lerobot_memobench.datasets.staging.folders import STAGING, TEMPORARY, clean_temporaries, flush_to_disk
from lerobot_memobench.datasets.staging.stage import stage_demonstration
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_name, write_file
from lerobot_memobench.protocol import CAMERAS, CONTROL_HZ

ROBOT_TYPE = "panda"


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
    versions = (manifest or {}).get("request", {}).get("versions")
    features = _write_lerobot(written, build, repo_id, versions) if LEROBOT in formats else {}
    if HDF5 in formats:
        _write_hdf5(written, build / HDF5_FOLDER)
    _write_manifest(episodes, manifest or {}, build)
    if LEROBOT in formats:
        write_card(build, episodes, features, repo_id=repo_id, made_by=made_by, left_out=left_out)
    _move(build, out)
    return out


def _write_lerobot(
    written: Sequence[StagedEpisode], build: Path, repo_id: str, versions: dict[str, str] | None
) -> dict[str, dict[str, Any]]:
    """Write the LeRobotDataset of the episodes into ``build``; return its features."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    part = build.with_name(f"{build.name}-lerobot")  # LeRobot wants a folder that is not there yet
    shutil.rmtree(part, ignore_errors=True)
    meta = LeRobotDatasetMetadata.create(
        repo_id=repo_id,
        fps=CONTROL_HZ,
        features=dataset_features(_image_size(written[0]), objects=all(episode.has_objects for episode in written)),
        root=part,
        robot_type=ROBOT_TYPE,
        use_videos=written[0].has_images,
        metadata_buffer_size=len(written) + 1,  # one table: types of its columns come from all episodes
    )
    write_frames(meta, written, write_videos(meta, written), versions)
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
        path = folder / f"{file_name(name, f'the task of {chosen[0].folder}')}{SUFFIX}"
        write_task_file(path, attributes, [episode.hdf5 for episode in chosen])


def _image_size(episode: StagedEpisode) -> tuple[int, int] | None:
    if not episode.has_images:
        return None
    import av

    with av.open(str(episode.video(next(iter(CAMERAS))))) as container:
        stream = container.streams.video[0]
        return stream.height, stream.width


def _write_manifest(episodes: Sequence[StagedEpisode], extra: dict[str, Any], build: Path) -> None:
    """Write the hashes of all episodes asked for; failed ones have a reason in place of an index."""
    keys = ("task_name", "seed", "referent", "variant", "success", "frames", "scene_hash", "digest")
    rows, index = [], 0
    for episode in episodes:
        row = {key: episode.info.get(key) for key in keys}
        row |= {"episode_index": None if episode.failure else index, "failure": episode.failure}
        index += episode.failure is None
        rows.append(row)
    write_file(build / MANIFEST_FILE, json.dumps(extra | {"episodes": rows}, indent=1), durable=True)


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
