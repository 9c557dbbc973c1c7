"""Agreement of raters, from tables made by hand."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.tables import markdown
from research.agreement.__main__ import main
from research.agreement.study import Labels, majority, report, study

#: Five templates, three raters: three unanimous, one S/U split, one three-way split.
HAND_MADE = Labels(
    templates=("a", "b", "c", "d", "e"),
    raters={"r1": tuple("SUCSS"), "r2": tuple("SUCSU"), "r3": tuple("SUCUC")},
    released=tuple("SUCSC"),
)


def test_a_majority_is_more_than_half() -> None:
    assert [majority(row) for row in ("SSU", "SUC", "SU", "SSUU", "UUUC")] == ["S", None, None, None, "U"]


def test_counted_by_hand() -> None:
    found = study(HAND_MADE)
    assert found.exact == (3, 5)
    assert found.splits == {"S/U": 1, "S/U/C": 1}
    assert found.majority == (4, 5)  # "e" has none
    assert found.per_rater == {"r1": (4, 5), "r2": (4, 5), "r3": (4, 5)}
    assert found.pooled == (12, 15)
    assert found.confusion == {
        "S": {"S": 5, "U": 1, "C": 0},
        "U": {"S": 0, "U": 3, "C": 0},
        "C": {"S": 1, "U": 1, "C": 4},
    }
    # r1 and r2 agree on 4 of 5; labels 3 S 1 U 1 C and 2 S 2 U 1 C, so 9/25 by chance.
    assert found.cohen["r1", "r2"] == pytest.approx((0.8 - 9 / 25) / (1 - 9 / 25))
    # Per template 1, 1, 1, 1/3, 0; labels 6 S, 5 U, 4 C... of 15.
    expected = sum((n / 15) ** 2 for n in (6, 5, 4))
    assert sum(found.confusion[label]["S"] for label in "SUC") == 6
    assert found.fleiss == pytest.approx(((3 + 1 / 3) / 5 - expected) / (1 - expected))


def test_without_released_labels_only_raters_are_compared() -> None:
    found = study(Labels(HAND_MADE.templates, HAND_MADE.raters))
    assert found.exact == (3, 5)
    assert (found.majority, found.pooled, found.per_rater, found.confusion) == (None,) * 4
    assert "majority" not in markdown(report(found))


def test_written_as_json() -> None:
    data = json.loads(json.dumps(report(study(HAND_MADE)).data))
    assert data["pooled_vs_released"] == {"agree": 12, "of": 15, "percent": 80.0}


def test_one_rater_is_no_study() -> None:
    with pytest.raises(MemobenchError, match="two raters"):
        Labels(("a",), {"r1": ("S",)})


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = tmp_path / "labels.csv"
    sheet.write_text("template,released,x,y\na,S,S,S\nb,U,U,C\n")
    assert main([str(sheet)]) == 0
    assert "3/4" in capsys.readouterr().out
    assert main([str(sheet), "--format", "markdown", "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "agreement.md").is_file()
    assert main(["--paper"]) == 0
    assert capsys.readouterr().out.count("equal") >= 7
    blank = tmp_path / "new" / "blank.csv"
    assert main(["--template", str(blank)]) == 0
    assert len(blank.read_text().splitlines()) == 85
    assert main(["--template", str(blank)]) == 2  # raters may have filled it in
    assert main([]) == 2
