"""Readouts: what is linearly there is found, what is not is not, and the penalty is chosen without the test."""

from __future__ import annotations

import pytest
import torch

from research.alignment.measures import choose_readout, fit_readout, mean_and_deviation, top1


def _data(informative: bool, count: int = 240) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    candidates = torch.nn.functional.normalize(torch.randn(5, 12, generator=generator), dim=-1)
    labels = torch.arange(count) % 5
    vectors = torch.randn(count, 20, generator=generator)
    if informative:
        vectors[:, :5] += 4.0 * torch.nn.functional.one_hot(labels, 5)
    return vectors, labels, candidates, torch.arange(count) // 20


def test_finds_what_is_there() -> None:
    vectors, labels, candidates, episodes = _data(informative=True)
    readout = choose_readout(vectors[:180], labels[:180], candidates, episodes[:180])
    assert top1(readout(vectors[180:]), labels[180:], candidates) > 0.9


def test_does_not_find_what_is_not_there() -> None:
    vectors, labels, candidates, episodes = _data(informative=False)
    readout = choose_readout(vectors[:180], labels[:180], candidates, episodes[:180])
    assert top1(readout(vectors[180:]), labels[180:], candidates) < 0.45


def test_scale_and_offset_of_vectors_do_not_matter() -> None:
    vectors, labels, candidates, _ = _data(informative=True)
    plain = fit_readout(vectors, candidates[labels], 0.1)
    scaled = fit_readout(1e3 * vectors + 7.0, candidates[labels], 0.1)
    torch.testing.assert_close(plain(vectors), scaled(1e3 * vectors + 7.0))


def test_only_allowed_candidates_are_answered() -> None:
    candidates = torch.eye(3)
    embeddings = torch.tensor([[1.0, 0.5, 0.0]])
    allowed = torch.tensor([[False, True, True]])
    assert top1(embeddings, torch.tensor([1]), candidates) == 0.0
    assert top1(embeddings, torch.tensor([1]), candidates, allowed) == 1.0


def test_mean_and_deviation() -> None:
    assert mean_and_deviation([1.0, 2.0, 3.0]) == (pytest.approx(2.0), pytest.approx(1.0))
    assert mean_and_deviation([4.0]) == (4.0, None)
