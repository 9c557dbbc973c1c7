"""Reports of several evaluations: the same figures in every format, sweeps, the paper beside."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import Rate, report_values
from lerobot_memobench.evaluation.records import Run, read_runs
from lerobot_memobench.evaluation.report import FILES, build, render, write_documents
from lerobot_memobench.evaluation.report_tables import best_interval, departures
from lerobot_memobench.evaluation.tables import (
    WIDTH,
    Name,
    Report,
    Section,
    Table,
    best_in_columns,
    csv_text,
    markdown,
)
from tests.support import logs


@pytest.fixture
def sweep(tmp_path: Path) -> list[Run]:
    """A policy at three intervals: 1, 3 and 2 of 4 episodes succeed."""
    for k, successes in ((5, 1), (20, 3), (35, 2)):
        logs.evaluation(tmp_path / f"k{k}", successes, replan_steps=k)
    return read_runs([f"mine_&_co={tmp_path}/k{k}" for k in (5, 20, 35)])


def rendered(runs: list[Run], format_: str, paper: bool = False) -> str:
    return render(build(runs, paper), runs, format_, paper)


def test_json_of_one_evaluation_holds_report_json_unchanged(tmp_path: Path) -> None:
    runs = read_runs([logs.evaluation(tmp_path / "a")])
    data = json.loads(rendered(runs, "json"))
    schema = json.loads(json.dumps(report_values(runs[0].summary)))
    assert {key: data[key] for key in schema} == schema
    assert data["intervals"]["average"]["SR"] == [21.5, 78.5]  # 4 of 8
    assert data["ordered_prefix"] == schema["prefix"]
    assert data["pooled"]["checkpoints"] == {"percent": 80.0, "n": 20}  # 2·(4+2) + 2·(4+4+2)... of 20


def test_the_sweep_names_the_best_interval(sweep: list[Run]) -> None:
    data = json.loads(rendered(sweep, "json"))
    (name,) = data["replan_sweep"]
    assert name == "mine_&_co"
    swept = data["replan_sweep"][name]
    assert swept["average"]["20"] == {"SR": 75.0, "MSR": 100.0, "MUR": 87.5, "MCR": 75.0}
    assert swept["best"] == {"SR": [20], "MSR": [5, 20, 35], "MUR": [20], "MCR": [20]}
    assert "Best replan interval by average: SR 75.0 at 20, MSR 100.0 at 5 and 20 and 35" in rendered(sweep, "markdown")
    assert best_interval(sweep, "SR")[0] == [20]


def test_csv_names_are_no_formulas() -> None:
    text = csv_text([["=cmd()", -3.5, None], ["@SUM(1)", "a, b", "-"]], ["name", "figure", "rest"])
    assert list(csv.reader(io.StringIO(text))) == [
        ["name", "figure", "rest"],
        ["'=cmd()", "-3.5", ""],
        ["'@SUM(1)", "a, b", "'-"],
    ]


def test_csv_has_one_figure_a_row(sweep: list[Run]) -> None:
    rows = list(csv.DictReader(io.StringIO(rendered(sweep, "csv", paper=True))))
    (row,) = [
        r
        for r in rows
        if (r["evaluation"], r["table"], r["name"], r["figure"]) == ("mine_&_co k=20", "tasks", "one", "SR")
    ]
    assert [row[key] for key in ("replan_steps", "percent", "low", "high", "n")] == ["20", "75.0", "30.1", "95.4", "4"]
    places = {r["table"] for r in rows}
    assert places == {"tasks", "memory_types", "average", "pooled", "prefix", "ordered_prefix", "failures", "extent"}
    assert [r["n"] for r in rows if r["table"] == "extent"][:2] == ["2", "8"]
    theirs = [r for r in rows if r["evaluation"] == "paper, main: MemoryVLA" and r["replan_steps"] == "20"]
    assert [r["percent"] for r in theirs if r["table"] == "average"] == ["29.2", "55.1", "49.9", "14.1"]
    assert len({r["evaluation"] for r in rows if r["evaluation"].startswith("paper")}) == 6 + 4 + 2 + 1


def test_latex_is_balanced_and_escaped(sweep: list[Run]) -> None:
    text = rendered(sweep, "latex", paper=True)
    assert r"mine\_\&\_co k=20" in text
    assert r"\texttt{two\_of\_them}" in text
    assert r"$\pi_{0.5}$ + memory module" in text
    assert text.count("{") == text.count("}")
    assert text.count(r"\begin{table}") == text.count(r"\end{table}") > 10
    assert len(set(re.findall(r"\\label\{(.*?)\}", text))) == text.count(r"\label")
    for block in re.findall(r"\\begin\{tabular\}\{@\{\}([lr]+)@\{\}\}(.*?)\\end\{tabular\}", text, re.DOTALL):
        columns, body = block
        for line in body.splitlines():
            if line.endswith(r"\\"):
                spans = [int(n) for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
                cells = len(re.findall(r"(?<!\\)&", line)) + 1 + sum(spans) - len(spans)
                assert cells == len(columns), line
    code = re.sub(r"(?m)^%.*$|\\label\{.*?\}|\$.*?\$", "", text)
    assert not re.findall(r"[_#~^]", re.sub(r"\\[a-zA-Z]+|\\.", "", code))


BLOCKS = ("heading", "paragraph", "blockquote", "table", "thead", "tbody", "tr", "th", "td")


EVIL = "a|b\n\n# x\n```\n<script>alert(1)</script> ``[y](javascript:z) ![](w) &lt; \x1b[2J\u202e ~~s~~ *b*"


def test_no_text_of_a_stranger_is_more_than_text_in_markdown() -> None:
    """Parsed by the CommonMark parser that rich uses, with tables: every block and mark is one of the report's own."""
    table = Table("t", EVIL, (EVIL, "b"), ((EVIL, "1"), (Name(EVIL), "2")), note=f"# {EVIL}")
    report = Report(EVIL, (Section(EVIL, (table,), (f"- {EVIL}", f"12. {EVIL}", "==="), (f"> {EVIL}",)),))
    tokens = MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(markdown(report))
    blocks = {token.type for token in tokens if token.nesting != 0}
    assert blocks <= {f"{name}_{end}" for name in BLOCKS for end in ("open", "close")}
    assert [token.type for token in tokens].count("tr_open") == 3
    inner = [inside for token in tokens for inside in token.children or ()]
    assert {inside.type for inside in inner} <= {"text", "text_special"}
    assert sum("<script>alert(1)</script>" in "".join(i.content for i in t.children or ()) for t in tokens) == 10


