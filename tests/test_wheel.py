"""The published files: sdist and wheel, and an installation of the wheel in an empty environment."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
COMMANDS = {"lerobot", "memobench"}


def build(kind: str, folder: Path) -> Path:
    """Build the wheel (2 s) or the sdist (3 s)."""
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)], cwd=ROOT, check=True)
    (built,) = folder.glob({"wheel": "*.whl", "sdist": "*.tar.gz"}[kind])
    return built


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", tmp_path_factory.mktemp("wheel"))


def test_wheel_contains_only_the_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (file,) = (name for name in names if name.endswith("METADATA"))
        requirements = [
            Requirement(line.removeprefix("Requires-Dist: "))
            for line in archive.read(file).decode().splitlines()
            if line.startswith("Requires-Dist: ")
        ]
    assert {name.split("/")[0] for name in names} == {
        "lerobot_memobench",
        "lerobot_policy_memobench",
        "mujoco_raster",
        file.split("/")[0],
    }
    assert not [name for name in names if re.search(r"(^|/)(test_|conftest|research)", name)]
    source = ROOT / "src"
    files = {path.relative_to(source).as_posix() for path in source.glob("*/**/[!.]*") if path.is_file()}
    assert {name for name in files - set(names) if "__pycache__" not in name} == set()
    # pip would need a compiler for these, or install them over files of another package.
    assert not {"robosuite", "opencv-python", "pynput"} & {requirement.name for requirement in requirements}


@pytest.mark.slow
def test_sdist_and_metadata(wheel: Path, tmp_path: Path) -> None:
    """The sdist contains all tracked files, and registries accept the metadata of both files."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no git checkout")
    sdist = build("sdist", tmp_path)
    with tarfile.open(sdist) as archive:
        contained = {name.partition("/")[2] for name in archive.getnames()}
    tracked = {name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()}
    assert tracked - contained == set()
    command = [sys.executable, "-m", "twine", "check", "--strict", str(wheel), str(sdist)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout.count("PASSED")) == (0, 2), done.stdout


def test_no_other_package_installs_our_commands() -> None:
    """LeRobot's commands are lerobot-eval, lerobot-train, …; pip would overwrite one of two commands `lerobot`."""
    entries = [entry for name in COMMANDS for entry in metadata.entry_points(group="console_scripts", name=name)]
    assert {(entry.name, entry.value.partition(".")[0]) for entry in entries} == {
        (name, "lerobot_memobench") for name in COMMANDS
    }
    theirs = {entry.name for entry in metadata.distribution("lerobot").entry_points}
    assert "lerobot-eval" in theirs
    assert not COMMANDS & theirs


def installation_commands(wheel: Path) -> list[list[str]]:
    """Return the commands of docs/start/install.md, with the wheel instead of the repository."""
    page = (ROOT / "docs" / "start" / "install.md").read_text()
    (block,) = (block for block in re.findall(r"```bash\n(.*?)```", page, re.DOTALL) if "pip install" in block)
    lines = [[word for word in shlex.split(line) if word != "-e"] for line in block.splitlines()]
    return [[str(wheel) if word == "." else word for word in line] for line in lines]


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_documented_installation_runs_an_episode(wheel: Path, tmp_path: Path) -> None:
    """In an empty environment without a compiler, uv or this repository."""
    bare = tmp_path / "bare"
    python = Path(sys.base_prefix) / "bin" / "python3.12"
    subprocess.run([python if python.exists() else sys.executable, "-m", "venv", str(bare)], check=True)
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    environment["PATH"] = str(bare / "bin")
    assert shutil.which("cc", path=environment["PATH"]) is None

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        program = [str(bare / "bin" / words[0]), *words[1:]]
        return subprocess.run(program, cwd=tmp_path, env=environment, capture_output=True, text=True)

    if run("pip", "download", "-q", "--no-deps", "-d", str(tmp_path), "termcolor").returncode:
        pytest.skip("pip cannot reach a package index")
    *installing, doctor = installation_commands(wheel)
    for command in installing:
        done = run(*command)
        assert done.returncode == 0, done.stdout + done.stderr
    done = run(*doctor, "--json")
    findings = {finding["what"]: finding for finding in json.loads(done.stdout)}
    assert done.returncode == 0, findings
    # FFmpeg is optional.
    assert [what for what, finding in findings.items() if finding["status"] == "warning"] in ([], ["video decoding"])
    names = {package["name"].lower() for package in json.loads(run("pip", "list", "--format", "json").stdout)}
    assert {name for name in names if "opencv" in name} == {"opencv-python-headless"}
    done = run("lerobot", "eval", "env=memobench", "tasks=open_and_close_the_microwave", "episodes=1", "output_dir=out")
    assert done.returncode == 0, done.stdout + done.stderr
    (line,) = (tmp_path / "out" / "episodes.jsonl").read_text().splitlines()
    assert json.loads(line)["success"]
