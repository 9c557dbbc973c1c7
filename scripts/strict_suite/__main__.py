"""Write the strict suite's task folders: ``python scripts/strict_suite``; ``--check`` lists differing files.

The folders are the data; this script keeps formulas and texts of thirty tasks consistent.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import counting
import finding
import ordering
import prompted
from folders import StrictTask, files, write


def strict_tasks() -> Iterable[StrictTask]:
    """Return all strict tasks."""
    return [*counting.strict_tasks(), *ordering.strict_tasks(), *finding.strict_tasks(), *prompted.strict_tasks()]


def stale() -> list[str]:
    """Return the files that are missing or say something else than is written here."""
    return [
        str(path)
        for task in strict_tasks()
        for path, text in ((task.folder / name, text) for name, text in files(task).items())
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    ]


if __name__ == "__main__":
    if "--check" in sys.argv[1:]:
        sys.exit("\n".join(stale()) or 0)
    for task in strict_tasks():
        write(task)
        print(task.folder)
