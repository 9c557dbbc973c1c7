"""Ten hand-made mutants of the source, each with parts of a net that notice it.

A mutant replaces a text that occurs once below ``src``, in any file, so it survives moves.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from scripts.nets.store import ROOT

COPY = ROOT / "outputs" / "mutants"
COPIED = ("src", "scripts", "research", "results", "docs", "README.md", "pyproject.toml")
MUTANTS = """
hold ~ logs ~ difficulty=hard ~ self._held = steps + -( ~ self._held = steps + 1 + -(
cameras ~ starts ~ turn_it_off-v0 ~ "agentview": AGENTVIEW, "wrist": robot ~ "wrist": AGENTVIEW, "agentview": robot
predicate ~ executions ~ published 24 ~ return self.touching(a, b) ~ return True
normalisation ~ weights ~ objects none ~ "STATE": mode, ~ "STATE": NormalizationMode.IDENTITY,
loss ~ weights ~ objects motion ~ per_sample + of_memory, total + of_memory.mean() ~ per_sample, total
salt ~ actions ~ memobench_strict put_only ~ stream, *salted] ~ stream]
held ~ executions ~ strict 24 ~ is_held = episode.phase == EXECUTION and not ~ is_held = not
steps ~ logs ~ tasks=1,12,24,28 ~ "steps": episode.exec_steps, ~ "steps": episode.step_index,
pauses ~ logs ~ pause_steps=15 ~ _whole_chunks(settings.pause_steps, self._chunk) ~ _whole_chunks(0, self._chunk)
interval ~ commands ~ recompute ~ 1.959963984540054 ~ 1.6448536269514722
"""
"""Name ~ net ~ text in the names of its parts ~ text of the source ~ replacement."""


def table() -> dict[str, list[str]]:
    """Return name -> net, parts, text and replacement of each mutant."""
    rows = (line.split(" ~ ") for line in MUTANTS.strip().splitlines())
    return {name: row for name, *row in rows}


def place_of(text: str, root: Path) -> Path:
    """Return the file with a text; raise a ``ValueError`` if it does not occur once."""
    files = [file for file in sorted((root / "src").rglob("*.py")) if text in file.read_text()]
    if len(files) != 1 or files[0].read_text().count(text) != 1:
        raise ValueError(f"{text!r} occurs in {[file.name for file in files]}; expected it once below src")
    return files[0]


def report(names: list[str]) -> int:
    """Print for each mutant whether its net notices it; return 1 if one is missed."""
    shutil.rmtree(COPY / "outputs", ignore_errors=True)  # of earlier nets
    for name in COPIED:  # with numba's caches, which depend on paths and times
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, COPY / name, dirs_exist_ok=True)
        else:
            shutil.copy2(ROOT / name, COPY / name)
    missed, env = 0, {**os.environ, "PYTHONPATH": "src"}
    for name in names or table():
        net, only, old, new = table()[name]
        file = place_of(old, COPY)
        text, before = file.read_text(), file.stat()
        command = [sys.executable, "-m", "scripts.nets", "compare", "--net", net, "--only", only]
        try:
            file.write_text(text.replace(old, new))
            done = subprocess.run(command, cwd=COPY, env=env, capture_output=True, text=True, check=False)
        finally:
            file.write_text(text)
            os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
        missed += not done.returncode
        changes = [line for line in done.stdout.splitlines() if line.startswith("    ")]
        print(f"{'caught' if done.returncode else 'MISSED'}: {name}, by {net} ({only})", flush=True)
        print("\n".join((changes or done.stderr.splitlines())[:4]), flush=True)
    return int(missed > 0)
