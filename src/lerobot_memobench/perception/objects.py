"""Place detections of both cameras in the world, as the object slots of `sim.object_slots`, without a simulator.

The inputs are the present images and the robot's state; the slots include detection errors. Tilt and the front of an
object are not detected: objects are assumed to be upright and to face the direction in which tasks place them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import pi

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from lerobot_memobench.perception.detector import Detections, Detector, detections
from lerobot_memobench.perception.visual_encoder import area_averaged
from lerobot_memobench.sim.asset import (
    AGENTVIEW_ANGLE,
    AGENTVIEW_POSITION,
    AGENTVIEW_QUATERNION,
    CLASSES,
    TABLE_TOP,
    UNKNOWN_CLASS,
)
from lerobot_memobench.sim.object_layout import SLOTS, WIDTH, field
from lerobot_memobench.sim.object_slots import classes, fill_slots
from lerobot_memobench.sim.placement import quaternion_matrix, sample_orientation
from lerobot_memobench.sim.simulation import MJCF_CAMERAS

Array = NDArray[np.float64]
View = Mapping[str, Array] | NDArray[np.void]
"""One camera, or (...) of them: ``eye`` (..., 3) its position, m; ``turned`` (..., 3, 3) its rotation, it looks along
-z; ``slope`` (...) tangent of half its field of view."""

WRIST_POSITION = (0.05, 0.0, -0.097)
WRIST_ROTATION = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""The wrist camera's pose in the hand's frame, from between the finger tips, m."""
ANGLES = {"agentview": AGENTVIEW_ANGLE, "wrist": 75.0}  # fields of view, degrees

DRAWERS = ("top_drawer", "middle_drawer", "bottom_drawer")
"""Each drawer is a kind of its own: drawers are closer together than two objects of one kind that can be separated."""
PARTS = (*DRAWERS, "door", "knob")  # kinds that have a joint; their indices come first
ONE = frozenset({*PARTS, "flat_stove", "kitchen_table", "microwave", "wooden_cabinet", "wooden_two_layer_shelf"})
"""Kinds with one object per scene."""
FACING = {"flat_stove": 0.0, "knob": pi / 2} | dict.fromkeys(
    ("drawer", "door", "microwave", "wooden_cabinet", "wooden_two_layer_shelf"), pi
)
"""Class of fixture or part -> angle of its x axis in the world, as tasks place it and at joint position 0, rad."""
MIN_SCORE_ALONE = 0.1  # of a detection by one camera alone
APART, SAME = 0.03, 0.04
"""Smallest distance of two objects of a kind, and largest distance of two cameras' detections of one object, m."""
LIT = 0.5  # smallest probability of a highlighted object
WRIST_RANGE = 0.2
"""Depth up to which the wrist camera may give an object's rotation more precisely than the other camera, m."""
LEAST_ERROR = 0.0005  # m; keeps precisions finite


# -- geometry of the cameras -------------------------------------------------------------------------------------------


def views_of(state: NDArray[np.floating]) -> dict[str, View]:
    """Return both cameras' views for a robot state (>= 6,): the hand's position, m, and axis-angle rotation, rad."""
    slope = {camera: np.tan(np.radians(angle) / 2) for camera, angle in ANGLES.items()}
    fixed = Rotation.from_quat(AGENTVIEW_QUATERNION, scalar_first=True).as_matrix()
    hand = Rotation.from_rotvec(np.asarray(state[3:6], np.float64)).as_matrix()
    eye = state[:3] + hand @ np.array(WRIST_POSITION)
    return {
        "agentview": {"eye": np.array(AGENTVIEW_POSITION), "turned": fixed, "slope": slope["agentview"]},
        "wrist": {"eye": eye, "turned": hand @ np.array(WRIST_ROTATION), "slope": slope["wrist"]},
    }


def rays(places: Array, view: View) -> Array:
    """Return the lines of sight (..., 3) in the world through places (..., 2), of depth one along the camera's view."""
    slope = np.asarray(view["slope"])
    across, up = (2 * places[..., 0] - 1) * slope, (1 - 2 * places[..., 1]) * slope
    local = np.stack([across, up, -np.ones_like(across)], axis=-1)
    return np.asarray(np.einsum("...ij,...j->...i", view["turned"], local))


