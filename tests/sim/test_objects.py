"""Files of objects: LIBERO's, this package's, scans, and a user's own folder, by the example of its guide."""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import files, mjcf
from lerobot_memobench.sim.scene import get_scene
from lerobot_memobench.sim.visuals import drawing_model
from lerobot_memobench.tasks.catalogue import get_task, load_task
from mujoco_raster.drawlist import POSITION, ROW
from tests.sim.conftest import DRAWER

CLASSES = sorted(folder.name for folder in files.OWN_OBJECTS.iterdir())


def test_files_are_small() -> None:
    assert sum(path.stat().st_size for path in files.OWN_OBJECTS.glob("*/*")) <= 500_000


@pytest.mark.parametrize("name", CLASSES)
def test_each_class_has_one_contact_box_of_its_size(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(files.SCANS_VARIABLE, raising=False)
    known = mjcf.class_file(name, "published")
    (box,) = (geom for geom in known.body.iter("geom") if not mjcf.is_visual(geom))
    x, y, z = mjcf.parse_numbers(box.attrib["size"])
    assert (known.radius, known.bottom, known.top) == (max(x, y), -z, z)
    assert all(Path(one.attrib["file"]).is_file() for one in known.assets() if "file" in one.attrib)
    assert known.stand_in


def test_strict_tasks_ignore_scans(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(files.SCANS_VARIABLE, str(tmp_path))
    assert not mjcf.class_file("artichoke", "strict").stand_in


# --- LIBERO's files and scans ---


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
    task = get_task(DRAWER)
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


# --- the user's objects ---

PAGE = Path(__file__).parents[2] / "docs/develop/add_an_object_class.md"
BLOCK = re.compile(r'^```(\w+)(?: title="([^"\n]+)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)
TASK = "my_tasks/object/put_the_sponge_on_the_plate"
XML = "my_objects/sponge/sponge.xml"


def scripts() -> list[str]:
    """Return the page's Python programs: the one that draws the texture, and the one that draws the scene."""
    return [text for kind, _, text in BLOCK.findall(PAGE.read_text()) if kind == "python"]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with the page's files, which is the working folder."""
    for _, name, text in BLOCK.findall(PAGE.read_text()):
        if name:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(files.OBJECTS_VARIABLE, "my_objects")
    monkeypatch.delenv(files.SCANS_VARIABLE, raising=False)
    exec(scripts()[0], {})
    return tmp_path


def test_the_guides_example(place: Path) -> None:
    exec(scripts()[1], {})
    image = np.asarray(Image.open(place / "sponge.png")).astype(int)
    green = (image[..., 1] > image[..., 0] + 20) & (image[..., 1] > image[..., 2] + 20)
    assert 50 < green.sum() < 20_000  # the texture's stripe
    env = MemobenchEnv(TASK)
    env.reset(seed=7)
    for _ in range(5):
        observation, *_ = env.step(np.zeros(7, np.float32))
    assert np.ptp(observation["pixels"]["image"]) > 100
    sponge = env.episode.sim.assets["sponge_1"]
    assert [grasp.width for grasp in sponge.grasps] == pytest.approx([0.05])
    assert env.episode.stand_ins == ()


def test_the_expert_solves_the_guides_task(place: Path) -> None:
    episode = Episode(load_task(TASK), demonstration_prompt=False)
    episode.reset(7)
    while not episode.done and not episode.success:
        episode.step(episode.expert_action())
    assert episode.success


def sites(**places: str) -> tuple[str, str]:
    """Return a replacement of all sites by these."""
    lines = "".join(f'<site name="{name}_site" pos="{pos}"/>' for name, pos in places.items())
    return r"(?s)</body>\s*<site.*/>\s*</body>", f"</body>{lines}</body>"


FAULTS = {
    "plugin": ("<asset>", "<asset><plugin/>", "<plugin>.*expected only mujoco, asset"),
    "include": ("<asset>", '<include file="/etc/passwd"/><asset>', "<include>"),
    "another file": ('file="sponge.png"', 'fileup="sponge.png"', "'fileup'.*expected 'file' only"),
    "outside": ('file="sponge.obj"', 'file="../outside.obj"', "'../outside.obj', which is not in its folder"),
    "link": ('file="sponge.obj"', 'file="link.obj"', "'link.obj', which is not in its folder"),
    "no mesh": ('file="sponge.obj"', 'file="sponge.xml"', "no object file"),
    "unnamed": ('texture name="tex-sponge"', "texture", "an asset without a name"),
    "no contact": ('group="0"', 'group="0" contype="0" conaffinity="0"', "no contact geom in group 0"),
    "outer geom": ('<body name="object">', '<geom size="1"/><body name="object">', "a body 'object' with all geoms"),
    "not XML": ("</mujoco>", "", "no object file .*ParseError"),
    "not MJCF": ('size="0.025 0.04 0.015"', 'sise="1"', "no object file .*sise"),
    "no site": (*sites(bottom="0 0 -1", top="0 0 1"), "no pos of horizontal_radius_site, expected sites bottom_site"),
    "no place": (' pos="0 0 0.015"', "", "no pos of top_site"),
    "NaN": (*sites(bottom="0 0 nan", top="0 0 1", horizontal_radius="1 0 0"), "bottom_site at z=nan"),
    "swapped": (*sites(bottom="0 0 1", top="0 0 -1", horizontal_radius="1 0 0"), "z=1 and top_site at z=-1"),
    "radius": (*sites(bottom="0 0 -1", top="0 0 1", horizontal_radius="0 1 0"), "x=0, expected a positive"),
    "numbers": (*sites(bottom="0 0 -1", top="a", horizontal_radius="0 1 0"), "no object file"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_that_cannot_be_used_is_an_error(place: Path, fault: str) -> None:
    found, instead, message = FAULTS[fault]
    path = place / XML
    (place / "my_objects/outside.obj").write_bytes(path.with_name("sponge.obj").read_bytes())
    path.with_name("link.obj").symlink_to(place / "my_objects/outside.obj")
    changed = re.sub(found, instead, path.read_text(), count=1)
    assert changed != path.read_text()
    path.write_text(changed)
    with pytest.raises(MemobenchError, match=f"(?s)sponge.*{message}") as error:
        mjcf.class_file("sponge", "published").assets()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("linked", ["my_objects/sponge", XML])
def test_links_are_errors(place: Path, linked: str) -> None:
    (place / linked).rename(place / "elsewhere")
    (place / linked).symlink_to(place / "elsewhere")
    with pytest.raises(MemobenchError, match=r"found a link to .*elsewhere"):
        mjcf.class_file("sponge", "published")


def test_missing_classes_are_errors(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for scans in ("", str(place)):
        monkeypatch.setenv(files.SCANS_VARIABLE, scans)
        with pytest.raises(MemobenchError, match=r"'spnge' \(did you mean 'sponge'.*set MEMOBENCH_OBJECTS to a folder"):
            mjcf.class_file("spnge", "published")
    with pytest.raises(MemobenchError, match=r"the class of an object is '\.\./sponge'"):
        mjcf.class_file("../sponge", "published")
    (place / XML).unlink()
    with pytest.raises(MemobenchError, match=r"sponge\.xml is no object file .*No such file"):
        mjcf.class_file("sponge", "published")
    monkeypatch.setenv(files.OBJECTS_VARIABLE, "my_things")
    with pytest.raises(MemobenchError, match=r"MEMOBENCH_OBJECTS is '.*my_things', expected a folder"):
        mjcf.class_file("biscuit", "published")


@pytest.mark.parametrize("name", ["plate", "biscuit", "kitchen_table"])
def test_names_of_built_in_classes_are_refused(place: Path, name: str) -> None:
    (place / "my_objects" / name).mkdir()
    with pytest.raises(MemobenchError, match=f"{name} has the name of a built-in class"):
        mjcf.class_file("sponge", "published")


def test_another_folder_is_another_scene(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = load_task(TASK)
    width = get_scene(task).assets["sponge_1"].grasps[0].width
    (place / "my_objects").rename(place / "others")
    path = place / "others/sponge/sponge.xml"
    path.write_text(path.read_text().replace('size="0.025', 'size="0.02'))
    monkeypatch.setenv(files.OBJECTS_VARIABLE, "others")
    assert get_scene(task).assets["sponge_1"].grasps[0].width == pytest.approx(width - 0.01)


def drawn(text: str) -> NDArray[np.float64]:
    """Return position, normal and texture coordinate of each drawn vertex in the world (V, 8), sorted."""
    spec = mujoco.MjSpec.from_string(text)
    folder = Path(tempfile.mkdtemp(dir="."))  # MuJoCo caches a mesh of a path in the process without its `refpos`
    for part in (*spec.meshes, *spec.textures):
        part.file = str(shutil.copy(Path("my_objects/sponge", part.file), folder.absolute()))
    model, draw_list = drawing_model(spec)
    data, origin = mujoco.MjData(model), draw_list.origin
    mujoco.mj_kinematics(model, data)
    count = int((origin[:, ROW] < len(draw_list.geoms)).sum())
    geoms, position = draw_list.geoms[origin[:count, ROW]], draw_list.points[origin[:count, POSITION]]
    normal, uv = draw_list.vertices[:count, :3], draw_list.vertices[:count, 3:5]
    turns = data.geom_xmat[geoms].reshape(-1, 3, 3)
    place, normal = (np.einsum("vij,vj->vi", turns, vectors) for vectors in (position, normal))
    rows = np.concatenate([place + data.geom_xpos[geoms], normal, uv], axis=1).round(4) + 0.0
    return rows[np.lexsort(rows.T)]


SETTINGS = ('refpos="0.02 0 0"', 'refquat="1 1 0 0"', 'smoothnormal="true"', 'scale="2 1 1"')


def test_settings_of_meshes_are_drawn(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cache of shapes and its placeholders follow all settings of a mesh."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(place))
    text = (place / XML).read_text()
    plain = drawn(text)
    assert np.abs(plain[:, :3]).max(axis=0) == pytest.approx([0.025, 0.04, 0.015])
    assert [
        setting for setting in SETTINGS if np.array_equal(drawn(text.replace("<mesh", f"<mesh {setting}")), plain)
    ] == []
    shifted = text.replace("<mesh", f"<mesh {SETTINGS[0]} {SETTINGS[1]}")
    assert drawn(shifted.replace('"mesh"', '"mesh" pos="0.02 0 0" quat="1 1 0 0"')) == pytest.approx(plain, abs=2e-4)
