"""Motion (HiF-VLA): an action chunk reads the motion of the last frames, and the expert predicts the next motion.

From HiF-VLA (OpenHelix-Team/HiF-VLA, CVPR 2026): hindsight of the last 8 motions, its encoder, 8 foresight queries,
their loss of 0.01 L1, and modulation of the expert by hindsight. `docs/guides/memory/motion.md` lists the differences.

A motion field has C cells of K numbers. Of images a cell is a block of the thumbnail, whose motion is found by
exhaustive block matching, as in a video codec; of objects it is a slot, or the hand, whose motion is a displacement.

Shapes: N pairs of frames, B samples, h pairs of a sample, n following frames, W width of tokens.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from einops import rearrange, reduce, repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.encoders import THUMBNAIL
from lerobot_memobench.policies.memobench_mem.fusion import MemoryPass
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    Histories,
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    NoSettings,
    Query,
    with_noise,
)
from lerobot_memobench.policies.memobench_mem.objects import (
    CLASS_DIM,
    HAND_DIM,
    PER_METRE,
    WORKSPACE_CENTRE,
    ObjectEncoder,
)
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH, field

HINDSIGHT, FORESIGHT = 8, 8
"""Number of remembered motions (h) and of predicted motions (n)."""
FORESIGHT_WEIGHT = 0.01  # HiF-VLA's
LAYERS, HEADS = 4, 8
FORESEEN = "memory.foreseen"


# -- foresight --------------------------------------------------------------------------------------------------------


class MotionExpert(nn.Module):
    """Additions to the action expert: motion queries, the condition made of hindsight, and a decoder of motion.

    The condition's last layer starts at zero, so training starts without an effect of hindsight.
    """

    def __init__(self, memory_dim: int, width: int, numbers: int) -> None:
        super().__init__()
        self.queries = nn.Parameter(torch.randn(FORESIGHT, width) * width**-0.5)
        last = nn.Linear(width, width)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.condition = nn.Sequential(nn.Linear(memory_dim, width), nn.SiLU(), last)
        self.decode = nn.Sequential(nn.Linear(width, width), nn.Tanh(), nn.Linear(width, numbers))


class ForesightPass(MemoryPass):
    """A pass with hindsight in the condition of the expert's norms, and motion queries before the actions.

    Queries and actions attend to each other. The queries shift the actions' positions by `FORESIGHT`.
    """

    parts = ("foresight.",)

    @classmethod
    def extend(cls, model: Any, memory_dim: int, expert_dim: int) -> None:
        pool = model.memory.pool
        model.foresight = MotionExpert(memory_dim, expert_dim, pool.cells * pool.moved)

    def __init__(self, model: Any, memory: MemoryTokens, watched: bool = False) -> None:
        super().__init__(model, memory, watched)
        self.expert: MotionExpert = model.foresight
        self.hindsight: Tensor = self.expert.condition(memory.rows().squeeze(1))

    def actions(self, tokens: Tensor) -> Tensor:
        queries = repeat(self.expert.queries.to(tokens.dtype), "n w -> b n w", b=len(tokens))
        return torch.cat([queries, tokens], dim=1)

    def condition(self, condition: Tensor) -> Tensor:
        return condition + self.hindsight

    def expert_states(self, states: Tensor) -> None:
        self.outputs[FORESEEN] = self.expert.decode(states[:, :FORESIGHT].to(torch.float32))


# -- hindsight --------------------------------------------------------------------------------------------------------


class Motion(MemoryMechanism):
    """The last 8 motions between stored frames, as one token.

    Of objects every control step is stored; of images every fourth, in which an arm moves by some pixels of a
    thumbnail. With fewer motions the earliest is repeated; at an episode's first frame the motion is zero.
    """

    fusion = ForesightPass
    stride = {"objects": 1, "pixels": 4}
    asks_motion = True
    ahead = FORESIGHT
    capacity = HINDSIGHT + 1

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: NoSettings) -> None:
        super().__init__(spec, pool, settings)
        width = spec.expert
        layer = nn.TransformerEncoderLayer(width, HEADS, 2 * width, batch_first=True)  # torch's defaults, as the source
        self.encoder = nn.TransformerEncoder(layer, LAYERS, enable_nested_tensor=False)
        self.summary = nn.Parameter(torch.randn(width) * 0.02)
        self.out = nn.Linear(width, spec.width)
        self._followed: tuple[Tensor, Tensor] | None = None

    @classmethod
    def make_pool(cls, observations: Any, spec: MemorySpec) -> MotionField:
        if isinstance(observations, ObjectEncoder):
            return ObjectMotion(observations.order, observations.kinds, spec.expert, HINDSIGHT)
        return ImageMotion(spec.expert, HINDSIGHT)

    @property
    def field(self) -> MotionField:
        return cast(MotionField, self.pool)

    @classmethod
    def slots(cls, slot: int, settings: NoSettings) -> Sequence[int]:
        return range(max(0, slot - HINDSIGHT), slot + 1)

    def init(self, rows: int) -> dict[str, Tensor]:
        like, field = self.summary, self.field
        return {
            "frame": like.new_zeros(rows, 1, field.size),
            "motions": like.new_zeros(rows, HINDSIGHT, field.cells, field.numbers),
            "frames": torch.zeros(rows, dtype=torch.int64, device=like.device),
        }

    def pooled(self, frames: Tensor) -> Tensor:
        return frames  # motion is found between stored frames

    def write(self, state: Any, tokens: Tensor, step: Tensor, query: Query = Query()) -> dict[str, Tensor]:
        count, motions = state["frames"], state["motions"]
        moved = self.field.between(state["frame"].to(tokens.dtype), tokens).to(motions.dtype).unsqueeze(1)
        first, second = (rearrange(count == number, "r -> r 1 1 1") for number in (0, 1))
        later = torch.cat([motions[:, 1:], moved], dim=1)
        motions = torch.where(first, motions, torch.where(second, moved.expand_as(motions), later))
        return {"frame": tokens.to(state["frame"].dtype), "motions": motions, "frames": (count + 1).clamp(max=2)}

    def noised(self, state: Any, generator: torch.Generator) -> dict[str, Tensor]:
        return {**state, "motions": with_noise(state["motions"], generator)}  # not the last frame

    def read(self, state: Any, query: Query = Query()) -> MemoryTokens:
        return self._encoded(state["motions"])

    def replay(self, histories: Histories, query: Query = Query()) -> MemoryTokens:
        """Compute the motions of all samples at once, and the following motions as labels."""
        frames, places, field = histories.frames, histories.places, self.field
        exact = frames if histories.exact is None else histories.exact
        self._followed = None
        if histories.ahead is not None:
            last = places.gather(1, (places >= 0).sum(dim=1, keepdim=True) - 1)
            following = torch.cat([last, histories.ahead], dim=1)
            with torch.no_grad():
                moved, known = field.following(exact[following.clamp(min=0)])
            self._followed = moved, known & (following[:, 1:, None] >= 0)
        pairs = places[:, 1:] >= 0
        moved = field.between(frames[places[:, :-1][pairs]], frames[places[:, 1:][pairs]])
        motions = self.summary.new_zeros(len(places), HINDSIGHT, field.cells, field.numbers)
        count = pairs.sum(dim=1, keepdim=True)
        # The motions of row b begin at first[b] in `moved`, oldest first; the earliest is repeated in front.
        first = count.cumsum(dim=0) - count
        ages = torch.arange(HINDSIGHT, device=places.device) - HINDSIGHT + count
        some = count.squeeze(1) > 0
        motions[some] = moved.to(motions.dtype)[(first + ages.clamp(min=0))[some]]
        return self._encoded(motions)

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the weighted mean error of the predicted motions over cells with a known motion."""
        if self._followed is None or FORESEEN not in batch:
            return {}
        (moved, known), self._followed = self._followed, None
        foreseen = batch[FORESEEN].unflatten(-1, moved.shape[2:])
        errors = reduce((foreseen - moved).abs(), "b n c k -> b n c", "mean") * known
        return {"foresight": FORESIGHT_WEIGHT * errors.sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)}

    def _encoded(self, motions: Tensor) -> MemoryTokens:
        tokens = self.field.tokens(motions)
        summary = repeat(self.summary, "w -> b 1 w", b=len(tokens))
        read = self.encoder(torch.cat([summary.to(tokens.dtype), tokens], dim=1))[:, :1]
        return MemoryTokens(self.out(read), torch.ones(read.shape[:2], dtype=torch.bool, device=read.device))


