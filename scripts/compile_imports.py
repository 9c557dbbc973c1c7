"""Write bytecode for everything that the source in some folders imports, and fill numba's cache of rendering functions.

Saves seconds per command where PYTHONDONTWRITEBYTECODE is set, as in many containers. Modules that cannot be imported
are skipped.

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
"""Modules that commands import by a computed name."""


def imported(folder: Path) -> set[str]:
    """Return the absolute names of all modules imported anywhere in the Python files below a folder."""
    nodes = (node for path in folder.rglob("*.py") for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    return {name for node in nodes for name in _names(node)}


def _names(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield node.module


def compile_imports(folders: Iterable[Path]) -> None:
    """Import all modules with bytecode writing enabled."""
    sys.dont_write_bytecode = False
    for name in [*COMMANDS, *sorted(set().union(*map(imported, folders)))]:
        with contextlib.suppress(Exception, SystemExit):  # optional packages, modules of other systems
            importlib.import_module(name)


def render() -> None:
    """Step and render a simulation, so that numba compiles and caches its functions, and meshes are cached."""
    from lerobot_memobench.sim.simulation import MJCF_CAMERAS, NO_OP, QUALITIES, RenderSettings, Simulation
    from lerobot_memobench.tasks.catalogue import get_task, task_names

    for quality in QUALITIES:
        simulation = Simulation(get_task(task_names()[0]), RenderSettings(64, 64, quality))
        simulation.reset(0)
        simulation.step(NO_OP)
        for camera in MJCF_CAMERAS:
            simulation.render(camera)
            simulation.visible_bodies(camera)


if __name__ == "__main__":
    compile_imports([Path(folder) for folder in sys.argv[1:]])
    render()
