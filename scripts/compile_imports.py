"""Import, once and with bytecode on, what the source in some folders imports, late imports included; draw a picture.

Where PYTHONDONTWRITEBYTECODE is set, as in many containers, every process would compile all of it anew. The functions
that draw are compiled by numba at their first call and kept. Whatever is not installed here or does not import is left
alone: this only saves time.

    python scripts/compile_imports.py src
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

COMMANDS = ("lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train")
"""What is imported by a name that is put together while a command runs."""


def imported(folder: Path) -> set[str]:
    """Return the modules that the Python files below a folder import anywhere, by their absolute names."""
    nodes = (node for path in folder.rglob("*.py") for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    return {name for node in nodes for name in _names(node)}


def _names(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield node.module


def compile_imports(folders: Iterable[Path]) -> None:
    """Import it all; what has no compiled file yet gets one where this interpreter looks for it."""
    sys.dont_write_bytecode = False
    for name in [*COMMANDS, *sorted(set().union(*map(imported, folders)))]:
        # Another system's module, or a package that users may leave out, is no reason to stop.
        with contextlib.suppress(Exception, SystemExit):
            importlib.import_module(name)


def draw() -> None:
    """Take a control step and draw both cameras, so that numba keeps what it compiles for it."""
    with contextlib.suppress(Exception):
        from lerobot_memobench.sim.rendering import RenderSettings
        from lerobot_memobench.sim.simulation import MJCF_CAMERAS, NO_OP, Simulation
        from lerobot_memobench.tasks.catalogue import get_task, task_names

        for quality in ("fast", "default"):
            simulation = Simulation(get_task(task_names()[0]), RenderSettings(64, 64, quality))
            simulation.reset(0)
            simulation.step(NO_OP)
            for camera in MJCF_CAMERAS:
                simulation.render(camera)
                simulation.geoms(camera)


if __name__ == "__main__":
    compile_imports([Path(folder) for folder in sys.argv[1:]])
    draw()
