"""Read a dataset of this package back: what it says of each episode, and an episode's frames."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.datasets.lerobot_format.layout import is_dataset
from lerobot_memobench.datasets.lerobot_format.tables import LANGUAGE
from lerobot_memobench.errors import MemobenchError

Columns = dict[str, Any]


def episode_rows(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of ``meta/episodes``, one per episode.

    Raises:
        MemobenchError: the folder is no dataset, or one without the benchmark's columns.
    """
    import pyarrow.parquet as pq

    if not is_dataset(folder):
        raise MemobenchError(f"{folder} is no dataset (there is no meta/info.json); name one that was generated")
    rows: list[dict[str, Any]] = pq.read_table(folder / "meta" / "episodes").to_pylist()
    _check_columns(folder, rows[0], ("task_name", "memory_type", "exec_start_index", "key_frames"))
    return rows


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """An episode of a dataset on disk: ``columns`` per frame and what meta/episodes says."""

    task_name: str
    variant: int
    seed: int
    exec_start: int
    columns: Columns
    whole: dict[str, Any]


def read_episode(root: Path | str, episode_index: int) -> RecordedEpisode:
    """Read an episode of a dataset that this package made; without states/, its columns lack ``states``."""
    import pyarrow.parquet as pq

    root = Path(root)
    if not is_dataset(root):
        raise MemobenchError(f"{root} is no dataset (there is no meta/info.json); name the folder of a generated one")
    rows = pq.read_table(root / "meta" / "episodes", filters=[("episode_index", "==", episode_index)]).to_pylist()
    if len(rows) != 1:
        raise MemobenchError(f"{root} has no episode {episode_index}; see total_episodes in its meta/info.json")
    meta = rows[0]
    _check_columns(root, meta, ("task_name", "variant", "seed", "exec_start_index"))
    columns = _read_columns(root, episode_index)
    whole = {key: meta[key] for key in ("success", "key_frames", "scene_hash") if key in meta}
    if "fixture_poses" in meta:
        whole["fixture_poses"] = json.loads(meta["fixture_poses"])
    if LANGUAGE in columns:
        whole[LANGUAGE] = columns[LANGUAGE][0]
    return RecordedEpisode(meta["task_name"], meta["variant"], meta["seed"], meta["exec_start_index"], columns, whole)


def _read_columns(root: Path, episode_index: int) -> Columns:
    """An episode's frames and, where they are, its states."""
    import pyarrow.parquet as pq

    chosen = [("episode_index", "==", episode_index)]
    table = pq.read_table(root / "data", filters=chosen).sort_by("frame_index")
    columns: Columns = {}
    for name in table.column_names:
        values = table.column(name).to_pylist()
        is_text = name == LANGUAGE or isinstance(values[0], str)
        columns[name] = values if is_text else np.array(values)
    for name in ("action", "observation.state"):
        columns[name] = columns[name].astype(np.float32)
    if (root / "states").is_dir():
        states = pq.read_table(root / "states", filters=chosen).sort_by("frame_index")
        columns["states"] = np.array(states.column("state").to_pylist(), dtype=np.float64)
    return columns


def _check_columns(root: Path, row: dict[str, Any], needed: tuple[str, ...]) -> None:
    missing = [key for key in needed if key not in row]
    if missing:
        raise MemobenchError(f"{root} lacks {', '.join(missing)} in meta/episodes: this package did not make it")
