"""Can scenes of a world be built on this machine? The package's own can; `world=libero` needs LIBERO's assets."""

from __future__ import annotations

from lerobot_memobench.sim.libero import files
from lerobot_memobench.tasks.task import LIBERO, World


def check_assets(world: World) -> str:
    """Check every file that scenes of a world are built of; return where they are, "" where none is needed.

    Raises:
        MemobenchError: a file is missing or is another one, with what to install.
    """
    if world != LIBERO:
        return ""
    for name in files.known_hashes():
        files.asset(name)
    return str(files.assets_folder())
