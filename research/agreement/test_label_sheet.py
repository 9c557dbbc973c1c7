"""The sheet of an annotation study: what is read, and what is refused by line and column."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task, task_names
from research.agreement.study import blank_sheet, read_labels, study


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
