"""Figures that the MEMOBench paper gives of its demonstrations, to stand beside those of a generated dataset.

Source: the paper's appendix on dataset statistics, the tables "Family level statistics for the expert
demonstrations" and "Distribution of expert demonstration lengths in action steps".
"""

from __future__ import annotations

from dataclasses import dataclass


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


FAMILIES: dict[str, FamilyFigures] = {
    "temporal": FamilyFigures(10, 500, 198_099, 396.20, 400.50, 679.05, 779, 72.66),
    "spatial": FamilyFigures(10, 500, 357_865, 715.73, 727.00, 1_101.10, 1_513, 131.58),
    "object": FamilyFigures(5, 250, 121_276, 485.10, 492.00, 526.00, 556, 44.53),
    "procedural": FamilyFigures(5, 250, 250_204, 1_000.82, 876.00, 1_649.50, 2_012, 91.79),
    "total": FamilyFigures(30, 1_500, 927_444, 618.30, 489.00, 1_110.10, 2_012, 340.56),
}

LENGTH_BUCKETS: dict[tuple[int, int | None], int] = {
    (0, 200): 50,
    (200, 400): 199,
    (400, 600): 687,
    (600, 800): 108,
    (800, 1000): 290,
    (1000, 1200): 110,
    (1200, 1500): 31,
    (1500, None): 25,
}
"""Steps [from, to) -> episodes of 1,500."""
