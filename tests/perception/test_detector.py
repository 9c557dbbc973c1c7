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
from lerobot_memobench.perception.detector import Detector, detections, load_detector, save_detector
from lerobot_memobench.perception.visual_encoder import GRID, SIDE, area_averaged
from research.detector.training import targets
from tests.support.labelled_images import all_outputs, laid_out, perfect, small_encoder, synthetic, trained_a_little

KINDS, CELLS = 3, 2 * GRID


@pytest.fixture(autouse=True)
def same_weights() -> None:
    """Let weights and images be drawn alike each time."""
    torch.manual_seed(0)


@torch.no_grad()
def test_folding_leaves_tokens_as_they_were() -> None:
    encoder, images = trained_a_little(small_encoder()), torch.rand(2, 3, SIDE, SIDE)
    before = encoder(images)
    encoder.fold()
    assert torch.allclose(encoder(images), before, atol=1e-5)
    assert not any("norm" in name for name in encoder.state_dict())


@torch.no_grad()
def test_a_detector_comes_back_from_its_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    detector, images = Detector(trained_a_little(small_encoder()), ("cork", "cap")), torch.rand(2, 3, SIDE, SIDE)
    before = all_outputs(detector.eval()(images))
    save_detector(detector, tmp_path / "detector.safetensors")
    back = load_detector(tmp_path / "detector.safetensors")
    assert back.kinds == ("cork", "cap")
    assert not caplog.messages, "only the package's was trained on other scenes"
    assert all(map(partial(torch.allclose, atol=0.05), all_outputs(back(images)), before))
    for name, value in detector.state_dict().items():
        assert torch.equal(back.state_dict()[name], value.bfloat16().float()), name


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("text")
    save_file({"weight": torch.zeros(2)}, tmp_path / "other")
    for name, problem in (("none", "there is no file"), ("text", "holds no detector"), ("other", "holds no detector")):
        with pytest.raises(MemobenchError, match=problem):
            load_detector(tmp_path / name)


def test_uncertainties_are_of_the_image_and_of_metres() -> None:
    output = perfect(targets(synthetic(2), KINDS, GRID), CELLS)
    uncertainty = torch.tensor([0.16, 0.01, 0.02]).log()[:, None, None].expand(2, KINDS, 3, CELLS, CELLS)
    assert not detections(output)[0]["uncertainty"].any()
    for things in detections(replace(output, uncertainty=laid_out(uncertainty))):
        assert things["uncertainty"] == pytest.approx(np.tile([0.01, 0.01, 0.02], (KINDS, 1)), rel=1e-4)


def test_images_are_square() -> None:
    assert area_averaged(torch.zeros(1, 3, 360, 360)).shape == (1, 3, SIDE, SIDE)
    with pytest.raises(MemobenchError, match="found images of 320 x 256 pixels"):
        area_averaged(torch.zeros(1, 3, 320, SIDE))
