"""Detection noise: privileged object state with errors like the detector's, drawn anew for every batch.

So a policy learns from demonstrations without a picture to act by detections. Sizes are those of the package's detector
at 720 frames of the thirty tasks and the strict ones (tuning seeds, arms moved at random): 1.6 mm off in the median, 8
at the 90th percentile and 18 at the 97th.
"""

from __future__ import annotations

from functools import cache

import mujoco
import torch
from torch import Tensor

from lerobot_memobench.perception.objects import set_axis, upright
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.sim.assets.registry import build_asset, known_classes
from lerobot_memobench.sim.object_layout import WIDTH, field
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.sim.scene import AGENTVIEW_POSITION

PLACE, KIND_PLACE = (0.0006, 1.45), (0.00065, 1.0)
"""Error of a place in each direction, m, and by how much its size varies (spread of its logarithm): of each sight of a
thing, and of all sights of a kind."""
AT_HAND, AT_HAND_PLACE, HIGHER = 0.2, (0.0015, 1.2), 1.5
"""Up to how far from the hand places are found worse, m; the errors that are added there, and how many times larger
they are in height."""
LOW, LOW_UP_TO = 0.35, 0.06
"""What does not stand on the table is found too low, along the third-person camera's line of sight: of a kind, by which
share of its height over the table (standard deviation), and up to which height that counts, m. A pan that is carried is
found 3 cm off."""
TURN, JOINT = (0.002, 2.0), {"drawer": (0.0025, 0.7), "door": (0.013, 0.6), "knob": (0.034, 0.6)}
"""Errors of a turn, rad, and of moving parts, m or rad."""
MISSED, KIND_MISSED = 0.01, 0.003
"""How often an object is missed in a frame, and a class in all of a batch."""
FALSE, SECOND_NAME, MISNAMED, ASTRAY = 0.6, 0.8, 0.015, 0.06
"""False objects of a frame: which share of them is a second name for one that is, where the others are
that thing once more and elsewhere; and how far from it both are, m."""


def with_detection_noise(slots: Tensor, hand: Tensor, size: float) -> Tensor:
    """Return slots (N, SLOTS, WIDTH) with the errors of a detector.

    Args:
        hand: (N, >= 3), its place in the world, m, and its turn.
        size: of the errors; 1 is as the package's detector errs.
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
    """Return errors in the shape of ``like``: normal, and so is the logarithm of their size, one for the last axis."""
    return torch.randn_like(like) * size * (spread * torch.randn_like(like[..., :1])).exp()


def _too_low(place: Tensor, kind: Tensor) -> Tensor:
    """Return by how much lifted things (N, SLOTS) are found too low, (N, SLOTS, 3), m, along the line of sight."""
    share = (LOW * torch.randn(len(classes()), device=kind.device)).abs().clamp(max=1.0)[kind]
    height = (place[..., 2] - _standing().to(place)[kind]).clamp(0.0, LOW_UP_TO)
    sight = place - place.new_tensor(AGENTVIEW_POSITION)
    return sight / -sight[..., 2:].clamp(max=-0.1) * (share * height)[..., None]


@cache
def _standing() -> Tensor:
    """Return where the origin of each class is as it stands on the table, m; infinite where it is no object."""
    spec, heights = mujoco.MjSpec(), torch.full((len(classes()),), torch.inf)
    for index, name in enumerate(classes()):
        if name in known_classes():
            asset = build_asset(spec, name, name)
            heights[index] = TABLE_TOP - asset.bottom if asset.kind == "object" else torch.inf
    return heights


def _turn(noisy: Tensor, angle: Tensor) -> None:
    """Turn the level x axes of things by angles (N, SLOTS), rad."""
    x, y, z = field(noisy, "rotation")[..., :3].unbind(-1)
    sine, cosine = angle.sin(), angle.cos()
    set_axis(noisy, torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=-1))


def _add_false(noisy: Tensor, there: Tensor, size: float) -> None:
    """Take away what is not ``there`` (N, SLOTS), and put what is none into some of the slots that are empty then."""
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
    """Return slots (N, n, WIDTH) sorted as by `sim.object_slots.fill_slots`: by class and place, empty ones last."""
    x = field(slots, "position")[..., 0].clamp(-4, 4) / 10
    order = (field(slots, "class").squeeze(-1) + x).masked_fill(field(slots, "present").squeeze(-1) == 0, torch.inf)
    rows: Tensor = slots.gather(1, order.argsort(dim=1)[..., None].expand(-1, -1, WIDTH))
    return rows
