"""Detector and visual encoder: sizes, folding, the file, where tokens and cells look, decoding, refinement."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import FINER, Detector, FeaturePyramid, RefinementHead, detections
from lerobot_memobench.perception.visual_encoder import GRID, POOLED, SIDE, WIDTH, ResidualBlock, VisualEncoder, resized
from lerobot_memobench.perception.weights import PACKAGE, SHIPPED, detector_file, load_detector, save_detector
from research.detector.labels import kinds
from research.detector.training import targets
from tests.support.labelled_images import (
    all_outputs,
    laid_out,
    perfect,
    small_encoder,
    synthetic,
    trained_a_little,
)

LARGEST_FILE, LARGEST_ENCODER = 6_000_000, 3_000_000
"""Bytes of the file, and weights of the encoder."""
KINDS, CELLS = 3, 2 * GRID


@pytest.fixture(autouse=True)
def same_weights() -> None:
    """Let weights and pictures be drawn alike each time."""
    torch.manual_seed(0)


def test_sizes(tmp_path: Path) -> None:
    detector = Detector(VisualEncoder(), kinds())
    assert sum(weights.numel() for weights in detector.encoder.parameters()) <= LARGEST_ENCODER
    tokens = detector.encoder.eval()(torch.rand(2, 3, SIDE, SIDE))
    assert tokens.shape == (2, GRID**2, WIDTH)
    assert detector.encoder.pooled(tokens).shape == (2, POOLED**2, WIDTH)
    save_detector(detector, tmp_path / "detector.safetensors")
    assert (tmp_path / "detector.safetensors").stat().st_size <= LARGEST_FILE


@torch.no_grad()
def test_folding_leaves_tokens_as_they_were() -> None:
    encoder, images = trained_a_little(small_encoder()), torch.rand(2, 3, SIDE, SIDE)
    before = encoder(images)
    encoder.fold()
    assert torch.allclose(encoder(images), before, atol=1e-5)
    assert not any("norm" in name for name in encoder.state_dict())


@torch.no_grad()
def test_a_detector_comes_back_from_its_file(tmp_path: Path) -> None:
    detector, images = Detector(trained_a_little(small_encoder()), ("cork", "cap")), torch.rand(2, 3, SIDE, SIDE)
    before = all_outputs(detector.eval()(images))
    save_detector(detector, tmp_path / "detector.safetensors")
    back = load_detector(tmp_path / "detector.safetensors")
    assert back.kinds == ("cork", "cap")
    assert all(map(partial(torch.allclose, atol=0.05), all_outputs(back(images)), before))
    for name, value in detector.state_dict().items():
        assert torch.equal(back.state_dict()[name], value.bfloat16().float()), name


def test_package_detector_has_a_name() -> None:
    assert detector_file(PACKAGE) == detector_file(Path(PACKAGE)) == SHIPPED  # the command line makes paths of names


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="there is no file"):
        load_detector(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("text")
    with pytest.raises(MemobenchError, match="holds no detector"):
        load_detector(tmp_path / "text.safetensors")
    save_file({"weight": torch.zeros(2)}, tmp_path / "other.safetensors")
    with pytest.raises(MemobenchError, match="holds no detector"):
        load_detector(tmp_path / "other.safetensors")


def test_pictures_of_any_size_are_averaged_over_areas() -> None:
    images = torch.randint(0, 256, (1, 3, 2 * SIDE, 2 * SIDE), dtype=torch.uint8)
    by_hand = images.float().reshape(1, 3, SIDE, 2, SIDE, 2).mean(dim=(3, 5))
    assert torch.allclose(resized(images), by_hand)
    assert resized(by_hand) is by_hand


def test_a_pooled_token_is_of_its_own_four() -> None:
    encoder = small_encoder()
    tokens = torch.rand(1, GRID**2, encoder.width, requires_grad=True)
    encoder.pooled(tokens)[0, POOLED + 2].sum().backward()  # second row, third column
    assert tokens.grad is not None
    used = tokens.grad[0].abs().sum(dim=1).reshape(GRID, GRID) > 0
    assert used.nonzero().tolist() == [[2, 4], [2, 5], [3, 4], [3, 5]]
    parts = encoder.pool.weight.reshape(encoder.width, 4, encoder.width)
    assert not torch.allclose(parts[:, 0], parts[:, 1])  # positions in the square are kept


def test_a_cell_of_the_pyramid_reads_its_own_token() -> None:
    encoder = small_encoder()
    pyramid = FeaturePyramid(encoder).eval()
    for block in (module for module in pyramid.modules() if isinstance(module, ResidualBlock)):
        for convolution in (block.first, block.second):
            torch.nn.init.zeros_(convolution.conv.weight)  # it would read neighbouring cells
    tokens = torch.rand(1, GRID**2, encoder.width, requires_grad=True)
    _, maps = encoder.tokens_and_maps(torch.rand(1, 3, SIDE, SIDE))
    maps = [one.detach().requires_grad_() for one in maps]
    cells = pyramid(tokens, maps).unflatten(1, (FINER * GRID, FINER * GRID))
    assert cells.shape[-1] == pyramid.width
    cells[0, 6, 11].sum().backward()
    assert tokens.grad is not None
    assert tokens.grad[0].any(dim=1).nonzero().flatten().tolist() == [1 * GRID + 2]
    used = [None if one.grad is None else one.grad[0].any(dim=0).nonzero().tolist() for one in maps]
    assert used == [None, None, [[6, 11]], [[3, 5]]], "the maps of the last stages, each the cell that it lies in"
    assert not torch.allclose(cells[0, 4, 8], cells[0, 4, 9]), "cells of one token differ"


def test_uncertainties_are_of_the_image_and_of_metres() -> None:
    output = perfect(targets(synthetic(2), KINDS, GRID), CELLS)
    uncertainty = torch.tensor([0.16, 0.01, 0.02]).log()[:, None, None].expand(2, KINDS, 3, CELLS, CELLS)
    assert not detections(output)[0]["uncertainty"].any()
    for things in detections(replace(output, uncertainty=laid_out(uncertainty))):
        assert things["uncertainty"] == pytest.approx(np.tile([0.01, 0.01, 0.02], (KINDS, 1)), rel=1e-4)


def test_the_refinement_head_scores_peaks() -> None:
    output = perfect(targets(synthetic(2), KINDS, GRID), CELLS)
    logits = torch.tensor([-4.0, 0.0, 2.0])

    def score(picture: torch.Tensor, _: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
        return torch.where(output.heatmap[picture, :, row, column] > 0, logits, -9.0)

    for things in detections(replace(output, score=score)):
        assert things["kind"].tolist() == [2, 1], "the most certain one first"
        assert things["score"] == pytest.approx(torch.sigmoid(logits[[2, 1]]).numpy())


def test_the_refinement_head_sees_what_is_around_a_peak() -> None:
    """The score moves with its surroundings; it depends on its whole square and not on the rest."""
    torch.manual_seed(0)
    look, side = RefinementHead(6, 5, KINDS), 16
    maps = {"fine": torch.rand(side, side, 6), "close": torch.rand(2 * side, 2 * side, 5)}
    maps["heat"] = torch.rand(side, side, KINDS)

    def output(row: int, column: int, **changed: torch.Tensor) -> torch.Tensor:
        seen = {**maps, **changed}
        close, heat = (seen[name].permute(2, 0, 1)[None] for name in ("close", "heat"))
        cells = (torch.tensor([value]) for value in (0, 1, row, column))
        return look(seen["fine"].flatten(0, 1)[None], close, heat)(*cells)

    first = output(7, 8)
    assert first.shape == (1, KINDS)
    moved = {name: values.roll((4, -4) if name == "close" else (2, -2), (0, 1)) for name, values in maps.items()}
    assert torch.allclose(output(9, 6, **moved), first, atol=1e-6)
    for name, row, column, reach in (("fine", 7, 8, 2), ("close", 14, 16, 6), ("heat", 7, 8, 1)):
        far = torch.full_like(maps[name], 9.0)
        near = (slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1))
        far[near] = maps[name][near]
        assert torch.allclose(output(7, 8, **{name: far}), first, atol=1e-6)
        far[row - reach, column + reach] = 9.0
        assert not torch.allclose(output(7, 8, **{name: far}), first, atol=1e-3)
