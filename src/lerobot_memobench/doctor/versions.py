"""What is installed, against what this project and LeRobot ask for."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import metadata

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from lerobot_memobench.doctor.findings import Finding
from lerobot_memobench.doctor.plugin import DISTRIBUTION

#: What the versions of are shown and held against the requirements of this project and of LeRobot.
SHOWN = ("lerobot", "torch", "transformers", "mujoco", "robosuite", "numpy", "gymnasium", "torchcodec", "av")

EXTRAS = ("", "dataset", "training", "evaluation", "pi", "transformers-dep", "av-dep")
"""Parts of LeRobot that are installed with this project."""


def python_version() -> Finding:
    """Compare the interpreter with the one that is supported."""
    found = ".".join(str(part) for part in sys.version_info[:3])
    good = sys.version_info[:2] == (3, 12)
    return Finding("Python", "ok" if good else "failed", found, "" if good else "run `make setup`, which uses 3.12")


def package_versions() -> Iterator[Finding]:
    """Yield installed versions against what this project and LeRobot require."""
    requirements = supported_versions()
    for name in SHOWN:
        found = _installed(name)
        wanted = requirements.get(name, SpecifierSet())
        if found is None:
            yield Finding(name, "failed", "not installed", "run `make setup`")
        elif not wanted.contains(found, prereleases=True):
            yield Finding(name, "failed", f"{found}; supported is {wanted}", "run `make setup`")
        else:
            yield Finding(name, "ok", found + (f" (supported {wanted})" if str(wanted) else ""))


def supported_versions() -> dict[str, SpecifierSet]:
    """Return package -> versions that both this project and LeRobot accept here."""
    found: dict[str, SpecifierSet] = {}
    for owner in ("lerobot", DISTRIBUTION):
        for requirement in _requirements(owner):
            name = requirement.name.lower().replace("_", "-")
            found[name] = found.get(name, SpecifierSet()) & requirement.specifier
    return found


def _requirements(owner: str) -> Iterator[Requirement]:
    """Yield what an installed distribution asks for on this machine."""
    try:
        lines = metadata.requires(owner) or []
    except metadata.PackageNotFoundError:
        return
    for requirement in map(Requirement, lines):
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in EXTRAS):
            yield requirement


def opencv() -> Finding:
    """Two distributions install the same module ``cv2``; the one with windows needs desktop libraries."""
    names = {"opencv-python", "opencv-python-headless", "opencv-contrib-python"}
    installed = {name: version for name in sorted(names) if (version := _installed(name)) is not None}
    if list(installed) == ["opencv-python-headless"]:
        return Finding("OpenCV", "ok", f"opencv-python-headless {installed['opencv-python-headless']} alone")
    fix = "run `make setup`, or uninstall all of them and install opencv-python-headless alone"
    return Finding("OpenCV", "warning", " and ".join(installed) or "not installed", fix)


def _installed(name: str) -> str | None:
    """Return the version of a package, None where it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
