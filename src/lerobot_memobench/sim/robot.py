"""Load the arm of the published stack: robosuite's Panda on the RethinkMount with the PandaGripper.

All files are robosuite's original ones.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import logging
import re
import warnings
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import cache_folder, write_file

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


@cache
def robot_xml() -> str:
    """Return the MJCF of the arm and robosuite's physics options, cached on the machine.

    Composing it with robosuite takes a second; an unwritable cache only costs this time.
    """
    path = _cache_file()
    with contextlib.suppress(OSError, ValueError):
        xml = path.read_text(encoding="utf-8")
        if all(Path(f).exists() for f in _mesh_files(xml)):
            return xml
    xml = _robosuite_xml()
    if arm_hash(xml) != ARM_SHA256:
        raise MemobenchError(
            f"the arm's files are not those of robosuite {ROBOSUITE}; run: {INSTALL_ROBOSUITE} --force-reinstall"
        )
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, xml)
    return xml


def _mesh_files(xml: str) -> list[str]:
    return re.findall(r'<mesh name="[^"]+" file="([^"]+)"', xml)


def arm_hash(xml: str) -> str:
    """Return the hash of an MJCF text without folder names and of its mesh files."""
    digest = hashlib.sha256(re.sub(r'file="[^"]*/', 'file="', xml).encode())
    for file in _mesh_files(xml):
        digest.update(Path(file).read_bytes())
    return digest.hexdigest()


def _cache_file() -> Path:
    """Return the cache file of the arm, named by a hash of everything it depends on."""
    found = importlib.util.find_spec("robosuite")  # the file names meshes of this environment
    places = [] if found is None else list(found.submodule_search_locations or ())
    key = hashlib.sha256(Path(__file__).read_bytes() + repr((robosuite_version(), places)).encode()).hexdigest()[:16]
    return cache_folder() / f"panda-{key}.xml"


def hide_helpers(spec: mujoco.MjSpec) -> None:
    """Hide the arm's debugging sites, and disable contacts of its visual geoms."""
    for geom in spec.geoms:
        if geom.meshname and "vis" not in geom.meshname and geom.group == 1:
            geom.contype, geom.conaffinity = 0, 0
    # Cameras of the published stack do not show robosuite's grip site and axes.
    for site in spec.sites:
        site.group = 4
