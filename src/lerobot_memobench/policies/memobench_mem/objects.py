"""Encoders of objects: each of the slots of `sim.object_slots` is a token, from privileged object state or detections.

Poses are given in the world and relative to the hand, whose pose is the robot's state before normalisation. A
remembered frame is stored as numbers (slots, robot state, phase), and pooled to tokens by learned attention. Places are
in m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, cached_property

import torch
from einops import rearrange
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES
from torch import Tensor, nn
from torch.nn.functional import pad, rms_norm

from lerobot_memobench.constants import CAMERAS, OBS_PHASE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.objects import ObjectLocalizer, upright
from lerobot_memobench.perception.visual_encoder import SIDE
from lerobot_memobench.policies.compatibility import hint
from lerobot_memobench.policies.memobench_mem.encoders import (
    ENCODED,
    TOKEN_SCALE,
    ObservationEncoder,
    PrefixParts,
    fingerprint,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import EXACT, FRAMES, OBJECT_TOKENS
from lerobot_memobench.sim.asset import AGENTVIEW_POSITION, TABLE_TOP
from lerobot_memobench.sim.object_layout import FIELDS, SIZE, SLOTS, WIDTH, field
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.sim.scene import standing_heights

CLASS_DIM = 32
WORKSPACE_CENTRE = (-0.05, 0.0, 0.95)
"""Approximate centre of the arm's workspace, in the world."""
NEAR_SCALES = (0.06, 0.015)
"""Scales of fine features of the offset from the hand: the width of a hand, and of a finger."""
PER_METRE = 5.0
"""Factor that scales places and joints to about one."""
HAND_DIM = 6
"""Length of the hand's pose at the start of the robot's state: place, and rotation as axis times angle."""
FEATURES = 3 * (2 + 2 * len(NEAR_SCALES)) + 2 * FIELDS["rotation"] + FIELDS["joint"] + FIELDS["highlighted"]


