"""One start of an evaluation on this machine: versions, commit, processor."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from lerobot_memobench.jobs.threads import cores, cpu_model

PACKAGES = ("lerobot_policy_memobench", "lerobot", "mujoco", "robosuite", "torch", "transformers", "numpy", "gymnasium")


def run_facts(command: Sequence[str], batch: int) -> dict[str, Any]:
    """Return what is known of one start of an evaluation on this machine."""
    return {
        "command": list(command),
        "batch_size": batch,
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": {"cpu": cpu_model(), "cores": cores(), "gpu": gpu_model(), "system": platform.platform()},
    }


def versions() -> dict[str, str]:
    """Return the versions on which an evaluation's numbers may depend."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def git_commit() -> str | None:
    """Return the commit that this package runs from, with ``+changes`` where files differ; None outside a checkout."""
    package = Path(__file__).resolve().parents[1]
    if not (package.parents[1] / ".git").exists():
        return None
    commit = git(package, "rev-parse", "HEAD")
    if not commit:
        return None
    return commit + ("+changes" if git(package, "status", "--porcelain", "--", str(package)) else "")


def git(folder: Path, *words: str) -> str | None:
    """Return what ``git`` says of a folder, None where it cannot."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=20, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def gpu_model() -> str | None:
    """Return the GPU's name, None without one."""
    import torch

    return str(torch.cuda.get_device_name(0)) if torch.cuda.is_available() else None


def drawn_with(run: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions of a card's run and what drew its pictures: the CPU, or OpenGL on an older card."""
    return {**run["versions"], "GL backend": "none, drawn on the CPU", **run.get("gl", {})}
