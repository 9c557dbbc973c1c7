"""`examples/demo.py`: its commands, and its images of evaluations, which are replaced here."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lerobot_memobench.commands.command_line import parse_words
from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.rollouts.plan import take_run_options
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.logs import rollout, write_log

DEMO = Path(__file__).parents[1] / "examples" / "demo.py"
HEIGHT, WIDTH = 32, 64
FAILURES: dict[str, dict[int, str]] = {
    "expert": {},
    "with_memory": {3: "reference_drift"},
    "without_memory": {1: "reference_drift", 2: "reference_drift", 3: "storage_failure"},
}
"""Evaluation of the second part -> failed episode -> failure class."""


@pytest.fixture(scope="module")
def demo() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(DEMO)))


def video(path: Path, length: int, grey: int | None = None) -> Path:
    """Write a video of one grey level, or from black to white."""
    recorder = VideoRecorder(path)
    for k in range(length):
        recorder.add(np.full((HEIGHT, WIDTH, 3), 255 * k // (length - 1) if grey is None else grey, np.uint8))
    recorder.finish()
    return path


def evaluate(demo: SimpleNamespace, words: list[str]) -> None:
    """Write the output files of an evaluation command."""
    given = dict(word.split("=", 1) for word in words if "=" in word)
    folder = Path(given["output_dir"])
    if folder.name == "expert" and folder.parent.name != "memory":
        for name in demo.TASKS:
            video(folder / "videos" / f"{name}.0.mp4", 12)
        return
    ends = [FAILURES[folder.name].get(k) for k in range(5)]
    records = [
        rollout(demo.STRICT_TASK, "object", "S", [not end], not end, k, failure=end) for k, end in enumerate(ends)
    ]
    write_log(folder, records)
    video(folder / "videos" / f"{demo.STRICT_TASK}.1.mp4", 6, 100)  # the first episode with different outcomes


def test_demo_writes_images_and_table(demo: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def fake_run(command: list[str], **_: Any) -> None:
        commands.append(command)
        evaluate(demo, command)

    monkeypatch.setattr(subprocess, "run", fake_run)
    monkeypatch.setattr(sys, "argv", ["demo.py", "--out", str(tmp_path)])
    demo.main()
    assert {path.name for path in tmp_path.iterdir()} == {
        *("expert", "memory", "contact_sheet.png", "memory.mp4", "memory.png", "memory.md")
    }
    assert [Path(command[0]).name for command in commands] == ["lerobot"] * 4
    for command in commands:
        take_run_options(parse_words([word for word in command[2:] if not word.startswith("policy=")]))
    # The evaluations of the second part differ only in policy and folder.
    varied = ("policy=", "output_dir=")
    assert len({tuple(word for word in command if not word.startswith(varied)) for command in commands[1:]}) == 1
    assert [get_task(name).memory_type for name in demo.TASKS] == ["temporal", "spatial", "object", "procedural"]
    assert "| without memory | 2/5 |" in (tmp_path / "memory.md").read_text()
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        pixels = np.asarray(sheet.convert("L")).astype(int)
    assert pixels.shape == (4 * 160, demo.FRAMES_PER_VIDEO * demo.COLUMN_WIDTH)
    means = pixels[:160].reshape(160, demo.FRAMES_PER_VIDEO, -1).mean(axis=(0, 2))
    assert (np.diff(means) >= 0).all(), "frames are in order of time"
    assert (means[0] < 20, means[-1] > 235) == (True, True), "first and last frames are included"
