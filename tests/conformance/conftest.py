from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "lerobot_policy_window"
MEMORY = Path(__file__).parents[2] / "examples" / "memobench_memory_traces"


def install(package: Path, folder: Path) -> None:
    """Install a package of examples/ as a third party's, as a wheel."""
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder / "wheel")]
    subprocess.run(words, cwd=package, check=True, capture_output=True)
    (wheel,) = (folder / "wheel").iterdir()
    zipfile.ZipFile(wheel).extractall(folder)
    sys.path.insert(0, str(folder))


@pytest.fixture(scope="session")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the example of a policy; LeRobot finds it by itself. Return where it is."""
    from lerobot.utils.import_utils import register_third_party_plugins

    folder = tmp_path_factory.mktemp("site")
    install(EXAMPLE, folder)
    register_third_party_plugins()
    return folder


@pytest.fixture(scope="session")
def traces(tmp_path_factory: pytest.TempPathFactory) -> None:
    install(MEMORY, tmp_path_factory.mktemp("memory_site"))


@pytest.fixture(scope="session")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Streams of object state, without images, so that no video is decoded."""
    from lerobot_memobench.conformance.streams import write_streams

    return write_streams(tmp_path_factory.mktemp("streams") / "objects", images=False, frames=13)


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Streams with images of the real size."""
    from lerobot_memobench.conformance.streams import write_streams

    return write_streams(tmp_path_factory.mktemp("streams") / "images", frames=13)
