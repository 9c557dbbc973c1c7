"""Figures that the MEMOBench paper gives of its demonstrations, to stand beside those of a generated dataset.

Source: the paper's appendix on dataset statistics, the tables "Family level statistics for the expert
demonstrations" and "Distribution of expert demonstration lengths in action steps"; the numbers are in
``lerobot_memobench.paper``.
"""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_memobench.paper import raw_tables


@dataclass(frozen=True)
class FamilyFigures:
    """A row of the first table; steps are control steps, storage is that of the published HDF5 files, GiB."""

    tasks: int
    episodes: int
    steps: int
    mean: float
    median: float
    p95: float
    max: int
    storage: float


def _families() -> dict[str, FamilyFigures]:
    rows = raw_tables()["demo_statistics"]
    order = ("temporal", "spatial", "object", "procedural", "total")
    return {
        name: FamilyFigures(
            **{key: value for key, value in rows[name].items() if key != "gib"}, storage=rows[name]["gib"]
        )
        for name in order
    }


def _bucket(name: str) -> tuple[int, int | None]:
    """Return [from, to) of a range as the paper writes it, ``200-399`` or ``1500+``."""
    if name.endswith("+"):
        return int(name[:-1]), None
    low, _, high = name.partition("-")
    return int(low), int(high) + 1


FAMILIES: dict[str, FamilyFigures] = _families()

LENGTH_BUCKETS: dict[tuple[int, int | None], int] = {
    _bucket(name): count for name, count in raw_tables()["length_buckets"].items()
}
"""Steps [from, to) -> episodes of 1,500."""
