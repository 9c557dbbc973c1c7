"""A scene as MJCF text, for the attribute ``model_file`` of the published layout; and where fixtures stand in one.

MuJoCo can write a scene that was built in memory, except for pictures: it has no text form for textures that
are not files. They are written as flat ones here, so the text has every body, joint, site, inertia and
collision shape of the scene, at its real place, and plain colours. Meshes of the arm are named by their
files, as robosuite's own ``model_file`` names them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from lerobot_memobench.tasks.task import Task

Pose = NDArray[np.float64]
"""Position and quaternion wxyz, (7,)."""

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def model_file(task: Task, fixture_poses: Mapping[str, Pose]) -> str:
    """Return a task's scene as MJCF, its fixtures at ``fixture_poses`` (written exactly)."""
    root = ElementTree.fromstring(_scene_xml(task))
    bodies = {body.get("name"): body for body in root.iterfind("worldbody/body")}
    for name, pose in fixture_poses.items():
        for key, part in (("pos", pose[:3]), ("quat", pose[3:])):
            bodies[name].set(key, " ".join(repr(float(value)) for value in part))
    return ElementTree.tostring(root, encoding="unicode")


@lru_cache(maxsize=2)
def _scene_xml(task: Task) -> str:
    import mujoco

    from lerobot_memobench.sim.scene import scene_spec

    spec, _ = scene_spec(task)
    for texture in spec.textures:
        texture.data = b""
        texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
        texture.width = texture.height = 16
        texture.rgb1 = [0.8, 0.8, 0.8]
    for mesh in spec.meshes:
        if not mesh.file:
            mesh.usertexcoord = []  # without a picture they say nothing, and MuJoCo writes them incompletely
            mesh.userfacetexcoord = []
    spec.compile()
    return str(spec.to_xml())


def read_fixture_poses(xml: str, names: Iterable[str]) -> dict[str, Pose]:
    """Return where the named fixtures stand in an MJCF text; those it does not have are left out.

    A fixture is the body of its name, or of its name with robosuite's suffix ``_main``.

    Raises:
        MemobenchError: the text is no XML, or a pose in it is no pose.
    """
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise MemobenchError(f"model_file is no XML ({error})") from None
    bodies = {body.get("name"): body for body in root.iter("body")}
    found: dict[str, Pose] = {}
    for name in names:
        body = bodies.get(name, bodies.get(f"{name}_main"))
        if body is None:
            continue
        found[name] = np.concatenate([_numbers(body, "pos", (0.0, 0.0, 0.0)), _numbers(body, "quat", IDENTITY)])
    return found


def _numbers(body: ElementTree.Element, key: str, default: tuple[float, ...]) -> Pose:
    text = body.get(key)
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([])
    if values.shape != (len(default),) or not np.isfinite(values).all():
        raise MemobenchError(
            f"model_file gives the body {body.get('name')} {key}={text!r}, expected {len(default)} numbers"
        )
    return values
