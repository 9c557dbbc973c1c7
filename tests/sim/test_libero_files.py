"""LIBERO's files of the required packages, and the user's folder of scans."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import files, mjcf
from lerobot_memobench.sim.scene import get_scene
from lerobot_memobench.tasks.catalogue import get_task

TOMATO = "put_the_tomato_into_the_top_drawer_of_the_cabinet"


def test_required_packages_have_all_files(monkeypatch: pytest.MonkeyPatch) -> None:
    places = dict(files._candidates())
    folder = places[f"the packages {files.DISTRIBUTIONS}"]
    assert files._verified(folder) == {name: folder / name for name in files.known_hashes()}


def scan_folder(folder: Path, category: str, names: tuple[str, ...]) -> Path:
    """Write scans of a category in the layout of the authors' folder."""
    for height, name in enumerate(names, start=1):
        path = folder / category / name / "usd" / "MJCF"
        (path / "visuals").mkdir(parents=True)
        corners = [(x, y, z * 0.01 * height) for x in (-0.02, 0.02) for y in (-0.03, 0.03) for z in (-1, 1)]
        quads = ("1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6")
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {quad}" for quad in quads]
        (path / "visuals" / "model.obj").write_text("\n".join(lines))
        (path / f"{name}.xml").write_text(
            f'<mujoco model="{name}"><asset><mesh name="model" file="visuals/model.obj"/></asset>'
            f'<worldbody><body name="object"><geom class="visual" type="mesh" mesh="model"/>'
            '<geom class="touched" type="mesh" mesh="model"/></body></worldbody>'
            '<default><default class="visual"><geom group="1" contype="0" conaffinity="0"/></default>'
            '<default class="touched"><geom group="0" condim="4"/></default></default></mujoco>'
        )
    return folder


def test_user_scans(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    task = get_task(TOMATO)
    monkeypatch.delenv(files.SCANS_VARIABLE, raising=False)
    assert get_scene(task).stand_ins == ("beefsteak_tomato__1", "box_of_oatmeal__3")
    scan_folder(tmp_path, "beefsteak_tomato", ("aaa", "bbb"))
    monkeypatch.setenv(files.SCANS_VARIABLE, str(tmp_path))
    with pytest.raises(MemobenchError, match="no folder 'box_of_oatmeal'"):
        get_scene(task)
    scan_folder(tmp_path, "box_of_oatmeal", ("a", "b", "c", "d"))
    scene = get_scene(task)
    assert scene.stand_ins == ()
    tomato = "beefsteak_tomato__1_1"
    (touched,) = (scene.model.geom_bodyid == scene.model.body(tomato).id).nonzero()[0]
    assert scene.model.geom_condim[touched] == 4
    assert scene.assets[tomato].high == pytest.approx((0.02, 0.03, 0.02))  # the second scan
    assert mjcf.class_file("beefsteak_tomato__1", "published").bottom == pytest.approx(-0.02)
    with pytest.raises(MemobenchError, match="2 scans"):
        mjcf.class_file("beefsteak_tomato__2", "published")


def test_scan_references_outside_its_folder_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan_folder(tmp_path, "biscuit", ("a",))
    path = tmp_path / "biscuit/a/usd/MJCF/a.xml"
    (path.parent.parent / "outside.obj").write_text("v 0 0 0\n")
    path.write_text(path.read_text().replace('file="visuals/model.obj"', 'file="../outside.obj"'))
    monkeypatch.setenv(files.SCANS_VARIABLE, str(tmp_path))
    with pytest.raises(MemobenchError, match="which is not in its folder"):
        mjcf.class_file("biscuit", "published").assets()
