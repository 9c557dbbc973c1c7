"""What videos are decoded with and policies run on here."""

from __future__ import annotations

import os
import shutil
import subprocess

from lerobot_memobench.doctor.findings import Finding
from lerobot_memobench.doctor.probing import run_probe


def ffmpeg() -> Finding:
    """Look for the program ffmpeg."""
    program = shutil.which("ffmpeg")
    if program is None:
        return Finding("FFmpeg", "warning", "no ffmpeg on the PATH", "apt-get install ffmpeg")
    lines = subprocess.run([program, "-version"], capture_output=True, text=True, check=False).stdout.splitlines()
    return Finding("FFmpeg", "ok", lines[0] if lines else program)


def torchcodec() -> Finding:
    """Try the decoder that LeRobot prefers."""
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
    """Say what policies run on here."""
    import torch

    if torch.cuda.is_available():
        return Finding("device", "ok", f"{torch.cuda.get_device_name()} ({torch.cuda.device_count()} in all)")
    return Finding("device", "ok", f"CPU, {os.cpu_count()} cores; enough for size=tiny and the expert")
