"""`make setup` installs pinned, hashed packages; no file names a registry."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
LOCKS = ["requirements.lock", "scripts/uv-requirements.txt"]


def pins(name: str) -> dict[str, Requirement]:
    """Package -> its pinned requirement, for this machine."""
    text = (ROOT / name).read_text()
    lines = [line.rstrip(" \\") for line in text.splitlines() if re.match(r"[A-Za-z0-9]", line)]
    found = [Requirement(line) for line in lines]
    environment = {**default_environment(), "extra": ""}
    return {r.name: r for r in found if r.marker is None or r.marker.evaluate(environment)}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.parametrize("name", LOCKS)
def test_pins_have_hashes_and_no_addresses(name: str) -> None:
    text = (ROOT / name).read_text()
    assert "://" not in text
    blocks = re.split(r"\n(?=[A-Za-z0-9])", text)
    for block in blocks:
        assert "==" in block
        assert "--hash=sha256:" in block


def test_the_lock_agrees_with_pyproject() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [
        *project["project"]["dependencies"],
        *(line for group in project["dependency-groups"].values() for line in group),
        *project["build-system"]["requires"],
    ]
    locked = pins("requirements.lock")
    for line in wanted:
        requirement = Requirement(line)
        pin = locked.get(canonical(requirement.name))
        assert pin is not None, f"{line} is not locked; run `make lock`"
        (version,) = [specifier.version for specifier in pin.specifier]
        assert requirement.specifier.contains(version), f"{line} is locked at {version}; run `make lock`"


def executable(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/usr/bin/env bash\n{text}\n")
    path.chmod(0o755)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a folder with the files of setup; installers are to be replaced: no download."""
    for name in ("requirements.lock", "pyproject.toml", ".python-version", "scripts/setup", *LOCKS[1:]):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    executable(tmp_path / ".venv/bin/memobench", "exit 0")
    return tmp_path


def test_setup_removes_only_its_own_packages(checkout: Path) -> None:
    tmp_path = checkout
    executable(tmp_path / ".uv/bin/uv", 'echo "$*" >>uv_calls')
    lock = (ROOT / "requirements.lock").read_text()
    (tmp_path / ".venv/.memobench-lock").write_text(f"dropped-one==1.0 \\\n    --hash=sha256:0\n{lock}")
    executable(tmp_path / ".venv/bin/python", '[ "$1" = -c ] && exit 0; echo "$*" >>calls; exit 1')
    executable(tmp_path / "bin/ffmpeg", "exit 0")
    environment = {**os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    printed = []
    for _ in range(2):
        done = subprocess.run([tmp_path / "scripts/setup"], env=environment, capture_output=True, text=True, check=True)
        printed.append(done.stderr)
    assert "could not be compiled; going on" in printed[0]
    assert printed[1] == ""
    assert (tmp_path / "calls").read_text() == "scripts/compile_imports.py src\n"
    packages = [call for call in (tmp_path / "uv_calls").read_text().splitlines() if call.startswith("pip ")]
    assert [call.split()[1] for call in packages] == ["install", "uninstall", "install"], "no `sync`: it removes others"
    assert packages[1].split()[-1] == "dropped-one"
    assert (tmp_path / ".venv/.memobench-lock").read_text() == lock


def test_no_file_names_a_package_registry() -> None:
    """The machine decides on the registry."""
    names = re.compile(r"pypi\.org|pythonhosted\.org|--index-url|--extra-index-url|download\.pytorch\.org")
    files = ["Makefile", "pyproject.toml", "README.md", *LOCKS, ".ci/run", "scripts/setup", "scripts/lock"]
    for name in files:
        assert not names.search((ROOT / name).read_text()), name
