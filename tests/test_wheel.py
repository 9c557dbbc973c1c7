"""What a user gets who never sees this repository: sdist and wheel, and the wheel in a bare environment."""

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


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the sdist and the wheel."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", str(folder)], cwd=ROOT, check=True)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (found,) = dist.glob("*.whl")
    return found


def test_registries_would_take_them(dist: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", *map(str, dist.iterdir())], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("PASSED") == 2


def test_the_wheel_holds_the_product_alone(wheel: Path) -> None:
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
        file.split("/")[0],
    }
    assert not [name for name in names if re.search(r"(^|/)(test_|conftest|research)", name)]
    page = ROOT / "src" / "lerobot_memobench" / "evaluation" / "html"
    files = {
        path.relative_to(ROOT / "src").as_posix() for path in page.rglob("*") if path.suffix in (".js", ".css", ".html")
    }
    assert len(files) > 10
    assert files <= set(names)
    # What pip could not install without a compiler, or would install over another's files.
    assert not {"robosuite", "opencv-python", "pynput"} & {requirement.name for requirement in requirements}


def test_the_sdist_holds_all_that_is_tracked(dist: Path) -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no git checkout")
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    tracked = {name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()}
    assert tracked - held == set()


def test_nobody_else_installs_our_commands() -> None:
    """LeRobot's are named lerobot-eval, lerobot-train, …; one named lerobot would replace ours or be replaced."""
    found = [entry for name in COMMANDS for entry in metadata.entry_points(group="console_scripts", name=name)]
    assert {(entry.name, entry.value.partition(".")[0]) for entry in found} == {
        (name, "lerobot_memobench") for name in COMMANDS
    }
    theirs = {entry.name for entry in metadata.distribution("lerobot").entry_points}
    assert "lerobot-eval" in theirs
    assert not COMMANDS & theirs


def documented_lines(wheel: Path) -> list[list[str]]:
    """Return the lines that docs/start/install.md says to type, with the wheel in place of the repository."""
    page = (ROOT / "docs" / "start" / "install.md").read_text()
    (block,) = (block for block in re.findall(r"```bash\n(.*?)```", page, re.DOTALL) if "pip install" in block)
    return [[str(wheel) if word == "." else word for word in shlex.split(line)] for line in block.splitlines()]


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_bare_environment(wheel: Path, tmp_path: Path) -> None:
    """The lines of the page, then one episode; without a compiler, uv, or this repository."""
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
        pytest.skip("pip reaches no package index from here")
    *installing, doctor = documented_lines(wheel)
    for line in installing:
        done = run(*line)
        assert done.returncode == 0, done.stdout + done.stderr
    done = run(*doctor, "--json")
    findings = {finding["what"]: finding for finding in json.loads(done.stdout)}
    assert done.returncode == 0, findings
    # The programs on the path are for whoever has them.
    assert [what for what, finding in findings.items() if finding["status"] == "warning"] in ([], ["FFmpeg"])
    names = {one["name"].lower() for one in json.loads(run("pip", "list", "--format", "json").stdout)}
    assert {name for name in names if "opencv" in name} == {"opencv-python-headless"}
    done = run("lerobot", "eval", "env=memobench", "tasks=open_and_close_the_microwave", "episodes=1", "output_dir=out")
    assert done.returncode == 0, done.stdout + done.stderr
    card = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert [episode["success"] for episode in card["episodes"]] == [True]
