"""What LeRobot keeps of a dataset in ``meta/info.json``, as far as it is used here; and reading what may be damaged."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from annotated_types import Ge, Le

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.files.reading import Count, read_json, refusing

INFO_FILE = Path("meta") / "info.json"
ADVICE = "the dataset is damaged; generate it or take it from its source again"
MOST_NUMBERS = 50_000_000
"""Of a feature in one frame: a picture of 4096 x 4096. LeRobot takes memory for as many as a dataset tells."""


class Info(TypedDict):
    """A dataset as a whole. Each of its episodes is looked at, so their number is no arbitrary one."""

    codebase_version: str
    total_episodes: Annotated[int, Ge(0), Le(10_000_000)]
    total_frames: NotRequired[Count]
    fps: NotRequired[Annotated[int, Ge(1), Le(10_000)]]
    features: dict[str, dict[str, Any]]


def read_info(folder: Path) -> dict[str, Any]:
    """Return ``meta/info.json`` of the dataset in ``folder``.

    Raises:
        MemobenchError: there is none, it is none of LeRobot's, or a feature is too large.
    """
    try:
        found: dict[str, Any] = read_json(folder / INFO_FILE, Info, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(f"{folder} is no dataset (there is no {INFO_FILE}); name one that was generated") from None
    for name, feature in found["features"].items():
        shape = feature.get("shape")
        sizes = [size for size in shape if isinstance(size, int)] if isinstance(shape, list) else []
        if abs(math.prod(sizes)) > MOST_NUMBERS:
            raise MemobenchError(
                f"{folder / INFO_FILE} tells of more than {MOST_NUMBERS:,} numbers of {name[:80]} a frame; {ADVICE}"
            )
    return found


def undamaged(folder: Path) -> AbstractContextManager[None]:
    """As `refusing`, for reading the dataset in ``folder``."""
    return refusing(lambda why: MemobenchError(f"{folder} cannot be read ({why}); {ADVICE}"))


def episode_count(folder: Path) -> int:
    """Return how many episodes the dataset in ``folder`` has, as ``meta/info.json`` and ``meta/episodes`` both say.

    Raises:
        MemobenchError: they cannot be read, or disagree.
    """
    import pyarrow.parquet as pq

    told = int(read_info(folder)["total_episodes"])
    with undamaged(folder):
        rows = sum(pq.read_metadata(path).num_rows for path in (folder / "meta" / "episodes").rglob("*.parquet"))
    if rows != told:
        raise MemobenchError(
            f"{folder / INFO_FILE} tells of {told} episodes, {folder}/meta/episodes of {rows}; {ADVICE}"
        )
    return told
