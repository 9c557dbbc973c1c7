"""Kept results of studies and sheets of raters, damaged in any way: they end in a result or a sentence."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_memobench.cli.report import ReportFormat
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task
from research.agreement.__main__ import agreement
from research.agreement.study import blank_sheet
from research.alignment.report import measures_table, summarise
from research.alignment.study import KeptBaselines, KeptRun, kept_or_made
from research.learning.results import costs_table
from research.learning.stages import Cost
from research.necessity.report import write
from research.necessity.settings import Settings
from research.necessity.study import Study
from tests.support import mutations

TASK = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it"
SAID = {"variant": 0, "step": 1, "answer": "(On a b)"}
SCENE = {
    "seed": 7,
    "solved": 1,
    "decisions": 3,
    "aliased": {"at_home": 1, "pixel_exact": 0, "as_it_happens": 0, "with_step": 0},
    "in_order": {
        **{"chance": 0.2, "deterministic": 0.0, "stochastic": 0.2, "pixel_exact": 1.0},
        **{"as_it_happens": 1.0, "with_step": 1.0},
    },
    "examples": [{"seed": 7, "a": SAID, "b": SAID, "difference": 0.0}],
    "largest_same": 0.1,
    "smallest_different": 0.5,
}
SEARCH = {
    "deterministic": 0.5,
    "stochastic": 0.5,
    "confirmed": 1,
    "of": 1,
    "complete": True,
    "exhausted": True,
    "unexplored": 0,
    "policy": [{"when": ["a"], "do": "b"}],
}
SCORES = {"all": 0.5, "own_task": 0.5}
RUN = {
    "arm": "memory",
    "seed": 0,
    "memory": SCORES,
    "last_frame": SCORES,
    "action_loss": 0.1,
    "wall_s": 1.5,
    "cpu_s": 1.5,
}
BASELINES = dict.fromkeys(KeptBaselines.__annotations__, SCORES)


def sheet(path: Path) -> None:
    rng = random.Random(0)
    lines = blank_sheet(3).splitlines()
    labelled = [line[: -len(",,")] + ",".join(rng.choice("SUC") for _ in range(3)) for line in lines[1:]]
    path.write_text("\n".join([lines[0], *labelled]) + "\n")


def check(
    tmp_path: Path,
    prepare: Callable[[Path], object],
    use: Callable[[Path], object],
    mutate: Callable[[bytes, random.Random], bytes],
    count: int,
) -> int:
    source, whole = tmp_path / "source", tmp_path / "whole"
    whole.mkdir()
    (source / "it").mkdir(parents=True)
    prepare(source / "it")

    def damage(rng: random.Random) -> None:
        mutations.fresh_copy(source, whole)
        files = sorted(path for path in (whole / "it").rglob("*") if path.is_file())
        mutations.damage(rng.choice(files), rng, mutate)

    found = mutations.ends_well(range(count), damage, lambda _: use(whole / "it"), whole, ("it",))
    assert found["result"] > 20
    return found["refused"]


def test_damaged_sheets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def use(folder: Path) -> None:
        agreement(folder / "sheet.csv", format_=[ReportFormat.TABLE, ReportFormat.JSON])

    refused = check(tmp_path, lambda folder: sheet(folder / "sheet.csv"), use, mutations.mutated_bytes, 300)
    assert refused > 50


def test_what_a_necessity_study_keeps_is_used_or_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where its fingerprint is right."""
    monkeypatch.setattr(Study, "_observe", lambda self, seed: SCENE)
    monkeypatch.setattr(Study, "_explore", lambda self, seed: SEARCH)

    def study(folder: Path) -> Study:
        return Study(get_task(TASK), "fixed", Settings(episodes=2), folder)

    def use(folder: Path) -> None:
        blocked = any(path.is_dir() for path in (folder / "results").iterdir())
        try:
            write(folder, [study(folder).result()])
        except MemobenchError:
            assert blocked, "what is only damaged is made again"
            raise
        assert not blocked, "what a folder stands in the way of cannot be kept"

    assert check(tmp_path, lambda folder: study(folder).result(), use, mutations.mutated_json, 200) > 0


def test_what_an_alignment_study_keeps_is_used_or_refused(tmp_path: Path) -> None:
    def prepare(folder: Path) -> None:
        (folder / "memory-0.json").write_text(json.dumps(RUN))
        (folder / "baselines.json").write_text(json.dumps(BASELINES))

    def use(folder: Path) -> None:
        run = kept_or_made(folder / "memory-0.json", KeptRun, lambda: RUN)
        baselines = kept_or_made(folder / "baselines.json", KeptBaselines, lambda: BASELINES)
        measures_table({"memory": summarise([run])}, baselines)
        costs_table({"questions": [Cost(run["wall_s"], run["cpu_s"])]})

    assert check(tmp_path, prepare, use, mutations.mutated_json, 200) > 50
