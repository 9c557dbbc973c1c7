"""What the MEMOBench paper publishes: its tables as data (``tables.json``), and typed access to them.

Source: H. Sun, H. Wang, J. Chen et al., "MEMOBench: A Process Level Memory Benchmark for Robotic Manipulation",
https://github.com/Collab-Gen/MEMOBench. The data are the figures as printed there, percentages with one decimal. This
package imports nothing of the project but its errors, so every other package may stand its own figures beside these.
"""

from lerobot_memobench.paper.tables import (
    METRICS,
    TABLES,
    AgreementFigures,
    Figures,
    PublishedRow,
    annotator_agreement,
    failure_taxonomy,
    published_rows,
    raw_tables,
    shuffled_control,
)

__all__ = [
    "METRICS",
    "TABLES",
    "AgreementFigures",
    "Figures",
    "PublishedRow",
    "annotator_agreement",
    "failure_taxonomy",
    "published_rows",
    "raw_tables",
    "shuffled_control",
]