def rotation(axis_angle: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of axes times angles (..., 3), rad (Rodrigues)."""
    angle = axis_angle.norm(dim=-1, keepdim=True).clamp(min=1e-6)  # a zero rotation has no axis
    x, y, z = (axis_angle / angle).unbind(-1)
    none = torch.zeros_like(x)
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1).unflatten(-1, (3, 3))
    angle = angle.unsqueeze(-1)
    return torch.eye(3, device=x.device) + angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)


def slot_features(slots: Tensor, hand: Tensor) -> Tensor:
    """Return features (M, FEATURES), scaled to about one, of things (M, WIDTH) given the hand's pose (M, 6)."""
    position, axes = field(slots, "position"), field(slots, "rotation").unflatten(-1, (2, 3))
    turned = rotation(hand[:, 3:HAND_DIM])
    offset = position - hand[:, :3]
    # A row vector times the hand's matrix is that vector in the hand's frame.
    from_hand = (offset.unsqueeze(1) @ turned).squeeze(1)
    near = [torch.tanh(vector / scale) for vector in (offset, from_hand) for scale in NEAR_SCALES]
    middle = torch.tensor(WORKSPACE_CENTRE, device=position.device)
    vectors = [(position - middle) * PER_METRE, offset * PER_METRE, *near]
    rest = [field(slots, "joint") * PER_METRE, field(slots, "highlighted")]
    return torch.cat([*vectors, axes.flatten(1), (axes @ turned).flatten(1), *rest], dim=-1)


class SlotEncoder(nn.Module):
    """Encode each object in slots by a network of two layers; empty slots are skipped.

    ``order`` maps the class indices of this version to those of training, which are ``kinds`` with one for new classes.
    """

    def __init__(self, order: Sequence[int], kinds: int, hidden: int, width: int) -> None:
        super().__init__()
        self.order = list(order)
        self.kind = nn.Embedding(kinds, CLASS_DIM)
        self.mlp = nn.Sequential(nn.Linear(FEATURES + CLASS_DIM, hidden), nn.GELU(), nn.Linear(hidden, width))

    def forward(self, slots: Tensor, hand: Tensor) -> tuple[Tensor, Tensor]:
        """Return vectors (M, width) of things in slots (N, SLOTS, WIDTH) given hands (N, 6), and their slots (bool)."""
        present = field(slots, "present").squeeze(-1) > 0
        things, hands = slots[present], hand.unsqueeze(1).expand(-1, slots.shape[1], -1)[present]
        with torch.autocast(slots.device.type, enabled=False):  # bfloat16 rounds places to 4 mm
            features = slot_features(things, hands)
        order = torch.tensor(self.order, device=slots.device)
        kinds = order[field(things, "class").squeeze(-1).long()]
        vectors: Tensor = self.mlp(torch.cat([features, self.kind(kinds)], dim=-1))
        return vectors, present


# -- object state -----------------------------------------------------------------------------------------------------


OBS_RAW_STATE = "observation.raw_state"


def frame_row(slots: Tensor, state: Tensor, phase: Tensor) -> Tensor:
    """Return N stored frames (N, 1, SIZE + 6 + 1) of slots (N, SIZE), state (N, >= 6) and phase (N,)."""
    row = torch.cat([slots, state[:, :HAND_DIM], phase.reshape(-1, 1).to(slots.dtype)], dim=1)
    return rearrange(row, "n d -> n 1 d")


def in_slots(vectors: Tensor, present: Tensor, empty: float = 0.0) -> Tensor:
    """Return the vectors of things (M, D) in their slots (N, SLOTS, D), which ``present`` (N, SLOTS) marks."""
    slots = vectors.new_full((*present.shape, vectors.shape[-1]), empty)
    slots[present] = vectors  # masked_scatter takes three times as long
    return slots


class ObjectPool(nn.Module):
    """Pool the objects of a stored frame to `OBJECT_TOKENS` tokens of unit size by learned attention."""

    def __init__(self, order: Sequence[int], kinds: int, width: int, phase: bool = False) -> None:
        super().__init__()
        self.slot = SlotEncoder(order, kinds, width, width)
        self.score = nn.Linear(width, OBJECT_TOKENS)
        self.phase = nn.Linear(1, width) if phase else None
        self.out = nn.Sequential(nn.GELU(), nn.Linear(width, width))

    def forward(self, frames: Tensor) -> Tensor:
        """Return tokens (N, tokens, width) of frames (N, 1, SIZE + 6 + 1)."""
        slots, hand, phase = frames.flatten(1).split([SIZE, HAND_DIM, 1], dim=1)
        vectors, present = self.slot(slots.unflatten(1, (SLOTS, WIDTH)), hand)
        score = self.score(vectors)
        # A finite score keeps a frame without objects finite; its pooled values are zeros.
        scores, values = in_slots(score, present, -1e4), in_slots(vectors, present)
        pooled = torch.einsum("nsk,nsd->nkd", scores.softmax(dim=1), values)
        if self.phase is not None:
            pooled = pooled + self.phase(phase).unsqueeze(1)
        tokens: Tensor = self.out(pooled)
        # Without the norm, the initial output is several times smaller than the encoding of time that is added to it.
        # With it, 400 updates chose the right one of three bowls in 85 % of frames, instead of 58 %.
        return rms_norm(tokens, tokens.shape[-1:], eps=1e-6)

    def phases(self, frames: Tensor) -> Tensor:
        """Return tokens of frames without objects and hand, which hold only the phase."""
        return self.forward(pad(frames[..., -1:], (frames.shape[-1] - 1, 0)))


class ObjectEncoder(nn.Module, ObservationEncoder):
    """A token per present object; a remembered frame is stored as numbers for `ObjectPool`.

    ``trained`` are the classes of training in order of their indices, ``width`` is that of all tokens, ``noise`` the
    size of the detection noise in training, and ``phase`` whether a remembered frame records its phase.
    """

    memory_input = OBS_ENV_STATE
    key: str = f"objects-{SIZE}"
    tokens_per_frame = OBJECT_TOKENS
    grid = 0

    def __init__(self, trained: Sequence[str], width: int, noise: float = 0.0, phase: bool = False) -> None:
        super().__init__()
        self.dim, self.noise, self.phase = width, noise, phase
        self.order = [trained.index(name) if name in trained else len(trained) for name in classes()]
        self.kinds = len(trained) + 1
        self.slot = SlotEncoder(self.order, self.kinds, 2 * width, width)

    def observed(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return a training batch with detection noise, drawn once per frame, present or remembered."""
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
        """Return slots and hand (B, n WIDTH + 6), and which of the n slots hold an object (B, n)."""
        slots = batch[OBS_ENV_STATE].to(torch.float32).unflatten(1, (SLOTS, WIDTH))
        hand = batch[OBS_RAW_STATE][:, :HAND_DIM].to(slots)
        if self.training:  # in a rollout, a row must not depend on others
            slots = slots[:, : max(1, int((slots[..., 0] > 0).sum(dim=1).max()))]
        return [torch.cat([slots.flatten(1), hand], dim=1)], [slots[..., 0] > 0]

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        chosen = list(rows)
        slots, state = batch[OBS_ENV_STATE][chosen].to(torch.float32), batch[OBS_RAW_STATE][chosen]
        # A batch without phases is execution.
        phase = batch[OBS_PHASE].reshape(-1)[chosen] if OBS_PHASE in batch else torch.ones(len(chosen))
        return frame_row(slots, state.to(slots), phase.to(slots))

    def prefix(self, observed: Tensor) -> Tensor:
        slots, hand = observed[:, :-HAND_DIM], observed[:, -HAND_DIM:]
        vectors, present = self.slot(slots.unflatten(1, (-1, WIDTH)), hand)
        return in_slots(vectors * TOKEN_SCALE, present)

    def pool(self) -> nn.Module:
        return ObjectPool(self.order, self.kinds, self.dim, self.phase)


# -- detections -------------------------------------------------------------------------------------------------------


DETECTED = f"{ENCODED}objects"
"""Key of the detections (B, SIZE) in a training sample."""
VIEWS = {f"{OBS_IMAGES}.{name}": camera for name, camera in CAMERAS.items()}
"""Key of an image at the policy -> camera."""


class ObjectsFromImages:
    """Detect objects in images, and return them as slots."""

    def __init__(self, detector: Detector) -> None:
        self._detector, self._locate = detector, ObjectLocalizer(detector)

    @cached_property
    def key(self) -> str:
        return f"{fingerprint({'detector': self._detector})}-{SIDE}x{SIDE}-objects-{SIZE}"

    def __call__(self, images: Mapping[str, Tensor], states: Tensor) -> Tensor:
        """Return the slots (N, SIZE) float32 of images (N, 3, H, H) in [0, 1] and robots' states (N, >= 6)."""
        for name in VIEWS:
            if name not in images:
                raise MemobenchError(f"The observation has no '{name}', which the detector reads; {hint(name, images)}")
        device = next(self._detector.parameters()).device
        views = {camera: images[name].to(device) for name, camera in VIEWS.items()}
        with torch.autocast(device.type, enabled=False):  # mixed precision would differ from training
            return self._locate(views, states).to(states.device)


class DetectionEncoder(ObjectEncoder):
    """A token per object detected in the present images, instead of privileged object state.

    The trained layers are those of `ObjectEncoder`, so a policy trained on privileged object state acts from images.
    """

    memory_input = next(iter(VIEWS))

    def __init__(self, detect: ObjectsFromImages, trained: Sequence[str], width: int, phase: bool = False) -> None:
        super().__init__(trained, width, phase=phase)
        self.detect = detect  # no module, so that a checkpoint holds only its name
        self.key = detect.key

    def present(self, batch: Mapping[str, Tensor]) -> PrefixParts:
        return super().present(self._with_objects(batch))

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        wanted = {DETECTED} if DETECTED in batch else {*VIEWS}
        chosen = {key: value[list(rows)] for key, value in batch.items() if key in wanted | {OBS_RAW_STATE, OBS_PHASE}}
        return super().remember(self._with_objects(chosen), range(len(rows)))

    def _with_objects(self, batch: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        slots = batch[DETECTED] if DETECTED in batch else self.detect(batch, batch[OBS_RAW_STATE])
        return {**batch, OBS_ENV_STATE: slots}


# -- detection noise ---------------------------------------------------------------------------------------------------

# Errors like the detector's, added to privileged object state and drawn for every batch. With them, a policy learns
# from demonstrations without images to act by detections. The sizes are those of the detector of version 0.2 on
# 720 frames of its scenes (tuning seeds, arms moved at random): an error of 1.6 mm in the median, 8 mm at the 90th
# percentile and 18 mm at the 97th. The present one errs by 2.2 and 8.9 mm (`results/detector.md`).

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
    """Return slots (N, SLOTS, WIDTH) with the errors of a detector, times ``size``.

    ``hand`` (N, >= 3) is its place in the world, m.
    """
    noisy = upright(slots)
    present = field(noisy, "present").squeeze(-1) > 0
    kind = field(noisy, "class").squeeze(-1).long()
    position, joint = field(noisy, "position"), field(noisy, "joint")
    at_hand = _error(position, *AT_HAND_PLACE) * position.new_tensor([1.0, 1.0, HIGHER])
    at_hand *= (position - hand[:, None, :3]).norm(dim=-1, keepdim=True) < AT_HAND
    of_kinds = _error(position.new_empty(len(classes()), 3), *KIND_PLACE)[kind]
    down = _too_low(position, kind)
    position += size * (_error(position, *PLACE) + of_kinds + at_hand + down)
    for name, how in JOINT.items():
        joint += size * _error(joint, *how) * (kind == classes().index(name))[..., None]
    _turn(noisy, size * _error(joint, *TURN).squeeze(-1))
    missed = torch.rand_like(joint).squeeze(-1) < size * MISSED
    missed |= (torch.rand(len(classes()), device=kind.device) < size * KIND_MISSED)[kind]
    _add_false(noisy, present & ~missed, size)
    return in_order(noisy)


def _error(like: Tensor, size: float, spread: float) -> Tensor:
    """Return normal errors in the shape of ``like``, whose size along the last axis is log-normal."""
    return torch.randn_like(like) * size * (spread * torch.randn_like(like[..., :1])).exp()


def _too_low(position: Tensor, kind: Tensor) -> Tensor:
    """Return the error (N, SLOTS, 3) of lifted things along the line of sight, m."""
    share = (LOW * torch.randn(len(classes()), device=kind.device)).abs().clamp(max=1.0)[kind]
    height = (position[..., 2] - _standing().to(position)[kind]).clamp(0.0, LOW_UP_TO)
    sight = position - position.new_tensor(AGENTVIEW_POSITION)
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


def _add_false(noisy: Tensor, present: Tensor, size: float) -> None:
    """Remove things that are not ``present`` (N, SLOTS), and add false objects to some empty slots."""
    empty = (~present).sum(dim=1, keepdim=True).clamp(min=1)
    chance = size * FALSE / empty * present.any(dim=1, keepdim=True)
    false = ~present & (torch.rand(present.shape, device=noisy.device) < chance)
    row = false.nonzero()[:, 0]
    added = noisy[row, torch.multinomial(present[row].float(), 1)[:, 0]] if len(row) else noisy[false]
    misnamed = torch.rand(len(added), 1, device=noisy.device) < SECOND_NAME
    kind, position = field(added, "class"), field(added, "position")
    kind[:] = torch.where(misnamed, torch.randint_like(kind, len(classes())), kind)
    position += torch.randn_like(position) * torch.where(misnamed, MISNAMED, ASTRAY)
    noisy[~present] = 0.0
    noisy[false] = added


def in_order(slots: Tensor) -> Tensor:
    """Return slots (N, n, WIDTH) sorted as by `sim.object_slots.fill_slots`: by class and place, empty slots last."""
    kind, position = field(slots, "class").squeeze(-1), field(slots, "position")
    first = torch.where(kind == classes().index("drawer"), -position[..., 2], position[..., 0])  # drawers from the top
    # Classes are whole numbers, and a place adds less than half of one.
    order = (kind + first.clamp(-4, 4) / 10).masked_fill(field(slots, "present").squeeze(-1) == 0, torch.inf)
    return slots.gather(1, order.argsort(dim=1)[..., None].expand(-1, -1, WIDTH))
