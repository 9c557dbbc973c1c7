"""LeRobot's own commands, called in this process."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from lerobot_memobench.run.lerobot_commands import PREFIX, load_command


def call_lerobot(command: str, flags: Sequence[str]) -> int:
    """Run ``lerobot-<command>`` with these flags; return its exit status. Its main function reads ``sys.argv``."""
    entry = load_command(command)
    before = sys.argv
    sys.argv = [f"{PREFIX}{command}", *flags]
    try:
        status = entry()
    except SystemExit as stop:
        status = stop.code
    finally:
        sys.argv = before
    if status is None:
        return 0
    if isinstance(status, int):
        return status
    print(status, file=sys.stderr)  # as Python does with such a status
    return 1
