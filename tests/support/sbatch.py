"""A replacement of Slurm's sbatch that records its options and prints a job's number."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

PROGRAM = """#!{python}
import json, sys
with open({log!r}, "a") as file:
    file.write(json.dumps(sys.argv[1:]) + "\\n")
if {refuses!r}:
    sys.exit("sbatch: error: " + {refuses!r})
print(4711)
"""


class Sbatch:
    """The program, first on the path; ``calls`` are the words of each call."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, refuses: str = "") -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._log = folder / "sbatch.log"
        program = folder / "sbatch"
        program.write_text(PROGRAM.format(python=sys.executable, log=str(self._log), refuses=refuses))
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")

    @property
    def calls(self) -> list[list[str]]:
        return [json.loads(line) for line in self._log.read_text().splitlines()]