# -- objects -----------------------------------------------------------------------------------------------------------


@dataclass
class DetectedObject:
    """An object, by the detections of one camera or of both."""

    kind: int
    score: float
    cameras: tuple[str, ...]
    depth: float  # from the camera that placed it, m
    position: Array  # of its origin in the world, m
    precision: Array  # (3, 3) inverse covariance of the position, 1/m²
    axis: Array  # (3,) its x axis or the opposite one, level
    joint: float  # m or rad
    lit: float  # probability of a highlight around it

    def merge(self, other: DetectedObject, unique: bool) -> None:
        """Merge the detection of another camera with a lower score; ``unique``: a scene has one object of this kind."""
        # Positions are averaged by their precisions. The rotation is that of the higher score, except the wrist
        # camera's from a large distance. The origins of fixtures and their parts, unique kinds, are outside the wrist
        # camera's image, so the other camera alone places them.
        outside = other if self.cameras[0] == "wrist" else self
        self.cameras += other.cameras
        self.lit = max(self.lit, other.lit)
        both = self.precision + other.precision
        mean = np.linalg.solve(both, self.precision @ self.position + other.precision @ other.position)
        self.position, self.precision = (outside.position, outside.precision) if unique else (np.asarray(mean), both)
        if self.cameras[0] == "wrist" and (unique or self.depth > WRIST_RANGE):
            self.depth, self.axis, self.joint = other.depth, other.axis, other.joint


class ObjectLocalizer:
    """Detect objects in both cameras' images and place them in the world; kinds without a class are ignored."""

    def __init__(self, detector: Detector) -> None:
        self.detector = detector
        names = ["drawer" if kind in DRAWERS else kind for kind in detector.kinds]
        self._unique = [kind in ONE for kind in detector.kinds]
        self._class = [classes().index(name) if name in classes() else None for name in names]

    @torch.inference_mode()
    def __call__(self, images: Mapping[str, Tensor], states: Tensor) -> Tensor:
        """Return object slots (N, `object_slots.SIZE`), float32.

        ``images`` of each camera are (N, 3, H, H) in [0, 1]; ``states`` (N, >= 6) are as for `views_of`.
        """
        both = torch.cat([area_averaged(images[camera]) for camera in MJCF_CAMERAS])  # one pass is faster than two
        detected = detections(self.detector(both))
        hands = states.cpu().numpy().astype(np.float64)
        slots = []
        for row in range(len(hands)):
            by_camera = dict(zip(MJCF_CAMERAS, detected[row :: len(hands)], strict=True))
            slots.append(self.slots(by_camera, views_of(hands[row])))
        return torch.stack(slots)

    def slots(self, detected: Mapping[str, Detections], views: Mapping[str, View]) -> Tensor:
        """Return the slots (SIZE,) of each camera's detections at one time."""
        rows, positions = [], []
        for obj in sorted(self.objects(detected, views)[:SLOTS], key=lambda obj: obj.kind):
            kind = self.detector.kinds[obj.kind]
            joint = obj.joint if kind in PARTS else 0.0
            positions.append(obj.position * (kind not in DRAWERS))  # drawers are in the order of kinds, from the top
            lit = float(obj.lit > LIT)
            rows.append([1.0, self._class[obj.kind], *obj.position, *obj.axis, 0.0, 0.0, 0.0, joint, lit])
        slots = torch.from_numpy(fill_slots(np.array(rows).reshape(-1, WIDTH), np.array(positions).reshape(-1, 3)))
        return upright(slots.unflatten(0, (SLOTS, WIDTH))).flatten()

    def objects(self, detected: Mapping[str, Detections], views: Mapping[str, View]) -> list[DetectedObject]:
        """Return the objects by each camera's detections at one time, highest score first."""
        single = [self._located(camera, views[camera], row) for camera in detected for row in detected[camera]]
        objects: list[DetectedObject] = []
        for new in sorted(single, key=lambda obj: -obj.score):
            if self._class[new.kind] is None:
                continue
            known = next((obj for obj in objects if self._same(obj, new)), None)
            if known is None:
                objects.append(new)
            elif new.cameras[0] not in known.cameras:
                known.merge(new, self._unique[new.kind])
        return [obj for obj in objects if len(obj.cameras) > 1 or obj.score > MIN_SCORE_ALONE]

    def _same(self, known: DetectedObject, new: DetectedObject) -> bool:
        if known.kind != new.kind or self._unique[new.kind]:
            return known.kind == new.kind
        apart = APART if new.cameras[0] in known.cameras else SAME
        return float(np.linalg.norm(known.position - new.position)) < apart

    def _located(self, camera: str, view: View, detection: np.void) -> DetectedObject:
        sight, turned = rays(detection["place"].astype(np.float64), view), np.asarray(view["turned"])
        angle = np.arctan2(detection["turn"][1], detection["turn"][0]) / 2
        axis = np.cos(angle) * turned[:, 0] + np.sin(angle) * turned[:, 1]
        across, depth_error, height_error = detection["uncertainty"].astype(np.float64)
        if camera == "wrist":
            depth, along = float(detection["depth"]), depth_error
        else:
            down = max(-sight[2], 1e-3)  # a line of sight that points up meets the height very far away
            depth = float((view["eye"][2] - (TABLE_TOP + detection["height"])) / down)
            along = height_error / down
            axis = axis - turned[:, 2] * (axis[2] / turned[2, 2])  # the axis is level, the image is not
        return DetectedObject(
            int(detection["kind"]),
            float(detection["score"]),
            (camera,),
            depth,
            view["eye"] + sight * depth,
            precision(sight, 2 * float(view["slope"]) * abs(depth) * across, along * float(np.linalg.norm(sight))),
            axis,
            float(detection["joint"]),
            float(detection["lit"]),
        )


