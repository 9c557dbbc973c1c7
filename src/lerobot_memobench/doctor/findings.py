"""``memobench doctor``: can this machine run the benchmark, and if not, what mends it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from lerobot_memobench.cli.golden import TOLERANCE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.rendering import BACKENDS, gl_backend

DISTRIBUTION = "lerobot_policy_memobench"
SYSTEM_PACKAGES = "apt-get install libegl1 libgl1-mesa-dri libgles2 libopengl0 libosmesa6"

#: What the versions of are shown and held against the requirements of this project and of LeRobot.
SHOWN = ("lerobot", "torch", "transformers", "mujoco", "robosuite", "numpy", "gymnasium", "torchcodec", "av")

#: GL renderers that run on the CPU.
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader")

Status = Literal["ok", "warning", "failed"]
MARKS: dict[Status, str] = {
    "ok": "[green]ok[/green]",
    "warning": "[yellow]warning[/yellow]",
    "failed": "[red]failed[/red]",
}


@dataclass(frozen=True)
class Finding:
    """One thing looked at.

    Attributes:
        status: ``failed`` keeps the benchmark from running, ``warning`` costs speed or a part of it.
        fix: what to do about it; empty when there is nothing to do.
    """

    what: str
    status: Status
    detail: str
    fix: str = ""

    def as_dict(self) -> dict[str, str]:
        return asdict(self)


def examine() -> list[Finding]:
    """Look at everything; this takes some tens of seconds, most of it LeRobot's import."""
    return [
        python_version(),
        *package_versions(),
        opencv(),
        plugin(),
        *rendering(),
        golden_frame(),
        ffmpeg(),
        torchcodec(),
        device(),
    ]


def exit_status(findings: list[Finding]) -> int:
    """Return 1 when something that is needed failed."""
    return int(any(finding.status == "failed" for finding in findings))


def finding_table(findings: list[Finding]) -> Table:
    """Return one row per finding, the fix under what it mends."""
    table = Table(header_style="bold", pad_edge=False, show_lines=False)
    for name in ("checked", "", "found"):
        table.add_column(name, overflow="fold")
    for finding in findings:
        fix = f"\n[bold]fix:[/bold] {_plain(finding.fix)}" if finding.fix else ""
        table.add_row(finding.what, MARKS[finding.status], _plain(finding.detail) + fix)
    return table


def _plain(text: str) -> str:
    """Keep rich from reading brackets in other programs' messages as markup."""
    return text.replace("[", "\\[")


# --- versions ---


def python_version() -> Finding:
    found = ".".join(str(part) for part in sys.version_info[:3])
    good = sys.version_info[:2] == (3, 12)
    return Finding("Python", "ok" if good else "failed", found, "" if good else "run `make setup`, which uses 3.12")


def package_versions() -> Iterator[Finding]:
    """Yield installed versions against what this project and LeRobot require."""
    requirements = supported_versions()
    for name in SHOWN:
        try:
            found = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Finding(name, "failed", "not installed", "run `make setup`")
            continue
        wanted = requirements.get(name)
        if wanted is not None and not wanted.contains(found, prereleases=True):
            yield Finding(name, "failed", f"{found}; supported is {wanted}", "run `make setup`")
        else:
            yield Finding(name, "ok", found + (f" (supported {wanted})" if wanted is not None and str(wanted) else ""))


def supported_versions() -> dict[str, Any]:
    """Return package -> versions that both this project and LeRobot accept here (``SpecifierSet``)."""
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet

    found: dict[str, SpecifierSet] = {}
    for owner in ("lerobot", DISTRIBUTION):
        try:
            lines = metadata.requires(owner) or []
        except metadata.PackageNotFoundError:
            continue
        for line in lines:
            requirement = Requirement(line)
            name = requirement.name.lower().replace("_", "-")
            extras = ("", "dataset", "training", "evaluation", "pi", "transformers-dep", "av-dep")
            if requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in extras):
                found[name] = found.get(name, SpecifierSet()) & requirement.specifier
    return found


def opencv() -> Finding:
    """Two distributions install the same module ``cv2``; the one with windows needs desktop libraries."""
    names = {"opencv-python", "opencv-python-headless", "opencv-contrib-python"}
    installed = sorted(name for name in names if _installed(name))
    if installed == ["opencv-python-headless"]:
        return Finding("OpenCV", "ok", f"opencv-python-headless {metadata.version(installed[0])} alone")
    fix = "run `make setup`, or uninstall all of them and install opencv-python-headless alone"
    return Finding("OpenCV", "warning", " and ".join(installed) or "not installed", fix)


def _installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


# --- the plugin ---


