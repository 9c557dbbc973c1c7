"""Each fault of a machine is found and has a fix."""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

import pytest

from lerobot_memobench import doctor
from lerobot_memobench.cli import memobench
from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.memobench import finding_table
from lerobot_memobench.constants import PUBLISHED_MUJOCO
from lerobot_memobench.doctor import Finding
from lerobot_memobench.sim.simulation import Simulation


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, str | None]:
    """Return versions that replace the installed ones; None for a missing package."""
    versions: dict[str, str | None] = {}
    real = metadata.version

    def version(name: str) -> str:
        found = versions[name] if name in versions else real(name)
        if found is None:
            raise metadata.PackageNotFoundError(name)
        return found

    monkeypatch.setattr(metadata, "version", version)
    return versions


def test_wrong_or_missing_package_fails(installed: dict[str, str | None]) -> None:
    installed |= {"mujoco": "3.2.0", "torch": None}
    findings = {finding.what: finding for finding in doctor.package_versions()}
    for name in ("mujoco", "torch"):
        assert findings[name].status == "failed"
        assert findings[name].fix.startswith(f'pip install "{name}')
    assert findings["lerobot"].status == "ok"


@pytest.mark.parametrize(("version", "status"), [("0.6.1", "ok"), ("0.7.0", "warning"), ("0.8.0", "failed")])
def test_untested_lerobot_is_named(installed: dict[str, str | None], version: str, status: str) -> None:
    installed["lerobot"] = version
    found = next(finding for finding in doctor.package_versions() if finding.what == "lerobot")
    assert (found.status, version in found.detail) == (status, True)
    assert ("not tested" in found.detail) == (status == "warning")
    assert f"\nlerobot=={doctor.RUN_WITH} " in (Path(__file__).parents[1] / "requirements.lock").read_text()


def test_overwritten_opencv_and_mujoco_are_warnings(installed: dict[str, str | None]) -> None:
    assert doctor.opencv().status == "ok"
    installed["opencv-python"] = "5.0.0.93"
    finding = doctor.opencv()
    assert finding.status == "warning"
    assert finding.fix.startswith("pip uninstall -y opencv-python opencv-python-headless && pip install ")
    lock = (Path(__file__).parents[1] / "requirements.lock").read_text()
    assert f"\nmujoco=={PUBLISHED_MUJOCO} " in lock
    installed |= {"mujoco": PUBLISHED_MUJOCO, "mujoco-core": None}
    assert doctor.physics().status == "ok"
    installed |= {"mujoco": "4.0.0", "mujoco-core": "4.0.0"}
    assert PUBLISHED_MUJOCO in doctor.physics().detail
    installed["mujoco"] = "3.9.0"
    assert (doctor.physics().status, "mujoco-core" in doctor.physics().fix) == ("warning", True)


def test_missing_or_broken_plugin_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.plugin().status == "ok"
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, doctor.DISTRIBUTION, None)
        finding = doctor.plugin()
    assert (finding.status, "importing it fails" in finding.detail) == ("failed", True)
    monkeypatch.setattr(metadata, "distributions", list)
    finding = doctor.plugin()
    assert (finding.status, "make setup" in finding.fix) == ("failed", True)


def test_a_copy_is_named_in_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "src" / doctor.PACKAGE / "inner").mkdir(parents=True)
    for folder in (tmp_path, tmp_path / "src" / doctor.PACKAGE / "inner"):
        monkeypatch.chdir(folder)
        finding = doctor.plugin()
        assert (finding.status, f"-e {tmp_path}" in finding.fix) == ("warning", True)
    monkeypatch.chdir(Path(doctor.__file__).parent)
    assert doctor.plugin().status == "ok"


def test_operating_system(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.system().status in ("ok", "warning")
    with monkeypatch.context() as patched:
        patched.setattr(platform, "machine", lambda: "aarch64")
        assert doctor.system().status == "warning"
    for name, status in (("darwin", "warning"), ("win32", "failed")):
        monkeypatch.setattr(sys, "platform", name)
        finding = doctor.system()
        assert (finding.status, bool(finding.fix)) == (status, True)


def test_missing_video_decoder_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchcodec.decoders", None)
    finding = doctor.video_decoding()
    assert (finding.status, "ffmpeg" in finding.fix) == ("warning", True)


def test_scene_that_cannot_be_drawn_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.image().status == "ok"

    def broken(*_: object) -> None:
        raise RuntimeError("no such scene")

    monkeypatch.setattr(Simulation, "reset", broken)
    finding = doctor.image()
    assert (finding.status, finding.detail, bool(finding.fix)) == ("failed", "RuntimeError: no such scene", True)


def test_exit_status_and_table(monkeypatch: pytest.MonkeyPatch) -> None:
    findings = [Finding("a", "ok", "x"), Finding("b", "warning", "[y]", "do z")]
    for more, status in (([], 0), ([Finding("c", "failed", "w", "v")], 1)):
        with monkeypatch.context() as patched:
            patched.setattr(doctor, "examine", lambda found=[*findings, *more]: found)
            assert memobench.main(["doctor", "--json"]) == status
    screen = console()
    with screen.capture() as capture:
        screen.print(finding_table(findings))
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capture.get().splitlines() if "│" in line]
    assert rows == [["a", "ok", "x"], ["b", "warning", "[y]"], ["", "", "fix: do z"]]
    assert json.dumps([asdict(finding) for finding in findings])


def test_caches_in_a_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "other"))
    assert doctor.caches().status == "ok"
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    found = doctor.caches()
    assert (found.status, str(tmp_path / "cache") in found.detail) == ("warning", True)
    assert "XDG_CACHE_HOME" in found.fix
