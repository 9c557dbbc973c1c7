"""Encoders of objects: the slots of `sim.object_slots`, each a token, from privileged object state or from detections.

An object's pose is given in the world and from the hand, whose pose is the robot's state before it is normalised. A
remembered frame is stored as numbers (slots, robot state, phase), and pooled to tokens by learned attention. All places
are m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import torch
from einops import rearrange
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES
from torch import Tensor, nn
from torch.nn.functional import pad, rms_norm

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.objects import ObjectLocalizer
from lerobot_memobench.perception.visual_encoder import SIDE
from lerobot_memobench.policies.compatibility import cure
from lerobot_memobench.policies.memobench_mem.detection_noise import with_detection_noise
from lerobot_memobench.policies.memobench_mem.encoders import (
    ENCODED,
    LOUD,
    ObservationEncoder,
    PrefixParts,
    fingerprint,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import EXACT, FRAMES
from lerobot_memobench.protocol import CAMERAS, OBS_PHASE
from lerobot_memobench.sim.object_layout import FIELDS, SIZE, SLOTS, WIDTH, field
from lerobot_memobench.sim.object_slots import classes

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
    near = [torch.tanh(vector / scale) for vector in (offset, from_hand) for scale in NEAR]
    middle = torch.tensor(MIDDLE, device=place.device)
    places = [(place - middle) * PER_METRE, offset * PER_METRE, *near]
    rest = [field(slots, "joint") * PER_METRE, field(slots, "highlighted")]
    return torch.cat([*places, axes.flatten(1), (axes @ turned).flatten(1), *rest], dim=-1)


class SlotEncoder(nn.Module):
    """A vector for each object in slots, through a network of two layers; empty slots cost nothing.

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


# -- object state -----------------------------------------------------------------------------------------------------


OBS_RAW_STATE = "observation.raw_state"


def frame_row(slots: Tensor, state: Tensor, phase: Tensor) -> Tensor:
    """Return N stored frames (N, 1, SIZE + 6 + 1) of slots (N, SIZE), state (N, >= 6) and phase (N,)."""
    row = torch.cat([slots, state[:, :HAND_DIM], phase.reshape(-1, 1).to(slots.dtype)], dim=1)
    return rearrange(row, "n d -> n 1 d")


def in_slots(made: Tensor, there: Tensor, empty: float = 0.0) -> Tensor:
    """Return the vectors of things (M, D) in their slots (N, SLOTS, D), of which ``there`` (N, SLOTS) hold one."""
    slots = made.new_full((*there.shape, made.shape[-1]), empty)
    slots[there] = made  # masked_scatter takes three times as long
    return slots


class ObjectPool(nn.Module):
    """A stored frame to a few tokens of unit size: its objects, pooled by learned attention.

    As these layers begin, their output is several times smaller than the encoding of time that is added to it. At unit
    size, 400 updates chose the right one of three bowls at 85 % of frames, instead of at 58 %.
    """

    def __init__(self, order: Sequence[int], kinds: int, tokens: int, width: int, phase: bool = False) -> None:
        super().__init__()
        self.slot = SlotEncoder(order, kinds, width, width)
        self.score = nn.Linear(width, tokens)
        self.phase = nn.Linear(1, width) if phase else None
        self.out = nn.Sequential(nn.GELU(), nn.Linear(width, width))

    def forward(self, frames: Tensor) -> Tensor:
        """Return tokens (N, tokens, width) of frames (N, 1, SIZE + 6 + 1)."""
        slots, hand, phase = frames.flatten(1).split([SIZE, HAND_DIM, 1], dim=1)
        made, there = self.slot(slots.unflatten(1, (SLOTS, WIDTH)), hand)
        score = self.score(made)
        # A finite score keeps a frame without objects finite: it becomes zeros.
        scores, values = in_slots(score, there, -1e4), in_slots(made, there)
        pooled = torch.einsum("nsk,nsd->nkd", scores.softmax(dim=1), values)
        if self.phase is not None:
            pooled = pooled + self.phase(phase).unsqueeze(1)
        kept: Tensor = self.out(pooled)
        return rms_norm(kept, kept.shape[-1:], eps=1e-6)

    def phases(self, frames: Tensor) -> Tensor:
        """Return tokens as of frames without objects and hand: all that they tell is the phase."""
        blank: Tensor = self(pad(frames[..., -1:], (frames.shape[-1] - 1, 0)))
        return blank


