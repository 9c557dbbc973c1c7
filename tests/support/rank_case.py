"""One rank of a distributed training step, or the whole of it in one process."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from lerobot_memobench.policies.memobench_mem.losses import alignment_loss, make_alignment, mean_losses

ROWS, FRAMES, TOKENS, DIM = 7, 2, 2, 5
RANKS = (slice(0, 4), slice(4, ROWS))
CASES = [
    ("contrastive", (1, 1, 1, 1, 1, 1, 1)),
    ("contrastive", (1, 0, 1, 1, 0, 1, 0)),
    ("contrastive", (1, 1, 0, 1, 0, 0, 0)),  # the second rank has nothing to align
    ("contrastive", (0, 0, 0, 0, 0, 0, 0)),
    ("semantic", (1, 0, 1, 1, 0, 1, 0)),
    ("framewise", (1, 0, 1, 1, 0, 1, 0)),
    ("none", (1, 0, 1, 1, 0, 1, 0)),
]


class Learner(nn.Module):
    """A memory encoder with an objective; with ``none`` the action loss, of which ``has_text`` counts."""

    def __init__(self, align: str) -> None:
        super().__init__()
        self.encoder = nn.Linear(DIM, DIM)
        self.alignment = make_alignment(align, DIM, DIM, TOKENS)

    def forward(self, seen: Tensor, text: Tensor, has_text: Tensor) -> tuple[Tensor, Tensor]:
        memory = self.encoder(seen)
        if self.alignment is None:
            found = mean_losses(memory, has_text[:, None] * torch.tensor([1.0, 1.0, 1.0, 0.0]))
            return found.mean, torch.tensor([0.0, 0.0])
        frames = self.alignment.__class__.__name__.startswith("Framewise")
        batch = {"memory.text": text, "memory.text_mask": has_text[:, None].expand(-1, FRAMES) if frames else has_text}
        if not frames:
            batch["memory.text"] = text[:, 0]
        mask = torch.ones(memory.shape[:2], dtype=torch.bool)
        loss, logged = alignment_loss(self.alignment, 0.3, batch, memory, mask, list(self.encoder.parameters()))
        return loss, torch.tensor([logged.get(name, -1.0) for name in ("align_top1", "align_grad_norm")])


def step(align: str, has_text: tuple[int, ...], rows: slice, wrap: type[nn.Module] | None = None) -> dict[str, Tensor]:
    """Loss, top-1 and gradients of a step on some of the rows."""
    torch.manual_seed(5)
    learner = Learner(align)
    seen, text = torch.randn(ROWS, FRAMES * TOKENS, DIM), torch.randn(ROWS, FRAMES, DIM)
    text[3] = text[0]  # the same subgoal on two samples
    module = learner if wrap is None else wrap(learner)
    loss, (top1, norm) = module(seen[rows], text[rows], torch.tensor(has_text[rows], dtype=torch.bool))
    loss.backward()
    gradients = {name: p.grad for name, p in learner.named_parameters() if p.grad is not None}
    return {"loss": loss.detach(), "top1": top1, "norm": norm} | gradients


def run_rank(rank: int, folder: Path) -> None:
    """Take the steps as one of the ranks and save what came out."""
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=len(RANKS))

    def parallel(module: nn.Module) -> nn.Module:
        return DistributedDataParallel(module, find_unused_parameters=True)

    found = [step(*case, RANKS[rank], parallel) for case in CASES]  # type: ignore[arg-type]
    torch.save(found, folder / f"{rank}.pt")
    dist.destroy_process_group()
