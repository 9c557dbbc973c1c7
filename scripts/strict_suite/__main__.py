"""Write the strict suite's task folders: ``python scripts/strict_suite``.

The folders are the data; this is how their thirty times three texts and formulas are kept alike. A test compares both.
"""

from __future__ import annotations

from collections.abc import Iterable

import counting
import finding
import ordering
import prompted
from folders import Twin, write


def twins() -> Iterable[Twin]:
    """Return all twins."""
    return [*counting.twins(), *ordering.twins(), *finding.twins(), *prompted.twins()]


if __name__ == "__main__":
    for twin in twins():
        write(twin)
        print(twin.folder)
