"""Reports: files next to a log, formats, first line, sweeps, figures, compressed logs."""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt
from PIL import Image

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import EpisodeLog, line_of, read_episodes, write_episodes
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, write_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import report_values
from lerobot_memobench.evaluation.plots import OUTCOMES, bars, draw_figures, draw_replan, success_by_gap
from lerobot_memobench.evaluation.records import Run, headline, read_runs
from lerobot_memobench.evaluation.report import best_interval, evaluation_report, write_report
from lerobot_memobench.evaluation.tables import (
    WRITERS,
    Name,
    Report,
    Section,
    Table,
    csv_tables,
    csv_text,
    to_markdown,
)
from lerobot_memobench.tasks.assessment import FAILURES, FAULTS, REFINED_FAILURES
from lerobot_memobench.tasks.catalogue import cue_to_use, get_task, longest_cue_to_use, task_names
from lerobot_memobench.tasks.task import STRICT_FAILURES
from tests.support import logs
from tests.support.logs import rollout, write_log


def record(task: str, memory_type: str, episode: int, success: bool, **changes: Any) -> dict[str, Any]:
    marks = [("S", 3, 3), ("U", 5 if success else None, 5 if success else None)]
    own = {"memory_type": memory_type, "success": success, "failure": None if success else "stale_memory"}
    return logs.record(task, episode, marks, **own | changes)


# --- next to the log ---


