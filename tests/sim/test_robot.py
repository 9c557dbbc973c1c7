"""The arm equals robosuite 1.4.1 byte for byte."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import robot


@pytest.mark.parametrize("found", [None, "1.4.0"])
def test_another_robosuite_names_the_install_command(monkeypatch: pytest.MonkeyPatch, found: str | None) -> None:
    def version(name: str) -> str:
        if found is None:
            raise metadata.PackageNotFoundError(name)
        return found

    robot._arrays.cache_clear()
    monkeypatch.setattr(metadata, "version", version)
    with pytest.raises(MemobenchError, match=r"run: pip install --no-deps robosuite==1\.4\.1$"):
        robot.robot_spec()


def test_a_modified_arm_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    xml = robot._robosuite_xml()
    assert robot.arm_hash(xml) == robot.ARM_SHA256
    monkeypatch.setattr(robot, "_robosuite_xml", lambda: xml.replace('mass="', 'mass="1', 1))
    with pytest.raises(MemobenchError, match="not those of robosuite"):
        robot._build()


def test_the_arms_hash_covers_meshes_but_not_folders(tmp_path: Path) -> None:
    hashes = set()
    for folder, mesh in (("a", b"1"), ("b", b"1"), ("c", b"2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "m.stl").write_bytes(mesh)
        hashes.add(robot.arm_hash(f'<mesh name="m" file="{tmp_path / folder}/m.stl"/>'))
    assert len(hashes) == 2
