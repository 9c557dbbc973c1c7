"""Keyframes (MemER): a high level chooses the active checkpoint and nominates keyframes; a low level acts on this.

The memory belongs to the high level: recent frames, and keyframes that it nominated among earlier recent frames. The
low level, which is the policy, reads the words of the checkpoint that the high level chose last.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median_low
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    Histories,
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    Query,
    State,
)
from lerobot_memobench.policies.memobench_mem.memory.subgoal import CheckpointTexts, scored

RECENT, SHOWN, GAP = 8, 8, 5
"""Frames of the recent window; maximum number of keyframes shown; maximum gap in a cluster of nominations, frames."""
NOMINATED = 64
"""Nominated frames that are kept, the latest."""
DROPPED, SHIFTED = 0.1, 2
"""In training: share of the true keyframes that is dropped, and maximum shift of the others, frames."""
LAYERS, HEADS = 2, 8


def representatives(nominated: Sequence[int], gap: int) -> list[int]:
    """Return the low median of each cluster of nominations, ascending; a gap above ``gap`` separates clusters."""
    clusters: list[list[int]] = []
    for frame in sorted(nominated):
        if not clusters or frame - clusters[-1][-1] > gap:
            clusters.append([])
        clusters[-1].append(frame)
    return [median_low(cluster) for cluster in clusters]


def shown_keyframes(nominated: Sequence[int], gap: int, window: int) -> list[int]:
    """Return the keyframes to show: the last representatives before ``window``, the oldest recent frame."""
    return [frame for frame in representatives(nominated, gap)[-SHOWN:] if frame < window]


class Keyframes(MemoryMechanism):
    """MemER on this backbone; nominations, clusters and labels follow its released code.

    A frame is written every 10 control steps (2 Hz), and the high level runs for each; the recent window spans 4 s. A
    keyframe's label is the last written frame before a checkpoint is completed. The high level learns from true
    keyframes, clustered as in a rollout, with some dropped or shifted. Its target is the checkpoint that is active at
    the next frame, on which the low level acts as well. `docs/guides/memory/keyframes.md` lists the differences.
    """

    stride = 10
    ahead = 1
    privileged = True
    reads_text = True
    capacity = RECENT + NOMINATED

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: Any) -> None:
        super().__init__(spec, pool, settings)
        width, self.count = spec.width, len(spec.subgoals)
        self.embed = nn.Linear(spec.dim, width)
        self.place = nn.Parameter(0.02 * torch.randn(SHOWN + RECENT, 1, width))
        self.spot = nn.Parameter(0.02 * torch.randn(spec.tokens, width))
        self.ask = nn.Parameter(0.02 * torch.randn(1, 1, width))
        self.task = nn.Linear(self.count, width)
        layer = nn.TransformerEncoderLayer(width, HEADS, 4 * width, 0.0, F.gelu, batch_first=True, norm_first=True)
        self.encoder = nn.TransformerEncoder(layer, LAYERS, nn.LayerNorm(width), enable_nested_tensor=False)
        self.score = nn.Linear(width, self.count)
        self.nominate = nn.Linear(width, 1)
        self.texts = CheckpointTexts(spec.subgoals, width)
        self._losses: dict[str, Tensor] = {}

    # -- the high level ----------------------------------------------------------------------------------------------

    def ask_high_level(self, frames: Tensor, real: Tensor, choices: Tensor) -> tuple[Tensor, Tensor]:
        """Return scores (B, S + 1) of the checkpoints, and logits (B, RECENT) for nominating the recent frames.

        ``frames`` (B, SHOWN + RECENT, P, D) are keyframes, then recent frames, each the latest last.
        """
        tokens = self.embed(frames.to(self.embed.weight.dtype)) + self.place + self.spot
        task = self.task(choices.to(tokens.dtype)).unsqueeze(1)
        sequence = torch.cat([tokens.flatten(1, 2), task, self.ask.expand(len(task), -1, -1)], dim=1)
        padding = F.pad(~real.repeat_interleave(self.spec.tokens, dim=1), (0, 2))
        states = self.encoder(sequence, src_key_padding_mask=padding)
        recent = states[:, SHOWN * self.spec.tokens : -2].unflatten(1, (RECENT, self.spec.tokens)).mean(dim=2)
        return scored(self.score(states[:, -1]), choices), self.nominate(recent).squeeze(-1)

    # -- a rollout ---------------------------------------------------------------------------------------------------

    def init(self, rows: int) -> State:
        like = self.ask
        frame = rows, RECENT + NOMINATED, self.spec.tokens, self.spec.dim
        return {
            "frames": torch.zeros(frame, device=like.device),
            "steps": torch.full(frame[:2], -1, device=like.device),
            "votes": torch.zeros(rows, NOMINATED, dtype=torch.int64, device=like.device),
            "text": torch.full((rows,), self.count, device=like.device),
        }

    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query = Query()) -> State:
        """Keep the frame, run the high level, and count its nominations."""
        assert query.choices is not None
        keyframes, old = state["frames"][:, :NOMINATED], state["frames"][:, NOMINATED:]
        keyframe_at, old_at = state["steps"][:, :NOMINATED], state["steps"][:, NOMINATED:]
        recent = torch.cat([old[:, 1:], tokens.to(old.dtype).unsqueeze(1)], dim=1)
        recent_at = torch.cat([old_at[:, 1:], step.unsqueeze(1)], dim=1)
        keys, filled = self._shown(keyframes, keyframe_at, state["votes"], recent_at)
        real = torch.cat([filled, recent_at >= 0], dim=1)
        scores, logits = self.ask_high_level(torch.cat([keys, recent], dim=1), real, query.choices)
        nominated = (logits > 0) & (recent_at >= 0)
        again = (keyframe_at.unsqueeze(2) == recent_at.unsqueeze(1)) & nominated.unsqueeze(1)
        first = nominated & ~again.any(dim=1)
        votes = torch.cat([state["votes"] + again.sum(dim=2), first.long()], dim=1)
        at = torch.cat([keyframe_at, recent_at.masked_fill(~first, -1)], dim=1)
        latest = at.argsort(dim=1, stable=True)[:, -NOMINATED:]
        rows = torch.arange(len(at), device=at.device).unsqueeze(1)
        keyframes, keyframe_at = torch.cat([keyframes, recent], dim=1)[rows, latest], at[rows, latest]
        return {
            "frames": torch.cat([keyframes, recent], dim=1),
            "steps": torch.cat([keyframe_at, recent_at], dim=1),
            "votes": votes[rows, latest],
            "text": scores.argmax(dim=1),
        }

    def _shown(self, keyframes: Tensor, keyframe_at: Tensor, votes: Tensor, recent_at: Tensor) -> tuple[Tensor, Tensor]:
        chosen = torch.full((len(keyframes), SHOWN), -1)
        for row, (steps, counts, recent) in enumerate(
            zip(keyframe_at.tolist(), votes.tolist(), recent_at.tolist(), strict=True)
        ):
            nominated = [step for step, count in zip(steps, counts, strict=True) for _ in range(count)]
            window = min(step for step in recent if step >= 0)
            frames = [steps.index(step) for step in shown_keyframes(nominated, GAP * self.spec.stride, window)]
            chosen[row, SHOWN - len(frames) :] = torch.tensor(frames, dtype=torch.int64)
        chosen = chosen.to(keyframes.device)
        rows = torch.arange(len(keyframes), device=keyframes.device).unsqueeze(1)
        return keyframes[rows, chosen.clamp(min=0)], chosen >= 0

    def read(self, state: State, query: Query = Query()) -> MemoryTokens:
        return MemoryTokens(*self.texts(state["text"]))

    # -- a training --------------------------------------------------------------------------------------------------

    def replay(self, histories: Histories, query: Query = Query()) -> MemoryTokens:
        """Run the high level once per sample with true keyframes; without labels, replay a rollout."""
        if histories.subgoals is None or query.subgoal is None:
            return super().replay(histories, query)
        assert query.choices is not None
        labels = F.pad(histories.subgoals, (0, 1), value=-1)[histories.places]
        counts = (histories.places >= 0).sum(dim=1)
        slots, keyframe = self._true_frames(labels, counts)
        places = histories.places.gather(1, slots.clamp(min=0)).masked_fill(slots < 0, -1)
        needed, where = places.unique(return_inverse=True)
        frames = self.pool(histories.frames[needed.clamp(min=0)])[where]
        scores, logits = self.ask_high_level(frames, slots >= 0, query.choices)
        target = query.subgoal
        if histories.ahead is not None:
            following = histories.ahead[:, 0]
            target = torch.where(following < 0, target, histories.subgoals[following.clamp(min=0)])
        recent = slots[:, SHOWN:] >= 0
        errors = F.binary_cross_entropy_with_logits(logits.float(), keyframe.float(), reduction="none") * recent
        self._losses = {
            "subtask": F.cross_entropy(scores, target, ignore_index=-1, reduction="none"),
            "keyframes": errors.sum(dim=1) / recent.sum(dim=1),
        }
        return MemoryTokens(*self.texts(torch.where(target < 0, self.count, target)))

    def _true_frames(self, labels: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Return the frames shown to the high level in training, and which recent frames it should nominate.

        These are indices (B, SHOWN + RECENT) in the histories, -1 for padding, and bool (B, RECENT). A frame is a
        keyframe if the next frame has another label (B, F): a checkpoint is completed between them.
        """
        device, size = labels.device, labels.shape[1]
        within = torch.arange(1, size, device=device) < counts.unsqueeze(1)
        ends = F.pad((labels[:, :-1] != labels[:, 1:]) & (labels[:, :-1] >= 0) & (labels[:, 1:] >= 0) & within, (0, 1))
        recent = counts.unsqueeze(1) + torch.arange(-RECENT, 0, device=device)
        chosen = torch.full((len(labels), SHOWN), -1)
        for row, (ended, count) in enumerate(zip(ends, counts.tolist(), strict=True)):
            window = max(count - RECENT, 0)
            frames = torch.tensor(shown_keyframes(ended.nonzero().flatten().tolist(), GAP, window), dtype=torch.int64)
            if self.training and len(frames):
                moved = frames + torch.randint(-SHIFTED, SHIFTED + 1, frames.shape)
                frames = moved.clamp(0, window - 1)[torch.rand(len(frames)) >= DROPPED]
            chosen[row, SHOWN - len(frames) :] = frames
        slots = torch.cat([chosen.to(device), recent.clamp(min=-1)], dim=1)
        return slots, ends.gather(1, recent.clamp(min=0)) & (recent >= 0)

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        losses, self._losses = self._losses, {}
        return losses
