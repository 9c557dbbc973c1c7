"""Objects that eyes find in both cameras' pictures, as slots: what `sim.object_slots` says, without a simulator.

Nothing is known but the present pictures and where the hand is. What stands in slots is what was found, right or
wrong. How things are tilted is not looked for, nor where they have their front, which is taken to be where tasks have
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from lerobot_memobench.perception.finding import found
from lerobot_memobench.perception.kinds import DRAWERS, PARTS
from lerobot_memobench.perception.labels import level_depth, rays
from lerobot_memobench.perception.tower import shrunk
from lerobot_memobench.perception.views import View, views_of
from lerobot_memobench.perception.weights import Eyes
from lerobot_memobench.sim.object_layout import SLOTS, WIDTH, field
from lerobot_memobench.sim.object_slots import classes, in_slots
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.sim.simulation import MJCF_CAMERAS

Array = NDArray[np.float64]
Things = NDArray[np.void]

ONE = frozenset({*PARTS, "flat_stove", "kitchen_table", "microwave", "wooden_cabinet", "wooden_two_layer_shelf"})
"""Kinds of which a scene has one."""
TURNED = ONE - {"flat_stove", "kitchen_table", "knob"} | {"drawer"}
"""Kinds, and the class of drawers, whose x axis points to the robot; that of others points away from it, as near as
half a turn allows."""
# fmt: off
ROUND = frozenset({
    "akita_black_bowl", "artichoke", "beefsteak_tomato", "biscuit", "bottle_of_coffee",
    "bottle_of_olive_oil", "bottle_of_protein_powder", "broccoli", "brussels_sprouts", "cap",
    "cork", "plate", "white_bowl",
})
# fmt: on
"""Kinds that are alike from all sides: their x axis is taken to be the world's, as tasks place them."""
ALONE = 0.1
"""Probability from which on what one camera alone finds is there."""
APART, SAME = 0.03, 0.04
"""How near to one another two things of a kind can stand, and how far apart two cameras may see one thing, m."""
LIT = 0.5
"""Probability from which on a thing is said to stand in a highlight."""
NEAR = 0.2
"""Depth up to which the wrist's camera may see better than the other how things lie, m."""
LEAST = 0.0005
"""No place is taken to be surer than this, m."""


@dataclass
class Sighting:
    """A thing that was found.

    Attributes:
        cameras: that found it. depth: from the one by which it was placed, m.
        place: of its origin in the world, m. sureness: (3, 3) the inverse covariance of that, 1/m².
        axis: (3,) its x axis or the opposite one, level. joint: m or rad.
        lit: probability that it stands in a highlight.
    """

    kind: int
    score: float
    cameras: tuple[str, ...]
    depth: float
    place: Array
    sureness: Array
    axis: Array
    joint: float
    lit: float

    def seen_too(self, other: Sighting, one: bool) -> None:
        """Take in how another camera, less sure of it, sees this thing, which is the only one of its kind if ``one``.

        What each says of its place counts as much as it is sure of it, along its line of sight and across. The surer
        one says how it lies, unless it is the wrist's and far. Fixtures and their parts, whose origin is outside the
        wrist's picture, are placed from outside alone.
        """
        outside = other if self.cameras[0] == "wrist" else self
        self.cameras += other.cameras
        self.lit = max(self.lit, other.lit)
        both = self.sureness + other.sureness
        place = np.linalg.solve(both, self.sureness @ self.place + other.sureness @ other.place)
        self.place, self.sureness = (outside.place, outside.sureness) if one else (np.asarray(place), both)
        if self.cameras[0] == "wrist" and (one or self.depth > NEAR):
            self.depth, self.axis, self.joint = other.depth, other.axis, other.joint


