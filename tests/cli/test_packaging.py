"""What `make setup` installs from: pinned, hashed, and without any registry's address."""

from __future__ import annotations

import re
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
def test_every_pin_has_hashes_and_no_line_an_address(name: str) -> None:
    text = (ROOT / name).read_text()
    assert "://" not in text
    blocks = re.split(r"\n(?=[A-Za-z0-9])", text)
    for block in blocks:
        assert "==" in block
        assert "--hash=sha256:" in block


def test_the_lock_answers_to_pyproject() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [
        *project["project"]["dependencies"],
        *project["dependency-groups"]["dev"],
        *project["build-system"]["requires"],
    ]
    locked = pins("requirements.lock")
    for line in wanted:
        requirement = Requirement(line)
        pin = locked.get(canonical(requirement.name))
        assert pin is not None, f"{line} is not locked; run `make lock`"
        (version,) = [specifier.version for specifier in pin.specifier]
        assert requirement.specifier.contains(version), f"{line} is locked at {version}; run `make lock`"


def test_what_needs_a_desktop_or_a_compiler_is_left_out() -> None:
    locked = pins("requirements.lock")
    assert "opencv-python-headless" in locked
    assert not {"opencv-python", "pynput", "evdev"} & set(locked)


@pytest.mark.parametrize("script", ["scripts/setup", "scripts/lock", ".ci/run"])
def test_scripts_are_sound_and_executable(script: str) -> None:
    path = ROOT / script
    assert path.stat().st_mode & 0o111
    subprocess.run(["bash", "-n", path], check=True)


def test_no_file_names_a_package_registry() -> None:
    """Where packages come from is the machine's affair."""
    names = re.compile(r"pypi\.org|pythonhosted\.org|--index-url|--extra-index-url|download\.pytorch\.org")
    files = ["Makefile", "pyproject.toml", "README.md", *LOCKS, ".ci/run", "scripts/setup", "scripts/lock"]
    for name in files:
        assert not names.search((ROOT / name).read_text()), name
