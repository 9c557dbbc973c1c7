"""Where the commands print to."""

from __future__ import annotations

import sys

from rich.console import Console

#: Columns when the output is no terminal: task names are long, and a log file has no edge.
WIDTH_OF_A_FILE = 140


def console() -> Console:
    """Return a console as wide as the terminal, or wide enough for the tables where there is none."""
    return Console(width=None if sys.stdout.isatty() else WIDTH_OF_A_FILE, highlight=False)
