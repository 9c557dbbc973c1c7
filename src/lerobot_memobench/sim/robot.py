"""Load the arm of the published stack: robosuite's Panda on the RethinkMount with the PandaGripper.

``panda`` contains the arm of robosuite 1.4.0, which LIBERO uses. ``scripts/robosuite_arm.py`` writes it.
"""

from __future__ import annotations

from functools import cache
from html import escape
from pathlib import Path

import mujoco
import numpy as np

FOLDER = Path(__file__).with_name("panda")
"""Folder of the arm's MJCF and meshes."""

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


@cache
def robot_xml() -> str:
    """Return the MJCF of the arm and robosuite's physics options, with absolute file paths."""
    return (FOLDER / "panda.xml").read_text(encoding="utf-8").replace('file="', f'file="{escape(str(FOLDER))}/')


def hide_helpers(spec: mujoco.MjSpec) -> None:
    """Hide the arm's debugging sites, and disable contacts of its visual geoms."""
    for geom in spec.geoms:
        if geom.meshname and "vis" not in geom.meshname and geom.group == 1:
            geom.contype, geom.conaffinity = 0, 0
    # Cameras of the published stack do not show robosuite's grip site and axes.
    for site in spec.sites:
        site.group = 4
