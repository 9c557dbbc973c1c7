"""Motion (HiF-VLA): an action chunk reads the motion of the last frames, and the expert predicts the next motion.

From HiF-VLA (OpenHelix-Team/HiF-VLA, CVPR 2026): hindsight of the last 8 motions, its encoder, 8 foresight queries,
their loss of 0.01 L1, and modulation of the expert by hindsight. Differences: motion is found by block matching of
thumbnails, or is the displacement of objects, instead of vectors of a codec; the queries join the actions in pi0.5's
expert, and there is no joint expert with its own norms, projections and feed-forwards for motion; two layers decode
motion, without attention over place and time; an action chunk is learned as in pi0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import torch
from einops import rearrange, reduce, repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import MemoryFusion, Reading
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    Histories,
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    NoSettings,
    Query,
    with_noise,
)

if TYPE_CHECKING:
    from lerobot_memobench.policies.memobench_mem.motion_fields import MotionField

HINDSIGHT, FORESIGHT = 8, 8
"""Number of remembered motions (h) and of predicted motions (n)."""
FORESIGHT_WEIGHT = 0.01
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


class ForesightReading(Reading):
    """A pass with hindsight in the condition of the expert's norms, and motion queries before the actions."""

    def __init__(self, expert: MotionExpert, memory: MemoryTokens) -> None:
        super().__init__()
        self.expert, self.hindsight = expert, expert.condition(memory.rows().squeeze(1))

    def actions(self, tokens: Tensor) -> Tensor:
        """Insert the queries before the actions; queries and actions attend to each other."""
        queries = repeat(self.expert.queries.to(tokens.dtype), "n w -> b n w", b=len(tokens))
        return torch.cat([queries, tokens], dim=1)

    def condition(self, condition: Tensor) -> Tensor:
        """Add hindsight."""
        hindsight: Tensor = self.hindsight
        return condition + hindsight

    def expert_states(self, states: Tensor) -> None:
        """Decode the motion (B, n, C k) that the queries predict."""
        self.outputs[FORESEEN] = self.expert.decode(states[:, :FORESIGHT].to(torch.float32))


class Foresight(MemoryFusion):
    """Add hindsight to the condition of the expert's norms, and insert motion queries before the actions.

    The actions' positions are therefore shifted by `FORESIGHT` from those of plain pi0.5.
    """

    parts = ("foresight.",)

    def __init__(self, model: nn.Module, memory_dim: int, expert_dim: int) -> None:
        self.model = cast(Any, model)
        pool = self.model.memory.pool
        self.model.foresight = MotionExpert(memory_dim, expert_dim, pool.cells * pool.moved)

    def begin(self, memory: MemoryTokens, watched: bool = False) -> Reading:
        """Begin a pass conditioned on this memory."""
        return ForesightReading(self.model.foresight, memory)


# -- hindsight --------------------------------------------------------------------------------------------------------


class Motion(MemoryMechanism):
    """The last 8 motions between stored frames, as one token.

    Of objects every control step is stored; of pictures every fourth, in which an arm moves by some pixels of a
    thumbnail. With fewer motions the earliest is repeated; at an episode's first frame the motion is zero.
    """

    fusion = Foresight
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

    @property
    def field(self) -> MotionField:
        """The motion field between two stored frames."""
        return cast("MotionField", self.pool)

    @classmethod
    def slots(cls, slot: int, settings: NoSettings) -> Sequence[int]:
        """Return the last frames, between which the motions are."""
        return range(max(0, slot - HINDSIGHT), slot + 1)

    def init(self, rows: int) -> dict[str, Tensor]:
        """Return zero motion, and no last frame."""
        like, field = self.summary, self.field
        return {
            "frame": like.new_zeros(rows, 1, field.size),
            "motions": like.new_zeros(rows, HINDSIGHT, field.cells, field.numbers),
            "frames": torch.zeros(rows, dtype=torch.int64, device=like.device),
        }

    def observe(self, state: Any, frames: Tensor, step: Tensor, query: Query | None = None) -> dict[str, Tensor]:
        """Append the motion to stored frames."""
        return self.write(state, frames, step, query)

    def write(self, state: Any, tokens: Tensor, step: Tensor, query: Query | None = None) -> dict[str, Tensor]:
        """Append the motion to stored frames."""
        count, motions = state["frames"], state["motions"]
        moved = self.field.between(state["frame"].to(tokens.dtype), tokens).to(motions.dtype).unsqueeze(1)
        first, second = (rearrange(count == number, "r -> r 1 1 1") for number in (0, 1))
        later = torch.cat([motions[:, 1:], moved], dim=1)
        motions = torch.where(first, motions, torch.where(second, moved.expand_as(motions), later))
        return {"frame": tokens.to(state["frame"].dtype), "motions": motions, "frames": (count + 1).clamp(max=2)}

    def noised(self, state: Any, generator: torch.Generator) -> dict[str, Tensor]:
        """Return the state with noise on its motions, not on the last frame."""
        return {**state, "motions": with_noise(state["motions"], generator)}

    def read(self, state: Any, query: Query | None = None) -> MemoryTokens:
        """Encode the motions to one token."""
        return self._encoded(state["motions"])

    def replay(self, histories: Histories, query: Query | None = None) -> MemoryTokens:
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
