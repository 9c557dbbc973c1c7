"""Load the arm of the published stack: robosuite's Panda on the RethinkMount with the PandaGripper.

Kinematics, masses, collision geometry and actuators are robosuite's original files. Only visual meshes are simplified:
their 182,000 faces are mostly smaller than a pixel at 256×256 and would triple the cost of a frame. Frames of quality
``high`` use the original meshes (`whole_arm`).
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import logging
import re
import warnings
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import cache_folder, draft_of

ROBOSUITE = "1.4.1"
INSTALL_ROBOSUITE = f"pip install --no-deps robosuite=={ROBOSUITE}"
"""robosuite is not a declared requirement: pip would also install its dependencies, a second `cv2` and a keyboard
library that must be compiled."""
ARM_SHA256 = "477a3b019b26022236d3c82372d29d86dc784d1f2bade46103e232c12467e48f"
"""SHA-256 of the composed MJCF without folder names, and its meshes."""

BASE_POSITION = (-0.66, 0.0, 0.0)
"""Base of the mount, m: x = −0.16 − table length / 2 (robosuite's offset for a table of 1 m)."""

ARM_START = (0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.22675220, np.pi / 4)
"""Joint angles at reset, rad (LIBERO's mounted Panda)."""

GRIPPER_START = (0.020833, -0.020833)
"""Finger positions at reset, m."""

GRIPPER_OPEN = (0.04, -0.04)
"""Finger positions of the open hand, m. Opening fingers approach them for seconds; strict episodes start there, so that
the finger positions do not reveal the time since they were closed."""

ARM_JOINTS = tuple(f"robot0_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
ARM_ACTUATORS = tuple(f"robot0_torq_j{i}" for i in range(1, 8))
FINGER_ACTUATORS = ("gripper0_gripper_finger_joint1", "gripper0_gripper_finger_joint2")
GRIP_SITE = "gripper0_grip_site"
HAND_BODY = "robot0_right_hand"
WRIST_CAMERA = "robot0_eye_in_hand"

FACE_DENSITY, MIN_FACES, MAX_FACES = 6_000, 24, 700
"""Face density of simplified visual meshes (a link has about 0.1 m²), and bounds of the number of faces per mesh."""
GRIPPER_DENSITY_FACTOR = 4
"""Factor of the gripper's face density, because the wrist camera is close to it."""

Vertices = NDArray[np.float64]
"""(N, 3) points, m."""
Faces = NDArray[np.int32]
"""(M, 3) indices of vertices, counter-clockwise from outside."""


def robosuite_version() -> str:
    """Return the installed version of robosuite.

    Raises:
        MemobenchError: robosuite is missing or has another version.
    """
    try:
        found = importlib.metadata.version("robosuite")
    except importlib.metadata.PackageNotFoundError:
        found = ""
    if found != ROBOSUITE:
        installed = f"robosuite {found}" if found else "none"
        raise MemobenchError(f"the arm requires robosuite {ROBOSUITE}, found {installed}; run: {INSTALL_ROBOSUITE}")
    return found


def _robosuite_xml() -> str:
    """Compose the arm's MJCF with robosuite, without its warnings about unused macro files."""
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from robosuite.models.grippers import gripper_factory
        from robosuite.models.mounts import mount_factory
        from robosuite.models.robots import Panda
        from robosuite.models.world import MujocoWorldBase

        arm = Panda(idn=0)
        arm.add_mount(mount_factory("RethinkMount", idn=0))
        arm.add_gripper(gripper_factory("PandaGripper", idn=0))
        arm.set_base_xpos(np.array(BASE_POSITION))
        world = MujocoWorldBase()
        world.merge(arm)
        return str(world.get_xml())


def _build() -> dict[str, np.ndarray]:
    """Return the MJCF text and, for each visual mesh, its simplified vertices and faces."""
    xml = _robosuite_xml()
    if arm_hash(xml) != ARM_SHA256:
        raise MemobenchError(
            f"the arm's files are not those of robosuite {ROBOSUITE}; run: {INSTALL_ROBOSUITE} --force-reinstall"
        )
    arrays: dict[str, np.ndarray] = {"xml": np.array(xml)}
    drawn = set(re.findall(r'group="1"[^>]*\bmesh="([^"]+)"', xml))
    drawn |= set(re.findall(r'\bmesh="([^"]+)"[^>]*group="1"', xml))
    for name, file in re.findall(r'<mesh name="([^"]+)" file="([^"]+)"', xml):
        # Keep the shape of a mesh that is both visual and collision geometry.
        if name not in drawn or not ("vis" in name or "pedestal" in name):
            continue
        vertices, faces = read_mesh(Path(file))
        density = FACE_DENSITY * (GRIPPER_DENSITY_FACTOR if name.startswith("gripper0") else 1)
        target = max(MIN_FACES, min(MAX_FACES, int(density * area(vertices, faces))))
        vertices, faces = simplify(vertices, faces, target)
        arrays[f"v:{name}"], arrays[f"f:{name}"] = vertices, faces
    return arrays


def arm_hash(xml: str) -> str:
    """Return the hash of an MJCF text without folder names and of its mesh files."""
    digest = hashlib.sha256(re.sub(r'file="[^"]*/', 'file="', xml).encode())
    for file in re.findall(r'<mesh name="[^"]+" file="([^"]+)"', xml):
        digest.update(Path(file).read_bytes())
    return digest.hexdigest()


def _cache_file() -> Path:
    """Return the cache file of the simplified arm, named by a hash of everything it depends on."""
    source = Path(__file__).read_bytes()
    versions = robosuite_version() + importlib.metadata.version("fast-simplification")
    key = hashlib.sha256(source + versions.encode()).hexdigest()[:16]
    return cache_folder() / f"panda-{key}.npz"


@cache
def _arrays() -> dict[str, np.ndarray]:
    """Load the simplified arm from the cache, or build it; an unwritable cache only costs time."""
    path = _cache_file()
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError):
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        if all(Path(f).exists() for f in re.findall(r'file="([^"]+)"', str(arrays["xml"]))):
            return arrays
    arrays = _build()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(path) as draft:
            np.savez(draft, **arrays)  # type: ignore[arg-type]  # numpy's stub wants one type for all
    return arrays


def robot_xml() -> str:
    """Return the MJCF of the arm and robosuite's physics options, with the original visual meshes."""
    return str(_arrays()["xml"])


def robot_spec() -> mujoco.MjSpec:
    """Return a new spec with the arm and robosuite's physics options, as the base of a scene."""
    spec = mujoco.MjSpec.from_string(robot_xml())
    _thin(spec)
    hide_helpers(spec)
    return spec


def _thin(spec: mujoco.MjSpec) -> None:
    """Replace the arm's visual meshes in a scene by the simplified ones."""
    arrays = _arrays()
    for mesh in spec.meshes:
        if f"v:{mesh.name}" in arrays:
            mesh.file = ""
            mesh.uservert = arrays[f"v:{mesh.name}"].ravel().tolist()
            mesh.userface = arrays[f"f:{mesh.name}"].ravel().tolist()


def hide_helpers(spec: mujoco.MjSpec) -> None:
    """Hide the arm's debugging sites, and disable contacts of its visual geoms."""
    for geom in spec.geoms:
        if geom.meshname and "vis" not in geom.meshname and geom.group == 1:
            geom.contype, geom.conaffinity = 0, 0
    # Cameras of the published stack do not show robosuite's grip site and axes.
    for site in spec.sites:
        site.group = 4


@cache
def whole_arm() -> mujoco.MjModel:
    """Return the arm alone with its original visual meshes; compiled once, in less than a second."""
    return mujoco.MjModel.from_xml_string(robot_xml())


# --- reading and simplifying meshes ---


def read_mesh(path: Path) -> tuple[Vertices, Faces]:
    """Read the points and triangles of an OBJ or binary STL file, equal points merged.

    Raises:
        MemobenchError: the file has another format.
    """
    corners: NDArray[np.float64]
    faces: NDArray[np.integer]
    suffix = path.suffix.lower()
    if suffix == ".stl":
        raw = path.read_bytes()
        count = int.from_bytes(raw[80:84], "little")
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(raw, record, count, offset=84)["corners"].reshape(-1, 3).astype(np.float64)
        faces = np.arange(3 * count).reshape(-1, 3)
    elif suffix == ".obj":
        lines = path.read_text().splitlines()
        corners = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float64)
        polygons = [[int(c.split("/")[0]) for c in line.split()[1:]] for line in lines if line.startswith("f ")]
        faces = np.array([[p[0], p[i], p[i + 1]] for p in polygons for i in range(1, len(p) - 1)])
        faces = np.where(faces > 0, faces - 1, faces + len(corners))
    else:
        raise MemobenchError(f"cannot read the mesh {path}: expected an .obj or binary .stl file")
    return weld(corners, faces.astype(np.int32), 1e-6)


def weld(vertices: Vertices, faces: Faces, cell: float) -> tuple[Vertices, Faces]:
    """Merge points that share a grid cell of size ``cell``, m, and drop collapsed faces."""
    grid = np.round(vertices / cell).astype(np.int64)
    _, first, index = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[faces].astype(np.int32)
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices[first], faces[whole]


def area(vertices: Vertices, faces: Faces) -> float:
    """Return the surface of a mesh, m²."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def simplify(vertices: Vertices, faces: Faces, target: int) -> tuple[Vertices, Faces]:
    """Reduce a mesh to about ``target`` faces by quadric edge collapse; return smaller meshes unchanged.

    CAD meshes consist of many separate shells, and edges at their seams cannot collapse. Points much closer than the
    resulting edge length are therefore merged first.
    """
    if len(faces) <= target:
        return vertices, faces
    side = np.sqrt(2 * area(vertices, faces) / target)
    vertices, faces = weld(vertices, faces, side / 6)
    if len(faces) <= target:
        return vertices, faces
    import fast_simplification  # needed for the first scene on a machine only

    points, triangles = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=target, agg=5)
    return points.astype(np.float64), triangles.astype(np.int32)
