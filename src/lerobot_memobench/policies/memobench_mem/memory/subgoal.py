"""Say the active checkpoint, and act on that alone: SimpleMemVLA's narrow channel.

History and present stand in the prefix. There the policy first says which of its task's checkpoints is the active one;
the tokens of that text follow the prefix, attend to all of it, and are all that the action expert reads of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import torch
import torch.nn.functional as F
from einops import repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import MemoryFusion, Prefix
from lerobot_memobench.policies.memobench_mem.memory.frames import Frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import SUBGOAL, Histories, MemoryTokens, Query
from lerobot_memobench.policies.memobench_mem.memory.texts import CheckpointTexts, scored

if TYPE_CHECKING:
    from lerobot_memobench.policies.memobench_mem.network import MemoryPI05

SCORES = "memory.scores"


class SubgoalChoice(nn.Module):
    """What the narrow channel adds to the model.

    Attributes:
        ask: the token, last of the prefix, whose last state says which text is active. score: from it to S scores.
        texts: tokens of the texts.
    """

    def __init__(self, texts: tuple[str, ...], width: int) -> None:
        super().__init__()
        self.ask = nn.Parameter(torch.randn(1, 1, width))
        self.score = nn.Linear(width, len(texts))
        self.texts = CheckpointTexts(texts, width)


class NarrowChannel(MemoryFusion):
    """The prefix holds LeRobot's, the memory, and ``ask``; behind them stand the text said and a copy of the state.

    | attends to            | prefix, memory, ask | text | copy of the state | actions |
    |-----------------------|---------------------|------|-------------------|---------|
    | prefix, memory, ask   | yes                 |      |                   |         |
    | text                  | yes                 | yes  |                   |         |
    | copy of the state     |                     |      | yes               |         |
    | actions               |                     | yes  | yes               | yes     |

    The state's own token attends to the whole prefix, so that its states would be a second channel: hence a copy. Where
    the state enters as words of the text prompt there is none. Conditions of the expert's norms are told the text and
    not the instruction.

    In training the text is the true one; otherwise a pass over the prefix chooses it, which does not depend on what
    stands behind.

    Attributes:
        said: (B,) number of the text of the last prefix; S: none.
    """

    tells_reads = True

    def __init__(self, model: MemoryPI05, memory_dim: int, expert_dim: int) -> None:
        self.model = model
        assert model.memory is not None
        self.count = len(model.memory.spec.subgoals)
        model.subgoal = SubgoalChoice(model.memory.spec.subgoals, memory_dim)
        self.memory: MemoryTokens | None = None
        self.said: Tensor | None = None
        self._scores: Tensor | None = None

    def hand_over(self, memory: MemoryTokens) -> None:
        """Keep this memory, and what may be said, for the next prefix."""
        self.memory, self._scores = memory, None

    def owns(self, name: str) -> bool:
        """Say whether a parameter is of the choice."""
        return name.startswith("subgoal.")

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Append memory, text and the state's copy."""
        memory, added = self.memory, cast(SubgoalChoice, self.model.subgoal)
        assert memory is not None
        assert memory.query is not None
        own = prefix.tokens[:, : 0 if state is None else state + 1][:, -1:]
        ask = repeat(added.ask, "1 1 d -> b 1 d", b=len(own))
        prefix = prefix.joined(memory.rows(), memory.mask).joined(ask, memory.mask.new_ones(len(own), 1))
        unread, true = prefix.tokens.shape[1], memory.query.subgoal
        prefix = prefix._replace(asked=slice(unread - 1, unread))
        said = self.said = self._chosen(prefix) if true is None else torch.where(true < 0, self.count, true)
        text, of_text = added.texts(said)
        if self.model.instruction is not None:
            self.model.instruction.read(text, of_text)
        whole = prefix.joined(text, of_text).joined(own, of_text.new_ones(own.shape[:2]))
        return whole._replace(attends=self.attention(whole, unread, own.shape[1]), unread=unread, asked=prefix.asked)

    def attention(self, prefix: Prefix, unread: int, copies: int) -> Tensor:
        """Return which tokens attend to which, (B, N, N) bool: see the table.

        Args:
            unread: how many of the first ones actions do not read. copies: 1 where the last is the state's copy.
        """
        places = torch.arange(prefix.tokens.shape[1], device=prefix.tokens.device)
        part = (places >= unread).int() + (places >= len(places) - copies).int()  # 0: what is before, 1: text, 2: copy
        of_query, of_key = part[:, None], part
        seen = torch.where(of_query == 2, of_key == 2, of_key <= of_query)
        return seen.expand(len(prefix.tokens), -1, -1)

    @torch.no_grad()
    def _chosen(self, prefix: Prefix) -> Tensor:
        """Return the texts (B,) that a pass over this prefix chooses."""
        self.model.read_prefix(prefix)
        assert self._scores is not None
        return self._scores.argmax(dim=1)

    def read_out(self, states: Tensor) -> None:
        """Score the texts by the last state of ``ask``."""
        added, memory = cast(SubgoalChoice, self.model.subgoal), self.memory
        assert memory is not None
        assert memory.query is not None
        assert memory.query.choices is not None
        self._scores = scored(added.score(states[:, 0].to(added.score.weight.dtype)), memory.query.choices)

    @contextmanager
    def watched(self) -> Iterator[list[Tensor]]:
        """Yield how much the text said attends to each of the memory's tokens: a share of all that it attends to."""
        found: list[Tensor] = []
        with self.model.paligemma_with_expert.watched() as (of_prefix, _):
            yield found
        assert self.memory is not None
        assert self.said is not None
        _, real = cast(SubgoalChoice, self.model.subgoal).texts(self.said)
        words, length = real.shape[1], self.memory.mask.shape[1]
        for weights in of_prefix[len(of_prefix) // 2 :]:  # (B, heads, N, N), after the pass that chooses
            unread = weights.shape[2] - words - (self.model.state_token is not None)
            read = weights[:, :, unread : unread + words, unread - 1 - length : unread - 1].mean(dim=1)
            found.append((read * real.unsqueeze(-1)).sum(dim=1) / real.sum(dim=1, keepdim=True))

    def outputs(self) -> dict[str, Tensor]:
        """Return the scores (B, S + 1) of the texts."""
        return {} if self._scores is None else {SCORES: self._scores}


class Subgoal(Frames):
    """SimpleMemVLA on this backbone: 32 frames in the prefix, the active checkpoint said, an expert that reads that.

    As there: cross-entropy of the text beside the actions' loss, 1 : 1; the expert is trained on states of the true
    text; its condition is states and embeddings of the text, and the robot's state. Otherwise than there: frames are
    those of ``memory=frames`` (at most 32, even over the episode, not 120 at 2 Hz); the text is chosen among the task's
    and not generated; its words are embedded anew; the expert is pi0.5's, which reads states of every layer and not
    the last's.
    """

    privileged = True
    fusion = NarrowChannel

    def read(self, state: Any, query: Query | None = None) -> MemoryTokens:
        """Read the frames, and keep what may be said."""
        return super().read(state, query)._replace(query=query)

    def replay(self, histories: Histories, query: Query | None = None) -> MemoryTokens:
        """Read the frames, and keep what may be said and what is true."""
        return super().replay(histories, query)._replace(query=query)

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return how far from the true text the choice was; 0 where there is none."""
        if SCORES not in batch:  # no pass was made
            return {}
        true = batch[SUBGOAL].to(batch[SCORES].device)
        return {"subgoal": F.cross_entropy(batch[SCORES], true, ignore_index=-1, reduction="none")}
