"""Training: targets and detections undo one another, losses, whitening, and a run that resumes as if never stopped."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import Detector, detections, load_detector, save_detector
from lerobot_memobench.perception.visual_encoder import GRID, SIDE
from lerobot_memobench.sim.asset import TABLE_TOP
from research.detector import training
from research.detector.data import Pictures
from research.detector.labels import Rows, images_of, projected
from research.detector.training import (
    CELLS,
    CHECKPOINT,
    LOSSES,
    TokenHeads,
    Training,
    augmented,
    loss,
    score_loss,
    targets,
    train,
    train_last,
    uncertainty_loss,
    unfold,
    whiten,
)
from tests.support.labelled_images import (
    HEIGHT,
    SLOPE,
    all_outputs,
    perfect,
    small_encoder,
    synthetic,
    trained_a_little,
)

KINDS = ("red", "green", "blue")
PARTS = ("around", "reduce", "near", "heat", "hidden", "score")
TRAINED_LAST = {"fine_heads.uncertainty", *(f"refinement_head.{part}" for part in PARTS)}
SQUARES = len(KINDS)
FINE_SIDE = 2 * GRID


class Stopped(Exception):
    """Imitate a kill of the process."""


@pytest.fixture
def pictures(tmp_path: Path) -> Pictures:
    np.save(tmp_path / "pictures.npy", synthetic(12))
    return Pictures([tmp_path / "pictures.npy"])


@pytest.mark.parametrize(
    ("at", "again"),
    [
        pytest.param(
            8,
            6 + 1 + 12,
            id="first part",
            marks=pytest.mark.slow,
        ),
        pytest.param(19, 1 + 8, id="last part"),
    ],
)
def test_resume_repeats_a_whole_run(
    at: int,
    again: int,
    pictures: Pictures,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = Training(updates=12, batch=4)
    whole = train(pictures, KINDS, tmp_path / "whole", settings, encoder=small_encoder, save_every=2)
    read, asked = Pictures.rows, []

    def rows(self: Pictures, indices: np.ndarray) -> Rows:
        asked.append(1)
        if len(asked) == at:
            raise Stopped
        return read(self, indices)

    monkeypatch.setattr(Pictures, "rows", rows)
    with pytest.raises(Stopped):
        train(pictures, KINDS, tmp_path / "stopped", settings, encoder=small_encoder, save_every=2)
    stopped = train(pictures, KINDS, tmp_path / "stopped", settings, encoder=small_encoder, save_every=2)
    assert len(asked) == at + again
    assert stopped.read_bytes() == whole.read_bytes()
    assert (tmp_path / "stopped" / LOSSES).is_file()


def test_the_last_part_of_another_training_is_not_resumed(pictures: Pictures, tmp_path: Path) -> None:
    settings = Training(updates=4, batch=4)
    alone = train(pictures, KINDS, tmp_path / "alone", settings, encoder=small_encoder, save_every=2)
    train(pictures, KINDS, tmp_path / "again", replace(settings, seed=1), encoder=small_encoder, save_every=2)
    (tmp_path / "again" / CHECKPOINT).unlink()
    again = train(pictures, KINDS, tmp_path / "again", settings, encoder=small_encoder, save_every=2)
    assert again.read_bytes() == alone.read_bytes()


def test_every_weight_learns(pictures: Pictures, tmp_path: Path) -> None:
    settings = Training(updates=3, batch=4)
    train(pictures, KINDS, tmp_path, settings, encoder=small_encoder)
    learned = torch.load(tmp_path / CHECKPOINT, weights_only=True)["model"]
    torch.manual_seed(settings.seed)
    first = dict(TokenHeads(Detector(small_encoder(), KINDS)).named_parameters())
    same = {name for name, value in first.items() if torch.equal(value, learned[name])}
    assert {name.rpartition(".")[0].removeprefix("detector.") for name in same} == TRAINED_LAST


@pytest.mark.slow
def test_last_part_fits_and_changes_no_other_weight(
    pictures: Pictures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "UNCERTAINTY_RATE", 0.1)
    monkeypatch.setattr(training, "SCORE_RATE", 3e-4)  # quicker, it learns twelve pictures by heart, and is too score
    settings = Training(updates=30, batch=12, rate=1e-2)
    detector = load_detector(train(pictures, KINDS, tmp_path / "run", settings, encoder=small_encoder, save_every=30))
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    train_last(detector, pictures, Training(updates=150, batch=12))
    changed_ones = {name for name, value in detector.state_dict().items() if not torch.equal(value, before[name])}
    assert {name.rpartition(".")[0] for name in changed_ones} == TRAINED_LAST
    rows = pictures.rows(np.arange(12))
    wanted = targets(rows, len(KINDS), *CELLS["fine"])
    with torch.inference_mode():
        learned = detector(images_of(rows))
        uncertainty, score = learned.uncertainty, learned.score
        assert uncertainty is not None
        assert score is not None
        for times in (0.5, 2.0):
            other = replace(learned, uncertainty=lambda *cells, more=times: uncertainty(*cells) + np.log(more))
            assert uncertainty_loss(learned, wanted) < uncertainty_loss(other, wanted), "as large as errors are"
        for more in (-1.0, 1.0):
            other = replace(learned, score=lambda *cells, more=more: score(*cells) + more)
            assert score_loss(learned, wanted) < score_loss(other, wanted), "as score as detected are right"
    monkeypatch.undo()
    train_last(detector, pictures, Training(updates=150, batch=12))
    with torch.inference_mode():
        learned = detector(images_of(rows))
        score = learned.score
        assert score is not None
        for same in np.linspace(-6, 0, 13):
            other = replace(learned, score=lambda *cells, same=same: torch.full_like(score(*cells), same))
            assert 5 * score_loss(learned, wanted) < score_loss(other, wanted), (
                "scores separate right detections from wrong ones"
            )


def test_other_settings_do_not_go_on(pictures: Pictures, tmp_path: Path) -> None:
    train(pictures, KINDS, tmp_path, Training(updates=1, batch=2), encoder=small_encoder, save_every=1)
    with pytest.raises(MemobenchError, match="is of a training with"):
        train(pictures, KINDS, tmp_path, Training(updates=2, batch=2), encoder=small_encoder)


def test_changed_pictures_stay_pictures() -> None:
    images = torch.rand(4, 3, 16, 16)
    seen = augmented(images, torch.Generator().manual_seed(0))
    assert seen.min() >= 0
    assert seen.max() <= 1
    assert torch.equal(seen, augmented(images, torch.Generator().manual_seed(0)))
    assert 0.005 < float((seen - images).abs().mean()) < 0.15


@torch.no_grad()
def test_whitening_keeps_the_output(tmp_path: Path) -> None:
    torch.manual_seed(1)
    detector = Detector(trained_a_little(small_encoder()), ("cork", "cap")).eval()
    images = torch.rand(24, 3, SIDE, SIDE)
    before = all_outputs(detector(images))
    whiten(detector, images.split(10))
    assert all(map(partial(torch.allclose, atol=1e-3), all_outputs(detector(images)), before))
    save_detector(detector, tmp_path / "detector.safetensors")
    kept = load_detector(tmp_path / "detector.safetensors")
    for encoder, rounding in ((detector.encoder, 1e-3), (kept.encoder, 0.2)):  # the file's bfloat16 moves means
        for tokens in (encoder(images), encoder.pooled(encoder(images))):
            rows = tokens.flatten(0, 1)
            variances = torch.linalg.eigvalsh(torch.cov(rows.T))
            assert rows.mean(dim=0).abs().max() < rounding
            assert variances.max() < 1.2
            assert variances[-3:].min() > 0.8


@torch.no_grad()
def test_unfolding_keeps_the_output() -> None:
    torch.manual_seed(1)
    detector = Detector(trained_a_little(small_encoder()), ("cork", "cap")).eval()
    detector.fold()
    images = torch.rand(8, 3, SIDE, SIDE)
    before = all_outputs(detector(images))
    unfold(detector, images)
    for of_batch in (False, True):  # by the normalisations' own moments, and by the batch's
        assert all(map(partial(torch.allclose, atol=1e-3), all_outputs(detector.train(of_batch)(images)), before))


def test_a_start_goes_on_with_the_weights_of_a_file(pictures: Pictures, tmp_path: Path) -> None:
    settings = Training(updates=1, batch=4)
    first = train(pictures, KINDS, tmp_path / "first", settings, encoder=small_encoder)
    still = replace(settings, start=str(first), rate=0.0)
    again = load_detector(train(pictures, KINDS, tmp_path / "again", still))
    images = images_of(pictures.rows(np.arange(12)))
    with torch.inference_mode():
        assert torch.allclose(again(images).heatmap, load_detector(first)(images).heatmap, atol=0.1)
    with pytest.raises(MemobenchError, match="other kinds"):
        train(pictures, ("red",), tmp_path / "other", still)


@pytest.mark.parametrize("cells", CELLS.values(), ids=CELLS)
def test_detections_undo_targets(cells: tuple[int, int, int]) -> None:
    rows, (grid, _, coarse) = synthetic(6), cells
    for row, things in zip(rows, detections(perfect(targets(rows, SQUARES, *cells), grid * coarse)), strict=True):
        assert sorted(things["kind"]) == list(range(SQUARES))
        true = row["things"][things["kind"]]
        place, depth = projected(true["position"].astype(float), row)
        assert np.allclose(things["place"], place, atol=1e-5)
        assert np.allclose(things["depth"], HEIGHT, atol=1e-5)
        assert np.allclose(depth, HEIGHT, atol=1e-5)
        assert np.allclose(things["height"], true["position"][:, 2] - TABLE_TOP, atol=1e-5)
        jointed = ~np.isnan(true["joint"])
        assert np.allclose(things["joint"][jointed], true["joint"][jointed], atol=1e-6)
        assert np.allclose(things["turn"], true["turn"], atol=1e-5)
        assert ((things["lit"] > 0.5) == true["lit"]).all()


def test_each_loss_measures_its_own_part() -> None:
    wanted = targets(synthetic(3), SQUARES, GRID)
    right = perfect(wanted, FINE_SIDE)
    assert all(float(value) < 1e-3 for value in loss(right, wanted).values())
    wrong = {
        "heat": replace(right, heatmap=-right.heatmap),
        "place": replace(right, geometry=lambda *cells: right.geometry(*cells) + torch.eye(8)[0]),
        "rest": replace(right, geometry=lambda *cells: right.geometry(*cells) + torch.eye(8)[2]),
        "mask": replace(right, mask=right.mask.flip(1)),
    }
    for name, output in wrong.items():
        costs = loss(output, wanted)
        assert [other for other, value in costs.items() if float(value) > 0.5] == [name]


def test_objects_of_few_pixels_are_no_targets() -> None:
    rows = synthetic(1)
    rows["things"]["pixels"][:, 1] = 3
    wanted = targets(rows, SQUARES, GRID)
    assert [bool((wanted.heat[0, kind] == 1).any()) for kind in range(SQUARES)] == [True, False, True]
    assert set(wanted.cells[:, 1].tolist()) == {0, 2}


def test_of_two_of_a_kind_in_a_cell_the_nearer_is_the_target() -> None:
    rows = synthetic(1)
    rows["things"][0, 1] = rows["things"][0, 0]
    rows["things"]["anchor"][0, :2] = [(0.5, 0.53), (0.5, 0.58)]
    cells = targets(rows, SQUARES, GRID).cells.tolist()
    assert len(cells) == len({tuple(cell) for cell in cells})


def test_an_origin_outside_the_image_is_predicted() -> None:
    """The wrist camera shows only a corner of a stove or a pan."""
    rows = synthetic(4)
    rows["things"]["position"][:, :, 0] += 0.8 * 2 * HEIGHT * SLOPE
    for row, things in zip(rows, detections(perfect(targets(rows, SQUARES, GRID), FINE_SIDE)), strict=True):
        true = row["things"][things["kind"]]["position"].astype(float)
        assert np.allclose(things["place"], projected(true, row)[0], atol=1e-5)
