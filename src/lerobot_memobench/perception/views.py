"""Where the benchmark's cameras are and what they cover, told by the robot's state: the wrist's hangs on the hand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.scene import AGENTVIEW_ANGLE, AGENTVIEW_POSITION, AGENTVIEW_QUATERNION

Array = NDArray[np.float64]
View = Mapping[str, Array]
"""As rows of `labels.PICTURE` have it: ``eye`` (3,), ``turned`` (3, 3) and ``slope`` ()."""

HUNG_AT = (0.05, 0.0, -0.097)
"""The wrist's camera from between the finger tips, in the hand's frame, m."""
HUNG = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""Its rotation in the hand's frame."""
ANGLES = {"agentview": AGENTVIEW_ANGLE, "wrist": 75.0}
"""Fields of view, degrees."""


def views_of(state: NDArray[np.floating]) -> dict[str, View]:
    """Return the views of both cameras for a robot's state (>= 6,): the hand's place and turn."""
    return {camera: view_of(camera, state) for camera in ANGLES}


def view_of(camera: str, state: NDArray[np.floating]) -> View:
    """Return the view of a camera (`agentview` or `wrist`) for a robot's state, see `views_of`."""
    slope = np.tan(np.radians(ANGLES[camera]) / 2)
    if camera == "agentview":
        turned = Rotation.from_quat(AGENTVIEW_QUATERNION, scalar_first=True).as_matrix()
        return {"eye": np.array(AGENTVIEW_POSITION), "turned": turned, "slope": slope}
    hand = Rotation.from_rotvec(np.asarray(state[3:6], np.float64)).as_matrix()
    return {"eye": state[:3] + hand @ np.array(HUNG_AT), "turned": hand @ np.array(HUNG), "slope": slope}
