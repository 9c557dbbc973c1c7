"""The package's objects of the scanned classes: files, contacts, motion, and the choice between scan and object."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim import files, mjcf
from lerobot_memobench.sim.robot import SUBSTEPS
from lerobot_memobench.sim.scene import scene_spec
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task

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


def test_visual_geoms_change_no_motion() -> None:
    """The simulated model has none."""
    sim = Simulation(get_task("put_the_tomato_into_the_top_drawer_of_the_cabinet"))
    sim.reset(7)
    ends = []
    for visuals in (False, True):
        model = scene_spec(sim.task, visuals).compile()
        model.body_pos[:], model.body_quat[:] = sim.model.body_pos, sim.model.body_quat
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        data.qpos[:] = sim.data.qpos
        for _ in range(50):
            data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T) / 4
            mujoco.mj_step(model, data, SUBSTEPS)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    assert np.abs(ends[0][: sim.model.nq] - sim.data.qpos).max() > 0.1
    np.testing.assert_array_equal(*ends)
