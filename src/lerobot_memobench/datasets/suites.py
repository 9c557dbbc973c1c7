"""Is a dataset of the suite that is meant?"""

from __future__ import annotations

from pathlib import Path

from lerobot_memobench.datasets.lerobot_format.layout import is_dataset
from lerobot_memobench.datasets.lerobot_format.reading import list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import suite_of


def check_suite_of(folder: Path, suite: str) -> None:
    """Refuse a LeRobotDataset that holds a task of another suite; tasks outside the catalogue belong to none.

    Raises:
        MemobenchError: naming the first such task.
    """
    for place in list_episodes(folder) if is_dataset(folder) else ():
        name = place.record.task_name if place.record is not None else ""
        found = suite_of(name)
        if found not in (None, suite):
            raise MemobenchError(
                f"{folder} holds demonstrations of {name!r}, a task of the {found} suite; say --suite {found}"
            )