def precision(sight: Array, across: float, along: float) -> Array:
    """Return the inverse covariance (3, 3), 1/m², for expected errors across a line of sight (3,) and along it, m."""
    line = sight / np.linalg.norm(sight)
    on_it = np.outer(line, line)
    return np.asarray((np.eye(3) - on_it) / max(across, LEAST_ERROR) ** 2 + on_it / max(along, LEAST_ERROR) ** 2)


def upright(slots: Tensor) -> Tensor:
    """Return slots (..., SLOTS, WIDTH) with upright objects that face the direction in which tasks place them.

    Only the x axis of their rotation is used; objects that look the same from all sides have that of their placement.
    """
    slots = slots.clone()
    kind = field(slots, "class").squeeze(-1).long().cpu()
    facing, from_all_sides, y_up = _classes()[kind].to(slots).split(1, dim=-1)
    # Doors and knobs turn about the vertical; a drawer's position, up to 0.16 m, is too small to change the sign below.
    angle = facing + field(slots, "joint")
    front = torch.cat([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    axis = normalize(field(slots, "rotation")[..., :3] * slots.new_tensor([1.0, 1.0, 0.0]), dim=-1, eps=1e-6)
    axis = torch.where((axis * front).sum(dim=-1, keepdim=True) < 0, -axis, axis)
    axis = torch.where(from_all_sides > 0, front, axis)
    x, y, z = axis.split(1, dim=-1)
    y_axis = torch.where(y_up > 0, slots.new_tensor([0.0, 0.0, 1.0]), torch.cat([-y, x, z], dim=-1))
    field(slots, "rotation")[:] = torch.cat([axis, y_axis], dim=-1) * (field(slots, "present") > 0)
    return slots


@cache
def _classes() -> Tensor:
    # (classes, 3): angle of `FACING`, whether it is round, whether its y axis points up
    rows = []
    for name in classes():
        known = CLASSES.get(name, UNKNOWN_CLASS)
        placed = quaternion_matrix(sample_orientation(known.turns, np.random.RandomState(0)))[:, 0]
        rows.append([FACING.get(name, np.arctan2(placed[1], placed[0])), known.round, known.y_up])
    return torch.tensor(rows)
