"""Files as the authors' script writes them in LIBERO's scenes, and how they differ."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_memobench.datasets.convert import convert
from lerobot_memobench.datasets.demonstration import Demonstration, labels
from lerobot_memobench.datasets.hdf5.model_file import DEEPEST, LONGEST_TEXT, joints_of
from lerobot_memobench.datasets.hdf5.reading import PublishedDemo, PublishedFile
from lerobot_memobench.datasets.hdf5.restore import restore, task_of
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.object_layout import FIELDS, SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.task import LIBERO
from tests.support import libero_layout
from tests.support.libero import needs_assets
from tests.support.short_demonstrations import drawn_steps

pytestmark = needs_assets

DRAWER = "check_the_middle_drawer_of_the_cabinet"
SHORT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
STOCK = Path("/work/shared/reference/published_layout/drawer.hdf5")


OPENED, SHUT = 8, 15
"""Frames of `drawer` at which the drawer is open, and shut again."""


@pytest.fixture(scope="module")
def drawer() -> Demonstration:
    """The middle drawer is drawn out and pushed back, by hand; the arm and the bowl do something else meanwhile."""
    demo = drawn_steps(DRAWER, 10_000, 20, world=LIBERO)
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
    return grey(changed)


def grey(demo: Demonstration) -> Demonstration:
    """Return it with pictures that show nothing."""
    picture = np.full((len(demo), 16, 16, 3), 128, np.uint8)
    return replace(demo, images={"image": picture, "wrist_image": picture})


def first(path: Path) -> tuple[PublishedFile, PublishedDemo]:
    with PublishedFile(path) as file:
        return file, file.read(file.groups()[0])


@pytest.mark.parametrize("backwards", [False, True])
def test_a_file_as_the_authors_script_writes_it(drawer, tmp_path, backwards):
    """Unknown key frames, groups from 1 on with a gap, things in any order: all is as it was, states to the bit."""
    path = libero_layout.write(tmp_path / "drawer_demo.hdf5", drawer, numbers=(1, 4), backwards=backwards)
    summary = convert(path, tmp_path / "ds")
    assert (summary.exit_status, summary.episodes, summary.notes) == (0, 2, ())
    for number in range(2):
        episode = read_episode(tmp_path / "ds", number)
        np.testing.assert_array_equal(episode.columns["states"], drawer.states)
        np.testing.assert_allclose(episode.columns["observation.state"], drawer.proprio, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(episode.columns["privileged.environment_state"], drawer.objects)
        for name, pose in drawer.fixture_poses.items():
            np.testing.assert_array_equal(episode.whole["fixture_poses"][name], pose)
        assert (episode.world, episode.whole["key_frames"], episode.whole["success"]) == (LIBERO, [SHUT], True)
    with h5py.File(path) as file:
        assert np.array_equal(file["data/demo_1/states"][:], drawer.states) != backwards


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


def test_what_cannot_be_placed_is_refused_by_name(tmp_path):
    demo = grey(drawn_steps(SHORT, 10_000, 6, 2, LIBERO))
    file, found = first(libero_layout.write(tmp_path / "milk.hdf5", demo, timestep_exec_start_idx=2, key_frame=[4]))
    task = task_of(file, found)
    np.testing.assert_array_equal(restore(task, found).states, demo.states)

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
    said("arm's base 'robot0_base' at .* another scene", lambda xml: xml.replace('pos="-0.66 0.0 ', 'pos="0 0 '))
    said("has a <composite> in its worldbody", lambda xml: xml.replace("</worldbody>", "<composite/></worldbody>"))
    said("attribute 'childclass', which is not read", lambda xml: xml.replace("<body ", '<body childclass="a" ', 1))
    said("pos is '1 x', expected 3 numbers", lambda xml: xml.replace("<body ", '<body pos="1 x" name="b"/><body ', 1))
    said("no MJCF", lambda xml: "<scene/>")
    said("no XML", lambda xml: xml[:-30])
    said("declares a document type", lambda xml: '<!DOCTYPE a [<!ENTITY b "c">]>' + xml)
    said("characters, more than", lambda xml: "x" * (LONGEST_TEXT + 1))
    said("or some 60 deep", lambda xml: "<mujoco>" + "<body>" * DEEPEST + xml)


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
        bowl = fact["joints"]["akita_black_bowl_1_joint0"][:3]
        assert np.linalg.norm(things[:, where] - bowl, axis=1).min() < 2e-4
        (middle,) = fact["joints"]["wooden_cabinet_1_middle_level"]
        assert abs(things[1, STARTS["joint"]] - middle) < 2e-4, "it stays in one slot"
    for number, told in enumerate(truth.values()):
        assert read_episode(tmp_path / "ds", number).whole["key_frames"] == told["meta"]["key_frame"]


def test_without_liberos_assets_a_sentence_says_what_to_install(drawer, tmp_path, monkeypatch):
    path = libero_layout.write(tmp_path / "drawer_demo.hdf5", drawer)
    monkeypatch.setenv("MEMOBENCH_LIBERO_ASSETS", str(tmp_path))
    with pytest.raises(MemobenchError, match=r"LIBERO's asset .* is missing"):
        convert(path, tmp_path / "ds")


def test_two_worlds_make_no_dataset(drawer, tmp_path):
    libero_layout.write(tmp_path / "a.hdf5", drawer)
    path = libero_layout.write(tmp_path / "b.hdf5", drawer)
    with h5py.File(path, "a") as file:
        attributes = file["data/demo_1"].attrs
        attributes["model_file"] = attributes["model_file"].replace('model="base"', 'model="memobench"')
    summary = convert(tmp_path, tmp_path / "ds")
    assert summary.episodes == 1
    assert "its scenes are of world=memobench, those before of libero" in str(summary.problems[0])
