"""Build a task's scene of LIBERO's assets: room and table, arm of robosuite 1.4.0, objects, fixtures.

The simulated model has no visual geoms; it moves bit-equally to the complete model and is built in some 25 ms. Visual
assets (80 MB) are loaded for the first image (`visuals`). Seeds change the state of a scene only.
"""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import mjcf, robot
from lerobot_memobench.sim.asset import (
    ALL_CLASSES,
    ALONG_X,
    ALONG_Y,
    ARENAS,
    CLASSES,
    COLLISION_GROUP,
    SITE_GROUP,
    TABLE_SIZE,
    TABLE_TOP,
    UNKNOWN_CLASS,
    VISUAL_GROUP,
    Arena,
    Articulation,
    Asset,
    Grasp,
    Quaternion,
    Triple,
    arena_of,
    split_class,
)
from lerobot_memobench.sim.files import user_folders
from lerobot_memobench.sim.visuals import drawing_model
from lerobot_memobench.tasks.task import STANDARD, STRICT, Task
from mujoco_raster.drawlist import DrawList

Array = NDArray[np.float64]

AGENTVIEW = "agentview"
ARENA_BYTES = 32 * 2**20
"""Memory for contacts and constraints of one simulation. robosuite's files reserve it for 5,000 contacts, 1.3 GB; no
scene uses 1 MB."""
ZONE_HALF_HEIGHT = 0.007  # half height of the site of a table region, m
FREE_DAMPING = "0.0005"
GLOW_SITES = {"flat_stove": "burner"}  # class -> site that LIBERO shows while an instance is on
GLOW = "glow"  # suffix of the name of the geom that replaces the site
GLOW_ON, GLOW_OFF = (0.9, 0.05, 0.05, 1.0), (0.9, 0.05, 0.05, 0.0)
Y_UP = (0.5**0.5, -(0.5**0.5), 0.0, 0.0)
"""Rotation from the frame with z up to that of a body with y up, quaternion wxyz."""
GRASP_DEPTH = 0.032  # depth of a grasp below an object's top, m; fingers reach 4 cm below the palm
MAX_GRASP_WIDTH = 0.068  # largest width of a grasp, m
CACHED_SCENES = 4  # compiled scenes cached per process, some MB each; evaluation runs tasks one after another


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene. The model is shared; modify copies only."""

    model: mujoco.MjModel  # the simulated model, without visual geoms
    assets: dict[str, Asset]  # instance name -> asset: objects, then fixtures without the table
    stand_ins: tuple[str, ...]
    """Published tasks: classes drawn by this package's objects because the paper's scans are not installed."""
    drawing: Callable[[], tuple[mujoco.MjModel, DrawList]]
    """Returns a visual model with equal bodies and joints, and its draw list."""


def get_scene(task: Task) -> Scene:
    """Return the compiled scene of a task, cached per process; raise `MemobenchError` for missing or unknown files."""
    # Variants of a task share their scene, at each difficulty.
    return _build_scene(task.variant(0).at(STANDARD), user_folders())


@lru_cache(maxsize=CACHED_SCENES)
def _build_scene(task: Task, _folders: tuple[str, ...]) -> Scene:
    with _naming(task):
        spec = scene_spec(task)
        model = spec.compile()
    assets = {name: _asset(model, task, name, class_name) for name, class_name in instances(task)}
    if task.suite == STRICT:  # detents depend on the assets, whose sizes come from a compiled model
        add_detents(spec, assets)
        model = spec.compile()
    missing = [class_name for _, class_name in instances(task) if mjcf.class_file(class_name, task.suite).stand_in]

    @cache
    def drawing() -> tuple[mujoco.MjModel, DrawList]:
        with _naming(task):
            return drawing_model(scene_spec(task, visuals=True))

    return Scene(model, assets, tuple(sorted(set(missing))), drawing)


@contextlib.contextmanager
def _naming(task: Task) -> Iterator[None]:
    try:
        yield
    except ValueError as error:  # MuJoCo cannot read a file
        raise MemobenchError(f"the scene of task {task.name} cannot be built: {error}") from None


def instances(task: Task) -> Iterator[tuple[str, str]]:
    """Yield name and class of each instance in LIBERO's order: objects by class, then fixtures by class."""
    for declared in (task.objects, task.fixtures):
        for class_name in dict.fromkeys(declared.values()):
            yield from ((name, class_name) for name in declared if declared[name] == class_name not in ARENAS)


def scene_spec(task: Task, visuals: bool = False) -> mujoco.MjSpec:
    """Return a task's scene as an editable specification, with or without visual geoms, materials and lights."""
    spec = mujoco.MjSpec.from_string(scene_xml(task, visuals))
    spec.modelname = "libero"
    spec.nconmax, spec.njmax, spec.memory = -1, -1, ARENA_BYTES
    if visuals:
        robot.hide_helpers(spec)
        _add_glow(spec, task)
    return spec


