"""Import, once and with bytecode on, what the source in some folders imports, late imports included.

Where PYTHONDONTWRITEBYTECODE is set, as in many containers, every process would compile all of it anew. What is not
installed here or does not import is left alone: this only saves time.

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


if __name__ == "__main__":
    compile_imports([Path(folder) for folder in sys.argv[1:]])
