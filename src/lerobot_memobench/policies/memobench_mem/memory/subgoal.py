"""Say the active checkpoint, and act on that alone: SimpleMemVLA's narrow channel.

History and present stand in the prefix. There the policy first says which of its task's checkpoints is the active one;
the tokens of that text follow the prefix, attend to all of it, and are all that the action expert reads of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import torch
import torch.nn.functional as F
from einops import repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import MemoryFusion, Prefix, Reading
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


class NarrowReading(Reading):
    """A pass whose prefix holds LeRobot's, the memory and ``ask``, then the chosen text and a copy of the state.

    | attends to            | prefix, memory, ask | text | copy of the state | actions |
    |-----------------------|---------------------|------|-------------------|---------|
    | prefix, memory, ask   | yes                 |      |                   |         |
    | text                  | yes                 | yes  |                   |         |
    | copy of the state     |                     |      | yes               |         |
    | actions               |                     | yes  | yes               | yes     |

    The state's own token attends to the whole prefix, so its states would be a second channel: hence a copy. Where
    the state enters as words of the text prompt there is none. Conditions of the expert's norms come from the text
    instead of the instruction.

    In training the text is the true one; otherwise a pass over the prefix chooses it, which does not depend on the
    tokens behind.

    Attributes:
        said: (B,) number of the text of the prefix; S: none.
    """

    def __init__(self, model: MemoryPI05, memory: MemoryTokens, watched: bool) -> None:
        super().__init__(watched)
        assert memory.query is not None
        self.model, self.memory, self.query = model, memory, memory.query
        self.choice = cast(SubgoalChoice, model.subgoal)
        self.said: Tensor | None = None

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Append memory, text and the state's copy."""
        memory, true = self.memory, self.query.subgoal
        own = prefix.tokens[:, : 0 if state is None else state + 1][:, -1:]
        ask = repeat(self.choice.ask, "1 1 d -> b 1 d", b=len(own))
        prefix = prefix.joined(memory.rows(), memory.mask).joined(ask, memory.mask.new_ones(len(own), 1))
        unread, none = prefix.tokens.shape[1], self.choice.score.out_features
        prefix = prefix._replace(asked=slice(unread - 1, unread))
        said = self.said = self._chosen(prefix) if true is None else torch.where(true < 0, none, true)
        text, of_text = self.choice.texts(said)
        if self.model.instruction is not None:
            prefix = prefix._replace(instruction=self.model.instruction(text, of_text))
        whole = prefix.joined(text, of_text).joined(own, of_text.new_ones(own.shape[:2]))
        return whole._replace(attends=self.attends(whole, unread, own.shape[1]), unread=unread, asked=prefix.asked)

    def attends(self, prefix: Prefix, unread: int, copies: int) -> Tensor:
        """Return which tokens attend to which, (B, N, N) bool: see the table.

        Args:
            unread: number of leading tokens that actions do not read. copies: 1 where the last is the state's copy.
        """
        places = torch.arange(prefix.tokens.shape[1], device=prefix.tokens.device)
        part = (places >= unread).int() + (places >= len(places) - copies).int()  # 0: before the text, 1: text, 2: copy
        of_query, of_key = part[:, None], part
        seen = torch.where(of_query == 2, of_key == 2, of_key <= of_query)
        return seen.expand(len(prefix.tokens), -1, -1)

    @torch.no_grad()
    def _chosen(self, prefix: Prefix) -> Tensor:
        """Return the texts (B,) that a pass over this prefix chooses."""
        self.model.read_prefix(prefix, self)
        return self.outputs[SCORES].argmax(dim=1)

    def read_out(self, states: Tensor) -> None:
        """Score the texts by the last state of ``ask``: (B, S + 1)."""
        assert self.query.choices is not None
        score = self.choice.score
        self.outputs[SCORES] = scored(score(states[:, 0].to(score.weight.dtype)), self.query.choices)

    def shares(self) -> list[Tensor]:
        """Return the share of the chosen text's attention that each memory token gets."""
        assert self.said is not None
        _, real = self.choice.texts(self.said)
        words, length = real.shape[1], self.memory.mask.shape[1]
        of_prefix, _ = self.attention or ([], [])
        found = []
        for weights in of_prefix[len(of_prefix) // 2 :]:  # (B, heads, N, N), after the pass that chooses
            unread = weights.shape[2] - words - (self.model.state_token is not None)
            read = weights[:, :, unread : unread + words, unread - 1 - length : unread - 1].mean(dim=1)
            found.append((read * real.unsqueeze(-1)).sum(dim=1) / real.sum(dim=1, keepdim=True))
        return found


class NarrowChannel(MemoryFusion):
    """Choose a text by prefix and memory; actions read that text alone (`NarrowReading`)."""

    tells_reads = True

    def __init__(self, model: MemoryPI05, memory_dim: int, expert_dim: int) -> None:
        self.model = model
        assert model.memory is not None
        model.subgoal = SubgoalChoice(model.memory.spec.subgoals, memory_dim)

    def begin(self, memory: MemoryTokens, watched: bool = False) -> Reading:
        """Begin a pass over this memory, whose ``query`` holds the texts to choose from."""
        return NarrowReading(self.model, memory, watched)

    def owns(self, name: str) -> bool:
        """Return whether a parameter is of the choice."""
        return name.startswith("subgoal.")


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
