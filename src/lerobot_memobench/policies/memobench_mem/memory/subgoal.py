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
from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d
from lerobot.utils.constants import OPENPI_ATTENTION_MASK_VALUE
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import UNREAD, MemoryFusion, Prefix, hooked
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

    attends_fused = True
    tells_reads = True

    def __init__(self, model: MemoryPI05, memory_dim: int, expert_dim: int) -> None:
        self.model = model
        assert model.memory is not None
        self.count = len(model.memory.spec.subgoals)
        model.subgoal = SubgoalChoice(model.memory.spec.subgoals, memory_dim)
        self.memory: MemoryTokens | None = None
        self.said: Tensor | None = None
        self._scores: Tensor | None = None
        self._unread = self._length = 0  # of the prefix: what actions do not read, and all of it; 0: it is not made yet
        self._copies_state = False
        language: Any = model.paligemma_with_expert.paligemma.model.language_model
        last = language.layers[-1]
        self._attention = last.self_attn
        for part in (last.self_attn.q_proj, last.self_attn.o_proj, last.post_attention_layernorm, language.norm):
            part.register_forward_pre_hook(self._those_read)
        for part in (last.self_attn.q_proj, last.self_attn.o_proj, last.mlp):
            part.register_forward_hook(self._padded)

    def _skipped(self) -> int:
        """Return of how many of the prefix's first tokens a training's pass makes no last state: none reads them."""
        return self._unread - 1 if self._length and torch.is_grad_enabled() else 0

    def _those_read(self, part: nn.Module, inputs: tuple[Tensor]) -> Tensor:
        return inputs[0][:, self._skipped() :]

    def _padded(self, part: nn.Module, inputs: Any, outputs: Tensor) -> Tensor:
        return F.pad(outputs, (0, 0, self._skipped(), 0))

    def hand_over(self, memory: MemoryTokens) -> None:
        """Keep this memory, and what may be said, for the next prefix."""
        self.memory, self._scores, self._length = memory, None, 0

    def owns(self, name: str) -> bool:
        """Say whether a parameter is of the choice."""
        return name.startswith("subgoal.")

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Append memory, text and the state's copy."""
        memory, added = self.memory, cast(SubgoalChoice, self.model.subgoal)
        assert memory is not None
        assert memory.query is not None
        self._length = 0
        embeddings, real, blocks = prefix
        dtype, own = embeddings.dtype, embeddings[:, : 0 if state is None else state + 1][:, -1:]
        ask = repeat(added.ask, "1 1 d -> b 1 d", b=len(embeddings))
        embeddings = torch.cat([embeddings, memory.rows().to(dtype), ask.to(dtype)], dim=1)
        real = torch.cat([real, memory.mask, torch.ones_like(real[:, :1])], dim=1)
        blocks = torch.zeros_like(real)
        true = memory.query.subgoal
        said = self._chosen((embeddings, real, blocks)) if true is None else torch.where(true < 0, self.count, true)
        self.said = said
        text, of_text = added.texts(said)
        if self.model.instruction is not None:
            self.model.instruction.read(text, of_text)
        begins = torch.zeros_like(of_text)
        begins[:, 0] = True
        self._unread, self._copies_state = embeddings.shape[1], state is not None
        behind = torch.ones(own.shape[:2], dtype=torch.bool, device=real.device)
        embeddings = torch.cat([embeddings, text.to(dtype), own], dim=1)
        self._length = embeddings.shape[1]
        setattr(self._attention, UNREAD, self._unread - 1)
        return embeddings, torch.cat([real, of_text, behind], dim=1), torch.cat([blocks, begins, behind], dim=1)

    @torch.no_grad()
    def _chosen(self, prefix: Prefix) -> Tensor:
        """Return the texts (B,) that a pass over this prefix chooses; in eager attention, as LeRobot's own pass."""
        embeddings, real, blocks = prefix
        both = self.model.paligemma_with_expert
        both.paligemma.model.language_model.config._attn_implementation = "eager"
        both.forward(
            attention_mask=prepare_attention_masks_4d(make_att_2d_masks(real, blocks)),
            position_ids=torch.cumsum(real, dim=1) - 1,
            inputs_embeds=[embeddings, None],
            use_cache=False,
        )
        assert self._scores is not None
        return self._scores.argmax(dim=1)

    def attention(self, mask: Tensor) -> Tensor:
        """Hide from actions what they do not read, and from the state's copy all but itself."""
        if not self._length:
            return mask
        queries, keys = (torch.arange(count, device=mask.device) for count in mask.shape[-2:])
        queries = (queries + len(keys) - len(queries)).unsqueeze(1)  # actions alone come over cached keys
        hidden = (queries >= self._length) & (keys < self._unread)
        if self._copies_state:
            hidden |= (queries == self._length - 1) & (keys != self._length - 1)
        return mask.masked_fill(hidden, OPENPI_ATTENTION_MASK_VALUE)

    def read_out(self, states: Tensor) -> None:
        """Score the texts by the last state of ``ask``."""
        added, memory = cast(SubgoalChoice, self.model.subgoal), self.memory
        assert memory is not None
        assert memory.query is not None
        assert memory.query.choices is not None
        asked = states[:, self._unread - self._length - 1 if self._length else -1]
        self._scores = scored(added.score(asked.to(added.score.weight.dtype)), memory.query.choices)

    @contextmanager
    def watched(self) -> Iterator[list[Tensor]]:
        """Yield how much the text said attends to each of the memory's tokens: a share of all that it attends to."""
        found: list[Tensor] = []

        def note(attention: Any, inputs: Any, outputs: tuple[Tensor, Tensor]) -> None:
            assert self.memory is not None
            weights, length = outputs[1], self.memory.mask.shape[1]  # (B, heads, N, N)
            if weights.shape[2] == self._length:  # and not the pass that chooses
                assert self.said is not None
                _, real = cast(SubgoalChoice, self.model.subgoal).texts(self.said)
                read = weights[:, :, self._unread :, self._unread - 1 - length : self._unread - 1].mean(dim=1)
                words = read[:, : real.shape[1]] * real.unsqueeze(-1)
                found.append(words.sum(dim=1) / real.sum(dim=1, keepdim=True))

        layers = self.model.paligemma_with_expert.paligemma.model.language_model.layers
        with hooked([layer.self_attn for layer in layers], note):
            yield found

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
