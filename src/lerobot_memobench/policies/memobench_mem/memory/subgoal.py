"""SimpleMemVLA's narrow channel: choose the text of the active checkpoint, and act on that text only.

The prefix holds history and present. From it the policy chooses one of its task's checkpoint texts. The tokens of this
text follow the prefix, attend to all of it, and are all that the action expert reads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from einops import repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import MemoryPass, Prefix
from lerobot_memobench.policies.memobench_mem.memory.frames import FrameSampling
from lerobot_memobench.policies.memobench_mem.memory.mechanism import SUBGOAL, Histories, MemoryTokens, Query

SCORES = "memory.scores"


# -- texts of checkpoints as tokens ------------------------------------------------------------------------------------


class CheckpointTexts(nn.Module):
    """Embed texts as learned tokens of their words; the last text is an empty one, for frames without a text.

    Equal words share an embedding. Each text ends with the same token.
    """

    rows: Tensor

    def __init__(self, texts: Sequence[str], width: int) -> None:
        super().__init__()
        spelled = [text.lower().split() for text in (*texts, "")]
        number = {word: row for row, word in enumerate(sorted({word for words in spelled for word in words}), start=1)}
        self.length = 1 + max(map(len, spelled))
        padding = [[-1] * (self.length - 1 - len(words)) for words in spelled]
        rows = [[*(number[word] for word in words), 0, *rest] for words, rest in zip(spelled, padding, strict=True)]
        # On the CPU, so that a model built on the meta device has it too.
        self.register_buffer("rows", torch.tensor(rows, device="cpu"), persistent=False)
        self.embedding = nn.Embedding(1 + len(number), width)

    def forward(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tokens (B, n, d) of texts by their indices (B,), -1 for the empty text, and a mask (B, n)."""
        rows = self.rows[numbers]
        return self.embedding(rows.clamp(min=0)), rows >= 0


def scored(scores: Tensor, choices: Tensor) -> Tensor:
    """Return scores (B, S + 1) given those (B, S) of all texts; the last is the empty text's.

    Texts that ``choices`` (B, S) excludes rank below the empty text, which ranks below all other texts.
    """
    low = torch.finfo(torch.float32).min
    masked = scores.to(torch.float32).masked_fill(~choices, low)
    return torch.cat([masked, masked.new_full((len(masked), 1), low / 2)], dim=1)


# -- the channel -------------------------------------------------------------------------------------------------------


class SubgoalChoice(nn.Module):
    """A last token of the prefix, whose last state is scored, and the texts."""

    def __init__(self, texts: tuple[str, ...], width: int) -> None:
        super().__init__()
        self.ask = nn.Parameter(torch.randn(1, 1, width))
        self.score = nn.Linear(width, len(texts))
        self.texts = CheckpointTexts(texts, width)