class ObjectEncoder(nn.Module, ObservationEncoder):
    """A token per present object; a remembered frame is its numbers, for `ObjectPool`.

    Args:
        trained: names of the classes that it was trained with, in order of their indices.
        tokens_per_frame: memory tokens of a frame. width: of all tokens.
        noise: size of the detection noise that is added to slots while it learns; 0: none.
        phase: whether a remembered frame tells whether it was of the prompt.
    """

    memory_input = OBS_ENV_STATE
    key: str = f"objects-{SIZE}"
    grid = 0
    pictures = False

    def __init__(
        self, trained: Sequence[str], tokens_per_frame: int, width: int, noise: float = 0.0, phase: bool = False
    ) -> None:
        super().__init__()
        self.tokens_per_frame, self.dim, self.noise, self.phase = tokens_per_frame, width, noise, phase
        self.order = [trained.index(name) if name in trained else len(trained) for name in classes()]
        self.kinds = len(trained) + 1
        self.slot = SlotEncoder(self.order, self.kinds, 2 * width, width)

    def observed(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return a training batch with detection noise: one draw for each frame, wherever it stands in the batch."""
        if not (self.training and self.noise):
            return batch
        present = self.remember(batch, range(len(batch[OBS_ENV_STATE])))
        stored = batch.get(FRAMES, present[:0]).to(present)
        rows = torch.cat([stored, present]).flatten(1)
        frames, where = rows[:, : SIZE + HAND_DIM].unique(dim=0, return_inverse=True)
        slots, hand = frames.split([SIZE, HAND_DIM], dim=1)
        noisy = with_detection_noise(slots.unflatten(1, (SLOTS, WIDTH)), hand, self.noise).flatten(1)[where]
        seen = torch.cat([noisy, rows[:, SIZE:]], dim=1).unsqueeze(1)
        remembered = {FRAMES: seen[: len(stored)], EXACT: stored} if FRAMES in batch else {}
        return {**batch, **remembered, OBS_ENV_STATE: noisy[len(stored) :]}

    def present(self, batch: Mapping[str, Tensor]) -> PrefixParts:
        """Return slots and hand (B, n WIDTH + 6), and which of the n slots hold an object (B, n).

        A batch to learn from has as many slots as the fullest of its samples; elsewhere there are all of them, so that
        a row does not depend on the others.
        """
        slots = batch[OBS_ENV_STATE].to(torch.float32).unflatten(1, (SLOTS, WIDTH))
        hand = batch[OBS_RAW_STATE][:, :HAND_DIM].to(slots)
        if self.training:
            slots = slots[:, : max(1, int((slots[..., 0] > 0).sum(dim=1).max()))]
        return [torch.cat([slots.flatten(1), hand], dim=1)], [slots[..., 0] > 0]

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return the rows (n, 1, D') of frames; without a phase all is execution."""
        chosen = list(rows)
        slots, state = batch[OBS_ENV_STATE][chosen].to(torch.float32), batch[OBS_RAW_STATE][chosen]
        phase = batch[OBS_PHASE].reshape(-1)[chosen] if OBS_PHASE in batch else torch.ones(len(chosen))
        return frame_row(slots, state.to(slots), phase.to(slots))

    def prefix(self, observed: Tensor) -> Tensor:
        """Return a token (B, n, d_vlm) per slot of what `present` returns; zeros for empty ones."""
        slots, hand = observed[:, :-HAND_DIM], observed[:, -HAND_DIM:]
        made, there = self.slot(slots.unflatten(1, (-1, WIDTH)), hand)
        return in_slots(made * LOUD, there)

    def pool(self) -> nn.Module:
        """Return a pool of each frame's objects."""
        return ObjectPool(self.order, self.kinds, self.tokens_per_frame, self.dim, self.phase)


# -- detections -------------------------------------------------------------------------------------------------------


DETECTED = f"{ENCODED}objects"
"""Name of the detections (B, SIZE) in a training sample."""
VIEWS = {f"{OBS_IMAGES}.{name}": camera for name, camera in CAMERAS.items()}
"""Name of a picture at the policy -> camera."""


class ObjectsFromPictures:
    """Detections in pictures by their names at the policy, as slots."""

    def __init__(self, detector: Detector) -> None:
        self._detector, self._locate = detector, ObjectLocalizer(detector)

    @cached_property
    def key(self) -> str:
        """Identity of the detections: weights, and size of the pictures."""
        return f"{fingerprint({'detector': self._detector})}-{SIDE}x{SIDE}-objects-{SIZE}"

    def __call__(self, pictures: Mapping[str, Tensor], states: Tensor) -> Tensor:
        """Return the slots (N, SIZE) float32 of pictures (N, 3, H, H) in [0, 1] and robots' states (N, >= 6).

        Raises:
            MemobenchError: a camera is missing.
        """
        for name in VIEWS:
            if name not in pictures:
                raise MemobenchError(
                    f"The observation has no '{name}', which the detector reads; {cure(name, pictures)}"
                )
        device = next(self._detector.parameters()).device
        views = {camera: pictures[name].to(device) for name, camera in VIEWS.items()}
        with torch.autocast(device.type, enabled=False):  # mixed precision would differ from training
            return self._locate(views, states).to(states.device)


class DetectionEncoder(ObjectEncoder):
    """A token per object that is detected in the present pictures, in the place of privileged object state.

    All that learns is as in `ObjectEncoder`, so a policy that was trained on privileged object state acts from pictures
    too. The detector is no part of the policy: a checkpoint names it, and another may be given to it.

    Args:
        detect: no module, so that a checkpoint has no part of it.
        trained, tokens_per_frame, width, phase: as of `ObjectEncoder`.
    """

    memory_input = next(iter(VIEWS))
    pictures = True

    def __init__(
        self,
        detect: ObjectsFromPictures,
        trained: Sequence[str],
        tokens_per_frame: int,
        width: int,
        phase: bool = False,
    ) -> None:
        super().__init__(trained, tokens_per_frame, width, phase=phase)
        self.detect = detect
        self.key = detect.key

    def present(self, batch: Mapping[str, Tensor]) -> PrefixParts:
        """Return what `ObjectEncoder.present` does, of detections in the batch or in its pictures."""
        return super().present(self._with_objects(batch))

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return the rows (n, 1, D') of frames; without a phase all is execution."""
        wanted = {DETECTED} if DETECTED in batch else {*VIEWS}
        chosen = {key: value[list(rows)] for key, value in batch.items() if key in wanted | {OBS_RAW_STATE, OBS_PHASE}}
        return super().remember(self._with_objects(chosen), range(len(rows)))

    def _with_objects(self, batch: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        found = batch[DETECTED] if DETECTED in batch else self.detect(batch, batch[OBS_RAW_STATE])
        return {**batch, OBS_ENV_STATE: found}