def _add_glow(spec: mujoco.MjSpec, task: Task) -> None:
    """Add glow geoms of burners; LIBERO shows and hides sites instead."""
    for name, class_name in instances(task):
        if class_name in GLOW_SITES:
            disc = spec.site(f"{name}_{GLOW_SITES[class_name]}")
            shape = {"type": disc.type, "size": disc.size, "pos": disc.pos}
            looks = {"rgba": GLOW_OFF, "group": VISUAL_GROUP, "contype": 0, "conaffinity": 0, "mass": 0.0}
            disc.parent.add_geom(name=f"{name}_{GLOW}", **shape, **looks)


def scene_xml(task: Task, visuals: bool) -> str:
    """Return a task's scene as MJCF with absolute file paths."""
    root = ET.fromstring(robot.robot_xml())
    world, assets = root.find("worldbody"), root.find("asset")
    assert world is not None
    assert assets is not None
    arena = arena_of(task)
    _place_arm(world, arena)
    room = mjcf.arena(arena.file)
    for index, element in enumerate(_room(room, arena, task)):
        world.insert(index, element)
    classes: dict[str, mjcf.ClassFile] = {}
    for name, class_name in instances(task):
        classes[class_name] = known = mjcf.class_file(class_name, task.suite)
        body = mjcf.instance(class_name, name, known)
        if name in task.objects:
            joint = {"name": f"{name}_joint0", "type": "free", "damping": FREE_DAMPING}
            body.insert(0, ET.Element("joint", joint))
        else:
            _add_handles(body, name, class_name)
        world.append(body)
    for class_name, known in classes.items():
        if visuals or known.collides_by_mesh:  # other files need not be found for physics
            assets.extend(mjcf.shared_assets(class_name, known))
    assets.extend(_room_assets(room, arena))
    if not visuals:
        _strip(world, assets)
    return ET.tostring(root, encoding="unicode")


# --- arm, room and table ---


def _place_arm(world: ET.Element, arena: Arena) -> None:
    base, mount = _body(world, "robot0_base"), _body(world, "mount0_base")
    x, y, z = arena.base
    if arena.mounted:
        z = mjcf.parse_numbers(base.attrib["pos"])[2]
    else:
        mount.clear()
        mount.attrib.update(name="mount0_base", pos="0 0 0")
    base.set("pos", mjcf.format_numbers((x, y, z)))


def _body(root: ET.Element, name: str) -> ET.Element:
    return next(body for body in root.iter("body") if body.get("name") == name)


def _room(room: ET.Element, arena: Arena, task: Task) -> Iterator[ET.Element]:
    for element in room.iterfind("worldbody/*"):
        if element.tag == "body" and element.get("name") == arena.body:
            if arena.lays_out:
                _lay_out(element, arena.friction)
            element.extend(_zones(arena, task))
        if element.tag != "camera":
            yield element
    view = mjcf.format_numbers(arena.camera_position), mjcf.format_numbers(arena.camera_quaternion)
    yield ET.Element("camera", {"name": AGENTVIEW, "mode": "fixed", "pos": view[0], "quat": view[1]})


def _lay_out(table: ET.Element, friction: tuple[float, float, float] | None) -> None:
    x, y, half = (side / 2 for side in TABLE_SIZE)
    table.set("pos", mjcf.format_numbers((0, 0, TABLE_TOP - half)))
    leg = (TABLE_TOP - half) / 2
    corners = iter(((1, 1), (-1, 1), (-1, -1), (1, -1)))
    for part in table:
        name = part.get("name", "")
        if name in ("table_collision", "table_visual"):
            part.set("size", mjcf.format_numbers((x, y, half)))
        elif name == "table_top":
            part.set("pos", mjcf.format_numbers((0, 0, half)))
        elif name.startswith("table_leg"):
            right, back = next(corners)
            part.set("pos", mjcf.format_numbers((right * (x - 0.1), back * (y - 0.1), -leg)))
            part.set("size", mjcf.format_numbers((0.025, leg)))
        if name == "table_collision" and friction is not None:
            part.set("friction", mjcf.format_numbers(friction))


def _zones(arena: Arena, task: Task) -> Iterator[ET.Element]:
    x, y, z = arena.zones
    for name, region in task.regions.items():
        if task.fixtures.get(region.target) in ARENAS and region.ranges:
            x1, y1, x2, y2 = region.ranges[0]
            pos = mjcf.format_numbers(((x2 + x1) / 2 + x, (y2 + y1) / 2 + y, z))
            size = mjcf.format_numbers(((x2 - x1) / 2, (y2 - y1) / 2, ZONE_HALF_HEIGHT))
            yield ET.Element("site", {"name": name, "type": "box", "group": str(SITE_GROUP), "pos": pos, "size": size})