class ObjectFinder:
    """Look for objects through eyes; kinds that this version does not know are passed over."""

    def __init__(self, eyes: Eyes) -> None:
        self.eyes = eyes
        names = ["drawer" if kind in DRAWERS else kind for kind in eyes.kinds]
        self._one = [kind in ONE for kind in eyes.kinds]
        self._class = [classes().index(name) if name in classes() else None for name in names]

    @torch.inference_mode()
    def __call__(self, pictures: Mapping[str, Tensor], states: Tensor) -> Tensor:
        """Return the slots (N, `object_slots.SIZE`) float32 of N moments.

        Args:
            pictures: of each camera, `agentview` and `wrist`, (N, 3, H, H) in [0, 1].
            states: (N, >= 6) the hand's place, m, and its turn as axis times angle, rad.
        """
        both = torch.cat([shrunk(pictures[camera]) for camera in MJCF_CAMERAS])  # one pass is quicker than two
        finds = found(self.eyes.find(both))
        hands = states.cpu().numpy().astype(np.float64)
        slots = []
        for row, hand in enumerate(hands):
            seen = dict(zip(MJCF_CAMERAS, finds[row :: len(hands)], strict=True))
            slots.append(self.slots(seen, views_of(hand)))
        return torch.stack(slots)

    def slots(self, finds: Mapping[str, Things], views: Mapping[str, View]) -> Tensor:
        """Return the slots (SIZE,) of what each camera found at one moment, of dtype `finding.FOUND`."""
        rows = []
        for thing in self.merged(finds, views)[:SLOTS]:
            joint = thing.joint if self.eyes.kinds[thing.kind] in PARTS else 0.0
            lit = float(thing.lit > LIT)
            rows.append([1.0, self._class[thing.kind], *thing.place, *thing.axis, 0.0, 0.0, 0.0, joint, lit])
        found = torch.from_numpy(in_slots(np.array(rows).reshape(-1, WIDTH)))
        return settled(found.unflatten(0, (SLOTS, WIDTH))).flatten()

    def merged(self, finds: Mapping[str, Things], views: Mapping[str, View]) -> list[Sighting]:
        """Return the things that there are by what each camera found, the surest first."""
        single = [self._sighting(camera, views[camera], find) for camera in finds for find in finds[camera]]
        things: list[Sighting] = []
        for seen in sorted(single, key=lambda thing: -thing.score):
            if self._class[seen.kind] is None:
                continue
            known = next((thing for thing in things if self._is(thing, seen)), None)
            if known is None:
                things.append(seen)
            elif seen.cameras[0] not in known.cameras:
                known.seen_too(seen, self._one[seen.kind])
        return [thing for thing in things if len(thing.cameras) > 1 or thing.score > ALONE]

    def _is(self, thing: Sighting, seen: Sighting) -> bool:
        """Whether two finds are of one thing."""
        if thing.kind != seen.kind or self._one[seen.kind]:
            return thing.kind == seen.kind
        apart = APART if seen.cameras[0] in thing.cameras else SAME
        return float(np.linalg.norm(thing.place - seen.place)) < apart

    def _sighting(self, camera: str, view: View, find: np.void) -> Sighting:
        """Return where in the world a find of a camera is."""
        sight, turned = rays(find["place"].astype(np.float64), view), np.asarray(view["turned"])
        angle = np.arctan2(find["turn"][1], find["turn"][0]) / 2
        axis = np.cos(angle) * turned[:, 0] + np.sin(angle) * turned[:, 1]
        across, depth_off, height_off = find["doubt"].astype(np.float64)
        if camera == "wrist":
            depth, along = float(find["depth"]), depth_off
        else:
            depth = float(level_depth(sight, TABLE_TOP + find["height"], view))
            along = height_off / max(-sight[2], 1e-3)
            axis = axis - turned[:, 2] * (axis[2] / turned[2, 2])  # it is level, where the picture is not
        return Sighting(
            int(find["kind"]),
            float(find["score"]),
            (camera,),
            depth,
            view["eye"] + sight * depth,
            sureness(sight, 2 * float(view["slope"]) * abs(depth) * across, along * float(np.linalg.norm(sight))),
            axis,
            float(find["joint"]),
            float(find["lit"]),
        )


def sureness(sight: Array, across: float, along: float) -> Array:
    """Return the inverse covariance (3, 3), 1/m², of a place that may be so far off across a line of sight (3,) and
    along it, m.
    """
    line = sight / np.linalg.norm(sight)
    on_it = np.outer(line, line)
    return np.asarray((np.eye(3) - on_it) / max(across, LEAST) ** 2 + on_it / max(along, LEAST) ** 2)


def settled(slots: Tensor) -> Tensor:
    """Return slots (..., SLOTS, WIDTH) in which things stand as they are taken to: level, with the front where tasks
    have it. Of their rotation only the x axis is read.
    """
    seen = slots.clone()
    there, kind = field(seen, "present") > 0, field(seen, "class").squeeze(-1).long().cpu()
    axis = normalize(field(seen, "rotation")[..., :3] * seen.new_tensor([1.0, 1.0, 0.0]), dim=-1, eps=1e-6)
    turned, from_all_sides = (_classes(kinds)[kind][..., None].to(seen.device) for kinds in (TURNED, ROUND))
    axis = torch.where((axis[..., :1] < 0) != turned, -axis, axis)
    axis = torch.where(from_all_sides, seen.new_tensor([1.0, 0.0, 0.0]), axis)
    set_axis(seen, axis * there)
    return seen


def set_axis(slots: Tensor, axis: Tensor) -> None:
    """Write rotations about the vertical into slots (..., WIDTH), given the level x axes (..., 3)."""
    x, y, z = axis.unbind(-1)
    field(slots, "rotation")[:] = torch.stack([x, y, z, -y, x, z], dim=-1)


@cache
def _classes(names: frozenset[str]) -> Tensor:
    """Return for each class whether it is one of those, (classes,) bool."""
    return torch.tensor([name in names for name in classes()])
