"""Figures of an evaluation: known beforehand, because what is detected is made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lerobot_memobench.perception.detector import DETECTION, Detections, Detector
from lerobot_memobench.perception.geometry import projected
from lerobot_memobench.perception.visual_encoder import SIDE
from lerobot_memobench.perception.weights import SHIPPED, load_detector, save_detector
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from research.detector import evaluation
from research.detector.__main__ import main
from research.detector.data import TESTED, DetectorData, Pictures
from research.detector.evaluation import (
    NUMBERS,
    OBJECT,
    OUTCOME,
    PICTURE,
    TABLE,
    Detect,
    Evaluation,
    detecting,
    drawn,
    numbers,
    object_outcomes,
    outcomes,
    write_report,
)
from research.detector.labels import Rows, images_of, kinds
from tests.support.labelled_images import BOWLS, DRAWERS, HEIGHT, SLOPE, small_encoder, synthetic

KINDS = ("red", "green", "blue")
CENTIMETRE = 0.01 / (2 * SLOPE * HEIGHT)
"""On the table, as a fraction of a picture's side."""
NOTHING, NO = np.zeros(0, OBJECT), np.zeros(0, OUTCOME)


def perfect(rows: Rows) -> list[Detections]:
    """See what the labels say."""
    return [_as_detected(row) for row in rows]


def _as_detected(row: Rows) -> Detections:
    things = row["things"][: row["count"]]
    detected = np.zeros(len(things), DETECTION)
    detected["kind"], detected["score"], detected["joint"], detected["turn"] = (
        things["kind"],
        1,
        things["joint"],
        things["turn"],
    )
    detected["place"], detected["depth"] = projected(things["position"].astype(float), row)
    detected["height"], detected["lit"] = things["position"][:, 2] - TABLE_TOP, things["lit"]
    return detected


def off(**by: float) -> Detect:
    """See everything, off by so much in one respect."""

    def detect(rows: Rows) -> list[Detections]:
        found = perfect(rows)
        for things in found:
            for name, value in by.items():
                things[name] += np.array([value, 0]) if name == "place" else value
        return found

    return detect


@pytest.fixture
def shown(tmp_path: Path) -> Callable[..., Pictures]:
    """Return a function that puts rows on disk."""

    def put(rows: Rows) -> Pictures:
        np.save(tmp_path / "shown.npy", rows)
        return Pictures([tmp_path / "shown.npy"])

    return put


@pytest.mark.parametrize("camera", MJCF_CAMERAS)
def test_a_perfect_detector(shown: Callable[..., Pictures], camera: str) -> None:
    outcome, false = outcomes(perfect, shown(synthetic(40, camera=camera)))
    assert len(outcome) == 120
    assert false == 0
    assert outcome["error"].max() < 1e-3
    assert outcome["space"].max() < 1e-3
    assert np.nanmax(outcome["joint"]) == 0
    assert outcome["turn"].max() < 1e-3


@pytest.mark.parametrize("camera", MJCF_CAMERAS)
def test_errors_are_centimetres_on_the_table(shown: Callable[..., Pictures], camera: str) -> None:
    outcome, _ = outcomes(off(place=2 * CENTIMETRE), shown(synthetic(5, camera=camera)))
    assert outcome["error"] == pytest.approx(np.full(15, 2.0), rel=1e-3)


def test_depth_and_joints_have_errors_of_their_own(shown: Callable[..., Pictures]) -> None:
    outcome, _ = outcomes(off(depth=0.03, joint=0.02), shown(synthetic(5, camera="wrist")))
    assert outcome["error"].max() < 1e-3
    assert (outcome["space"] >= 2.99).all()
    assert outcome["joint"][outcome["kind"] == 0] == pytest.approx(np.full(5, 2.0), rel=1e-3)  # a drawer's, cm
    assert np.isnan(outcome["joint"][outcome["kind"] == 2]).all()


def test_what_is_missed_is_infinitely_far_and_what_is_not_there_is_false(shown: Callable[..., Pictures]) -> None:
    pictures = shown(synthetic(10))
    outcome, false = outcomes(off(place=6 * CENTIMETRE), pictures)
    assert np.isinf(outcome["error"]).all()
    assert false == 3
    outcome, false = outcomes(lambda rows: [things[1:] for things in perfect(rows)], pictures)
    assert np.isinf(outcome["error"]).sum() == 10
    assert false == 0
    table = numbers(Evaluation(KINDS, outcome, outcome, outcome, false, 10, 1.0, NOTHING, NOTHING))["rows"]
    red = next(row for row in table if row["kind"] == "red")
    assert (red["found"], red["median_cm"], red["shown"]) == (0.0, None, 10)
    everything, scene = (next(row for row in table if row["kind"] == kind) for kind in ("all", "all, as it was"))
    assert scene | {"kind": "all"} == everything
    assert everything["found"] == pytest.approx(2 / 3)
    assert everything["median_cm"] is not None
    assert everything["p90_cm"] is None


