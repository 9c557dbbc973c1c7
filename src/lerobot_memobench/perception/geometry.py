"""Camera geometry: poses of both cameras from the robot's state, projection, and lines of sight."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.asset import AGENTVIEW_ANGLE, AGENTVIEW_POSITION, AGENTVIEW_QUATERNION

Array = NDArray[np.float64]
View = Mapping[str, Array] | NDArray[np.void]
"""One camera, or (...) of them: ``eye`` (..., 3) its position, m; ``turned`` (..., 3, 3) its rotation, it looks along
-z; ``slope`` (...) tangent of half its field of view."""

WRIST_POSITION = (0.05, 0.0, -0.097)
"""The wrist camera's position in the hand's frame, from between the finger tips, m."""
WRIST_ROTATION = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""Its rotation in the hand's frame."""
ANGLES = {"agentview": AGENTVIEW_ANGLE, "wrist": 75.0}
"""Fields of view, degrees."""


def views_of(state: NDArray[np.floating]) -> dict[str, View]:
    """Return the views of both cameras for a robot state (>= 6,): the hand's position and axis-angle rotation."""
    return {camera: view_of(camera, state) for camera in ANGLES}


def view_of(camera: str, state: NDArray[np.floating]) -> View:
    """Return the view of a camera (`agentview` or `wrist`) for a robot state, see `views_of`."""
    slope = np.tan(np.radians(ANGLES[camera]) / 2)
    if camera == "agentview":
        turned = Rotation.from_quat(AGENTVIEW_QUATERNION, scalar_first=True).as_matrix()
        return {"eye": np.array(AGENTVIEW_POSITION), "turned": turned, "slope": slope}
    hand = Rotation.from_rotvec(np.asarray(state[3:6], np.float64)).as_matrix()
    return {
        "eye": state[:3] + hand @ np.array(WRIST_POSITION),
        "turned": hand @ np.array(WRIST_ROTATION),
        "slope": slope,
    }


def projected(positions: Array, view: View) -> tuple[Array, Array]:
    """Project points (..., 3) of the world: places (..., 2) in the image, and depths (...) along the view, m.

    Places are fractions of the image's side, x to the right and y down, from its upper left corner.
    """
    local = np.einsum("...ij,...i->...j", view["turned"], positions - view["eye"])
    depth = -local[..., 2]
    reach = np.maximum(np.abs(depth), 1e-3) * view["slope"]
    return np.stack([1 + local[..., 0] / reach, 1 - local[..., 1] / reach], axis=-1) / 2, depth


def rays(places: Array, view: View) -> Array:
    """Return the lines of sight (..., 3) in the world through places (..., 2), of depth one along the camera's view."""
    slope = np.asarray(view["slope"])
    across, up = (2 * places[..., 0] - 1) * slope, (1 - 2 * places[..., 1]) * slope
    local = np.stack([across, up, -np.ones_like(across)], axis=-1)
    return np.asarray(np.einsum("...ij,...j->...i", view["turned"], local))


def depth_at_height(sight: Array, height: Array, view: View) -> Array:
    """Return the depth (...) at which lines of sight (..., 3) meet a height; very large if they point up."""
    return np.asarray((height - view["eye"][2]) / np.minimum(sight[..., 2], -1e-3))
