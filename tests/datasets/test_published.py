"""Files as the authors' script writes them in LIBERO's scenes, and their variations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lerobot_memobench.constants import LIBERO
from lerobot_memobench.datasets.convert import convert
from lerobot_memobench.datasets.demonstration import Demonstration, key_frames
from lerobot_memobench.datasets.episodes import read_episode
from lerobot_memobench.datasets.hdf5 import PublishedDemo, PublishedFile
from lerobot_memobench.datasets.restore import joints_of, restore, task_of
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import Simulation
from tests.support import libero_layout
from tests.support.short_demonstrations import drawn_steps, with_images

DRAWER = "check_the_middle_drawer_of_the_cabinet"
MILK = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
OPENED, SHUT = 8, 15
"""Frames of `drawer` at which the drawer is open, and shut again."""


@pytest.fixture(scope="module")
def drawer() -> Demonstration:
    """The middle drawer is opened and closed by its joint; the arm moves at random."""
    demo = drawn_steps(DRAWER, 10_000, 20)
    sim = Simulation(demo.task)
    states = demo.states.copy()
    _, columns = joints_of(sim.model)["wooden_cabinet_1_middle_level"]
    states[:, columns[0]] = np.interp(range(20), [2, OPENED, SHUT - 1, SHUT], [-0.01, -0.15, -0.02, 0.006])
    look, proprio, objects = ObjectSlots(sim), [], []
    for state in states:
        sim.set_state(state, demo.fixture_poses)
        proprio.append(sim.proprio())
        objects.append(look.observe())
    satisfied = np.arange(20)[:, None] >= SHUT
    whole = replace(demo, states=states, proprio=np.array(proprio), objects=np.array(objects), satisfied=satisfied)
    return with_images(whole, 16)


def grey(demo: Demonstration) -> Demonstration:
    image = np.full((len(demo), 16, 16, 3), 128, np.uint8)
    return replace(demo, images={"image": image, "wrist_image": image})


def first(path: Path) -> tuple[PublishedFile, PublishedDemo]:
    with PublishedFile(path) as file:
        return file, file.read(file.groups()[0])


@pytest.mark.parametrize("backwards", [False, True])
def test_file_of_the_authors_script(drawer, tmp_path, backwards):
    """Unknown key frames, groups from 1 on with a gap, bodies in any order: states are equal to the bit."""
    path = libero_layout.write(tmp_path / "drawer_demo.hdf5", drawer, numbers=(1, 4), backwards=backwards)
    summary = convert(path, tmp_path / "ds")
    assert (summary.exit_status, summary.episodes, summary.notes) == (0, 2, ())
    for number in range(2):
        episode = read_episode(tmp_path / "ds", number)
        np.testing.assert_array_equal(episode.columns["states"], drawer.states)
        np.testing.assert_allclose(episode.columns["observation.state"], drawer.proprio, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(episode.columns["privileged.environment_state"], drawer.objects)
        for name, pose in drawer.fixture_poses.items():
            np.testing.assert_array_equal(episode.record.fixture_poses[name], pose)
        assert (episode.record.world, episode.record.key_frames, episode.record.success) == (LIBERO, [SHUT], True)
    with h5py.File(path) as file:
        assert np.array_equal(file["data/demo_1/states"][:], drawer.states) != backwards


def test_variations_of_files(drawer, tmp_path):
    """The name of an open file instead of a text, LIBERO's names of cameras, and some known key frames."""
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
    assert key_frames(restore(task, found)).tolist() == [SHUT - 3]
    both = replace(task, checkpoints=task.checkpoints * 2)
    some = restore(both, replace(found, metadata=found.metadata | {"key_frame": [SHUT - 7, -1]}))
    assert key_frames(some).tolist() == [SHUT - 7, SHUT], "the known one is kept, the other one is evaluated"
    summary = convert(path, tmp_path / "ds")
    assert (summary.exit_status, summary.episodes) == (0, 1)
    assert f"catalogue's {DRAWER}" in str(summary.notes[0])
    with h5py.File(path, "a") as changed:
        changed["data"].attrs["bddl_file_name"] = "src/bddl/temporal/unheard_of/task_config.bddl"
    with pytest.raises(MemobenchError, match="'unheard_of'"):
        task_of(*first(path))
    with h5py.File(path, "a") as changed:
        changed["data/demo_1"].attrs["meta_data"] = libero_layout.FILE_OBJECT
    with pytest.raises(MemobenchError, match=r"meta_data holds .* Python object"):
        first(path)


def test_other_scenes_are_refused(drawer, tmp_path):
    demo = grey(drawn_steps(MILK, 10_000, 6, 2))
    file, found = first(libero_layout.write(tmp_path / "milk.hdf5", demo, timestep_exec_start_idx=2, key_frame=[4]))
    task = task_of(file, found)
    np.testing.assert_array_equal(restore(task, found).states, demo.states)
    ghost = '<body name="ghost"><freejoint name="ghost_joint0"/></body></worldbody>'
    for reason, old, new in [
        ("no joint 'plate_1_joint0'", "plate_1_joint0", "dish_1_joint0"),
        ("body 'ghost' by the joint 'ghost_joint0'", "</worldbody>", ghost),
        ("base 'robot0_base' at .* another scene", 'pos="-0.66 0.0 ', 'pos="0 0 '),
        ("cannot compile", "<body ", '<body pos="1 x" name="b"/><body '),
        ("no XML", "</mujoco>", ""),
    ]:
        with pytest.raises(MemobenchError, match=reason):
            restore(task, replace(found, model_file=found.model_file.replace(old, new, 1)))
    file, found = first(libero_layout.write(tmp_path / "drawer.hdf5", drawer))
    start = found.model_file.index('pos="', found.model_file.index('name="wooden_cabinet_1_main"')) + 5
    x, y, _ = found.model_file[start:].split('"')[0].split()
    moved = f"{found.model_file[:start]}{x} {y} 0.0{found.model_file[found.model_file.index(chr(34), start) :]}"
    with pytest.raises(MemobenchError, match=r"'wooden_cabinet_1' at .* not on the table"):
        restore(task_of(file, found), replace(found, model_file=moved))