def _room_assets(room: ET.Element, arena: Arena) -> Iterator[ET.Element]:
    chosen = {"texplane": arena.floor, "tex-wall": arena.wall}
    for element in room.iterfind("asset/texture"):
        if element.get("name") in chosen:
            element.set("file", f"../textures/{chosen[element.attrib['name']]}")
    yield from mjcf.assets_of(room, "scenes")


# --- objects and fixtures ---


def _add_handles(body: ET.Element, name: str, class_name: str) -> None:
    """Add an invisible site at the centre of each handle, for experts."""
    for _, part in ALL_CLASSES.get(class_name, UNKNOWN_CLASS).parts:
        pose = {"pos": mjcf.format_numbers(part.handle), "quat": mjcf.format_numbers(part.handle_quaternion)}
        site = {"name": f"{name}_{part.handle_site}", "group": str(SITE_GROUP), **pose, "size": "0.005"}
        _body(body, f"{name}_{part.body}").append(ET.Element("site", site))


def _strip(world: ET.Element, assets: ET.Element) -> None:
    """Remove visual geoms, materials, lights and colours; MuJoCo's rays pass through transparent geoms."""
    _remove(world, lambda element: element.tag == "light")
    _remove(world, mjcf.is_visual)
    for geom in world.iter("geom"):
        for name in ("material", "rgba"):
            geom.attrib.pop(name, None)
    used = {geom.get("mesh") for geom in world.iter("geom")}
    _remove(assets, lambda element: element.tag != "mesh" or element.get("name") not in used)


def _remove(root: ET.Element, unwanted: Callable[[ET.Element], bool]) -> None:
    for parent in list(root.iter()):
        for child in [child for child in parent if unwanted(child)]:
            parent.remove(child)


def standing_heights() -> dict[str, float]:
    """Return class -> height of its origin above its support, m; variants by the name of their family."""
    root = ET.fromstring("<mujoco><asset/><worldbody/></mujoco>")
    classes = {split_class(name)[0]: name for name in (*CLASSES, *mjcf.own_objects())}
    for family, name in classes.items():
        root[1].append(mjcf.instance(name, family, mjcf.class_file(name, STRICT)))
    _strip(root[1], root[0])
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    upright = {family: Y_UP if CLASSES.get(name, UNKNOWN_CLASS).y_up else None for family, name in classes.items()}
    return {family: -_bounds(model, model.body(family).id, turn)[0][2] for family, turn in upright.items()}


def _asset(model: mujoco.MjModel, task: Task, name: str, class_name: str) -> Asset:
    known = ALL_CLASSES.get(class_name, UNKNOWN_CLASS)
    upright = Y_UP if known.y_up else None
    root = model.body(name).id
    low, high = _bounds(model, root, upright)
    own_boxes = (model.body_rootid[model.site_bodyid] == root) & (model.site_type == mujoco.mjtGeom.mjGEOM_BOX)
    regions = [model.site(site).name for site in np.flatnonzero(own_boxes)]
    is_object = name in task.objects
    contains = not np.isnan(known.floor)
    return Asset(
        name=name,
        class_name=class_name,
        kind="object" if is_object else "fixture",
        low=low,
        high=high,
        grasps=(known.grasps or _by_the_sides(low, high)) if is_object else (),
        articulations={region: replace(part, joint=f"{name}_{part.joint}") for region, part in known.parts},
        regions={full.removeprefix(f"{name}_"): full for full in regions},
        supports=known.floor if contains else high[2],
        clear_radius=known.clear if contains else 0.0,
        round=known.round,
        upright=upright,
    )


def _by_the_sides(low: Triple, high: Triple) -> tuple[Grasp, ...]:
    x, y, z = (np.add(low, high) / 2).tolist()
    centre = (x, y, max(z, high[2] - GRASP_DEPTH))
    widths = {ALONG_X: high[0] - low[0], ALONG_Y: high[1] - low[1]}
    return tuple(
        Grasp(centre, yaw, widths[yaw])
        for yaw in sorted(widths, key=widths.__getitem__)
        if widths[yaw] <= MAX_GRASP_WIDTH
    )