def plugin() -> Finding:
    """Do what LeRobot does to find plugins; it logs an import error and goes on, this reports it."""
    names = [dist.metadata.get("Name") for dist in metadata.distributions()]
    if DISTRIBUTION not in names:
        return Finding(
            "LeRobot plugin",
            "failed",
            f"no installed distribution is named {DISTRIBUTION}, so LeRobot does not look for it",
            "install the project (`make setup`); a source folder on PYTHONPATH is not enough",
        )
    try:
        __import__(DISTRIBUTION)
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.envs.configs import EnvConfig
        from lerobot.policies import factory as _factory  # noqa: F401 - importing it registers policies
    except Exception as error:
        reason = f"importing it fails: {type(error).__name__}: {error}"
        return Finding("LeRobot plugin", "failed", reason, "mend the import error; LeRobot only logs it")
    policies, environments = PreTrainedConfig.get_known_choices(), EnvConfig.get_known_choices()
    missing = [f"policy {name}" for name in ("memobench_mem", "memobench_expert") if name not in policies]
    missing += [f"env {name}" for name in ("memobench",) if name not in environments]
    if missing:
        return Finding(
            "LeRobot plugin",
            "failed",
            f"imported, but not registered: {', '.join(missing)}",
            "run `make setup`",
        )
    return Finding("LeRobot plugin", "ok", "discovered: env memobench, policies memobench_mem, memobench_expert")


# --- rendering ---


def rendering() -> Iterator[Finding]:
    """Yield what each GL backend really does here."""
    try:
        chosen = gl_backend()
    except MemobenchError as error:
        chosen = ""
        yield Finding("GL backend", "failed", str(error), SYSTEM_PACKAGES)
    else:
        origin = "MUJOCO_GL" if os.environ.get("MUJOCO_GL") else "the first whose library is installed"
        yield Finding("GL backend", "ok", f"{chosen} ({origin})")
    for backend in BACKENDS:
        answer = run_probe("gl", backend)
        needed: Status = "failed" if backend == chosen else "warning"
        what = f"GL {backend}" + (" (used)" if backend == chosen else "")
        if "error" in answer:
            yield Finding(what, needed, answer["error"], _gl_fix(backend, backend == chosen))
        elif not answer["sphere"]:
            yield Finding(
                what,
                needed,
                f"{answer['renderer']} draws a wrong picture",
                _gl_fix(backend, backend == chosen),
            )
        else:
            yield _renderer(what, answer["renderer"], answer["version"])


def _gl_fix(backend: str, used: bool) -> str:
    other = next(name for name in BACKENDS if name != backend)
    return SYSTEM_PACKAGES + (f", or set MUJOCO_GL={other}" if used else f" (only if {backend} is wanted)")


def _renderer(what: str, renderer: str, version: str) -> Finding:
    software = any(name in renderer.lower() for name in SOFTWARE)
    detail = f"{renderer}, {version}" + (" (software, on the CPU)" if software else "")
    if software and "egl" in what and Path("/dev/nvidia0").exists():
        return Finding(
            what,
            "warning",
            detail + ", though there is an NVIDIA GPU",
            "install the driver's GL libraries (in containers: NVIDIA_DRIVER_CAPABILITIES=all)",
        )
    return Finding(what, "ok", detail)


def golden_frame() -> Finding:
    """Compare a frame of the benchmark with the one that ships."""
    answer = run_probe("golden")
    if "error" in answer:
        return Finding("golden frame", "failed", answer["error"], "mend the GL backend above first")
    off = answer["difference"]
    detail = f"mean difference {off:.2f} of 255 (tolerance {TOLERANCE:g})"
    if off > TOLERANCE:
        fix = "the pictures here are not the benchmark's; try the other MUJOCO_GL backend or a newer driver"
        return Finding("golden frame", "failed", detail, fix)
    return Finding("golden frame", "ok", detail)


# --- video ---


def ffmpeg() -> Finding:
    program = shutil.which("ffmpeg")
    if program is None:
        return Finding("FFmpeg", "warning", "no ffmpeg on the PATH", "apt-get install ffmpeg")
    lines = subprocess.run([program, "-version"], capture_output=True, text=True, check=False).stdout.splitlines()
    return Finding("FFmpeg", "ok", lines[0] if lines else program)


def torchcodec() -> Finding:
    answer = run_probe("torchcodec")
    if "error" in answer:
        return Finding(
            "video decoding",
            "warning",
            f"torchcodec does not load ({answer['error']}); LeRobot falls back to PyAV, which is slower",
            "apt-get install ffmpeg (its libraries are what torchcodec needs)",
        )
    return Finding("video decoding", "ok", "torchcodec loads FFmpeg's libraries")


def device() -> Finding:
    import torch

    if torch.cuda.is_available():
        return Finding("device", "ok", f"{torch.cuda.get_device_name()} ({torch.cuda.device_count()} in all)")
    return Finding("device", "ok", f"CPU, {os.cpu_count()} cores; enough for size=tiny and the expert")


# --- probes ---


def run_probe(*words: str, timeout_s: float = 180.0) -> dict[str, Any]:
    """Run a probe in a process of its own; return its answer, or {"error": …} however it ended."""
    command = [sys.executable, "-m", "lerobot_memobench.cli.probe", *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"no answer in {timeout_s:.0f} s"}
    if done.returncode < 0:
        return {"error": f"the process was killed by {signal.Signals(-done.returncode).name}"}
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        reason = (done.stderr.strip().splitlines() or ["without a message"])[-1]
        return {"error": f"the process ended with status {done.returncode}: {reason}"}
    answer = json.loads(lines[-1])
    assert isinstance(answer, dict)
    return answer
