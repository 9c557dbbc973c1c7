"""A job that leaves a file; odd ones have a reason to give."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Note:
    """Writes one character into ``folder``/runs each time it is run."""

    folder: Path
    seed: int
    task_name: str = "note"

    def run(self) -> None:
        with (self.folder / "runs").open("a") as file:
            file.write("x")

    def finished(self) -> bool:
        return (self.folder / "runs").is_file()

    def failure(self) -> str | None:
        return "odd" if self.seed % 2 else None

    @property
    def runs(self) -> int:
        return len((self.folder / "runs").read_text())


class Killed(Note):
    """Ends its process as the kernel does when memory runs out."""

    def run(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)