def _bounds(model: mujoco.MjModel, root: int, upright: Quaternion | None) -> tuple[Triple, Triple]:
    """Return the corners of the bounding box of an instance's collision geoms, in its asset's frame, joints at zero."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frame, origin = data.xmat[root].reshape(3, 3), data.xpos[root]
    if upright is not None:
        frame = frame @ Rotation.from_quat(upright, scalar_first=True).as_matrix()
    corners = []
    for geom in range(model.ngeom):
        if model.body_rootid[model.geom_bodyid[geom]] == root and model.geom_group[geom] == COLLISION_GROUP:
            turn = frame.T @ data.geom_xmat[geom].reshape(3, 3)
            middle = frame.T @ (data.geom_xpos[geom] - origin) + turn @ model.geom_aabb[geom][:3]
            half = np.abs(turn) @ model.geom_aabb[geom][3:]
            corners.append((middle - half, middle + half))
    lows, highs = zip(*corners, strict=True)
    (x1, y1, z1), (x2, y2, z2) = np.min(lows, axis=0).tolist(), np.max(highs, axis=0).tolist()
    return (x1, y1, z1), (x2, y2, z2)


# --- detents ---

DETENT_LEVER = 0.05  # distance from a hinge to the spring's moving end, m
DETENT_OFFSET, DETENT_SLACK = 0.5, 2.5
"""Distance from the spring's fixed end to the path of the moving end, and the spring's rest length, in units of the
distance from dead centre to the closed end."""
STIFF_STOP_SOLREF = (0.004, 1.0)
"""`solref` of the stop: twice the physics step, the stiffest stable value; the spring moves the joint by microns."""

DEAD_CENTRE = {"drawer": 0.009, "door": 0.035, "knob": 0.09}
"""Distance of the spring's dead centre from the closed end, m or rad."""
_DETENT_FORCE = {"drawer": 5.0, "door": 0.45, "knob": 0.15}
"""Force of the spring at the closed end, N or Nm; exceeds the joint's friction at every closed position."""


def add_detents(spec: mujoco.MjSpec, assets: Mapping[str, Asset]) -> None:
    """Add to each drawer, door and knob a stop at its initial position and a spring that holds it there."""
    # In the published scenes a drawer that was pushed closed is up to 5 mm deeper than an untouched one, and doors and
    # knobs rest where they are released, so images reveal past events. As in furniture, an over-centre spring near the
    # closed end presses the joint against its stop. Away from that end it is slack and motion is as published.
    for asset in assets.values():
        for articulation in asset.articulations.values():
            joint = spec.joint(articulation.joint)
            joint.solref_limit = list(STIFF_STOP_SOLREF)
            if articulation.kind == "drawer":
                joint.range = [joint.range[0], articulation.closed_q]
            _add_spring(spec, spec.body(asset.name), joint, articulation)


def _add_spring(
    spec: mujoco.MjSpec, fixture: mujoco.MjsBody, joint: mujoco.MjsJoint, articulation: Articulation
) -> None:
    travel, press = DEAD_CENTRE[articulation.kind], _DETENT_FORCE[articulation.kind]
    lever = 1.0 if articulation.kind == "drawer" else DETENT_LEVER
    reach = travel * lever
    dead_centre = articulation.closed_q + np.sign(articulation.open_q - articulation.closed_q) * travel
    point, position = _moving_point(joint, lever, dead_centre)
    turn = Rotation.from_quat(joint.parent.quat, scalar_first=True)  # LIBERO's knob is turned by 90°
    fixed = joint.parent.pos + turn.apply(position) + DETENT_OFFSET * reach * np.array([0.0, 0.0, 1.0])
    ends = {"fixed": (fixture, fixed), "moving": (joint.parent, point)}
    tendon = spec.add_tendon(name=f"{joint.name}_detent", group=SITE_GROUP)
    for end, (body, offset) in ends.items():
        name = f"{joint.name}_detent_{end}"
        body.add_site(name=name, pos=offset.tolist(), size=[0.001] * 3, group=SITE_GROUP)
        tendon.wrap_site(name)
    closed = float(np.hypot(1.0, DETENT_OFFSET))
    pushes = (DETENT_SLACK - closed) / closed * reach * lever
    stiffness = press / pushes
    # Newer MuJoCo versions expect polynomial coefficients.
    tendon.stiffness = stiffness if np.ndim(tendon.stiffness) == 0 else [stiffness, 0.0, 0.0]
    tendon.springlength = [DETENT_SLACK * reach, 1.0]


def _moving_point(joint: mujoco.MjsJoint, lever: float, q: float) -> tuple[Array, Array]:
    """Return the spring's moving end in the moving part's frame, and its position at ``q`` in the parent's, (3,), m."""
    axis = np.asarray(joint.axis)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        return np.zeros(3), q * axis
    point = np.array([lever, 0.0, 0.0])
    return point, Rotation.from_rotvec(q * axis).apply(point)
