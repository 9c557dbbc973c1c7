"""An episode's frames as tables, and the files that they go to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.staging.episode import StagedEpisode
from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    import pyarrow as pa

LANGUAGE = "language_persistent"


def frames_table(columns: dict[str, NDArray], episode: StagedEpisode, features: dict[str, Any]) -> pa.Table:
    """Return an episode's frames as a table of exactly the type that LeRobot reads.

    Args:
        columns: name to one value or row per frame.
        episode: where they come from; its language rows are added.
        features: LeRobot's description of all columns.

    Raises:
        MemobenchError: a column is missing.
    """
    import pyarrow as pa
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    typed = get_hf_features_from_features(features)
    arrays = []
    for field in typed.arrow_schema:
        if field.name == LANGUAGE:
            arrays.append(_language(episode, typed[LANGUAGE]))
        elif field.name in columns:
            arrays.append(_array(columns[field.name], field.type))
        else:
            raise MemobenchError(
                f"{episode.folder} was staged by an older version, without the column {field.name}; delete that folder "
                "and generate again to make this episode anew"
            )
    return pa.Table.from_arrays(arrays, schema=typed.arrow_schema)


def _array(values: NDArray, kind: pa.DataType) -> pa.Array:
    import pyarrow as pa

    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), type=kind.value_type), type=kind)
    return pa.array(values.tolist() if values.dtype.kind in "UO" else values, type=kind)


def _language(episode: StagedEpisode, feature: Any) -> pa.Array:
    """The episode's rows, the same on every frame: built once and repeated by index."""
    import datasets

    once = datasets.Dataset.from_dict(
        {LANGUAGE: [episode.language_rows]}, features=datasets.Features({LANGUAGE: feature})
    ).with_format("arrow")[:]
    return once.column(LANGUAGE).combine_chunks().take(np.zeros(int(episode.info["frames"]), dtype=np.int64))


def states_table(states: NDArray[np.float64], number: int) -> pa.Table:
    """Return the simulator's states, which lie beside the dataset, for replay; their width differs between tasks."""
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


class ParquetFiles:
    """A sequence of parquet files in LeRobot's chunk and file numbering; each write is a row group."""

    def __init__(self, build: Path, template: str) -> None:
        self.build, self.template = build, template
        self.chunk, self.file = 0, 0
        self._writer: Any = None
        self._path: Path | None = None

    def write(self, table: pa.Table) -> None:
        """Append a row group to the current file."""
        import pyarrow.parquet as pq

        if self._writer is None:
            self._path = self.build / self.template.format(chunk_index=self.chunk, file_index=self.file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(self._path, table.schema, compression="snappy", use_dictionary=True)
        self._writer.write_table(table)

    def size(self) -> int:
        """Bytes in the current file so far."""
        return self._path.stat().st_size if self._writer is not None and self._path is not None else 0

    def next(self, chunks_size: int) -> None:
        """Go on with the next file."""
        from lerobot.datasets.utils import update_chunk_file_indices

        self.close()
        self.chunk, self.file = update_chunk_file_indices(self.chunk, self.file, chunks_size)

    def close(self) -> None:
        """End the current file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
