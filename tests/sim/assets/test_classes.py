"""Every class builds, has its published size, is stable, and can be grasped, opened or switched."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.assets import registry
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import Builder
from lerobot_memobench.sim.assets.kitchen import TABLE, TABLE_TOP, build_kitchen
from lerobot_memobench.sim.assets.registry import build_asset
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import atoms

TASKS = [get_task(name) for name in task_names()]
OBJECTS = {class_name for task in TASKS for class_name in task.objects.values()}
FIXTURES = {class_name for task in TASKS for class_name in task.fixtures.values()} - {TABLE}
IN_DRAWERS = {task.objects[atom.args[0]] for task in TASKS for atom in atoms(task.goal) if atom.predicate == "in"}

# Collision extents in the published stack, x, y, z in cm (simulation facts of the benchmark).
PUBLISHED = {
    "akita_black_bowl": (10.7, 10.7, 5.1),
    "bbq_sauce": (2.9, 4.7, 10.7),
    "butter": (7.7, 4.0, 1.8),
    "chefmate_8_frypan": (20.4, 35.6, 5.8),
    "flat_stove": (29.7, 19.0, 7.0),
    "ketchup": (3.7, 5.6, 14.6),
    "microwave": (34.5, 26.3, 18.9),
    "milk": (5.3, 5.4, 13.1),
    "moka_pot": (8.1, 14.8, 15.2),
    "plate": (13.7, 13.8, 1.9),
    "white_bowl": (8.1, 8.1, 3.4),
    "wooden_cabinet": (25.5, 22.1, 21.8),
    "wooden_two_layer_shelf": (35.2, 19.1, 21.0),
}
CONTAINERS = {"akita_black_bowl", "white_bowl", "plate", "chefmate_8_frypan"}

Scene = tuple[mujoco.MjModel, mujoco.MjData, Asset]


def kitchen() -> mujoco.MjSpec:
    """Return a kitchen with the solver options of the published stack."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 20
    build_kitchen(spec)
    return spec


def build(class_name: str, yaw: float = 0.0) -> Scene:
    """Return a kitchen with one instance, half a millimetre above the table."""
    spec = kitchen()
    asset = build_asset(spec, "thing_1", class_name)
    body = spec.body("thing_1")
    if asset.kind == "object":
        body.add_freejoint(name="thing_1_joint0")
    body.pos = [0.0, 0.0, TABLE_TOP - asset.bottom + (0.0005 if asset.kind == "object" else 0.0)]
    body.quat = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    model = spec.compile()
    data = mujoco.MjData(model)
    for articulation in asset.articulations.values():
        data.joint(articulation.joint).qpos[0] = articulation.closed_q
    mujoco.mj_forward(model, data)
    return model, data, asset


def geoms(model: mujoco.MjModel, group: int) -> list[int]:
    """Return the ids of the thing's geoms of a group."""
    root = model.body("thing_1").id
    of_thing = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == root]
    return [g for g in of_thing if model.geom_group[g] == group]


def corners(model: mujoco.MjModel, data: mujoco.MjData, group: int) -> np.ndarray:
    """Return points (N, 3) in the thing's frame whose bounding box is that of its geoms of a group."""
    points = []
    body = data.body("thing_1")
    for g in geoms(model, group):
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[g])
            start, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
            local = model.mesh_vert[start : start + count]
        else:
            size, kind = model.geom_size[g], model.geom_type[g]
            if kind == mujoco.mjtGeom.mjGEOM_BOX:
                signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
                local = signs * size
            elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
                a = np.linspace(0, 2 * np.pi, 33)
                ring = np.stack([size[0] * np.cos(a), size[0] * np.sin(a), np.zeros_like(a)], axis=1)
                up = np.array([0.0, 0.0, size[1]])
                local = np.concatenate([ring + up, ring - up])
            else:
                raise AssertionError(f"no corners for geom type {kind}")
        world = local @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
        points.append((world - body.xpos) @ body.xmat.reshape(3, 3))
    return np.concatenate(points)


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {name: build(name) for name in sorted(OBJECTS | FIXTURES)}


@pytest.mark.parametrize("class_name", sorted(OBJECTS | FIXTURES))
def test_facts_agree_with_the_model(class_name: str, scenes: dict[str, Scene]) -> None:
    model, data, asset = scenes[class_name]
    assert asset.kind == ("object" if class_name in OBJECTS else "fixture")
    visual, contact = corners(model, data, 1), corners(model, data, 0)
    both = np.concatenate([visual, contact])
    np.testing.assert_allclose(both.min(axis=0), asset.low, atol=0.004)
    np.testing.assert_allclose(both.max(axis=0), asset.high, atol=0.004)
    np.testing.assert_allclose(visual[:, 2].min(), contact[:, 2].min(), atol=0.002)
    if asset.kind == "fixture" or class_name in CONTAINERS:
        assert asset.bottom == 0
    else:
        assert asset.bottom == pytest.approx(-asset.top, abs=0.003)
    if class_name in PUBLISHED:
        size = 100 * (np.array(asset.high) - np.array(asset.low))
        np.testing.assert_allclose(size, PUBLISHED[class_name], rtol=0.15)
    # Collision and visual geometry agree.
    assert np.all(contact.min(axis=0) > visual.min(axis=0) - 0.004)
    assert np.all(contact.max(axis=0) < visual.max(axis=0) + 0.004)


@pytest.mark.parametrize(
    "class_name", [pytest.param(name, marks=() if name in PUBLISHED else pytest.mark.slow) for name in sorted(OBJECTS)]
)
def test_object_comes_to_rest_upright(class_name: str) -> None:
    model, data, _ = build(class_name, yaw=0.4)
    start = data.body("thing_1").xpos.copy()
    mujoco.mj_step(model, data, 500)
    assert np.abs(data.qvel).max() < 0.01
    assert data.body("thing_1").xmat.reshape(3, 3)[2, 2] > 0.999
    np.testing.assert_allclose(data.body("thing_1").xpos, start, atol=0.003)


@pytest.mark.parametrize("class_name", sorted(OBJECTS))
def test_grasps_fit_gripper_and_object(class_name: str, scenes: dict[str, Scene]) -> None:
    _, _, asset = scenes[class_name]
    assert asset.grasps, "every object can be held somehow"
    for grasp in asset.grasps:
        assert 0 < grasp.width < 0.075
        position = np.array(grasp.position)
        assert np.all(position >= np.array(asset.low) - 1e-6)
        assert np.all(position <= np.array(asset.high) + 1e-6)
        # The palm is about 4.5 cm above the tips.
        assert asset.top - grasp.position[2] < 0.045
    if class_name in IN_DRAWERS:
        assert asset.top - asset.bottom <= 0.0525
        assert asset.radius < 0.075


# --- registry ---


def test_unknown_class_suggests_the_nearest() -> None:
    with pytest.raises(MemobenchError, match="microwave"):
        build_asset(mujoco.MjSpec(), "oven_1", "microwav")


def test_a_registered_builder_has_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_builders", dict(registry._builders))

    def cube(b: Builder) -> Asset:
        b.collision("box", (0.01, 0.01, 0.01), 0.01)
        return b.object((-0.01, -0.01, -0.01), (0.01 * b.variant, 0.01, 0.01))

    registry.register("cork__3", cube)
    spec = mujoco.MjSpec()
    assert build_asset(spec, "a", "cork__3").high[0] == pytest.approx(0.03)
    assert build_asset(spec, "b", "cork__1").high[0] != pytest.approx(0.01)