# -- motion fields ----------------------------------------------------------------------------------------------------


class MotionField(nn.Module, ABC):
    """Motion between two stored frames of D' numbers (``size``), and tokens of it, whose layers are trained.

    There are C ``cells`` of K ``numbers``; the first ``moved`` of these are motion.
    """

    size: int
    cells: int
    numbers: int
    moved: int

    @abstractmethod
    def between(self, before: Tensor, now: Tensor) -> Tensor:
        """Return the field (N, C, K) between stored frames (N, 1, D'), without trained weights."""

    @abstractmethod
    def following(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Follow the cells of the first of frames (B, n + 1, 1, D') from frame to frame.

        Return their motion (B, n, C, moved), and for which cells it is known, (B, n, C) bool.
        """

    @abstractmethod
    def tokens(self, fields: Tensor) -> Tensor:
        """Return tokens (B, T, W), positions included, of the fields (B, h, C, K) of a sample, oldest first."""


# -- images ---------------------------------------------------------------------------------------------------------


BLOCKS = 16
"""Side of the square of blocks."""
BLOCK = THUMBNAIL // BLOCKS
REACH = 4
"""Maximum displacement of a block in each direction, pixels of the thumbnail. In demonstrations of two tasks 3 % of the
moving blocks reached it in four steps, and 27 % in eight; in one step most moved by less than a pixel."""
UNCHANGED = 2.0
"""Mean difference of a block's pixels, of 255, up to which its motion is zero: the noise of video compression."""
OFFSETS = sorted(itertools.product(range(-REACH, REACH + 1), repeat=2), key=lambda offset: math.hypot(*offset))
"""Candidate offsets (rows, columns) to a block's earlier place, nearest first, which decides ties."""
WIDE = 512
"""From this width on a token covers 2 x 2 blocks, as in the source, else 4 x 4."""


@torch.no_grad()
def match_blocks(before: Tensor, now: Tensor) -> Tensor:
    """Return the displacement (N, 16, 16, 2) in pixels, x and y, of each block between images (N, S, S).

    The offset within `REACH` with the least sum of absolute differences is chosen; images are padded by their edge.
    """
    moving = F.avg_pool2d((now - before).abs().unsqueeze(1), BLOCK).squeeze(1) > UNCHANGED
    around = F.pad(before.unsqueeze(1), (REACH,) * 4, mode="replicate").squeeze(1)
    side = BLOCK + 2 * REACH
    # Blocks are the last axis, so that sums run over all of them at once.
    windows = rearrange(around.unfold(1, side, BLOCK).unfold(2, side, BLOCK)[moving], "m y x -> y x m").contiguous()
    blocks = rearrange(now.unfold(1, BLOCK, BLOCK).unfold(2, BLOCK, BLOCK)[moving], "m y x -> y x m").contiguous()
    costs = [
        (windows[row : row + BLOCK, column : column + BLOCK] - blocks).abs().sum(dim=(0, 1))
        for row, column in ((REACH + y, REACH + x) for y, x in OFFSETS)
    ]
    came_from = now.new_tensor(OFFSETS)[torch.stack(costs).argmin(dim=0)]
    moved = now.new_zeros(*moving.shape, 2)
    moved[moving] = -came_from.flip(-1)
    return moved


class ImageMotion(MotionField):
    """Motion of a thumbnail's blocks, in its pixels, and two convolutions over time and place (HiF-VLA's)."""

    size, cells, numbers, moved = THUMBNAIL**2, BLOCKS**2, 2, 2

    def __init__(self, width: int, pairs: int) -> None:
        super().__init__()
        stride = 1 if width >= WIDE else 2
        self.convolve = nn.Sequential(
            nn.Conv3d(2, width, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv3d(width, width, 3, stride=stride, padding=1),
            nn.ReLU(),
        )
        times, side = pairs // 2 // stride, BLOCKS // 2 // stride
        self.times = nn.Parameter(torch.randn(times, 1, width) * 0.02)
        self.places = nn.Parameter(torch.randn(side**2, width) * 0.02)

    def between(self, before: Tensor, now: Tensor) -> Tensor:
        earlier, later = (frames.to(torch.float32).reshape(-1, THUMBNAIL, THUMBNAIL) for frames in (before, now))
        return match_blocks(earlier, later).flatten(1, 2)

    def following(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Match each frame's blocks with those of the previous frame; all are known."""
        pairs = self.between(frames[:, :-1].flatten(0, 1), frames[:, 1:].flatten(0, 1))
        moved = pairs.unflatten(0, (len(frames), -1))
        return moved, torch.ones(moved.shape[:-1], dtype=torch.bool, device=moved.device)

    def tokens(self, fields: Tensor) -> Tensor:
        """Return a token per two fields (or four) and 2 x 2 blocks (or 4 x 4)."""
        features = self.convolve(rearrange(fields, "b h (y x) k -> b k h y x", y=BLOCKS))
        return (rearrange(features, "b w t y x -> b t (y x) w") + self.times + self.places).flatten(1, 2)


# -- objects ----------------------------------------------------------------------------------------------------------


SAME = 0.15
"""Maximum displacement of a thing between two frames, m; beyond it, another thing is assumed."""
PER_STEP = 200.0
"""Factor that scales displacements (m) and changes of joints (m or rad) per control step to about one."""
MOVED = 4
"""Displacement (3) and change of the joint (1)."""


class ObjectMotion(MotionField):
    """Displacement of each slot's thing and of the hand; one token per pair of frames, pooled by learned attention.

    A cell's numbers are its motion, whether it is known, its class (``kinds`` for the hand), and its place. ``order``
    and ``kinds`` are as of `objects.SlotEncoder`.
    """

    size, cells, numbers, moved = SIZE + HAND_DIM + 1, SLOTS + 1, MOVED + 5, MOVED

    def __init__(self, order: Sequence[int], kinds: int, width: int, pairs: int) -> None:
        super().__init__()
        self.order = [*order, kinds]
        self.kind = nn.Embedding(kinds + 1, CLASS_DIM)
        self.mlp = nn.Sequential(nn.Linear(MOVED + 3 + CLASS_DIM, width), nn.GELU(), nn.Linear(width, width))
        self.score = nn.Linear(width, 1)
        self.times = nn.Parameter(torch.randn(pairs, width) * 0.02)

    def between(self, before: Tensor, now: Tensor) -> Tensor:
        return self._between(before, now)[0]

    def _between(self, before: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
        """Return the field (N, C, K), and the cell of each thing in the later frame, (N, C)."""
        then, kind, position, joint = self._cells(before)
        later, later_kind, later_position, later_joint = self._cells(now)
        apart = torch.cdist(position, later_position)
        another = ~then.unsqueeze(2) | ~later.unsqueeze(1) | (kind.unsqueeze(2) != later_kind.unsqueeze(1))
        apart = apart.masked_fill(another | (apart > SAME), torch.inf)
        nearest = apart.argmin(dim=2)  # things match if each is the other's nearest of the same class
        back = apart.argmin(dim=1).gather(1, nearest)
        cells = torch.arange(self.cells, device=back.device)
        known = (back == cells) & apart.isfinite().any(dim=2)
        gone = later_position.gather(1, nearest.unsqueeze(-1).expand_as(position)) - position
        turned = later_joint.gather(1, nearest.unsqueeze(-1)) - joint
        moved = PER_STEP * torch.cat([gone, turned], dim=-1) * known.unsqueeze(-1)
        seen = position.new_tensor(WORKSPACE_CENTRE)
        parts = [moved, known.unsqueeze(-1), kind.unsqueeze(-1), (position - seen) * PER_METRE]
        return torch.cat([part.to(position.dtype) for part in parts], dim=-1), nearest

    def _cells(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return which cells of stored frames hold a thing (N, C), and their classes (N, C), places and joints."""
        slots, hand, _ = frames.to(torch.float32).flatten(1).split([SIZE, HAND_DIM, 1], dim=1)
        slots = slots.unflatten(1, (SLOTS, WIDTH))
        alone = torch.ones_like(hand[:, :1])
        present = torch.cat([field(slots, "present").squeeze(-1), alone], dim=1) > 0
        kind = torch.cat([field(slots, "class").squeeze(-1), alone * (len(self.order) - 1)], dim=1)
        position = torch.cat([field(slots, "position"), hand[:, None, :3]], dim=1)
        joint = torch.cat([field(slots, "joint"), 0 * alone.unsqueeze(-1)], dim=1)
        return present, kind, position, joint

    def following(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Follow each thing of the first frame from frame to frame until it is lost."""
        count = frames.shape[1] - 1
        pairs, went = self._between(frames[:, :-1].flatten(0, 1), frames[:, 1:].flatten(0, 1))
        pairs, went = (of.unflatten(0, (-1, count)) for of in (pairs, went))
        cell = torch.arange(self.cells, device=went.device).expand(len(frames), -1)
        known, followed = torch.ones_like(cell, dtype=torch.bool), []
        for number in range(count):
            now = pairs[:, number].gather(1, cell.unsqueeze(-1).expand(-1, -1, self.numbers))
            known = known & (now[..., MOVED] > 0)
            followed.append((now[..., :MOVED], known))
            cell = went[:, number].gather(1, cell)
        moved, knowns = (torch.stack(parts, dim=1) for parts in zip(*followed, strict=True))
        return moved, knowns

    def tokens(self, fields: Tensor) -> Tensor:
        moved, known, kind, position = fields.split([MOVED, 1, 1, 3], dim=-1)
        kinds = torch.tensor(self.order, device=fields.device)[kind.squeeze(-1).long()]
        features = self.mlp(torch.cat([moved, position, self.kind(kinds)], dim=-1))
        weights = self.score(features).masked_fill(known == 0, -1e4).softmax(dim=2) * known.any(dim=2, keepdim=True)
        return (features * weights).sum(dim=2) + self.times
