"""The package's objects of the scanned classes: files, contacts, and the choice between scan and object."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim import files, mjcf
from lerobot_memobench.sim.robot import SUBSTEPS
from lerobot_memobench.sim.scene import scene_spec, scene_xml
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import Task

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


# --- physics ---

HALF_SIZES: dict[str, tuple[float, float, float]] = {
    "artichoke": (0.029, 0.029, 0.026),
    "bag_of_snacks": (0.023, 0.048, 0.060),
    "bean_curd": (0.025, 0.030, 0.018),
    "beefsteak_tomato__1": (0.031, 0.031, 0.026),
    "biscuit": (0.029, 0.029, 0.012),
    "bottle_of_coffee": (0.029, 0.029, 0.069),
    "bottle_of_detergent__1": (0.029, 0.044, 0.075),
    "bottle_of_fabric_softener": (0.027, 0.038, 0.078),
    "bottle_of_olive_oil__1": (0.027, 0.027, 0.086),
    "bottle_of_protein_powder__2": (0.033, 0.033, 0.060),
    "box_of_cereal__2": (0.021, 0.050, 0.072),
    "box_of_flour": (0.028, 0.043, 0.066),
    "box_of_oatmeal__3": (0.024, 0.048, 0.069),
    "broccoli": (0.032, 0.032, 0.026),
    "brussels_sprouts__2": (0.025, 0.025, 0.024),
    "cap__2": (0.026, 0.026, 0.015),
    "carton_of_milk__6": (0.031, 0.031, 0.079),
    "charger": (0.044, 0.027, 0.019),
    "chestnut__2": (0.020, 0.024, 0.018),
    "cork__3": (0.019, 0.019, 0.026),
}
"""Class -> half extents of its box, m, z up."""
BOX = (
    '<body name="object"><geom type="box" size="{}" group="0" density="100" friction="0.95 0.3 0.1" '
    'solref="0.001 1" solimp="0.998 0.998 0.001"/></body>'
)
SPATIAL = [name for name in task_names() if get_task(name).memory_type == "spatial"]
STEPS = 50


def of_boxes(task: Task, monkeypatch: pytest.MonkeyPatch) -> mujoco.MjModel:
    """Return the model of a task whose scanned classes are boxes of `HALF_SIZES`, without visual geoms."""
    found = mjcf.class_file

    def box(class_name: str, suite: str) -> mjcf.ClassFile:
        if class_name not in HALF_SIZES:
            return found(class_name, suite)
        x, y, z = HALF_SIZES[class_name]
        body = ET.fromstring(BOX.format(mjcf.format_numbers((x, y, z))))
        return mjcf.ClassFile(body, list, max(x, y), -z, z, mjcf.SCAN_TURNS)

    with monkeypatch.context() as patch:
        patch.setattr(mjcf, "class_file", box)
        return scene_spec(task).compile()


def arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return all arrays of a model by name."""
    named = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {name: values for name, values in named.items() if isinstance(values, np.ndarray)}


@pytest.mark.parametrize("name", SPATIAL)
def test_models_equal_those_of_boxes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(files.SCANS_VARIABLE, raising=False)
    task = get_task(name)
    ours, boxes = arrays(scene_spec(task).compile()), arrays(of_boxes(task, monkeypatch))
    assert len(ours) > 300
    assert [field for field in ours if field != "geom_rgba" and not np.array_equal(ours[field], boxes[field])] == []


def with_visual_geoms(task: Task) -> mujoco.MjModel:
    """Return the model of a task with the visual geoms of this package's objects; others take seconds to read."""
    root = ET.fromstring(scene_xml(task, visuals=True))
    bodies = [
        body for body in root.iterfind("worldbody/body") if task.objects.get(body.get("name", "")) not in HALF_SIZES
    ]
    for parent in [part for body in bodies for part in body.iter()]:
        for geom in [one for one in parent if mjcf.is_visual(one)]:
            parent.remove(geom)
    for geom in root.iter("geom"):
        geom.attrib.pop("material", None)
    used, assets = {geom.get("mesh") for geom in root.iter("geom")}, root.find("asset")
    assert assets is not None
    for element in [one for one in assets if one.tag != "mesh" or one.get("name") not in used]:
        assets.remove(element)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def test_scenes_with_visual_geoms_move_as_those_of_boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(files.SCANS_VARIABLE, raising=False)
    sim = Simulation(get_task(SPATIAL[0]))
    sim.reset(7)
    ours = with_visual_geoms(sim.task)
    boxes = of_boxes(sim.task, monkeypatch)
    assert ours.ngeom > boxes.ngeom
    ends = []
    for model in (ours, boxes):
        model.body_pos[:], model.body_quat[:] = sim.model.body_pos, sim.model.body_quat
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        data.qpos[:] = sim.data.qpos
        for _ in range(STEPS):
            data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T) / 4
            mujoco.mj_step(model, data, SUBSTEPS)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    assert np.abs(ends[0][: sim.model.nq] - sim.data.qpos).max() > 0.1
    assert np.array_equal(*ends)
