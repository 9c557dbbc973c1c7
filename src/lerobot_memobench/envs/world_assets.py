"""Can scenes of a world be built on this machine? The package's own can; `world=libero` needs LIBERO's assets."""

from __future__ import annotations

import importlib
from importlib.util import find_spec

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.task import LIBERO, World

FILES = "lerobot_memobench.sim.libero.files"


def check_assets(world: World) -> str:
    """Check every file that scenes of a world are built of; return where they are, "" where none is needed.

    Raises:
        MemobenchError: a file is missing or is another one, with what to install.
    """
    if world != LIBERO:
        return ""
    if find_spec(FILES.rpartition(".")[0]) is None:
        raise MemobenchError(f"this version cannot build scenes of world={LIBERO}; install a later one")
    files = importlib.import_module(FILES)
    for name in files.known_hashes():
        files.asset(name)
    return str(files.assets_folder())
