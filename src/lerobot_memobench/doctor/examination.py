"""Checks of a machine: operating system, versions, plugin, rendering, video decoding, device."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from lerobot_memobench.doctor.golden import TOLERANCE, difference, read_golden, render_golden
from lerobot_memobench.errors import unsupported_system
from lerobot_memobench.io import cache_base
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.protocol import PUBLISHED_MUJOCO
from lerobot_memobench.sim.libero.files import ASSETS_VARIABLE, OBTAIN, places, unused, usable

DISTRIBUTION, PACKAGE = "lerobot_policy_memobench", "lerobot_memobench"
PLUGIN = "LeRobot plugin"
RUN_WITH = "0.6.1"
"""The version of LeRobot with which all tests of this version ran."""

#: Packages checked against the requirements of this project and of LeRobot.
SHOWN = ("lerobot", "torch", "transformers", "mujoco", "numpy", "gymnasium", "torchcodec", "av")

EXTRAS = ("", "dataset", "training", "evaluation", "pi", "transformers-dep", "av-dep")
"""Extras of LeRobot that this project installs."""


Status = Literal["ok", "warning", "failed"]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        status: ``failed`` if the benchmark cannot run, ``warning`` if a part is missing or slow.
        fix: how to repair it; empty if no action is needed.
    """

    what: str
    status: Status
    detail: str
    fix: str = ""


def examine() -> list[Finding]:
    """Run all checks. The import of LeRobot takes most of the time, some tens of seconds."""
    return [
        system(),
        python_version(),
        *package_versions(),
        physics(),
        opencv(),
        plugin(),
        caches(),
        assets(),
        golden_frame(),
        ffmpeg(),
        torchcodec(),
        device(),
    ]


def exit_status(findings: Sequence[Finding]) -> int:
    """Return 1 if a check failed, else 0."""
    return int(any(finding.status == "failed" for finding in findings))


def system() -> Finding:
    """Check the operating system."""
    found = f"{platform.system()} {platform.machine()}"
    if problem := unsupported_system():
        return Finding("system", "failed", found, problem)
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return Finding("system", "warning", f"{found}; only Linux x86_64 is tested", "packages may be missing or slow")
    return Finding("system", "ok", found)


def python_version() -> Finding:
    """Check the Python version."""
    found = ".".join(str(part) for part in sys.version_info[:3])
    good = sys.version_info[:2] == (3, 12)
    return Finding("Python", "ok" if good else "failed", found, "" if good else "use 3.12, as `make setup` does")


def package_versions() -> Iterator[Finding]:
    """Compare installed versions with the requirements of this project and of LeRobot."""
    requirements = supported_versions()
    for name in SHOWN:
        found = _installed(name)
        wanted = requirements.get(name, SpecifierSet())
        if found is None or not wanted.contains(found, prereleases=True):
            detail = "not installed" if found is None else f"{found}; supported is {wanted}"
            yield Finding(name, "failed", detail, f'pip install "{name}{wanted}"')
        elif name == "lerobot" and found != RUN_WITH:
            detail = f"{found}, with which this version was not tested; it was with {RUN_WITH}"
            yield Finding(name, "warning", detail, f'pip install "lerobot=={RUN_WITH}" if a command fails')
        else:
            yield Finding(name, "ok", found + (f" (supported {wanted})" if str(wanted) else ""))


def physics() -> Finding:
    """Compare MuJoCo with the version of the published figures. From 4.0 a second distribution contains its files."""
    found = _installed("mujoco") or "not installed"
    if found.startswith("3.") and (other := _installed("mujoco-core")):
        fix = f"pip uninstall -y mujoco mujoco-core mujoco-studio && pip install mujoco=={found}"
        return Finding("physics", "warning", f"MuJoCo {found} has overwritten the files of {other}", fix)
    if found != PUBLISHED_MUJOCO:
        return Finding("physics", "ok", f"MuJoCo {found}; published figures are of {PUBLISHED_MUJOCO}")
    return Finding("physics", "ok", f"MuJoCo {found}, as for published figures")


def supported_versions() -> dict[str, SpecifierSet]:
    """Return package -> versions that both this project and LeRobot accept."""
    found: dict[str, SpecifierSet] = {}
    for owner in ("lerobot", DISTRIBUTION):
        for requirement in _requirements(owner):
            name = requirement.name.lower().replace("_", "-")
            found[name] = found.get(name, SpecifierSet()) & requirement.specifier
    return found


def _requirements(owner: str) -> Iterator[Requirement]:
    """Yield the requirements of an installed distribution on this machine."""
    try:
        lines = metadata.requires(owner) or []
    except metadata.PackageNotFoundError:
        return
    for requirement in map(Requirement, lines):
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in EXTRAS):
            yield requirement


def opencv() -> Finding:
    """Check that only the headless distribution installs the module ``cv2``; the others need desktop libraries."""
    contrib = "opencv-contrib-python"
    names = {"opencv-python", "opencv-python-headless", contrib, f"{contrib}-headless"}
    installed = {name: version for name in sorted(names) if (version := _installed(name)) is not None}
    if list(installed) == ["opencv-python-headless"]:
        return Finding("OpenCV", "ok", f"opencv-python-headless {installed['opencv-python-headless']} alone")
    wanted = f'pip install "opencv-python-headless{supported_versions().get("opencv-python-headless", "")}"'
    fix = f"pip uninstall -y {' '.join(installed)} && {wanted}" if installed else wanted
    return Finding("OpenCV", "warning", " and ".join(installed) or "not installed", fix)


