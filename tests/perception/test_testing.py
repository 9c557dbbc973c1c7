"""Figures of a test: known beforehand, because what is seen is made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.perception import testing
from lerobot_memobench.perception.finding import FOUND
from lerobot_memobench.perception.labels import Rows, projected
from lerobot_memobench.perception.pictures import Pictures
from lerobot_memobench.perception.report import NUMBERS, PICTURE, TABLE, Examined, drawn, numbers, write_report
from lerobot_memobench.perception.testing import OBJECT, OUTCOME, See, Things, object_outcomes, outcomes
from lerobot_memobench.perception.tower import SIDE, Tower
from lerobot_memobench.perception.weights import Eyes, save_eyes
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from tests.support.made_up import HEIGHT, SLOPE, made_up

KINDS = ("red", "green", "blue")
CENTIMETRE = 0.01 / (2 * SLOPE * HEIGHT)
"""On the table, as a fraction of a picture's side."""
NOTHING, NO = np.zeros(0, OBJECT), np.zeros(0, OUTCOME)


def perfect(rows: Rows) -> list[Things]:
    """See what the labels say."""
    return [_as_found(row) for row in rows]


def _as_found(row: Rows) -> Things:
    things = row["things"][: row["count"]]
    finds = np.zeros(len(things), FOUND)
    finds["kind"], finds["score"], finds["joint"], finds["turn"] = things["kind"], 1, things["joint"], things["turn"]
    finds["place"], finds["depth"] = projected(things["position"].astype(float), row)
    finds["height"], finds["lit"] = things["position"][:, 2] - TABLE_TOP, things["lit"]
    return finds


def off(**by: float) -> See:
    """See everything, off by so much in one respect."""

    def see(rows: Rows) -> list[Things]:
        found = perfect(rows)
        for things in found:
            for name, value in by.items():
                things[name] += np.array([value, 0]) if name == "place" else value
        return found

    return see


@pytest.fixture
def shown(tmp_path: Path) -> Callable[..., Pictures]:
    """Return a function that puts rows on disk."""

    def put(rows: Rows) -> Pictures:
        np.save(tmp_path / "shown.npy", rows)
        return Pictures([tmp_path / "shown.npy"])

    return put


@pytest.mark.parametrize("camera", MJCF_CAMERAS)
def test_perfect_eyes(shown: Callable[..., Pictures], camera: str) -> None:
    told, false = outcomes(perfect, shown(made_up(40, camera=camera)))
    assert len(told) == 120
    assert false == 0
    assert told["error"].max() < 1e-3
    assert told["space"].max() < 1e-3
    assert np.nanmax(told["joint"]) == 0
    assert told["turn"].max() < 1e-3


@pytest.mark.parametrize("camera", MJCF_CAMERAS)
def test_errors_are_centimetres_on_the_table(shown: Callable[..., Pictures], camera: str) -> None:
    told, _ = outcomes(off(place=2 * CENTIMETRE), shown(made_up(5, camera=camera)))
    assert told["error"] == pytest.approx(np.full(15, 2.0), rel=1e-3)


def test_depth_and_joints_have_errors_of_their_own(shown: Callable[..., Pictures]) -> None:
    told, _ = outcomes(off(depth=0.03, joint=0.02), shown(made_up(5, camera="wrist")))
    assert told["error"].max() < 1e-3
    assert (told["space"] >= 2.99).all()
    assert told["joint"][told["kind"] == 0] == pytest.approx(np.full(5, 2.0), rel=1e-3)  # a drawer's, cm
    assert np.isnan(told["joint"][told["kind"] == 2]).all()


def test_what_is_missed_is_infinitely_far_and_what_is_not_there_is_false(shown: Callable[..., Pictures]) -> None:
    pictures = shown(made_up(10))
    told, false = outcomes(off(place=6 * CENTIMETRE), pictures)
    assert np.isinf(told["error"]).all()
    assert false == 3
    told, false = outcomes(lambda rows: [things[1:] for things in perfect(rows)], pictures)
    assert np.isinf(told["error"]).sum() == 10
    assert false == 0
    table = numbers(Examined(KINDS, told, told, told, false, 10, 1.0, NOTHING, NOTHING))["rows"]
    red = next(row for row in table if row["kind"] == "red")
    assert (red["found"], red["median_cm"], red["shown"]) == (0.0, None, 10)
    everything, scene = (next(row for row in table if row["kind"] == kind) for kind in ("all", "all, as it was"))
    assert scene | {"kind": "all"} == everything
    assert everything["found"] == pytest.approx(2 / 3)
    assert everything["median_cm"] is not None
    assert everything["p90_cm"] is None