def test_files_next_to_the_log(tmp_path: Path) -> None:
    log = EpisodeLog(tmp_path, logs.facts())
    for k in range(4):
        log.append(line_of(record("first", "temporal", k, k != 0)))
        log.append(line_of(record("second", "procedural", k, True)))
    assert not write_report(tmp_path).notes
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 8
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["average"] == {"n": 8, "SR": 87.5, "MSR": 100.0, "MUR": 87.5, "MCR": None}
    text = (tmp_path / "report.md").read_text()
    assert "| `first` | 4 | 75.0 [30.1, 95.4] | 100.0 [51.0, 100.0] | 75.0 [30.1, 95.4] | – |" in text
    assert "stale memory | 1" in text
    assert not list(tmp_path.glob("*.part"))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    write_report(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("workers", [False, True])
def test_every_line_of_the_log_stays(tmp_path: Path, workers: bool) -> None:
    lines = [json.dumps(line_of(record("first", "object", k, True))) for k in range(6)]
    lines[1], lines[2] = lines[1].replace("true", "tru"), json.dumps(json.loads(lines[2]) | {"failure": 7})
    merged = tmp_path / "episodes.jsonl"
    merged.write_text("\n".join(lines))
    write_evaluation(tmp_path, logs.facts({**logs.SETTINGS, "tasks": ["first"], "episodes": 4}))
    if workers:  # they hold the damaged line, and one episode more
        for k in (1, 7):
            EpisodeLog(tmp_path).append(line_of(record("first", "object", k, True)))
    notes = [write_report(tmp_path).notes for _ in range(2)]
    assert notes[0] == notes[1]
    assert sum("line" in note for note in notes[0]) == 2
    assert any(note.startswith(f"{2 + workers} rollouts beyond") for note in notes[0])
    kept = merged.read_text().splitlines()
    assert kept[:6] == lines
    assert [json.loads(line)["episode"] for line in kept[6:]] == ([1, 7] if workers else [])


# --- the first line ---


def prompted(folder: Path, policy: dict[str, Any], checkpoint: dict[str, Any] | None = None, **changes: Any) -> Path:
    """An evaluation whose policy observed the prompt, with a card where there is a ``checkpoint``."""
    settings = {**logs.SETTINGS, "suite": "strict", "replan_steps": 5, "inputs": "pixels", **changes}
    whole = logs.card({**settings, "tasks": ["first"], "episodes": 2}, policy, checkpoint=checkpoint)
    write_evaluation(folder, logs.facts(settings, policy) if checkpoint is None else whole)
    write_episodes(folder, [record("first", "object", k, True, prompt_steps=30) for k in range(2)])
    return folder


STRICT = "strict suite, referent fixed, seeds 7 to 8, 2 episodes of first, replan interval 5"


def test_first_line(tmp_path: Path) -> None:
    run = write_report(prompted(tmp_path / "a", {"type": "act"}, {"path": "user/mine"}))
    assert headline([run]) == f"act (user/mine): {STRICT}; inputs: pixels, prompt in steps (observed)"
    found = evaluation_report([run])
    assert WRITERS["markdown"](found).splitlines()[0] == f"# {headline([run])}"
    assert " ".join(WRITERS["table"](found).split()).startswith(headline([run]))
    assert WRITERS["latex"](found).startswith(f"% {headline([run])}")
    for changes, ending in (
        ({"prompt_in": "reset"}, "prompt in reset (not observed)"),
        ({"demonstration_prompt": False}, "no demonstration prompt"),
    ):
        plain = prompted(tmp_path / ending, {"type": "act", "identity": "act 0123456789ab"}, **changes)
        assert headline([write_report(plain)]) == f"act 0123456789ab: {STRICT}; inputs: pixels, {ending}"
    prompted(tmp_path / "b", {"type": "B"})
    runs = read_runs([f"one={tmp_path}/a", f"two={tmp_path}/b"])
    seen = "inputs: pixels, prompt in steps (observed)"
    assert headline(runs) == f"2 evaluations, {STRICT}; one: act (user/mine), {seen}; two: B, {seen}"
    short = replace(runs[1], records=runs[1].records[:1])
    other = STRICT.replace("seeds 7 to 8, 2 episodes", "seed 7, 1 episode")
    assert headline([runs[0], short]).endswith(f"({STRICT}); two: B, {seen} ({other})")
    file = tmp_path / "a" / EVALUATION_FILE
    file.write_text(json.dumps(json.loads(file.read_text()) | {"settings": {"env": {"task_dir": "mine"}}}))
    assert ": own tasks, suite=strict, referent" in headline(read_runs([tmp_path / "a"]))


# --- formats ---


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """A policy at three intervals: 1, 3 and 2 of 4 episodes succeed."""
    folder = tmp_path_factory.mktemp("sweep")
    for k, successes in ((5, 1), (20, 3), (35, 2)):
        logs.evaluation(folder / f"k{k}", successes, replan_steps=k)
    return read_runs([f"mine_&_co={folder}/k{k}" for k in (5, 20, 35)])


def test_json(sweep: list[Run], tmp_path: Path) -> None:
    runs = read_runs([logs.evaluation(tmp_path / "a")])
    data = json.loads(WRITERS["json"](evaluation_report(runs)))
    schema = json.loads(json.dumps(report_values(runs[0].summary)))
    assert {key: data[key] for key in schema} == schema
    assert data["intervals"]["average"]["SR"] == [21.5, 78.5]  # 4 of 8
    assert data["ordered_prefix"] == schema["prefix"]
    assert data["pooled"]["checkpoints"] == {"percent": 80.0, "n": 20}
    swept = json.loads(WRITERS["json"](evaluation_report(sweep)))["replan_sweep"]["mine_&_co"]
    assert swept["average"]["20"] == {"SR": 75.0, "MSR": 100.0, "MUR": 87.5, "MCR": 75.0}
    assert swept["best"] == {"SR": [20], "MSR": [5, 20, 35], "MUR": [20], "MCR": [20]}
    assert best_interval(sweep, "SR")[0] == [20]


def test_csv(sweep: list[Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = csv_text(
        [{"name": "=cmd()", "figure": -3.5, "rest": None}, {"name": "@SUM(1)", "figure": "a, b", "rest": "-"}]
    )
    assert list(csv.reader(io.StringIO(text)))[1:] == [["'=cmd()", "-3.5", ""], ["'@SUM(1)", "a, b", "'-"]]
    found = evaluation_report(sweep)
    rows = list(csv.DictReader(io.StringIO(csv_tables(found)["joined"])))
    (row,) = [row for row in rows if row["task"] == "one"]
    name = "mine_&_co k=20"
    assert [row[f"SR {name}{end}"] for end in ("", " low", " high")] == ["75.0", "30.1", "95.4"]
    assert row[f"MCR {name}"] == ""
    assert [row["task"] for row in rows] == ["one", "temporal", "two_of_them", "spatial", "average of memory types"]
    (alone,) = [
        row
        for row in csv.DictReader(io.StringIO(csv_tables(evaluation_report(sweep[:1]))["tasks"]))
        if row["task"] == "one"
    ]
    assert alone["n"] == "4"
    words = [f"mine={run.folder}" for run in sweep]
    formats = [word for name in ("csv", "json", "latex", "markdown", "table") for word in ("--format", name)]
    assert main(["report", *words, *formats, "--out", str(tmp_path / "out")]) == 0
    written = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*") if path.is_file()}
    files = {"report.json", "report.tex", "report.md", "report.txt"}
    tables = evaluation_report(read_runs(words)).tables
    assert written == files | {f"tables/{table.key}.csv" for table in tables}
    capsys.readouterr()
    (tmp_path / "file").write_text("")
    assert main(["report", *words, "--out", str(tmp_path / "file")]) == 2


def test_latex_is_balanced_and_escaped(sweep: list[Run]) -> None:
    text = WRITERS["latex"](evaluation_report(sweep))
    assert r"mine\_\&\_co k=20" in text
    assert r"\texttt{two\_of\_them}" in text
    assert text.count("{") == text.count("}")
    assert text.count(r"\begin{table}") == text.count(r"\end{table}") > 10
    assert len(set(re.findall(r"\\label\{(.*?)\}", text))) == text.count(r"\label")
    for columns, body in re.findall(r"\\begin\{tabular\}\{@\{\}([lr]+)@\{\}\}(.*?)\\end\{tabular\}", text, re.DOTALL):
        for line in body.splitlines():
            if line.endswith(r"\\"):
                spans = [int(n) for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
                cells = len(re.findall(r"(?<!\\)&", line)) + 1 + sum(spans) - len(spans)
                assert cells == len(columns), line
    code = re.sub(r"(?m)^%.*$|\\label\{.*?\}|\$.*?\$", "", text)
    assert not re.findall(r"[_#~^]|%(?!\n)", re.sub(r"\\[a-zA-Z]+|\\.", "", code))


BLOCKS = ("heading", "paragraph", "blockquote", "table", "thead", "tbody", "tr", "th", "td")
EVIL = "a|b\n\n# x\n```\n<script>alert(1)</script> ``[y](javascript:z) ![](w) &lt; \x1b[2J\u202e ~~s~~ *b*"


def test_markdown_escapes_all_text() -> None:
    """By a CommonMark parser with tables: every block and mark is the report's own."""
    table = Table("t", EVIL, (EVIL, "b"), ((EVIL, "1"), (Name(EVIL), "2")), note=f"# {EVIL}")
    report = Report(EVIL, (Section(EVIL, (table,), (f"- {EVIL}", f"12. {EVIL}", "==="), (f"> {EVIL}",)),))
    tokens = MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(to_markdown(report))
    blocks = {token.type for token in tokens if token.nesting != 0}
    assert blocks <= {f"{name}_{end}" for name in BLOCKS for end in ("open", "close")}
    assert [token.type for token in tokens].count("tr_open") == 3
    inner = [inside for token in tokens for inside in token.children or ()]
    assert {inside.type for inside in inner} <= {"text", "text_special"}
    assert sum("<script>alert(1)</script>" in "".join(i.content for i in t.children or ()) for t in tokens) == 10


# --- figures ---


def test_figures(sweep: list[Run], tmp_path: Path) -> None:
    runs = sweep[:2]
    found = bars(runs)
    assert [bar.heading for bar in found] == [*["all rollouts"] * 2, *["temporal"] * 2, *["spatial"] * 2]
    parts = found[0].parts
    assert (parts["success"], parts["stale_memory"], parts["compression_collapse"]) == (2, 3, 3)
    assert sum(parts.values()) == 8
    line = draw_replan(runs).axes[0].lines[0]
    assert [*line.get_xdata()] == [5, 20]
    assert [*line.get_ydata()] == pytest.approx([25, 75])
    files = draw_figures(runs, tmp_path / "figures")
    assert [path.name for path in files] == ["outcomes.pdf", "outcomes.png", "replan.pdf", "replan.png"]
    before = [path.read_bytes() for path in files]
    assert before[0].startswith(b"%PDF")
    assert np.asarray(Image.open(files[1]).convert("L")).std() > 10
    assert [path.stem for path in draw_figures(runs[:1], tmp_path / "figures")] == ["outcomes", "outcomes"]
    assert files[0].read_bytes() != before[0]


def test_outcomes_are_distinguishable() -> None:
    assert set(OUTCOMES) == {"success", *FAILURES, *REFINED_FAILURES, *STRICT_FAILURES, *FAULTS}
    assert len(set(OUTCOMES.values())) == len(OUTCOMES)


# --- compressed logs ---


def kept(folder: Path) -> Path:
    """Compress an evaluation as ``gzip -9n episodes.jsonl evaluation.json`` does; remove all other files."""
    write_report(prompted(folder, {"type": "act"}, {"path": "user/mine"}))
    for name in ("episodes.jsonl", EVALUATION_FILE):
        (folder / f"{name}.gz").write_bytes(gzip.compress((folder / name).read_bytes()))
        (folder / name).unlink()
    for name in ("report.json", "report.md"):
        (folder / name).unlink()
    return folder


def test_compressed_evaluations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, archive = prompted(tmp_path / "a", {"type": "act"}, {"path": "user/mine"}), kept(tmp_path / "b")
    before = sorted(archive.iterdir())
    printed = []
    for folder in (plain, archive):
        assert main(["report", str(folder), "--format", "csv"]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    assert len(printed[0].splitlines()) > 10
    assert main(["compare", str(plain), str(archive)]) == 0
    assert sorted(archive.iterdir()) == before
    file = archive / "episodes.jsonl.gz"
    whole = file.read_bytes()
    for damaged in (whole[:-12], b"no gzip", whole[:40] + b"x" * 9):
        file.write_bytes(damaged)
        assert main(["report", str(archive)]) == 2
        assert "gzip" in capsys.readouterr().err
    file.write_bytes(whole)
    monkeypatch.setattr("lerobot_memobench.untrusted.LARGEST_UNPACKED", 100)
    with pytest.raises(MemobenchError, match="larger"):
        read_runs([archive])


def test_the_nearest_log_is_suggested(tmp_path: Path) -> None:
    folder = tmp_path / "frames-0" / "rollouts"
    write_episodes(folder, [])
    for wrong in (tmp_path, folder / "episodes.jsonl"):
        with pytest.raises(MemobenchError, match=f"{folder}$"):
            read_episodes(wrong)


# --- steps from cue to use ---

COUNTING = "turn_the_stove_on_and_off_a_given_number_of_times"
HIDING = "find_the_tomato_hidden_in_one_of_the_drawers"


@pytest.mark.parametrize("suite", ["published", "strict"])
def test_every_checkpoint_of_the_catalogue_was_measured(suite: str) -> None:
    for task in map(get_task, task_names(suite=suite)):
        measured = cue_to_use(task)
        assert len(measured) == len(task.checkpoints)
        assert all(one is None or 0 < one.least <= one.median <= one.most for one in measured)
        # An instruction needs no memory, a prompt does.
        assert (measured[0] is None) == (task.prompt is None)
        if suite == "strict":
            longest = longest_cue_to_use(task)
            assert longest.median > 30
            assert longest.held == (task.prompt is not None)


def test_checkpoints_are_grouped_by_gap() -> None:
    """The third checkpoint counts for those episodes only that came to it."""
    done = [[True, True, True, True], [True, True, False, False], [True, False, False, False]]
    records = [rollout(COUNTING, "temporal", "SUUC", marks, all(marks), k) for k, marks in enumerate(done)]
    found = success_by_gap(records)
    assert sum(count for _, count in found.values()) == 4 + 3 + 2
    assert sum(reached for reached, _ in found.values()) == 4 + 2 + 1
    for record in records:  # logs of other tools omit it, as in prefix completion
        record["checkpoints"][0].pop("ordered_step", None)
    assert sum(reached for reached, _ in success_by_gap(records).values()) == 0
    assert success_by_gap([rollout("my_own_task", "temporal", "S", [True], True, 0)]) == {}


def test_figure_is_drawn_for_tasks_of_the_catalogue(tmp_path: Path) -> None:
    records = [rollout(HIDING, "spatial", "SUC", [True, k > 1, k > 2], k > 2, k) for k in range(4)]
    write_log(tmp_path / "log", records)
    files = draw_figures(read_runs([tmp_path / "log"]), tmp_path)
    assert {"gap.pdf", "gap.png"} <= {file.name for file in files}
