"""The loss of an update: padding, the memory's choice, ranks; and batches of LeRobot's own trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.losses import alignment_loss, make_alignment, mean_losses
from lerobot_memobench.policies.memobench_mem.memory.mechanism import SUBGOAL, SUBGOALS
from lerobot_memobench.policies.memobench_mem.texts import texts_of
from tests.support.small_policy import CHUNK, batch_of, draw_modulation, made_for_training, small_config


@pytest.mark.parametrize("memory", ["none", "frames"])
def test_lerobots_batches_train_policies_without_memory(synthetic: Path, memory: str) -> None:
    """Frames as LeRobot draws them; actions of prompts do not count."""
    config = small_config(size="tiny", memory=memory)
    times = {"action": [step / 20 for step in range(CHUNK)]}
    dataset = LeRobotDataset("memobench/synthetic", root=synthetic, delta_timestamps=times)
    policy: Any = make_policy(config, ds_meta=dataset.meta)
    before, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    batch = before(batch_of(dataset, [5, 42, 50]))
    if memory == "frames":
        with pytest.raises(MemobenchError, match="lerobot train policy=memobench_mem"):
            policy.train().forward(batch)
        return
    per_sample, _ = policy.train().forward(batch, reduction="none")
    assert (per_sample > 0).tolist() == [True, False, True], "the second frame is of a prompt"


def test_padded_actions_do_not_count(synthetic: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame 38 is the last but one of its episode: of its chunk two actions are real."""
    policy, before, _, dataset = made_for_training(synthetic)
    batch = before(batch_of(dataset, [38, 5]))
    losses = torch.ones(2, CHUNK, policy.config.max_action_dim)
    losses[0, 2:] = 1000.0
    losses[0, :2] = 5.0
    monkeypatch.setattr(policy.model, "forward", lambda *_: losses)
    _, logged = policy.forward(batch)
    assert logged["action_loss"] == pytest.approx((2 * 5.0 + CHUNK * 1.0) / (2 + CHUNK))
    per_sample, _ = policy.forward(batch, reduction="none")
    assert per_sample.mean().item() == pytest.approx(logged["action_loss"])


@pytest.mark.parametrize("memory", ["subgoal", "keyframes"])
def test_evaluation_loss_uses_the_memorys_own_choice(objects: Path, memory: str) -> None:
    policy, before, _, dataset = made_for_training(
        objects, memory=memory, frames=32, perception="objects", size="small"
    )
    if memory == "keyframes":
        draw_modulation(policy.model)  # so that actions depend on what it reads
    batch = before(batch_of(dataset, [10, 30, 50]))
    others = {name: (batch[name] + 1) % len(texts_of(policy.config.subgoals)) for name in (SUBGOAL, SUBGOALS)}
    with torch.no_grad():
        for learns in (True, False):
            mine, other = (policy.train(learns).forward(one)[1] for one in (batch, {**batch, **others}))
            assert (mine["action_loss"] == other["action_loss"]) is not learns
            own = [name for name in mine if name.startswith("memory_")]
            assert any(mine[name] != other[name] for name in own), "the labels still measure it"


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


@pytest.fixture(scope="module")
def ranks(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("ranks")
    torch.multiprocessing.spawn(run_rank, (folder,), nprocs=2)
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(CASES)), ids=lambda n: f"{n}-{CASES[n][0]}")
def test_two_ranks_are_one_batch(ranks: Any, number: int) -> None:
    joint = step(*CASES[number], slice(None))
    first, second = (rank[number] for rank in ranks)
    close = {"rtol": 1e-5, "atol": 1e-6}
    torch.testing.assert_close((first["loss"] + second["loss"]) / 2, joint["loss"], **close)
    assert first["top1"] == second["top1"] == joint["top1"]
    for name in joint.keys() - {"loss", "top1"}:
        torch.testing.assert_close(first[name], joint[name], **close)
        torch.testing.assert_close(second[name], joint[name], **close)
    if CASES[number][0] == "contrastive":
        torch.testing.assert_close(first["loss"], joint["loss"], **close)
        assert "alignment.log_temperature" in joint
