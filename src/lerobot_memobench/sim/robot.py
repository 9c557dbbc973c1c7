"""The arm of the published stack: robosuite's Panda on the RethinkMount with the PandaGripper.

The kinematics, masses, collision geometry and actuators are robosuite's own files, untouched. Only what is drawn is
thinned: the visual meshes have 182,000 faces, most of which are never a pixel at 256×256, and a frame with all of them
costs three times one without. Frames of quality ``high`` are drawn from the whole ones (`whole_arm`).
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
"""robosuite is none of our requirements: pip would also install what it requires, a second `cv2` and a keyboard library
that has to be compiled."""
ARM_SHA256 = "477a3b019b26022236d3c82372d29d86dc784d1f2bade46103e232c12467e48f"
"""Of the composed MJCF, without folders, and its meshes."""

BASE_POSITION = (-0.66, 0.0, 0.0)
"""Foot of the mount, m: x = −0.16 − table length / 2 (robosuite's offset for a table of 1 m)."""

ARM_START = (0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.22675220, np.pi / 4)
"""Joint angles at reset, rad (LIBERO's mounted Panda)."""

GRIPPER_START = (0.020833, -0.020833)
"""Finger positions at reset, m."""

GRIPPER_OPEN = (0.04, -0.04)
"""Finger positions of the open hand, m. They creep towards it for seconds: fingers that stand there from the start, as
in the strict suite, do not tell how long ago they were closed."""

ARM_JOINTS = tuple(f"robot0_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
ARM_ACTUATORS = tuple(f"robot0_torq_j{i}" for i in range(1, 8))
FINGER_ACTUATORS = ("gripper0_gripper_finger_joint1", "gripper0_gripper_finger_joint2")
GRIP_SITE = "gripper0_grip_site"
HAND_BODY = "robot0_right_hand"
WRIST_CAMERA = "robot0_eye_in_hand"

FACES_PER_SQUARE_METRE, LEAST_FACES, MOST_FACES = 6_000, 24, 700
"""Density at which a visual mesh is drawn (a link of the arm has about 0.1 m²), and what one may have at least and at
most."""
HAND_FACES = 4
"""How much denser the gripper is drawn: the wrist camera sees it from near."""

Vertices = NDArray[np.float64]
"""(N, 3) points, m."""
Faces = NDArray[np.int32]
"""(M, 3) indices of vertices, counter-clockwise from outside."""


def robosuite_version() -> str:
    """Return the installed version of robosuite.

    Raises:
        MemobenchError: it is not installed, or has another arm.
    """
    try:
        found = importlib.metadata.version("robosuite")
    except importlib.metadata.PackageNotFoundError:
        found = ""
    if found != ROBOSUITE:
        there = f"robosuite {found}" if found else "none"
        raise MemobenchError(f"the arm is that of robosuite {ROBOSUITE}, found {there}; run: {INSTALL_ROBOSUITE}")
    return found


def _robosuite_xml() -> str:
    """Compose the arm's MJCF with robosuite, quietly: it warns about macro files that nobody needs here."""
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
    """Return the MJCF text and, for each visual mesh, its thinned vertices and faces."""
    xml = _robosuite_xml()
    if arm_hash(xml) != ARM_SHA256:
        raise MemobenchError(
            f"the arm's files are not those of robosuite {ROBOSUITE}; run: {INSTALL_ROBOSUITE} --force-reinstall"
        )
    arrays: dict[str, np.ndarray] = {"xml": np.array(xml)}
    drawn = set(re.findall(r'group="1"[^>]*\bmesh="([^"]+)"', xml))
    drawn |= set(re.findall(r'\bmesh="([^"]+)"[^>]*group="1"', xml))
    for name, file in re.findall(r'<mesh name="([^"]+)" file="([^"]+)"', xml):
        # A mesh that is also collided with (a link drawn and felt by one file) keeps its own shape.
        if name not in drawn or not ("vis" in name or "pedestal" in name):
            continue
        vertices, faces = read_mesh(Path(file))
        density = FACES_PER_SQUARE_METRE * (HAND_FACES if name.startswith("gripper0") else 1)
        target = max(LEAST_FACES, min(MOST_FACES, int(density * area(vertices, faces))))
        vertices, faces = simplify(vertices, faces, target)
        arrays[f"v:{name}"], arrays[f"f:{name}"] = vertices, faces
    return arrays


def arm_hash(xml: str) -> str:
    """Return the hash of an MJCF text, without folders, and of the mesh files that it names."""
    digest = hashlib.sha256(re.sub(r'file="[^"]*/', 'file="', xml).encode())
    for file in re.findall(r'<mesh name="[^"]+" file="([^"]+)"', xml):
        digest.update(Path(file).read_bytes())
    return digest.hexdigest()


def _cache_file() -> Path:
    """Where the thinned arm is kept between processes, named by all that it depends on."""
    source = Path(__file__).read_bytes()
    versions = robosuite_version() + importlib.metadata.version("fast-simplification")
    key = hashlib.sha256(source + versions.encode()).hexdigest()[:16]
    return cache_folder() / f"panda-{key}.npz"


@cache
def _arrays() -> dict[str, np.ndarray]:
    """Load the thinned arm from the cache, or build it; a cache that cannot be written costs time, nothing else."""
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
    """Return the MJCF of the arm and robosuite's physics options, its visual meshes with all their faces."""
    return str(_arrays()["xml"])


def robot_spec() -> mujoco.MjSpec:
    """Return a fresh spec that holds the arm and robosuite's physics options, for a scene to be added to."""
    spec = mujoco.MjSpec.from_string(robot_xml())
    _thin(spec)
    hide_helpers(spec)
    return spec


def _thin(spec: mujoco.MjSpec) -> None:
    """Give the arm of a scene the thinned meshes."""
    arrays = _arrays()
    for mesh in spec.meshes:
        if f"v:{mesh.name}" in arrays:
            mesh.file = ""
            mesh.uservert = arrays[f"v:{mesh.name}"].ravel().tolist()
            mesh.userface = arrays[f"f:{mesh.name}"].ravel().tolist()


def hide_helpers(spec: mujoco.MjSpec) -> None:
    """Draw nothing of the arm of a scene that a camera does not see, and let nothing touch what is drawn alone."""
    for geom in spec.geoms:
        if geom.meshname and "vis" not in geom.meshname and geom.group == 1:
            geom.contype, geom.conaffinity = 0, 0
    # robosuite draws the grip site and its axes for debugging; a camera of the published stack does not see them.
    for site in spec.sites:
        site.group = 4


@cache
def whole_arm() -> mujoco.MjModel:
    """Return the arm alone, its visual meshes with all their faces. It is compiled once, in less than a second."""
    return mujoco.MjModel.from_xml_string(robot_xml())


# --- meshes: read and thinned out, since a face costs the same whether it is a pixel or not ---


def read_mesh(path: Path) -> tuple[Vertices, Faces]:
    """Read the points and triangles of an OBJ or binary STL file, equal points merged.

    Raises:
        MemobenchError: for any other kind of file.
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
    """Merge the points that share a cell of a grid, m, and drop the faces that collapse."""
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
    """Reduce a mesh to about ``target`` faces by quadric edge collapse; smaller meshes come back as they are.

    CAD meshes are many loose shells, at whose seams no edge may collapse: points much nearer to each other than the
    faces to come are merged first.
    """
    if len(faces) <= target:
        return vertices, faces
    side = np.sqrt(2 * area(vertices, faces) / target)
    vertices, faces = weld(vertices, faces, side / 6)
    if len(faces) <= target:
        return vertices, faces
    import fast_simplification  # only the first scene on a machine needs it

    points, triangles = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=target, agg=5)
    return points.astype(np.float64), triangles.astype(np.int32)