def test_the_paper_stands_beside_with_what_differs(sweep: list[Run]) -> None:
    text = rendered(sweep, "markdown", paper=True)
    assert "| paper: π0.5 + memory module | pixels | 5 | 9.8 | 92.0 | 32.2 | 10.0 |" in text
    assert text.count("| paper: ") == 43
    assert "2 of 30 tasks, 4 episodes of each instead of 50" in text
    assert text.count("| **mine\\_&\\_co k=20 (2 of 30 tasks, 8 rollouts)** |") == 3
    assert "| stale memory first update | 63 | 42.0" in text
    assert "paper:" not in rendered(sweep, "markdown")


def test_the_papers_own_protocol_departs_in_nothing(tmp_path: Path) -> None:
    (run,) = read_runs([logs.evaluation(tmp_path / "a")])
    assert departures(run)[0] == "2 of 30 tasks"
    changed = Run(run.name, run.method, run.folder, run.records, {**run.protocol, "horizon": 600})
    assert "horizon 600 instead of 1200" in departures(changed)


def test_tables_are_as_wide_as_their_header_and_mark_the_best() -> None:
    with pytest.raises(ValueError, match="1 cells for 2 columns"):
        Table("t", "", ("a", "b"), (("x",),))
    rows = (("x", Rate(0.5, 4), Rate(None, 0)), ("y", Rate(0.5, 8), Rate(0.1, 4)))
    assert best_in_columns(rows) == {(0, 1), (1, 1), (1, 2)}


def test_the_terminal_keeps_every_rate_in_one_piece(sweep: list[Run]) -> None:
    text = rendered(sweep, "table", paper=True)
    assert max(map(len, text.splitlines())) <= WIDTH
    assert "75.0 [30.1–95.4]" in text
    (line,) = [line for line in text.splitlines() if "paper: MemER" in line and "62.4" in line]
    assert " ".join(line.split()[4:]) == "62.4 63.8 61.7 63.0 50.4 84.3 52.8 77.6 93.2 93.2 – –"


def test_documents_are_written_whole(sweep: list[Run], tmp_path: Path) -> None:
    out = tmp_path / "out"
    written = write_documents(sweep, out, list(FILES))
    assert sorted(path.name for path in written if path.parent == out) == sorted(FILES.values())
    assert sorted(written) == sorted(path for path in out.rglob("*") if path.is_file())
    tables = {path.stem for path in (out / "tables").iterdir()}
    assert tables == {table.key for table in build(sweep).tables}
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match="is a file"):
        write_documents(sweep, tmp_path / "file", ["json"])