class NarrowPass(MemoryPass):
    """A pass with LeRobot's prefix, the memory and ``ask``, followed by the chosen text and a copy of the state.

    | attends to            | prefix, memory, ask | text | copy of the state | actions |
    |-----------------------|---------------------|------|-------------------|---------|
    | prefix, memory, ask   | yes                 |      |                   |         |
    | text                  | yes                 | yes  |                   |         |
    | copy of the state     |                     |      | yes               |         |
    | actions               |                     | yes  | yes               | yes     |

    The state's own token attends to the whole prefix, so reading it would open a second channel; hence the copy. If
    the prompt spells the state, there is no copy. The condition of the expert's norms comes from the text instead of
    the instruction. In training the text is the true one; otherwise a pass over the prefix chooses it (``chosen``
    (B,), S: none).
    """

    parts = ("subgoal.",)
    watches = ("prefix",)

    @classmethod
    def extend(cls, model: Any, memory_dim: int, expert_dim: int) -> None:
        model.subgoal = SubgoalChoice(model.memory.spec.subgoals, memory_dim)

    def __init__(self, model: Any, memory: MemoryTokens, watched: bool = False) -> None:
        super().__init__(model, memory, watched)
        assert memory.query is not None
        self.memory, self.query = memory, memory.query
        self.choice: SubgoalChoice = model.subgoal
        self.chosen: Tensor | None = None

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        memory, true = self.memory, self.query.subgoal
        own = prefix.tokens[:, : 0 if state is None else state + 1][:, -1:]
        ask = repeat(self.choice.ask, "1 1 d -> b 1 d", b=len(own))
        prefix = prefix.joined(memory.rows(), memory.mask).joined(ask, memory.mask.new_ones(len(own), 1))
        unread, none = prefix.tokens.shape[1], self.choice.score.out_features
        prefix = prefix._replace(asked=slice(unread - 1, unread))
        if true is None:
            with torch.no_grad():
                self.model.read_prefix(prefix, self)
                self.chosen = self.outputs[SCORES].argmax(dim=1)
        else:
            self.chosen = torch.where(true < 0, none, true)
        text, of_text = self.choice.texts(self.chosen)
        if self.model.instruction is not None:
            prefix = prefix._replace(instruction=self.model.instruction(text, of_text))
        whole = prefix.joined(text, of_text).joined(own, of_text.new_ones(own.shape[:2]))
        return whole._replace(attends=self.attends(whole, unread, own.shape[1]), unread=unread, asked=prefix.asked)

    def attends(self, prefix: Prefix, unread: int, copies: int) -> Tensor:
        """Return which tokens attend to which, (B, N, N) bool: see the table.

        Actions do not read the ``unread`` leading tokens; ``copies`` is 1 if the last token is the state's copy.
        """
        positions = torch.arange(prefix.tokens.shape[1], device=prefix.tokens.device)
        # 0: before the text, 1: text, 2: copy.
        part = (positions >= unread).int() + (positions >= len(positions) - copies).int()
        of_query, of_key = part[:, None], part
        seen = torch.where(of_query == 2, of_key == 2, of_key <= of_query)
        return seen.expand(len(prefix.tokens), -1, -1)

    def read_out(self, states: Tensor) -> None:
        assert self.query.choices is not None
        score = self.choice.score
        self.outputs[SCORES] = scored(score(states[:, 0].to(score.weight.dtype)), self.query.choices)

    def attention_shares(self) -> list[Tensor]:
        """Return the share of the chosen text's attention on each memory token."""
        assert self.chosen is not None
        _, real = self.choice.texts(self.chosen)
        words, length = real.shape[1], self.memory.mask.shape[1]
        of_prefix, shares = self.attention["prefix"], []
        for weights in of_prefix[len(of_prefix) // 2 :]:  # (B, heads, N, N), after the pass that chooses
            unread = weights.shape[2] - words - (self.model.state_token is not None)
            read = weights[:, :, unread : unread + words, unread - 1 - length : unread - 1].mean(dim=1)
            shares.append((read * real.unsqueeze(-1)).sum(dim=1) / real.sum(dim=1, keepdim=True))
        return shares


class Subgoal(FrameSampling):
    """SimpleMemVLA on this backbone: 32 frames in the prefix, and an expert that reads only the chosen text.

    As in the source: cross-entropy of the text with weight 1 next to the actions' loss; the expert is trained on states
    of the true text; its condition is states and embeddings of the text, and the robot's state.
    `docs/guides/memory/subgoal.md` lists the differences.
    """

    privileged = True
    fusion = NarrowPass

    def read(self, state: Any, query: Query = Query()) -> MemoryTokens:
        return super().read(state, query)._replace(query=query)

    def replay(self, histories: Histories, query: Query = Query()) -> MemoryTokens:
        return super().replay(histories, query)._replace(query=query)

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the cross-entropy of the choice; 0 for frames without a text."""
        if SCORES not in batch:  # without a pass of the model
            return {}
        true = batch[SUBGOAL].to(batch[SCORES].device)
        return {"subgoal": F.cross_entropy(batch[SCORES], true, ignore_index=-1, reduction="none")}
