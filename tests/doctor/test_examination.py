"""Each failure of a machine is found, with its fix; this machine's pictures are the benchmark's."""

from __future__ import annotations

import builtins
import json
import platform
import shutil
import sys
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packaging.specifiers import SpecifierSet

from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.memobench import finding_table
from lerobot_memobench.doctor import examination
from lerobot_memobench.doctor.examination import Finding, exit_status
from lerobot_memobench.doctor.golden import SIDE, TOLERANCE, difference, read_golden, shrink
from lerobot_memobench.protocol import PUBLISHED_MUJOCO


def test_supported_versions_come_from_the_requirements() -> None:
    supported = examination.supported_versions()
    assert supported["lerobot"].contains("0.6.1")
    assert not supported["lerobot"].contains("0.8.0")
    assert supported["mujoco"].contains("4.0.0")
    assert not supported["mujoco"].contains("3.3.6")
    assert supported["robosuite"] == SpecifierSet("==1.4.1")
    assert not supported["torch"].contains("2.12.0")


def test_a_version_out_of_range_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    real = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "3.2.0" if name == "mujoco" else real(name))
    findings = {finding.what: finding for finding in examination.package_versions()}
    assert findings["mujoco"].status == "failed"
    assert findings["mujoco"].fix
    assert findings["lerobot"].status == "ok"


def test_a_missing_package_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", version)
    assert {finding.status for finding in examination.package_versions()} == {"failed"}


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, str | None]:
    """Versions of packages that are installed (None: not) whatever really is, in an environment that pip made."""
    versions: dict[str, str | None] = {}
    real = metadata.version

    def version(name: str) -> str:
        found = versions[name] if name in versions else real(name)
        if found is None:
            raise metadata.PackageNotFoundError(name)
        return found

    monkeypatch.setattr(metadata, "version", version)
    return versions


@pytest.mark.parametrize("found", [None, "1.4.0"])
def test_robosuite_has_a_line_of_its_own(installed: dict[str, str | None], found: str | None) -> None:
    installed["robosuite"] = found
    (finding,) = [finding for finding in examination.package_versions() if finding.what == "robosuite"]
    assert (finding.status, finding.fix) == ("failed", "pip install --no-deps robosuite==1.4.1")


def test_two_distributions_of_one_cv2(installed: dict[str, str | None]) -> None:
    assert examination.opencv().status == "ok"
    installed["opencv-python"] = "5.0.0.93"
    finding = examination.opencv()
    assert finding.status == "warning"
    assert finding.fix.startswith("pip uninstall -y opencv-python opencv-python-headless && pip install ")
    assert '"opencv-python-headless<' in finding.fix


def test_the_mujoco_of_published_figures(installed: dict[str, str | None]) -> None:
    lock = (Path(__file__).parents[2] / "requirements.lock").read_text()
    assert f"\nmujoco=={PUBLISHED_MUJOCO} " in lock
    installed |= {"mujoco": PUBLISHED_MUJOCO, "mujoco-core": None}
    assert "as for published figures" in examination.physics().detail
    installed |= {"mujoco": "4.0.0", "mujoco-core": "4.0.0"}
    assert f"published figures are of {PUBLISHED_MUJOCO}" in examination.physics().detail
    installed["mujoco"] = "3.9.0"
    assert examination.physics().status == "warning"
    assert "mujoco-core" in examination.physics().fix


def test_the_plugin_is_discovered() -> None:
    assert examination.plugin().status == "ok"


def test_an_uninstalled_plugin_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "distributions", list)
    finding = examination.plugin()
    assert finding.status == "failed"
    assert "make setup" in finding.fix


def test_the_plugins_import_error_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def broken(name: str, *args: Any) -> Any:
        if name == examination.DISTRIBUTION:
            raise ImportError("no module named 'nonsense'")
        return real(name, *args)

    monkeypatch.setattr(builtins, "__import__", broken)
    finding = examination.plugin()
    assert finding.status == "failed"
    assert "nonsense" in finding.detail


@pytest.mark.parametrize(("name", "status", "words"), [("darwin", "warning", ""), ("win32", "failed", "use WSL2")])
def test_another_system_is_named(monkeypatch: pytest.MonkeyPatch, name: str, status: str, words: str) -> None:
    assert examination.system().status in ("ok", "warning")  # the tests' own
    monkeypatch.setattr(sys, "platform", name)
    finding = examination.system()
    assert finding.status == status
    assert words in finding.fix


def test_an_untested_processor_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert examination.system().status == "warning"


@pytest.mark.parametrize("wrong", ["dark", "an error"])
def test_golden_frame(monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    assert examination.golden_frame().status == "ok"

    def drawn() -> np.ndarray:
        if wrong == "an error":
            raise RuntimeError("no such scene")
        return np.zeros((SIDE, SIDE, 3), np.uint8)

    monkeypatch.setattr(examination, "render_golden", drawn)
    finding = examination.golden_frame()
    assert finding.status == "failed"
    assert finding.fix


def test_video(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchcodec.decoders", None)  # as where FFmpeg's libraries are missing
    assert examination.torchcodec().status == "warning"
    assert "apt-get install ffmpeg" in examination.torchcodec().fix
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert examination.ffmpeg().status == "warning"


def test_wrong_pictures_are_outside_the_tolerance() -> None:
    golden = read_golden()
    assert golden.shape == (SIDE, SIDE, 3)
    grey = np.repeat(golden.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    for wrong in (golden[::-1], golden[:, ::-1], golden[..., ::-1], grey, golden // 2, np.zeros_like(golden)):
        assert difference(wrong, golden) > TOLERANCE


def test_shrinking_averages_blocks() -> None:
    image = np.zeros((2 * SIDE, 2 * SIDE, 3), dtype=np.uint8)
    image[::2] = 100
    assert (shrink(image) == 50).all()


def test_the_exit_status_and_the_table() -> None:
    findings = [Finding("a", "ok", "x"), Finding("b", "warning", "[y]", "do z")]
    assert exit_status(findings) == 0
    assert exit_status([*findings, Finding("c", "failed", "w", "v")]) == 1
    screen = console()
    with screen.capture() as capture:
        screen.print(finding_table(findings))
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capture.get().splitlines() if "│" in line]
    assert rows == [["a", "ok", "x"], ["b", "warning", "[y]"], ["", "", "fix: do z"]]
    assert json.dumps([asdict(finding) for finding in findings])
