"""What is installed: versions against what this project and LeRobot ask for, and whether LeRobot finds its plugin."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from importlib import metadata

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from lerobot_memobench.doctor.findings import Finding
from lerobot_memobench.errors import unsupported_system

DISTRIBUTION = "lerobot_policy_memobench"
PLUGIN = "LeRobot plugin"

#: What the versions of are shown and held against the requirements of this project and of LeRobot.
SHOWN = ("lerobot", "torch", "transformers", "mujoco", "robosuite", "numpy", "gymnasium", "torchcodec", "av")

EXTRAS = ("", "dataset", "training", "evaluation", "pi", "transformers-dep", "av-dep")
"""Parts of LeRobot that are installed with this project."""


def system() -> Finding:
    """Compare the operating system with the one that is supported."""
    found = f"{platform.system()} {platform.machine()}"
    if problem := unsupported_system():
        return Finding("system", "failed", found, problem)
    if platform.machine() != "x86_64":
        return Finding("system", "warning", f"{found}; tested is Linux x86_64", "expect slower or missing packages")
    return Finding("system", "ok", found)


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


def plugin() -> Finding:
    """Do what LeRobot does to find plugins; it logs an import error and goes on, this reports it."""
    if DISTRIBUTION not in [distribution.metadata.get("Name") for distribution in metadata.distributions()]:
        return Finding(
            PLUGIN,
            "failed",
            f"no installed distribution is named {DISTRIBUTION}, so LeRobot does not look for it",
            "install the project (`make setup`); a source folder on PYTHONPATH is not enough",
        )
    try:
        missing = not_registered()
    except Exception as error:
        reason = f"importing it fails: {type(error).__name__}: {error}"
        return Finding(PLUGIN, "failed", reason, "mend the import error; LeRobot only logs it")
    if missing:
        return Finding(PLUGIN, "failed", f"imported, but not registered: {', '.join(missing)}", "run `make setup`")
    return Finding(PLUGIN, "ok", "discovered: env memobench, policies memobench_mem, memobench_expert")


def not_registered() -> list[str]:
    """Import the plugin as LeRobot does; return what LeRobot still does not know of it."""
    __import__(DISTRIBUTION)
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.policies import factory as _factory  # noqa: F401 - importing it registers policies

    policies, environments = PreTrainedConfig.get_known_choices(), EnvConfig.get_known_choices()
    missing = [f"policy {name}" for name in ("memobench_mem", "memobench_expert") if name not in policies]
    return missing + [f"env {name}" for name in ("memobench",) if name not in environments]


def _installed(name: str) -> str | None:
    """Return the version of a package, None where it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
