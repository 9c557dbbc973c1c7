"""``memobench report`` and ``compare`` as they are typed."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
from pathlib import Path

import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import write_episodes


def evaluation(folder: Path, replan_steps: int = 5, successes: int = 2) -> str:
    records = [
        {
            "task": "a_task",
            "memory_type": "temporal",
            "episode": k,
            "seed": 7 + k,
            "referent": "fixed",
            "replan_steps": replan_steps,
            "success": k < successes,
            "checkpoints": [
                {"operation": "S", "first_step": 3, "ordered_step": 3},
                {"operation": "U", "first_step": 5 if k < successes else None, "ordered_step": None},
            ],
        }
        for k in range(4)
    ]
    write_episodes(folder, records)
    return str(folder)


def test_report_in_several_formats_to_a_folder(tmp_path: Path) -> None:
    a = evaluation(tmp_path / "a")
    out = tmp_path / "out"
    words = ["report", a, "--format", "json", "--format", "latex", "--with", "paper", "--out", str(out)]
    assert main(words) == 0
    assert sorted(path.name for path in out.iterdir()) == ["report.json", "report.tex"]
    assert len(json.loads((out / "report.json").read_text())["paper"]) == 43
    beside = json.loads((tmp_path / "a" / "report.json").read_text())
    assert set(beside) == {"tasks", "memory_types", "average", "failures", "prefix", "inputs"}


def test_every_table_is_written_as_csv_with_the_figures_of_the_json(tmp_path: Path) -> None:
    a, b = evaluation(tmp_path / "a"), evaluation(tmp_path / "b", successes=3)
    out = tmp_path / "out"
    assert main(["report", a, b, "--format", "csv", "--format", "json", "--out", str(out)]) == 0
    tables = {path.stem: list(csv.DictReader(path.open())) for path in sorted((out / "tables").iterdir())}
    assert list(tables) == ["failures", "memory-types", "overview", "prefix", "tasks"]
    found = json.loads((out / "report.json").read_text())["evaluations"]
    for row, (name, figures) in zip(tables["tasks"], found.items(), strict=True):
        rates, intervals = figures["tasks"]["a_task"], figures["intervals"]["tasks"]["a_task"]
        assert row["evaluation"] == name
        assert row["task"] == "a_task"
        assert int(row["n"]) == rates["n"]
        for metric in ("SR", "MSR", "MUR"):
            assert float(row[metric]) == rates[metric]
            assert [float(row[f"{metric} {bound}"]) for bound in ("low", "high")] == intervals[metric]
        assert row["MCR"] == row["MCR low"] == ""
    prefix = tables["prefix"][0]
    assert [float(prefix[f"c{k} any order"]) for k in (1, 2)] == found["a"]["prefix"]["a_task"]
    assert [float(prefix[f"c{k} in order"]) for k in (1, 2)] == found["a"]["ordered_prefix"]["a_task"]
    assert [row["object SR"] for row in tables["overview"]] == ["", ""]
    assert [float(row["average SR"]) for row in tables["overview"]] == [50.0, 75.0]


def test_report_prints_json_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", evaluation(tmp_path / "a"), "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out)["average"]["SR"] == 50.0


def test_report_prints_intervals_and_the_best_replan_interval(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = evaluation(tmp_path / "a"), evaluation(tmp_path / "b", 20, 3)
    assert main(["report", f"p={a}", f"p={b}"]) == 0
    out = capsys.readouterr().out
    assert "Best replan interval by average: SR 75.0 at 20" in out
    assert "75.0 [30.1–95.4]" in out


def test_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = evaluation(tmp_path / "a"), evaluation(tmp_path / "b", 20, 3)
    assert main(["compare", a, b]) == 2
    assert "replan_steps: 5 and 20" in capsys.readouterr().err
    assert main(["compare", a, b, "--allow", "replan_steps", "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out)["differences"][0]["difference"] == 25.0
    assert main(["compare", a, b, "--allow", "replan_steps", "--format", "csv"]) == 0
    first = next(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert (first["metric"], first["pairs"], first["difference"]) == ("SR", "4", "25.0")


@pytest.mark.parametrize("option", ["--out", "--html"])
@pytest.mark.parametrize("refusal", ["full", "closed"])
def test_a_disk_that_takes_nothing_is_one_sentence(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    option: str,
    refusal: str,
) -> None:
    """Whatever command writes; and what was there before is whole."""
    a, out = evaluation(tmp_path / "a"), tmp_path / "out"
    assert main(["report", a, option, str(out)]) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert before
    number = {"full": errno.ENOSPC, "closed": errno.EROFS}[refusal]

    inner = Path.write_bytes

    def refuse(path: Path, content: bytes) -> int:
        if out in path.parents:
            raise OSError(number, os.strerror(number), str(path))
        return inner(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", refuse)
        capsys.readouterr()
        assert main(["report", a, option, str(out)]) == 2
    err = capsys.readouterr().err
    assert err.startswith("memobench: the disk does not take ")
    assert f"({os.strerror(number)}): make room, or name another folder" in err
    assert err.count("\n") == 1
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
