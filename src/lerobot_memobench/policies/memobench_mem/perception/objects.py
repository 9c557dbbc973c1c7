"""Objects: the slots of `sim.object_slots` instead of pictures; a remembered frame keeps them as numbers.

What is stored of a frame is what was seen, and what becomes of it is learned: slots, robot state and phase, one row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from einops import rearrange
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor, nn
from torch.nn.functional import rms_norm

from lerobot_memobench.policies.memobench_mem.perception.perception import Perception, Seen
from lerobot_memobench.policies.memobench_mem.perception.pooled_memory import PooledMemory
from lerobot_memobench.policies.memobench_mem.perception.sight_errors import TOLD, SightErrors
from lerobot_memobench.policies.memobench_mem.perception.slots import HAND_DIM, SlotEncoder
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH
from lerobot_memobench.sim.object_slots import classes

OBS_RAW_STATE, OBS_PHASE = "observation.raw_state", "observation.phase"
LOUD = 8.0
"""How much larger than a layer's output tokens are made; at 1 they learned slower."""


def frame_row(slots: Tensor, state: Tensor, phase: Tensor) -> Tensor:
    """Return what is stored of N frames, (N, 1, SIZE + 6 + 1): slots (N, SIZE), state (N, >= 6) and phase (N,)."""
    row = torch.cat([slots, state[:, :HAND_DIM], phase.reshape(-1, 1).to(slots.dtype)], dim=1)
    return rearrange(row, "n d -> n 1 d")


def in_slots(made: Tensor, there: Tensor, empty: float = 0.0) -> Tensor:
    """Return the vectors of things (M, D) in their slots (N, SLOTS, D), of which ``there`` (N, SLOTS) hold one."""
    slots = made.new_full((*there.shape, made.shape[-1]), empty)
    slots[there] = made  # masked_scatter takes three times as long
    return slots


class FramePool(nn.Module):
    """A stored frame to a few tokens of unit size: its things, pooled by learned attention.

    As these layers begin, what was seen comes out several times smaller than when it was seen, which the encoder adds
    to it. At unit size, 400 updates chose the right one of three bowls at 85 % of moments, instead of at 58 %.
    """

    def __init__(self, order: Sequence[int], kinds: int, tokens: int, width: int, errors: SightErrors = TOLD) -> None:
        super().__init__()
        self.errors = errors
        self.slot = SlotEncoder(order, kinds, width, width)
        self.score = nn.Linear(width, tokens)
        self.phase = nn.Linear(1, width)
        self.out = nn.Sequential(nn.GELU(), nn.Linear(width, width))

    def forward(self, frames: Tensor) -> Tensor:
        """Return tokens (N, tokens, width) of frames (N, 1, SIZE + 6 + 1)."""
        slots, hand, phase = frames.flatten(1).split([SIZE, HAND_DIM, 1], dim=1)
        slots = slots.unflatten(1, (SLOTS, WIDTH))
        if self.training:
            slots = self.errors.seen(slots, hand)
        made, there = self.slot(slots, hand)
        score = self.score(made)
        # A finite score keeps a frame in which nothing is seen finite: it becomes zeros.
        scores, values = in_slots(score, there, -1e4), in_slots(made, there)
        pooled = torch.einsum("nsk,nsd->nkd", scores.softmax(dim=1), values)
        kept: Tensor = self.out(pooled + self.phase(phase).unsqueeze(1))
        return rms_norm(kept, kept.shape[-1:], eps=1e-6)


class ObjectPerception(nn.Module, Perception):
    """A token per thing that is seen now; what is remembered are the numbers themselves, for `FramePool`.

    Args:
        trained: names of the classes that it knows, in order of their indices.
        tokens_per_frame: memory tokens of a frame. width: of all tokens.
        errors: with which slots are seen while it learns.
    """

    remembers = OBS_ENV_STATE
    key: str = f"objects-{SIZE}"
    grid = 0
    pictures = False

    def __init__(self, trained: Sequence[str], tokens_per_frame: int, width: int, errors: SightErrors = TOLD) -> None:
        super().__init__()
        self.tokens_per_frame, self.dim, self.errors = tokens_per_frame, width, errors
        self.order = [trained.index(name) if name in trained else len(trained) for name in classes()]
        self.kinds = len(trained) + 1
        self.slot = SlotEncoder(self.order, self.kinds, 2 * width, width)

    def present(self, batch: Mapping[str, Tensor]) -> Seen:
        """Return what is seen now: slots and hand (B, n WIDTH + 6), and which of the n slots hold something (B, n).

        A batch to learn from has as many slots as the fullest of its samples; elsewhere there are all of them, so that
        what is done does not depend on what else is in the batch.
        """
        slots = batch[OBS_ENV_STATE].to(torch.float32).unflatten(1, (SLOTS, WIDTH))
        hand = batch[OBS_RAW_STATE][:, :HAND_DIM].to(slots)
        if self.training:
            slots = self.errors.seen(slots, hand)
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

    def pool(self) -> FramePool:
        """Return what makes a stored frame's tokens."""
        return FramePool(self.order, self.kinds, self.tokens_per_frame, self.dim, self.errors)

    def memory(self, encoder: nn.Module) -> nn.Module:
        """Return the encoder behind a pool of each frame."""
        return PooledMemory(self.pool(), encoder)