def plugin() -> Finding:
    """Import the plugin in the way of LeRobot, which only logs an import error."""
    if DISTRIBUTION not in [distribution.metadata.get("Name") for distribution in metadata.distributions()]:
        return Finding(
            PLUGIN,
            "failed",
            f"no installed distribution is named {DISTRIBUTION}, so LeRobot does not load it",
            "run `make setup`, or `pip install -e .` in its folder; a source folder on PYTHONPATH is not enough",
        )
    try:
        missing = not_registered()
    except Exception as error:
        reason = f"importing it fails: {type(error).__name__}: {error}"
        return Finding(PLUGIN, "failed", reason, "fix the import error; LeRobot only logs it")
    if missing:
        fix = "install it again: `pip install --force-reinstall --no-deps -e .` in its folder"
        return Finding(PLUGIN, "failed", f"imported, but not registered: {', '.join(missing)}", fix)
    here, imported = Path.cwd(), Path(__file__).parents[2]
    for folder in (here, *here.parents):
        if (folder / "src" / PACKAGE).is_dir() and not imported.samefile(folder / "src"):
            detail = f"commands run the copy in {imported}, not this checkout, {folder}"
            return Finding(PLUGIN, "warning", detail, f"pip install --no-deps -e {folder}")
    return Finding(PLUGIN, "ok", "discovered: env memobench, policies memobench_mem, memobench_expert")


def not_registered() -> list[str]:
    """Import the plugin in the way of LeRobot; return the types that are still not registered."""
    __import__(DISTRIBUTION)
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.policies import factory as _factory  # noqa: F401 - importing it registers policies

    needed = {"policy memobench_mem", "policy memobench_expert", "env memobench"}
    known = {f"policy {name}" for name in PreTrainedConfig.get_known_choices()}
    return sorted(needed - known - {f"env {name}" for name in EnvConfig.get_known_choices()})


def _installed(name: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def caches() -> Finding:
    """Return the folder of caches, which is a temporary one if the home folder cannot be written."""
    folder, own = cache_base(), os.environ.get("NUMBA_CACHE_DIR")
    found = f"in {folder}" + (f"; numba's in {own}" if own else "")
    if folder.is_relative_to(tempfile.gettempdir()):
        fix = "set XDG_CACHE_HOME to a folder that you can write; otherwise each machine or container compiles again"
        return Finding("caches", "warning", f"{found}, a temporary folder", fix)
    return Finding("caches", "ok", found)


def golden_frame() -> Finding:
    """Compare a rendered frame with the golden frame of the package."""
    try:
        off = difference(render_golden(), read_golden())
    except Exception as error:
        return Finding("golden frame", "failed", _in_one_line(error), "fix what failed above first")
    detail = f"rendered on the CPU, mean difference {off:.2f} of 255 (tolerance {TOLERANCE:g})"
    if off > TOLERANCE:
        fix = "pictures differ from the benchmark's; remove numba's cache folders and install the package again"
        return Finding("golden frame", "failed", detail, fix)
    return Finding("golden frame", "ok", detail)


def assets() -> Finding:
    """Find LIBERO's assets, of which every scene is made; name the places that are not used."""
    found = places()
    if (place := usable(found)) is None:
        return Finding("assets", "failed", f"LIBERO's assets are not on this machine{unused(found)}", OBTAIN)
    detail = f"LIBERO's, from {place.source}: {place.folder} (MIT, CC BY 4.0){unused(found)}"
    if found[0].fault and found[0].source == ASSETS_VARIABLE:
        return Finding("assets", "warning", detail, f"correct or unset {ASSETS_VARIABLE}")
    return Finding("assets", "ok", detail)


def ffmpeg() -> Finding:
    """Check for the program ffmpeg."""
    program = shutil.which("ffmpeg")
    if program is None:
        return Finding("FFmpeg", "warning", "no ffmpeg on the PATH", "apt-get install ffmpeg")
    lines = subprocess.run([program, "-version"], capture_output=True, text=True, check=False).stdout.splitlines()
    return Finding("FFmpeg", "ok", lines[0] if lines else program)


def torchcodec() -> Finding:
    """Load LeRobot's preferred video decoder."""
    try:
        import torchcodec.decoders  # noqa: F401 - loads FFmpeg's libraries
    except Exception as error:
        return Finding(
            "video decoding",
            "warning",
            f"torchcodec does not load ({_in_one_line(error)}); LeRobot falls back to PyAV, which is slower",
            "apt-get install ffmpeg (torchcodec needs its libraries)",
        )
    return Finding("video decoding", "ok", "torchcodec loads FFmpeg's libraries")


def _in_one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def device() -> Finding:
    """Return the device on which policies run."""
    import torch

    if torch.cuda.is_available():
        return Finding("device", "ok", f"{torch.cuda.get_device_name()} ({torch.cuda.device_count()} in total)")
    return Finding("device", "ok", f"CPU, {cores()} cores; enough for size=tiny and the expert")
