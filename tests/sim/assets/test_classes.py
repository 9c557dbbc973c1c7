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
from lerobot_memobench.sim.assets.registry import build_asset, known_classes
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


def faces(model: mujoco.MjModel) -> int:
    """Return the number of drawn triangles of the thing."""
    count = 0
    for g in geoms(model, 1):
        is_mesh = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH
        count += int(model.mesh(model.geom_dataid[g]).facenum[0]) if is_mesh else 60
    return count


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {name: build(name) for name in sorted(OBJECTS | FIXTURES)}


def test_every_class_of_the_catalogue_is_known() -> None:
    families = {registry.split_class(name)[0] for name in OBJECTS | FIXTURES | {TABLE}}
    assert families == set(known_classes())


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


@pytest.mark.parametrize("class_name", sorted(OBJECTS | FIXTURES))
def test_light_and_plausible(class_name: str, scenes: dict[str, Scene]) -> None:
    model, _, asset = scenes[class_name]
    assert faces(model) <= 700
    assert len(geoms(model, 0)) <= 45
    assert not any(model.geom_contype[g] or model.geom_conaffinity[g] for g in geoms(model, 1))
    root = model.body("thing_1").id
    for body in range(model.nbody):
        if model.body_rootid[body] == root:
            assert model.body_mass[body] > 0
            assert np.all(model.body_inertia[body] > 0)
    if asset.kind == "object":
        assert 0.01 <= model.body_subtreemass[root] <= 0.5


@pytest.mark.parametrize("class_name", sorted(OBJECTS))
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


DRAWER = ((-0.16, 0.01), (-0.14, 0.0, np.nan, np.nan), (-0.16, -0.07, 0.0, 0.01))
DOOR = ((-2.094, 0.0), (-1.3, -0.005, np.nan, np.nan), (0.0, -0.7, -2.094))
KNOB = ((-0.005, 2.1), (np.nan, np.nan, 0.5, 0.0), (-0.004, 0.3, 2.09))
"""Limits of a joint, thresholds (open, closed, on, off), and positions, m or rad."""


@pytest.mark.parametrize(
    ("class_name", "region", "joint", "facts"),
    [
        *(("wooden_cabinet", f"{level}_region", f"{level}_level", DRAWER) for level in ("top", "middle", "bottom")),
        ("microwave", "", "microjoint", DOOR),
        ("flat_stove", "", "button", KNOB),
    ],
)
def test_joints_have_published_thresholds_and_hold_positions(
    class_name: str, region: str, joint: str, facts: tuple[tuple[float, ...], ...]
) -> None:
    limits, thresholds, positions = facts
    model, data, asset = build(class_name, yaw=np.pi)
    rule = asset.articulations[region]
    assert rule.joint == f"thing_1_{joint}"
    np.testing.assert_allclose(model.joint(rule.joint).range, limits)
    np.testing.assert_array_equal((rule.open_below, rule.closed_above, rule.on_at_least, rule.off_below), thresholds)
    assert rule.closed_q > rule.closed_above or rule.closed_q < rule.off_below
    assert rule.open_q < rule.open_below or rule.open_q > rule.on_at_least
    for q in (*positions, rule.closed_q, rule.open_q):
        mujoco.mj_resetData(model, data)
        data.joint(rule.joint).qpos[0] = q
        mujoco.mj_step(model, data, 500)
        assert data.joint(rule.joint).qpos[0] == pytest.approx(q, abs=1e-3)


def test_cabinet_regions_are_the_insides_of_the_drawers(scenes: dict[str, Scene]) -> None:
    model, data, asset = scenes["wooden_cabinet"]
    for level in ("top", "middle", "bottom"):
        site = model.site(asset.regions[f"{level}_region"])
        np.testing.assert_allclose(site.size, (0.11, 0.075, 0.03), atol=0.008)
        assert model.body(int(site.bodyid[0])).name == f"thing_1_{level}_drawer"
        # With yaw 0 drawers open to -y: the handle is in front of the region.
        handle = data.site(asset.articulations[f"{level}_region"].handle_site)
        assert handle.xpos[1] < data.site(site.name).xpos[1] - 0.075
        assert asset.articulations[f"{level}_region"].handle.clearance >= 0.025
    assert data.site(asset.regions["top_side"]).xpos[2] == pytest.approx(TABLE_TOP + asset.top - 0.001)


def test_burner_can_glow(scenes: dict[str, Scene]) -> None:
    model, data, asset = scenes["flat_stove"]
    assert asset.glow
    assert asset.glow_on != asset.glow_off
    assert all(model.geom(geom).group[0] == 1 for geom in asset.glow)
    site = model.site(asset.regions["cook_region"])
    top = data.site("thing_1_cook_region").xpos[2] + site.size[2]
    assert top == pytest.approx(TABLE_TOP + asset.supports, abs=1e-6)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ("plate", "milk"),
        ("plate", "butter"),
        ("plate", "akita_black_bowl"),
        ("plate", "white_bowl"),
        ("akita_black_bowl", "butter"),
        ("akita_black_bowl", "milk"),
        ("akita_black_bowl", "akita_black_bowl"),
    ],
)
def test_a_dropped_object_rests_on_its_support(lower: str, upper: str) -> None:
    spec = kitchen()
    below, above = build_asset(spec, "below", lower), build_asset(spec, "above", upper)
    for name in ("below", "above"):
        spec.body(name).add_freejoint(name=f"{name}_joint0")
    spec.body("below").pos = [0, 0, TABLE_TOP - below.bottom]
    spec.body("above").pos = [0.004, 0.003, TABLE_TOP - below.bottom + below.top - above.bottom + 0.005]
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1000)
    assert np.abs(data.qvel).max() < 0.02
    pairs = [{int(model.geom_bodyid[g]) for g in contact.geom} for contact in data.contact]
    assert {model.body(name).id for name in ("below", "above")} in pairs
    offset = data.body("above").xpos - data.body("below").xpos
    assert offset[2] >= 0
    assert np.hypot(*offset[:2]) < 0.03


def test_many_of_a_class_share_mesh_and_texture() -> None:
    spec = mujoco.MjSpec()
    for k in range(9):
        build_asset(spec, f"milk_{k}", "milk")
    model = spec.compile()
    assert (model.nmesh, model.ntex, model.nmat) == (1, 1, 1)


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
