"""The whole examination, in the order in which it is read."""

from __future__ import annotations

from lerobot_memobench.doctor.findings import Finding
from lerobot_memobench.doctor.machine import device, ffmpeg, golden_frame, rendering, torchcodec
from lerobot_memobench.doctor.software import opencv, package_versions, plugin, python_version, system


def examine() -> list[Finding]:
    """Look at everything; this takes some tens of seconds, most of it LeRobot's import."""
    return [
        system(),
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
