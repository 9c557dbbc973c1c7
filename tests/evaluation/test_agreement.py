"""Agreement of raters: textbook values, tables made by hand, the paper's own figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement.kappa import (
    Labels,
    cohen_kappa,
    confusion_kappa,
    disagreements,
    fleiss_kappa,
    from_published,
    majority,
    odd_ones_out,
    report,
    study,
)
from lerobot_memobench.evaluation.agreement.label_sheet import blank_sheet, read_labels
from lerobot_memobench.evaluation.documents.formats import markdown
from lerobot_memobench.paper import annotator_agreement
from lerobot_memobench.tasks.catalogue import get_task, task_names

#: Five templates, three raters: three unanimous, one S/U split, one three-way split.
HAND_MADE = Labels(
    templates=("a", "b", "c", "d", "e"),
    raters={"r1": tuple("SUCSS"), "r2": tuple("SUCSU"), "r3": tuple("SUCUC")},
    released=tuple("SUCSC"),
)


def test_fleiss_of_the_textbook() -> None:
    """Fleiss (1971) as reproduced everywhere: 10 subjects, 14 raters, 5 categories, kappa 0.210."""
    table = [
        (0, 0, 0, 0, 14), (0, 2, 6, 4, 2), (0, 0, 3, 5, 6), (0, 3, 9, 2, 0), (2, 2, 8, 1, 1),
        (7, 7, 0, 0, 0), (3, 2, 6, 3, 0), (2, 5, 3, 2, 2), (6, 5, 2, 1, 0), (0, 2, 2, 3, 7),
    ]  # fmt: skip
    rows = [[str(k) for k, count in enumerate(row) for _ in range(count)] for row in table]
    assert fleiss_kappa(rows) == pytest.approx(0.210, abs=5e-4)


def test_cohen_of_the_textbook() -> None:
    """20 yes/yes, 5 yes/no, 10 no/yes, 15 no/no: observed 0.7, expected 0.5, kappa 0.4."""
    assert confusion_kappa([[20, 5], [10, 15]]) == pytest.approx(0.4)
    a = "S" * 25 + "U" * 25
    b = "S" * 20 + "U" * 5 + "S" * 10 + "U" * 15
    assert cohen_kappa(a, b) == pytest.approx(0.4)


def test_one_label_only_has_no_kappa() -> None:
    assert cohen_kappa("SSS", "SSS") is None
    assert fleiss_kappa(["SS", "SS"]) is None


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


# --- the paper's study ---


def test_what_the_paper_publishes_is_consistent() -> None:
    found = from_published(annotator_agreement())
    assert len(found) == 7
    assert [each.name for each in found if not each.agrees] == []


def test_a_changed_matrix_would_be_noticed() -> None:
    from dataclasses import replace

    paper = annotator_agreement()
    changed = replace(paper, confusion={**paper.confusion, "C": (0, 30, 21)})
    wrong = {each.name for each in from_published(changed) if not each.agrees}
    assert {"pooled agreement with released labels", "Fleiss' κ"} <= wrong


def test_labels_that_fit_everything_published_have_its_kappas() -> None:
    """The only labels (but for names) that fit the text's 8 U/C and 6 S/U splits, the columns of the matrix and κ.

    The third rater is the majority everywhere: 36 S, 41 U, 7 C. The first says U for 6 of the S and C for 2 of the U,
    the second U for 6 of the C.
    """
    paper = annotator_agreement()
    third = "S" * 36 + "U" * 41 + "C" * 7
    first = "U" * 6 + "S" * 30 + "C" * 2 + "U" * 39 + "C" * 7
    second = "S" * 36 + "U" * 41 + "U" * 6 + "C"
    found = study(Labels(tuple(map(str, range(84))), {"1": tuple(first), "2": tuple(second), "3": tuple(third)}))
    assert found.fleiss is not None
    assert round(found.fleiss, 3) == paper.fleiss_kappa
    assert tuple(round(value, 3) for value in found.cohen.values() if value is not None) == paper.cohen_kappa
    assert found.exact == paper.exact
    assert found.splits == {"S/U": 6, "U/C": 8}
    given = first + second + third
    assert [given.count(label) for label in "SUC"] == [
        sum(column) for column in zip(*paper.confusion.values(), strict=True)
    ]


def test_who_is_alone_follows_from_cohens_kappas() -> None:
    apart = disagreements(annotator_agreement().cohen_kappa, 84, 0.4469)
    assert apart == [14, 8, 6]
    assert odd_ones_out(apart) == [8, 6, 0]


# --- the sheet ---


def test_the_blank_sheet_filled_in_with_the_released_labels_agrees(tmp_path: Path) -> None:
    lines = blank_sheet(2).splitlines()
    assert lines[0] == "task,checkpoint,memory_type,language,predicate,rater_1,rater_2"
    assert len(lines) == 85
    labels = [label for name in task_names() for label in get_task(name).operations]
    assert [labels.count(label) for label in "SUC"] == [35, 32, 17]
    path = tmp_path / "filled.csv"
    filled = [f"{line[:-1]}{label},{label.lower()}" for line, label in zip(lines[1:], labels, strict=True)]
    path.write_text("\n".join([lines[0], *filled]))
    found = study(read_labels(path))
    assert found.pooled == (168, 168)
    assert found.fleiss == 1.0


def sheet(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "labels.csv"
    path.write_text(text)
    return path


def test_labels_may_be_words_or_the_published_numbers(tmp_path: Path) -> None:
    found = read_labels(sheet(tmp_path, "\ufefftemplate,released,x,y\n\na,S,Storage,0\nb,u,UPDATE,1\nc,2,c,C\n"))
    assert found.templates == ("a", "b", "c")
    assert found.released == ("S", "U", "C")
    assert found.raters == {"x": ("S", "U", "C"), "y": ("S", "U", "C")}


def test_without_a_released_column_and_tasks_nothing_is_released(tmp_path: Path) -> None:
    assert read_labels(sheet(tmp_path, "template,x,y\na,S,S\n")).released is None


TASK = "turn_on_the_stove_and_turn_it_off"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; expected a header"),
        ("template,x,y\n", "holds no templates"),
        ("name,x,y\na,S,S\n", "line 1: found neither a column template"),
        ("template,x\na,S\n", "line 1: found x as columns of raters; expected two"),
        ("template,x,x\na,S,S\n", "line 1: there are two columns 'x'"),
        ("template,x,,y\na,S,S,S\n", "line 1: column 3 has no name"),
        ("template,x,y\na,S\n", "line 2: found 2 columns, expected the 3"),
        ("template,x,y\na,S,U\nb,S,Q\n", "line 3, column y: found 'Q'; expected S, U or C"),
        ("template,x,y\na,S,\n", "line 2, column y: is empty"),
        ("template,x,y\na,S,S\na,U,U\n", "line 3: the template 'a' was there before"),
        ("template,x,y\n,S,S\n", "line 2, column template: is empty"),
        ("task,checkpoint,x,y\nno_such_task,1,S,S\n", "line 2, column task: .*no_such_task"),
        (f"task,checkpoint,x,y\n{TASK},3,S,S\n", "line 2, column checkpoint: found '3'.* 1 to 2"),
        ('template,x,y\n"a,S,S\n', "line 2: .*expected comma-separated"),
    ],
)
def test_malformed_sheets_are_named_by_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(MemobenchError, match=message) as error:
        read_labels(sheet(tmp_path, text))
    assert "labels.csv" in str(error.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="cannot be read"):
        read_labels(tmp_path / "none.csv")
    (tmp_path / "latin.csv").write_bytes(b"template,x,y\n\xe9,S,S\n")
    with pytest.raises(MemobenchError, match="not UTF-8"):
        read_labels(tmp_path / "latin.csv")
