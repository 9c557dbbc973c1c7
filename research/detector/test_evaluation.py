"""Figures of an evaluation, from detections that the test makes up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_memobench.perception.detector import SHIPPED, Detector, load_detector, save_detector
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from research.detector.__main__ import main
from research.detector.data import TESTED, DetectorData, Pictures
from research.detector.evaluation import NUMBERS, TABLE, Localise, evaluate, figures, localising, match, outcomes
from research.detector.labels import Rows, images_of, kinds
from tests.support.labelled_images import BOWLS, DRAWERS, small_encoder, synthetic


@pytest.fixture
def frames(tmp_path: Path) -> Callable[..., Pictures]:

    def save(**changed: Any) -> Pictures:
        rows = np.repeat(synthetic(4), 2)
        rows["camera"][1::2] = list(MJCF_CAMERAS).index("wrist")
        rows["things"]["pixels"][:, 1] = (29, 400) * 4
        rows["hand"] = rows["things"]["position"][:, 0]
        for name, value in changed.items():
            rows["things"][name][:, :3] = value
        np.save(tmp_path / "shown.npy", rows)
        return Pictures([tmp_path / "shown.npy"])

    return save


def detector(*, off: float = 0.0, kind: int = 0, without: int = 0) -> Localise:

    def localise(rows: Rows) -> Any:
        things = rows[0]["things"][without : rows[0]["count"]]
        return things["kind"].astype(np.int64) + kind, things["position"] + [off, 0, 0], things["lit"]

    return localise


def test_perfect_detections(frames: Callable[..., Pictures]) -> None:
    found, false = outcomes(detector(), frames())
    assert (len(found), len(false)) == (12, 0)
    assert found["error"].max() < 1e-3
    rows = {row["objects"]: row for row in figures(found, false)}
    assert rows["as it was"] == {
        **{"objects": "as it was", "shown": 12, "detected": 1.0, "median_cm": 0.0, "p90_cm": 0.0},
        **{"false_per_shown": 0.0, "lit": 4, "lit_right": 4, "lit_wrong": 0},
    }
    assert rows[kinds()[2]]["shown"] == 4
    assert 0 < rows["as it was, hand within 15 cm"]["shown"] < 12


@pytest.mark.parametrize(
    ("seen", "detected", "error", "count"),
    [
        (detector(off=0.02), 1.0, 2.0, 0),
        (detector(off=0.06), 0.0, None, 12),
        (detector(kind=5), 0.0, None, 12),
        (detector(without=1), 2 / 3, 0.0, 0),
    ],
    ids=["2 cm off", "6 cm off", "other kinds", "one missed"],
)
def test_errors_misses_and_false_detections(
    seen: Localise, detected: float, error: float | None, count: int, frames: Callable[..., Pictures]
) -> None:
    found, false = outcomes(seen, frames())
    assert len(false) == count
    row = figures(found, false)[0]
    assert row["detected"] == pytest.approx(detected)
    assert row["median_cm"] == (None if error is None else pytest.approx(error, abs=1e-3))
    assert found["near"].sum() >= false["near"].sum()


def test_objects_of_few_pixels_need_not_be_detected(frames: Callable[..., Pictures]) -> None:
    found, false = outcomes(detector(), frames(pixels=29))
    assert (len(found), len(false)) == (0, 0)


def test_equal_objects_are_matched_by_the_smallest_sum() -> None:
    errors = np.array([[1.0, 2.0, 9.0], [0.5, 9.0, 9.0], [0.1, 0.1, 4.0]])
    assert match(np.array([0, 0, 1]), np.array([0, 0, 1]), errors).tolist() == [1, 0, 2]
    assert match(np.array([0, 0]), np.array([0]), errors[:2, 2:]).tolist() == [-1, -1]


def test_evaluation_writes_table_and_numbers(frames: Callable[..., Pictures], tmp_path: Path) -> None:
    save_detector(Detector(small_encoder(), kinds()), tmp_path / "detector.safetensors")
    table = evaluate(tmp_path / "detector.safetensors", tmp_path, frames)
    assert (tmp_path / TABLE).read_text() == table
    assert json.loads((tmp_path / NUMBERS).read_text())[0]["shown"] == 12


def test_other_kinds_and_seeds_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_detector(Detector(small_encoder(), ("sock",)), tmp_path / "detector.safetensors")
    assert main(["test", str(tmp_path / "detector.safetensors"), "--out", str(tmp_path)]) == 2
    assert "other kinds" in capsys.readouterr().err
    assert main(["train", "--out", str(tmp_path), "--first-seed", "7"]) == 2
    assert "30000 to 39999" in capsys.readouterr().err


@pytest.mark.slow
def test_package_detector_is_measured_and_its_tokens_are_white(tmp_path: Path) -> None:
    from lerobot_memobench.perception.objects import ObjectLocalizer

    shipped = load_detector(SHIPPED)
    assert SHIPPED.stat().st_size <= 6_000_000
    assert shipped.kinds == kinds()
    pictures = DetectorData([BOWLS, DRAWERS], 50_000, 1, 2).pictures(tmp_path, TESTED)
    errors = outcomes(localising(ObjectLocalizer(shipped)), pictures)[0]["error"]
    assert len(errors) > 40
    assert np.isfinite(errors).mean() > 0.9
    assert np.median(errors) < 0.5  # cm
    with torch.inference_mode():
        tokens = shipped.encoder(images_of(pictures.rows(np.arange(len(pictures))))).flatten(0, 1)
    assert tokens.mean(dim=0).abs().mean() < 0.3
    assert 0.3 < tokens.var(dim=0).mean() < 2  # measured 0.47; 0.48 in five tasks
