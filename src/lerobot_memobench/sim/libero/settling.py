"""Settle a stored initial state of LIBERO's suites, as stock LIBERO does with the MuJoCo of its states.

Two facts differ from other control steps:

1. `set_init_state` moves the arm, and robosuite's controller reads the new pose only after the first physics step, in
   which it exerts no torque but that against gravity. In the first control step it returns to the pose of its reset.
2. Up to version 3.3, MuJoCo reports half the depth of contacts between boxes. In some states groceries are 29 mm inside
   the table; at full depth they would leave it twice as fast and be in the air after these steps.
"""

from __future__ import annotations

import mujoco
import numpy as np

from lerobot_memobench.sim.controller import MUJOCO, OSCController
from lerobot_memobench.sim.scene import SUBSTEPS

FULL_DEPTH_SINCE = (3, 4)
"""First version of MuJoCo that reports the full depth of contacts between boxes."""


def settling_step(controller: OSCController, model: mujoco.MjModel, data: mujoco.MjData, first: bool) -> None:
    """Advance one control step without motion and with an open gripper.

    Args:
        controller: controller of the arm.
        model, data: simulation; ``data`` is in the state after `mujoco.mj_step1`, also afterwards.
        first: whether this is the first step after the state was set.
    """
    if not first:
        controller.set_goal(data, np.zeros(6))
    for substep in range(SUBSTEPS):
        if MUJOCO >= FULL_DEPTH_SINCE:
            _halve_depth_of_boxes(model, data)
        if first and substep == 0:
            controller.apply_gravity(data, -1.0)
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
        else:
            controller.advance(data, -1.0, 1)


def _halve_depth_of_boxes(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Halve the depth of contacts between boxes in the reference acceleration of their constraints.

    The impedance is that of the full depth, which is equal for contacts deeper than 2 mm.
    """
    boxes = (model.geom_type[data.contact.geom] == mujoco.mjtGeom.mjGEOM_BOX.value).all(axis=1)
    rows = data.contact.efc_address[boxes & (data.contact.efc_address >= 0)]
    stiffness, _, impedance, _ = data.efc_KBIP[rows].T
    data.efc_aref[rows] += 0.5 * stiffness * impedance * (data.efc_pos[rows] - data.efc_margin[rows])