def test_what_hardly_shows_need_not_be_found(shown: Callable[..., Pictures]) -> None:
    rows = made_up(4)
    rows["things"]["pixels"][:, 0] = 29
    told, false = outcomes(perfect, shown(rows))
    assert set(told["kind"]) == {1, 2}
    assert false == 0


def test_equal_things_are_matched_so_that_all_fit(shown: Callable[..., Pictures]) -> None:
    rows = made_up(4)
    rows["things"]["kind"] = 0
    told, _ = outcomes(lambda rows: [things[::-1] for things in perfect(rows)], shown(rows))
    assert told["error"].max() < 1e-3


def test_both_cameras_find_objects_together(
    shown: Callable[..., Pictures], small_tower: Callable[[], Tower], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = np.repeat(made_up(4), 2)
    rows["camera"][1::2] = list(MJCF_CAMERAS).index("wrist")
    rows["things"]["pixels"][:, 1] = (29, 400) * 4  # the wrist shows it
    rows["hand"] = rows["things"]["position"][:, 0]
    eyes = Eyes(small_tower().eval(), ("butter", "milk", "plate", "cork"))
    seen: dict[str, See] = {"see": perfect}
    monkeypatch.setattr(testing, "found", lambda _: seen["see"](rows))
    told, false = object_outcomes(eyes, shown(rows))
    assert (len(told), len(false)) == (12, 0)
    assert told["error"].max() < 0.01
    assert (told["lit"] == (told["kind"] == 1)).all()
    assert (told["lit"] == told["said_lit"]).all()
    table = {row["scene"]: row for row in numbers(Examined(KINDS, NO, NO, NO, 0.0, 8, 1.0, told, false))["objects"]}
    assert table["as it was"] | {"median_cm": 0} == {
        **{"scene": "as it was", "shown": 12, "found": 1.0, "median_cm": 0, "p90_cm": table["as it was"]["p90_cm"]},
        **{"false_per_shown": 0.0, "lit": 4, "lit_right": 4, "lit_wrong": 0},
    }
    seen["see"] = off(kind=1)
    told, false = object_outcomes(eyes, shown(rows))
    assert np.isinf(told["error"]).all()
    assert len(false) == 12
    assert 0 < told["near"].sum() == false["near"].sum() < 12


def test_the_report_is_written(shown: Callable[..., Pictures], tmp_path: Path) -> None:
    pictures = shown(made_up(8))
    told, false = outcomes(perfect, pictures)
    rows = pictures.rows(np.arange(8))
    table = write_report(
        Examined(KINDS, told, NO, NO, false, 8, 2.5, NOTHING, NOTHING), drawn(rows, perfect(rows), KINDS), tmp_path
    )
    assert (tmp_path / TABLE).read_text() == table
    assert "| red | 0.00 / 0.00 (1.000 of 8) |" in table
    assert json.loads((tmp_path / NUMBERS).read_text())["ms_per_picture"] == 2.5
    with Image.open(tmp_path / PICTURE) as sheet:
        assert sheet.size == (6 * SIDE, 2 * SIDE)
        assert ((np.asarray(sheet) == (0, 255, 0)).all(axis=-1)).sum() > 8 * 3 * 10  # rings


def test_eyes_of_other_kinds_are_not_tested(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_eyes(Eyes(Tower((4, 4, 8, 8, 16), (0, 0, 0, 0, 0)), ("sock",)), tmp_path / "eyes.safetensors")
    assert main(["eyes", "test", str(tmp_path / "eyes.safetensors"), "--out", str(tmp_path)]) == 2
    assert "train them anew" in capsys.readouterr().err


def test_eyes_are_not_trained_on_the_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eyes", "train", "--out", str(tmp_path), "--first-seed", "7"]) == 2
    assert "20000 to 39999" in capsys.readouterr().err
