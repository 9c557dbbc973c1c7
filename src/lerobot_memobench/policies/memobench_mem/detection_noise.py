"""Detection noise: errors like the detector's, added to privileged object state, drawn for every batch.

With them, a policy learns from demonstrations without pictures to act by detections. The sizes are those of the
package's detector on 720 frames of the scenes that version 0.2 modelled in code (tuning seeds, arms moved at random):
an error of 1.6 mm in the median, 8 mm at the 90th percentile and 18 mm at the 97th.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from lerobot_memobench.perception.objects import upright
from lerobot_memobench.sim.asset import AGENTVIEW_POSITION, TABLE_TOP
from lerobot_memobench.sim.object_layout import WIDTH, field
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.sim.scene import standing_heights

PLACE, KIND_PLACE = (0.0006, 1.45), (0.00065, 1.0)
"""Error of a place in each direction, m, and the standard deviation of the logarithm of its size: per thing, and shared
by all things of a class."""
AT_HAND, AT_HAND_PLACE, HIGHER = 0.2, (0.0015, 1.2), 1.5
"""Distance from the hand within which places have a further error, m; this error; and its factor in height."""
LOW, LOW_UP_TO = 0.35, 0.06
"""A thing above the table is found too low, along the line of sight of the third-person camera: by which share of its
height (standard deviation per class), up to which height, m. A carried pan is found 3 cm off."""
TURN, JOINT = (0.002, 2.0), {"drawer": (0.0025, 0.7), "door": (0.013, 0.6), "knob": (0.034, 0.6)}
"""Errors of an angle, rad, and of moving parts, m or rad."""
MISSED, KIND_MISSED = 0.01, 0.003
"""Probability that an object is missed in a frame, and a class in the whole batch."""
FALSE, SECOND_NAME, MISNAMED, ASTRAY = 0.6, 0.8, 0.015, 0.06
"""Mean number of false objects in a frame; the share that is an existing thing under a second class, the others being a
second copy of a thing; and the distance of either kind from the thing, m."""


def with_detection_noise(slots: Tensor, hand: Tensor, size: float) -> Tensor:
    """Return slots (N, SLOTS, WIDTH) with the errors of a detector.

    Args:
        hand: (N, >= 3), its place in the world, m, and its rotation.
        size: factor of the errors; 1: those of the package's detector.
    """
    noisy = upright(slots)
    there = field(noisy, "present").squeeze(-1) > 0
    kind = field(noisy, "class").squeeze(-1).long()
    place, joint = field(noisy, "position"), field(noisy, "joint")
    at_hand = _error(place, *AT_HAND_PLACE) * place.new_tensor([1.0, 1.0, HIGHER])
    at_hand *= (place - hand[:, None, :3]).norm(dim=-1, keepdim=True) < AT_HAND
    of_kinds = _error(place.new_empty(len(classes()), 3), *KIND_PLACE)[kind]
    down = _too_low(place, kind)
    place += size * (_error(place, *PLACE) + of_kinds + at_hand + down)
    for name, how in JOINT.items():
        joint += size * _error(joint, *how) * (kind == classes().index(name))[..., None]
    _turn(noisy, size * _error(joint, *TURN).squeeze(-1))
    missed = torch.rand_like(joint).squeeze(-1) < size * MISSED
    missed |= (torch.rand(len(classes()), device=kind.device) < size * KIND_MISSED)[kind]
    _add_false(noisy, there & ~missed, size)
    return in_order(noisy)


def _error(like: Tensor, size: float, spread: float) -> Tensor:
    """Return normal errors in the shape of ``like``, whose size along the last axis is log-normal."""
    return torch.randn_like(like) * size * (spread * torch.randn_like(like[..., :1])).exp()


def _too_low(place: Tensor, kind: Tensor) -> Tensor:
    """Return the error (N, SLOTS, 3) of lifted things along the line of sight, m."""
    share = (LOW * torch.randn(len(classes()), device=kind.device)).abs().clamp(max=1.0)[kind]
    height = (place[..., 2] - _standing().to(place)[kind]).clamp(0.0, LOW_UP_TO)
    sight = place - place.new_tensor(AGENTVIEW_POSITION)
    return sight / -sight[..., 2:].clamp(max=-0.1) * (share * height)[..., None]


@cache
def _standing() -> Tensor:
    """Return the height of the origin of each class on the table, m; infinite for moving parts."""
    heights = standing_heights()
    return torch.tensor([TABLE_TOP + heights.get(name, torch.inf) for name in classes()])


def _turn(noisy: Tensor, angle: Tensor) -> None:
    """Rotate things about the vertical by angles (N, SLOTS), rad."""
    x, y, z = field(noisy, "rotation").unflatten(-1, (2, 3)).unbind(-1)
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    field(noisy, "rotation")[:] = torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=-1).flatten(-2)


def _add_false(noisy: Tensor, there: Tensor, size: float) -> None:
    """Remove things that are not ``there`` (N, SLOTS), and add false objects to some empty slots."""
    empty = (~there).sum(dim=1, keepdim=True).clamp(min=1)
    chance = size * FALSE / empty * there.any(dim=1, keepdim=True)
    false = ~there & (torch.rand(there.shape, device=noisy.device) < chance)
    row = false.nonzero()[:, 0]
    made = noisy[row, torch.multinomial(there[row].float(), 1)[:, 0]] if len(row) else noisy[false]
    misnamed = torch.rand(len(made), 1, device=noisy.device) < SECOND_NAME
    kind, place = field(made, "class"), field(made, "position")
    kind[:] = torch.where(misnamed, torch.randint_like(kind, len(classes())), kind)
    place += torch.randn_like(place) * torch.where(misnamed, MISNAMED, ASTRAY)
    noisy[~there] = 0.0
    noisy[false] = made


def in_order(slots: Tensor) -> Tensor:
    """Return slots (N, n, WIDTH) sorted as by `sim.object_slots.fill_slots`: by class and place, empty slots last."""
    kind, place = field(slots, "class").squeeze(-1), field(slots, "position")
    first = torch.where(kind == classes().index("drawer"), -place[..., 2], place[..., 0])  # drawers from the top
    order = (kind + first.clamp(-4, 4) / 10).masked_fill(field(slots, "present").squeeze(-1) == 0, torch.inf)
    rows: Tensor = slots.gather(1, order.argsort(dim=1)[..., None].expand(-1, -1, WIDTH))
    return rows
