"""Overrides of a choice on LeRobot's command line, and its log lines kept quiet."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


def overrides(key: str, flags: Sequence[str]) -> list[str]:
    """Return the flags that set fields of a choice such as ``policy``, as draccus reads them."""
    from lerobot.configs import parser

    told = parser.get_cli_overrides(key, flags) or []
    # LeRobot's parser takes these out before draccus reads.
    return [flag for flag in told if not flag.startswith("--discover_packages_path")]


@contextmanager
def quiet() -> Iterator[None]:
    """Keep LeRobot's log lines about plugins and configurations to the run itself, which reads them again."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)
