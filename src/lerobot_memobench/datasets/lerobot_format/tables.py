"""Read a dataset's ``meta/info.json`` and Parquet tables."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired, TypedDict

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from lerobot_memobench.datasets.lerobot_format.layout import ADVICE, INFO_FILE, TASKS_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, check_fetched, files_below, read_json, refusing

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Filter = list[tuple[str, str, int]]
"""Column, comparison and number of the rows to read."""


def undamaged(folder: Path) -> AbstractContextManager[None]:
    """Turn errors of reading the dataset in ``folder``, or one of its files, into `MemobenchError` (`io.refusing`)."""
    return refusing(lambda why: MemobenchError(f"{folder} cannot be read ({why}); {ADVICE}"), folder)


class Info(TypedDict):
    """``meta/info.json``. The number of episodes is bounded, because each is read."""

    codebase_version: str
    total_episodes: Annotated[int, Ge(0), Le(10_000_000)]
    total_frames: NotRequired[Count]
    fps: NotRequired[Annotated[int, Ge(1), Le(10_000)]]
    features: dict[str, dict[str, Any]]


def read_info(folder: Path) -> dict[str, Any]:
    """Return ``meta/info.json`` of the dataset in ``folder``.

    Raises:
        MemobenchError: there is none, it is damaged, or of an earlier format.
    """
    try:
        found: dict[str, Any] = read_json(folder / INFO_FILE, Info, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(f"{folder} is no dataset (there is no {INFO_FILE}); name one that was generated") from None
    if not found["codebase_version"].startswith("v3."):
        raise MemobenchError(
            f"{folder} is in LeRobot's format {found['codebase_version']}, expected v3.0; convert it in place, from "
            f"v2.1: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/converted "
            f"--root={shlex.quote(str(folder))} --push-to-hub=false"
        )
    return found


def tables_of(
    folder: Path, wanted: Callable[[str], bool] = lambda _: True, rows: Filter | None = None
) -> Iterator[tuple[Path, pa.Table]]:
    """Yield each Parquet file of a folder and its table, with the ``wanted`` ones of its columns.

    Raises:
        MemobenchError: there is no file, or one cannot be read.
    """
    import pyarrow.parquet as pq

    files = files_below(folder, ".parquet")
    if not files:
        raise MemobenchError(f"{folder} holds no parquet file: the dataset is incomplete; fetch or generate it again")
    for path in files:
        with undamaged(path):
            names = [name for name in pq.read_schema(path).names if wanted(name)]
            table = pq.read_table(path, columns=names, filters=rows)
        yield path, table


def read_table(folder: Path, wanted: Callable[[str], bool] = lambda _: True, rows: Filter | None = None) -> pa.Table:
    """Return the tables of a folder as one (`tables_of`); columns that some files of merged datasets lack are null."""
    import pyarrow as pa

    return pa.concat_tables((table for _, table in tables_of(folder, wanted, rows)), promote_options="permissive")


def read_tasks(folder: Path) -> pd.DataFrame:
    """Return a dataset's instructions, the index, and their numbers, ``task_index``."""
    import pandas as pd

    with undamaged(folder / TASKS_FILE):
        check_fetched(folder / TASKS_FILE)
        return pd.read_parquet(folder / TASKS_FILE)


def is_numeric(kind: pa.DataType) -> bool:
    """Return whether a column holds numbers or flags, or lists of them."""
    import pyarrow.types as types

    while types.is_list(kind) or types.is_fixed_size_list(kind):
        kind = kind.value_type
    return types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)


def numbers(column: pa.ChunkedArray) -> NDArray:
    """Return a column of numbers as (n,), or (n, d) if it holds lists of one length."""
    import pyarrow.types as types

    if not (types.is_list(column.type) or types.is_fixed_size_list(column.type)):
        return np.asarray(column.to_numpy())
    return np.asarray(column.combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(len(column), -1)


def texts(column: pa.ChunkedArray) -> list[str]:
    """Return a column of texts. Rows are strings or lists of one string; a missing one is empty."""
    return [(value[0] if isinstance(value, list) else value) or "" for value in column.to_pylist()]
