"""Slots of objects as tokens: where each thing is, in the world and from the hand, through a small network.

A slot is a row of `sim.object_slots`; the hand's pose is the robot's state before it is normalised. All places are m.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lerobot_memobench.sim.object_layout import FIELDS, WIDTH, field

CLASS_DIM = 32
MIDDLE = (-0.05, 0.0, 0.95)
"""About the middle of what the arm reaches, in the world."""
NEAR = (0.06, 0.015)
"""Offsets from the hand that are told apart finely: a hand's breadth, and a finger's."""
PER_METRE = 5.0
"""What brings places and joints to about one."""
HAND_DIM = 6
"""The first numbers of the robot's state: the hand's place, and its rotation as axis times angle."""
FEATURES = 3 * (2 + 2 * len(NEAR)) + 2 * FIELDS["rotation"] + FIELDS["joint"] + FIELDS["highlighted"]


def in_order(slots: Tensor) -> Tensor:
    """Return slots (N, n, WIDTH) sorted as by `sim.object_slots.in_slots`: by class and place, the empty ones last."""
    x = field(slots, "position")[..., 0].clamp(-4, 4) / 10
    order = (field(slots, "class").squeeze(-1) + x).masked_fill(field(slots, "present").squeeze(-1) == 0, torch.inf)
    rows: Tensor = slots.gather(1, order.argsort(dim=1)[..., None].expand(-1, -1, WIDTH))
    return rows


def rotation(axis_angle: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of axes times angles (..., 3), rad (Rodrigues)."""
    angle = axis_angle.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    x, y, z = (axis_angle / angle).unbind(-1)
    none = torch.zeros_like(x)
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1).unflatten(-1, (3, 3))
    angle = angle.unsqueeze(-1)
    return torch.eye(3, device=x.device) + angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)


def slot_features(slots: Tensor, hand: Tensor) -> Tensor:
    """Return numbers (M, FEATURES) about one for things (M, WIDTH), each with the hand's pose (M, 6) beside it."""
    place, axes = field(slots, "position"), field(slots, "rotation").unflatten(-1, (2, 3))
    turned = rotation(hand[:, 3:HAND_DIM])
    offset = place - hand[:, :3]
    # A row vector times the hand's matrix is that vector in the hand's frame.
    from_hand = (offset.unsqueeze(1) @ turned).squeeze(1)
    near = [torch.tanh(seen / scale) for seen in (offset, from_hand) for scale in NEAR]
    middle = torch.tensor(MIDDLE, device=place.device)
    places = [(place - middle) * PER_METRE, offset * PER_METRE, *near]
    rest = [field(slots, "joint") * PER_METRE, field(slots, "highlighted")]
    return torch.cat([*places, axes.flatten(1), (axes @ turned).flatten(1), *rest], dim=-1)


class SlotEncoder(nn.Module):
    """A vector for each thing in slots, through a network of two layers; what is absent costs nothing.

    Args:
        order: for each class index of today's slots, that of the classes it was trained with, or the number of these.
        kinds: how many there are of them, and one for others. hidden: width between its two layers.
    """

    def __init__(self, order: Sequence[int], kinds: int, hidden: int, width: int) -> None:
        super().__init__()
        self.order = list(order)
        self.kind = nn.Embedding(kinds, CLASS_DIM)
        self.mlp = nn.Sequential(nn.Linear(FEATURES + CLASS_DIM, hidden), nn.GELU(), nn.Linear(hidden, width))

    def forward(self, slots: Tensor, hand: Tensor) -> tuple[Tensor, Tensor]:
        """Encode slots beside hands (N, 6); return the vectors of the M things there are, (M, width), and where they
        are (N, SLOTS) bool.
        """
        there = field(slots, "present").squeeze(-1) > 0
        things, hands = slots[there], hand.unsqueeze(1).expand(-1, slots.shape[1], -1)[there]
        with torch.autocast(slots.device.type, enabled=False):  # bfloat16 knows places to 4 mm
            features = slot_features(things, hands)
        order = torch.tensor(self.order, device=slots.device)
        kinds = order[field(things, "class").squeeze(-1).long()]
        made: Tensor = self.mlp(torch.cat([features, self.kind(kinds)], dim=-1))
        return made, there
