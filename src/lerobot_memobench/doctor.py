"""Checks of a machine and its installation, with a fix for each problem."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from itertools import chain
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from lerobot_memobench.constants import PUBLISHED_MUJOCO
from lerobot_memobench.errors import unsupported_system
from lerobot_memobench.io import cache_base
from lerobot_memobench.sim.files import ASSETS_VARIABLE, OBTAIN, find_assets
from lerobot_memobench.tasks.catalogue import get_task

DISTRIBUTION, PACKAGE = "lerobot_policy_memobench", "lerobot_memobench"
RUN_WITH = "0.6.1"  # the version of LeRobot with which all tests of this version ran
SHOWN = ("lerobot", "torch", "transformers", "mujoco", "numpy", "gymnasium", "torchcodec", "av")
"""Packages checked against the requirements of this project and of LeRobot."""
EXTRAS = ("", "dataset", "training", "evaluation", "pi", "transformers-dep", "av-dep")
"""Extras of LeRobot that this project installs."""


@dataclass(frozen=True)
class Finding:
    """The result of one check; ``fix``: how to repair it, empty if no action is needed."""

    what: str
    status: Literal["ok", "warning", "failed"]  # failed: the benchmark cannot run
    detail: str
    fix: str = ""


def examine() -> list[Finding]:
    """Run all checks. The import of LeRobot takes most of the time, some tens of seconds."""
    checks = (physics, opencv, plugin, caches, assets, image, video_decoding)
    return [system(), *package_versions(), *(check() for check in checks)]


def system() -> Finding:
    """Check the operating system."""
    detail = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    if problem := unsupported_system():
        return Finding("system", "failed", detail, problem)
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return Finding("system", "warning", f"{detail}; only Linux x86_64 is tested", "packages may be missing or slow")
    return Finding("system", "ok", detail)


def package_versions() -> Iterator[Finding]:
    """Compare installed versions with the requirements of this project and of LeRobot."""
    requirements = supported_versions()
    for name in SHOWN:
        installed, wanted = _installed(name), requirements.get(name, SpecifierSet())
        if installed is None or not wanted.contains(installed, prereleases=True):
            detail = "not installed" if installed is None else f"{installed}; supported is {wanted}"
            yield Finding(name, "failed", detail, f'pip install "{name}{wanted}"')
        elif name == "lerobot" and installed != RUN_WITH:
            detail = f"{installed}, with which this version was not tested; it was with {RUN_WITH}"
            yield Finding(name, "warning", detail, f'pip install "lerobot=={RUN_WITH}" if a command fails')
        else:
            yield Finding(name, "ok", installed + (f" (supported {wanted})" if str(wanted) else ""))


def supported_versions() -> dict[str, SpecifierSet]:
    """Return package -> versions that both this project and LeRobot accept on this machine."""
    supported: dict[str, SpecifierSet] = {}
    lines = [metadata.requires(owner) or [] for owner in ("lerobot", DISTRIBUTION) if _installed(owner)]
    for requirement in map(Requirement, chain(*lines)):
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in EXTRAS):
            name = canonicalize_name(requirement.name)
            supported[name] = supported.get(name, SpecifierSet()) & requirement.specifier
    return supported


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def physics() -> Finding:
    """Compare MuJoCo with the version of the published figures. From 4.0 a second distribution contains its files."""
    installed = _installed("mujoco") or "not installed"
    if installed.startswith("3.") and (other := _installed("mujoco-core")):
        fix = f"pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco=={installed}"
        return Finding("physics", "warning", f"MuJoCo {installed} has overwritten the files of {other}", fix)
    return Finding("physics", "ok", f"MuJoCo {installed}; published figures are of {PUBLISHED_MUJOCO}")


def opencv() -> Finding:
    """Check that only the headless distribution installs the module ``cv2``; the others need desktop libraries."""
    headless, contrib = "opencv-python-headless", "opencv-contrib-python"
    installed = [name for name in ("opencv-python", headless, contrib, f"{contrib}-headless") if _installed(name)]
    if installed == [headless]:
        return Finding("OpenCV", "ok", f"{headless} {_installed(headless)} alone")
    wanted = f'pip install "{headless}{supported_versions().get(headless, "")}"'
    fix = f"pip uninstall -y {' '.join(installed)} && {wanted}" if installed else wanted
    return Finding("OpenCV", "warning", " and ".join(installed) or "not installed", fix)


def plugin() -> Finding:
    """Import the plugin in the way of LeRobot, which only logs an import error."""
    if DISTRIBUTION not in [distribution.metadata.get("Name") for distribution in metadata.distributions()]:
        detail = f"no installed distribution is named {DISTRIBUTION}, so LeRobot does not load it"
        fix = "run `make setup`, or `pip install -e .` in its folder; a source folder on PYTHONPATH is not enough"
        return Finding("LeRobot plugin", "failed", detail, fix)
    try:
        __import__(DISTRIBUTION)
    except Exception as error:
        reason = f"importing it fails: {_in_one_line(error)}"
        return Finding("LeRobot plugin", "failed", reason, "fix the import error; LeRobot only logs it")
    here, imported = Path.cwd(), Path(__file__).parents[1]
    for folder in (here, *here.parents):
        if (folder / "src" / PACKAGE).is_dir() and not imported.samefile(folder / "src"):
            detail = f"commands run the copy in {imported}, not this checkout, {folder}"
            return Finding("LeRobot plugin", "warning", detail, f"pip install --no-deps -e {folder}")
    return Finding("LeRobot plugin", "ok", f"imported from {imported}")


def caches() -> Finding:
    """Return the folder of caches, which is a temporary one if the home folder cannot be written."""
    folder, own = cache_base(), os.environ.get("NUMBA_CACHE_DIR")
    detail = f"in {folder}" + (f"; numba's in {own}" if own else "")
    if folder.is_relative_to(tempfile.gettempdir()):
        fix = "set XDG_CACHE_HOME to a folder that you can write; otherwise each machine or container compiles again"
        return Finding("caches", "warning", f"{detail}, a temporary folder", fix)
    return Finding("caches", "ok", detail)


def assets() -> Finding:
    """Find LIBERO's assets, which every scene needs; name the places that are not used."""
    place, unused = find_assets()
    if place is None:
        return Finding("assets", "failed", f"LIBERO's assets are not on this machine{unused}", OBTAIN)
    detail = f"LIBERO's, from {place.source}: {place.folder} (MIT, CC BY 4.0){unused}"
    if ASSETS_VARIABLE in unused:
        return Finding("assets", "warning", detail, f"correct or unset {ASSETS_VARIABLE}")
    return Finding("assets", "ok", detail)


def image() -> Finding:
    """Simulate and draw a scene."""
    try:
        from lerobot_memobench.sim.simulation import Simulation

        simulation = Simulation(get_task("turn_on_the_stove_and_turn_it_off"))
        simulation.reset(0)
        height, width, _ = simulation.render("agentview").shape
    except Exception as error:
        fix = "fix the problems above first, or remove numba's files from the cache folder"
        return Finding("image", "failed", _in_one_line(error), fix)
    return Finding("image", "ok", f"a scene of {width} × {height} pixels, drawn on the CPU")


def video_decoding() -> Finding:
    """Load LeRobot's preferred video decoder."""
    try:
        import torchcodec.decoders  # noqa: F401 - loads FFmpeg's libraries
    except Exception as error:
        detail = f"torchcodec does not load ({_in_one_line(error)}); LeRobot falls back to PyAV, which is slower"
        return Finding("video decoding", "warning", detail, "apt-get install ffmpeg (torchcodec needs its libraries)")
    return Finding("video decoding", "ok", "torchcodec loads FFmpeg's libraries")


def _in_one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
