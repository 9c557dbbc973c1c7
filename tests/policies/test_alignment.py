"""Alignment objectives against the paper's formulas, written as loops; levels and shuffling of subgoals."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_memobench.datasets.frames import FrameTable
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.losses import make_alignment, retrieval_accuracy
from lerobot_memobench.policies.memobench_mem.texts import WordTextEncoder, answers, progress, shuffled
from lerobot_memobench.training.data import with_targets
from tests.support.small_policy import batch_of, made_for_training

B, F, P, D, T = 5, 3, 4, 6, 7


def _inputs(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(seed)
    memory = torch.randn(B, F * P, D)
    frames = torch.tensor([[1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 1, 1], [1, 1, 0]], dtype=torch.bool)
    return memory, frames.repeat_interleave(P, dim=1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _pooled(module: torch.nn.Module, memory: torch.Tensor, mask: torch.Tensor) -> np.ndarray:
    weight, bias = module.project.weight.detach().numpy(), module.project.bias.detach().numpy()
    rows = [np.mean([memory[b, i].numpy() for i in range(F * P) if mask[b, i]], axis=0) for b in range(B)]
    return np.stack([_unit(weight @ row + bias) for row in rows])


def test_semantic() -> None:
    memory, mask = _inputs()
    text = torch.randn(B, T)
    module = make_alignment("semantic", D, T, P)
    z = _pooled(module, memory, mask)
    expected = np.mean([1 - z[b] @ _unit(text[b].numpy()) for b in range(B)])
    assert module(memory, mask, text).item() == pytest.approx(expected, abs=1e-5)


def test_contrastive_counts_repeated_subgoals_as_positives() -> None:
    memory, mask = _inputs()
    text = torch.randn(B, T)
    text[3] = 2.5 * text[0]  # the same direction is the same text
    module = make_alignment("contrastive", D, T, P)
    assert module.log_temperature.exp().item() == pytest.approx(0.07)
    module.log_temperature.data.fill_(math.log(0.3))
    z = _pooled(module, memory, mask)
    t = np.stack([_unit(row) for row in text.numpy()])
    logits = z @ t.T / 0.3
    positive = (t @ t.T > 0.99).astype(float)
    assert positive[0].tolist() == [1, 0, 0, 1, 0]
    target = positive / positive.sum(axis=1, keepdims=True)
    to_text = to_memory = 0.0
    for i in range(B):
        for j in range(B):
            to_text -= target[i, j] * (logits[i, j] - np.log(np.exp(logits[i]).sum())) / B
            to_memory -= target[j, i] * (logits[j, i] - np.log(np.exp(logits[:, i]).sum())) / B
    assert module(memory, mask, text).item() == pytest.approx(0.5 * (to_text + to_memory), abs=1e-5)


def test_framewise() -> None:
    memory, mask = _inputs()
    text, text_mask = torch.randn(B, F, T), torch.ones(B, F, dtype=torch.bool)
    text_mask[0, 1] = False
    text[0, 1] = float("nan")  # the embedding of a frame without text
    module = make_alignment("framewise", D, T, P)
    weight, bias = module.project.weight.detach().numpy(), module.project.bias.detach().numpy()
    above = below = 0.0
    for b in range(B):
        valid = [f for f in range(F) if mask[b, f * P] and text_mask[b, f]]
        for rank, f in enumerate(valid):
            u = memory[b, f * P : (f + 1) * P].numpy().mean(axis=0)
            alpha = 0.5 + 0.5 * rank / max(len(valid) - 1, 1)
            above += alpha * (1 - _unit(weight @ u + bias) @ _unit(text[b, f].numpy()))
            below += alpha
    loss = module(memory, mask, text, text_mask)
    assert loss.item() == pytest.approx(above / below, abs=1e-5)
    loss.backward()
    assert torch.isfinite(module.project.weight.grad).all()
    shorter = module.usable(memory, mask, text[:, :2], text_mask[:, :2])
    text_mask[:, 2] = False
    assert module(*shorter).item() == pytest.approx(module(memory, mask, text, text_mask).item(), abs=1e-6)
    assert module(memory, torch.zeros_like(mask), text, text_mask).item() == 0.0


def test_retrieval_accuracy() -> None:
    text = torch.eye(3)[[0, 1, 0]]
    assert retrieval_accuracy(torch.eye(3)[[0, 1, 0]], text) == 1.0
    assert retrieval_accuracy(torch.eye(3)[[1, 1, 0]], text) == pytest.approx(2 / 3)
    assert retrieval_accuracy(torch.zeros(0, 3), torch.zeros(0, 3)) == 0.0


# -- subgoals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("align", "level", "column"),
    [
        ("semantic", "coarse", "subgoal.coarse"),
        ("framewise", "intermediate", "subgoal.intermediate"),
    ],
)
def test_subgoal_level_chooses_the_column(root: Path, align: str, level: str, column: str) -> None:
    fields = {"size": "small", "perception": "objects", "align": align, "subgoal_level": level}
    _, before, _, dataset = made_for_training(root, **fields)
    found = before(batch_of(dataset, [30]))["memory.text"][0]
    found = found[-1] if align == "framewise" else found
    torch.testing.assert_close(found, WordTextEncoder(64)([dataset.hf_dataset[30][column]])[0])


def test_shuffled_texts_are_those_of_the_batch(root: Path) -> None:
    fields = {"size": "small", "perception": "objects", "align": "contrastive"}
    found = []
    for targets in ("subgoals", "shuffled"):
        _, before, _, dataset = made_for_training(root, align_targets=targets, **fields)
        batches = [before(batch_of(dataset, [10, 75]))["memory.text"] for _ in range(2)]
        assert torch.equal(*batches), "equal in every epoch"
        found.append(batches[0])
    assert (found[0] != found[1]).any(dim=1).all()


def test_shuffled_subgoals_move_within_their_episode(caplog: pytest.LogCaptureFixture) -> None:
    texts, episodes = ["a", "a", "b", "c", "", "f", "f", "h"], np.array([0, 5, 7, 8])
    caplog.set_level("INFO")
    found = shuffled(texts, episodes)
    assert set(found[:4]) == {"a", "b", "c"}
    assert all(one != other for one, other in zip(found[:4], texts, strict=False))
    assert found[4] == ""
    assert "1 of 3 episodes permute their own; 2 have fewer" in caplog.text, "episodes with one subgoal"
    assert found[5] == found[6] in {"a", "b", "c", "h"}
    assert found[7] in {"a", "b", "c", "f"}
    assert found[0] == found[1]
    assert found == shuffled(texts, episodes)
    others = [shuffled(texts, episodes, seed)[:4] for seed in range(8)]
    assert len({tuple(other) for other in others}) == 2, "three subgoals can all move in two ways"


def test_one_subgoal_cannot_be_shuffled() -> None:
    table = FrameTable(np.array([0, 5]), np.ones(5, np.uint8), np.zeros(5, bool), {"coarse": ["put it down"] * 5}, None)
    config = MemobenchMemConfig(align="semantic", subgoal_level="coarse", align_targets="shuffled")
    with pytest.raises(MemobenchError, match="needs at least two"):
        with_targets(table, config, Path("here"))


TWO_DRAWERS = ["open the top drawer", "put the pea on the table", "open the low drawer", "", "put the pea on the table"]
"""Subgoals of the five frames of two episodes of one task."""


def test_answers_are_constant_in_an_episode() -> None:
    made = answers(TWO_DRAWERS, np.array([0, 2, 5]))
    assert made[:2] == ["open the top drawer; put the pea on the table"] * 2
    assert made[2:] == ["open the low drawer; put the pea on the table"] * 3


def test_progress_lacks_the_words_that_differ() -> None:
    made = progress(TWO_DRAWERS, np.array([0, 2, 5]), ["find", "find"])
    assert made == ["open the drawer", "put the pea on the table", "open the drawer", "", "put the pea on the table"]
    assert progress(["left", "right"], np.array([0, 1, 2]), ["turn", "turn"]) == ["-", "-"]
    assert progress(["left", "right"], np.array([0, 1, 2]), ["turn", "look"]) == ["left", "right"]
