"""Objects in the world: perfect detections are the simulator's slots, and two cameras detect one object."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lerobot_memobench.experts.expert import highlight_of
from lerobot_memobench.perception.detector import (
    DETECTION,
    MIN_SCORE,
    PACKAGE,
    Detector,
    load_detector,
)
from lerobot_memobench.perception.objects import (
    APART,
    FACING,
    MIN_SCORE_ALONE,
    ONE,
    PARTS,
    SAME,
    ObjectLocalizer,
    views_of,
)
from lerobot_memobench.policies.memobench_mem.objects import in_order
from lerobot_memobench.sim.asset import TABLE_TOP, split_class
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, classes
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from research.detector.labels import Labeller, Rows, kinds, projected
from research.detector.randomisation import reach, settle
from tests.support.labelled_images import BOWLS, DRAWERS, simulation, small_encoder

STOVE = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_the_shelf"
MILK = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
DOOR = "open_and_close_the_microwave"
PLACE = slice(2, 5)


@pytest.fixture(scope="module")
def localizer() -> ObjectLocalizer:
    return ObjectLocalizer(Detector(small_encoder(), kinds()))


def perfect(row: Rows, score: float = 1.0) -> NDArray[np.void]:
    things = row["things"][: row["count"]]
    detected = np.zeros(len(things), DETECTION)
    place, depth = projected(things["position"].astype(float), row)
    detected["kind"], detected["score"], detected["place"], detected["depth"] = things["kind"], score, place, depth
    detected["height"], detected["joint"] = things["position"][:, 2] - TABLE_TOP, things["joint"]
    detected["turn"], detected["lit"] = np.nan_to_num(things["turn"]), things["lit"]
    return detected


def bent(sim: Simulation) -> Simulation:
    here, turned = sim.eef_pose()
    assert reach(sim, here + np.array([0.1, -0.08, -0.1]), turned)
    settle(sim)
    return sim


def objects_of(slots: NDArray[np.float32] | torch.Tensor) -> NDArray[np.float32]:
    """Return the things (n, WIDTH) of an observation."""
    rows = np.asarray(slots).reshape(SLOTS, WIDTH)
    return rows[rows[:, 0] > 0]


@pytest.mark.parametrize("camera", MJCF_CAMERAS)
def test_views_are_the_cameras(camera: str) -> None:
    for sim in (simulation(BOWLS), bent(simulation(DRAWERS))):
        view, own = views_of(sim.proprio())[camera], sim.model.camera(MJCF_CAMERAS[camera]).id
        assert np.allclose(view["eye"], sim.data.cam_xpos[own], atol=1e-5)
        assert np.allclose(view["turned"], sim.data.cam_xmat[own].reshape(3, 3), atol=1e-5)
        assert view["slope"] == pytest.approx(np.tan(np.radians(sim.model.cam_fovy[own]) / 2))


def assert_slots_are_found(
    localizer: ObjectLocalizer, sim: Simulation, only: str = ""
) -> tuple[NDArray[np.float32], ...]:
    """Assert that perfect detections are the simulator's slots, of all classes or one; return both (n, WIDTH)."""
    labeller = Labeller(sim)
    detected = {
        camera: perfect(labeller.take(camera), score) for camera, score in zip(MJCF_CAMERAS, (1.0, 0.9), strict=True)
    }
    found, true = objects_of(localizer.slots(detected, views_of(sim.proprio()))), objects_of(ObjectSlots(sim).observe())
    assert len(true) > 3
    assert (np.diff(found[:, 1]) >= 0).all(), "in the order of their classes"
    compared = [thing for thing in true if only in ("", classes()[int(thing[1])])]
    assert compared
    for thing in compared:
        alike = found[found[:, 1] == thing[1]]
        nearest = alike[np.linalg.norm(alike[:, PLACE] - thing[PLACE], axis=1).argmin()]
        assert np.allclose(nearest, thing, atol=2e-3), classes()[int(thing[1])]
    return found, true


@pytest.mark.parametrize("task", [BOWLS, DRAWERS, STOVE, MILK])
def test_perfect_detections_are_the_simulators_slots(localizer: ObjectLocalizer, task: str) -> None:
    sim = bent(simulation(task))
    sim.highlights = (highlight_of(sim, next(name for name, asset in sim.assets.items() if asset.kind == "object")),)
    _, true = assert_slots_are_found(localizer, sim)
    assert true[:, -1].any()
    assert not true[:, -1].all()


def test_moved_parts_keep_the_direction_of_their_x_axis(localizer: ObjectLocalizer) -> None:
    """An open door and a turned knob point away from where tasks place them by more than a quarter turn."""
    for task, part, joint in ((DOOR, "door", "microwave_1_microjoint"), (STOVE, "knob", "flat_stove_1_button")):
        sim = simulation(task)
        for position in sim.model.joint(joint).range:
            sim.data.joint(joint).qpos[0] = position
            mujoco.mj_fwdPosition(sim.model, sim.data)
            assert_slots_are_found(localizer, sim, part)