def test_what_hardly_shows_need_not_be_found(shown: Callable[..., Pictures]) -> None:
    rows = synthetic(4)
    rows["things"]["pixels"][:, 0] = 29
    outcome, false = outcomes(perfect, shown(rows))
    assert set(outcome["kind"]) == {1, 2}
    assert false == 0


def test_equal_things_are_matched_so_that_all_fit(shown: Callable[..., Pictures]) -> None:
    rows = synthetic(4)
    rows["things"]["kind"] = 0
    outcome, _ = outcomes(lambda rows: [things[::-1] for things in perfect(rows)], shown(rows))
    assert outcome["error"].max() < 1e-3


def test_both_cameras_find_objects_together(shown: Callable[..., Pictures], monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.repeat(synthetic(4), 2)
    rows["camera"][1::2] = list(MJCF_CAMERAS).index("wrist")
    rows["things"]["pixels"][:, 1] = (29, 400) * 4  # the wrist shows it
    rows["hand"] = rows["things"]["position"][:, 0]
    detector = Detector(small_encoder().eval(), ("butter", "milk", "plate", "cork"))
    seen: dict[str, Detect] = {"see": perfect}
    monkeypatch.setattr(evaluation, "detections", lambda _: seen["see"](rows))
    outcome, false = object_outcomes(detector, shown(rows))
    assert (len(outcome), len(false)) == (12, 0)
    assert outcome["error"].max() < 0.01
    assert (outcome["lit"] == (outcome["kind"] == 1)).all()
    assert (outcome["lit"] == outcome["said_lit"]).all()
    table = {
        row["scene"]: row for row in numbers(Evaluation(KINDS, NO, NO, NO, 0.0, 8, 1.0, outcome, false))["objects"]
    }
    assert table["as it was"] | {"median_cm": 0} == {
        **{"scene": "as it was", "shown": 12, "found": 1.0, "median_cm": 0, "p90_cm": table["as it was"]["p90_cm"]},
        **{"false_per_shown": 0.0, "lit": 4, "lit_right": 4, "lit_wrong": 0},
    }
    seen["see"] = off(kind=1)
    outcome, false = object_outcomes(detector, shown(rows))
    assert np.isinf(outcome["error"]).all()
    assert len(false) == 12
    assert 0 < outcome["near"].sum() == false["near"].sum() < 12


def test_the_report_is_written(shown: Callable[..., Pictures], tmp_path: Path) -> None:
    pictures = shown(synthetic(8))
    outcome, false = outcomes(perfect, pictures)
    rows = pictures.rows(np.arange(8))
    table = write_report(
        Evaluation(KINDS, outcome, NO, NO, false, 8, 2.5, NOTHING, NOTHING), drawn(rows, perfect(rows), KINDS), tmp_path
    )
    assert (tmp_path / TABLE).read_text() == table
    assert "| red | 0.00 / 0.00 (1.000 of 8) |" in table
    assert json.loads((tmp_path / NUMBERS).read_text())["ms_per_picture"] == 2.5
    with Image.open(tmp_path / PICTURE) as sheet:
        assert sheet.size == (6 * SIDE, 2 * SIDE)
        assert ((np.asarray(sheet) == (0, 255, 0)).all(axis=-1)).sum() > 8 * 3 * 10  # rings


def test_a_detector_of_other_kinds_is_not_tested(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_detector(Detector(small_encoder(), ("sock",)), tmp_path / "detector.safetensors")
    assert main(["test", str(tmp_path / "detector.safetensors"), "--out", str(tmp_path)]) == 2
    assert "train it anew" in capsys.readouterr().err


def test_a_detector_is_not_trained_on_the_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--out", str(tmp_path), "--first-seed", "7"]) == 2
    assert "30000 to 39999" in capsys.readouterr().err


@pytest.mark.slow
def test_the_package_detector_detects_and_its_tokens_are_white(tmp_path: Path) -> None:
    detector = load_detector(SHIPPED)
    assert SHIPPED.stat().st_size <= 6_000_000
    assert detector.kinds == kinds()
    pictures = DetectorData([BOWLS, DRAWERS], 50_000, 1, 2).pictures(tmp_path, TESTED)
    outcome, _ = outcomes(detecting(detector), pictures)
    errors = outcome["error"][outcome["camera"] == 0]
    assert len(errors) > 40
    assert np.isfinite(errors).mean() > 0.8
    assert np.median(errors) < 0.6
    with torch.inference_mode():
        tokens = detector.encoder(images_of(pictures.rows(np.arange(len(pictures))))).flatten(0, 1)
    assert tokens.mean(dim=0).abs().mean() < 0.3
    assert 0.5 < tokens.var(dim=0).mean() < 2