def test_drawers_are_in_the_simulators_order_wherever_they_are(localizer: ObjectLocalizer) -> None:
    sim = simulation(DRAWERS)
    for opened in ("top", "middle", "bottom"):
        sim.data.joint(f"wooden_cabinet_1_{opened}_level").qpos[0] = -0.1
        mujoco.mj_fwdPosition(sim.model, sim.data)
        found, true = assert_slots_are_found(localizer, sim)
        noisy = in_order(torch.from_numpy(true[None, ::-1].copy()))[0].numpy()
        for rows in (found, true, noisy):
            heights = rows[rows[:, 1] == classes().index("drawer"), 4]
            assert len(heights) > 1
            assert (np.diff(heights) < 0).all(), "from the top"


def test_fixtures_face_as_tasks_place_them() -> None:
    found: set[str] = set()
    for name in task_names(suite=None):
        task = get_task(name)
        for fixture, where in (atom.args for atom in task.init if atom.predicate == "on" and len(atom.args) == 2):
            kind = task.fixtures.get(fixture)
            if kind is not None:
                assert np.cos(np.array(task.regions[where].yaw) - FACING[kind]).min() > 0.9, (name, kind)
                found.add(kind)
    assert found == FACING.keys() - {"drawer", "door", "knob"}


@pytest.mark.slow
def test_kinds_are_alone_as_assets_say() -> None:
    known: set[str] = set()
    for name in task_names():
        task = get_task(name)
        if {split_class(of)[0] for of in (*task.objects.values(), *task.fixtures.values())} <= known:
            continue
        for asset in Simulation(task).assets.values():
            kind = split_class(asset.class_name)[0]
            known.add(kind)
            assert (kind in ONE) == (asset.kind != "object"), kind
    assert ONE - {*PARTS, "kitchen_table"} <= known


Found = tuple[str, str, float, tuple[float, float]]
"""Camera, kind and score of a detection, and its distance from the hand in x and y, m."""


@pytest.fixture(scope="module")
def state() -> NDArray[np.float64]:
    return bent(simulation(BOWLS)).proprio().astype(float)


assert APART < 0.8 * SAME
HERE, NEAR, NEARER, FAR = (0.0, 0.0), (0.0, 0.8 * SAME), (0.0, 0.8 * APART), (0.0, 0.3)
DOUBTFUL = (MIN_SCORE + MIN_SCORE_ALONE) / 2


@pytest.mark.parametrize(
    ("things", "objects"),
    [
        ([("agentview", "butter", 0.9, HERE), ("wrist", "butter", 0.8, NEAR)], 1),
        ([("agentview", "butter", 0.9, HERE), ("wrist", "milk", 0.8, HERE)], 2),
        ([("agentview", "butter", 0.9, HERE), ("agentview", "butter", 0.8, NEAR)], 2),  # of a kind, close together
        ([("agentview", "butter", 0.9, HERE), ("agentview", "butter", 0.8, NEARER)], 1),
        ([("wrist", "wooden_cabinet", 0.9, HERE), ("agentview", "wooden_cabinet", 0.8, FAR)], 1),  # a scene has one
        # One camera alone needs a higher score.
        ([(camera, "butter", DOUBTFUL, HERE) for camera in MJCF_CAMERAS], 1),
        *(([(camera, "butter", DOUBTFUL, HERE)], 0) for camera in MJCF_CAMERAS),
        *(([(camera, "butter", MIN_SCORE_ALONE + 0.01, HERE)], 1) for camera in MJCF_CAMERAS),
    ],
)
def test_two_cameras_detect_one_object(
    localizer: ObjectLocalizer, state: NDArray[np.float64], things: list[Found], objects: int
) -> None:
    views, rows = views_of(state), {camera: [np.zeros(0, DETECTION)] for camera in MJCF_CAMERAS}
    for camera, kind, score, (x, y) in things:
        row = np.zeros(1, DETECTION)
        place, depth = projected(np.array([[state[0] + x, state[1] + y, 0.91]]), views[camera])
        row["kind"], row["score"], row["turn"] = kinds().index(kind), score, (1.0, 0.0)
        row["place"], row["depth"], row["height"] = place, depth, 0.91 - TABLE_TOP
        rows[camera].append(row)
    slots = localizer.slots({camera: np.concatenate(own) for camera, own in rows.items()}, views)
    assert len(objects_of(slots)) == objects


def test_package_detector_reads_images() -> None:
    detector = load_detector(PACKAGE)
    assert detector.kinds == kinds()
    sim, localizer = simulation(BOWLS), ObjectLocalizer(detector)
    images = {name: torch.from_numpy(sim.render(name)).permute(2, 0, 1)[None] / 255 for name in MJCF_CAMERAS}
    found = localizer(images, torch.from_numpy(sim.proprio())[None])
    assert torch.equal(found, localizer(images, torch.from_numpy(sim.proprio())[None]))
    assert (found.shape, found.dtype) == ((1, SIZE), torch.float32)
    rows = objects_of(found)
    assert len(rows) > 0
    assert not np.asarray(found).reshape(SLOTS, WIDTH)[len(rows) :].any(), "empty slots are last"
    assert np.isin(rows[:, 1], np.arange(len(classes()))).all()
    assert (np.diff(rows[:, 1]) >= 0).all(), "in the order of their classes"
    axes = rows[:, 5:11].reshape(-1, 2, 3)
    assert np.allclose(axes @ axes.transpose(0, 2, 1), np.eye(2), atol=1e-5), "x and y axis of a rotation"
