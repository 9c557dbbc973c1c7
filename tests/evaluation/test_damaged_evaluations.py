"""Damaged logs, protocols and cards: every command that reads them ends in a result or a MemobenchError."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.report import ReportFormat, compare, merge, report
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import check_facts, write_evaluation
from lerobot_memobench.rollouts import rerun as again
from lerobot_memobench.rollouts.evaluate import resumed_card
from lerobot_memobench.rollouts.plan import earlier_batch_size
from tests.support import logs, mutations

STOVE, DRAWER = "press_the_stove_button_four_times", "two_of_them"
SETTINGS: dict[str, Any] = {**logs.SETTINGS, "replan_steps": 5}


def card_of(folder: Path) -> dict[str, Any]:
    records = read_episodes(folder)
    return logs.card(
        protocol={"tasks": sorted({record["task"] for record in records}), "episodes": 4, **SETTINGS},
        policy={"type": "act", "seed": 7, "settings": {"n_action_steps": 5, "chunk_size": 50}},
        checkpoint={"path": "somewhere", "revision": None, "files": {"model.safetensors": "0" * 64}},
        trained_on={"repo_id": "me/it", "steps": 5},
        task_files={"one": "abc", "two_of_them": "def"},
        settings={"env": {"tasks": "one,two_of_them"}, "policy": {"type": "act"}},
    )


def whole_evaluation(folder: Path, successes: int) -> Path:
    """A folder with all files of an evaluation, but videos: a worker's file and the merged one."""
    logs.evaluation(folder, successes, steps=40, prompt_steps=0, variant=0, wall_s=1.5)
    lines = (folder / "episodes.jsonl").read_text().splitlines(keepends=True)
    (folder / "episodes").mkdir()
    worker = [json.dumps({**json.loads(line), "written_at": 1.0}) + "\n" for line in lines[:3]]
    (folder / "episodes" / "one.1.jsonl").write_text("".join(worker))
    write_evaluation(folder, card_of(folder))
    return folder


class Bench:
    """Two evaluations and the commands that read the first one, which is damaged."""

    def __init__(self, tmp_path: Path) -> None:
        self.whole = tmp_path / "whole"
        self.run, self.other, self.out = (self.whole / name for name in ("run", "other", "out"))
        self.source = tmp_path / "source"
        whole_evaluation(self.source / "run", 2)
        whole_evaluation(self.source / "other", 1)
        self.card = card_of(self.source / "run")
        self.commands: list[tuple[Callable[[random.Random], object], int]] = [
            (lambda _: report([str(self.run)], list(ReportFormat), None, self.out), 30),
            (lambda _: report([str(self.run), f"b={self.other}"], list(ReportFormat), None, None), 20),
            (lambda _: report([str(self.run), str(self.other)], html=self.out / "html"), 20),
            (lambda _: compare(str(self.run), str(self.other), ["scene_hash"], permutations=100), 30),
            (lambda _: merge(self.out, [self.run]), 20),
            (lambda _: merge(self.run, [self.other]), 20),
            (lambda _: resumed_card(self.run, self.card, lambda _: None), 20),
            (lambda _: earlier_batch_size(self.run), 5),
            (lambda _: check_facts(self.run, logs.facts(SETTINGS)), 5),
            (lambda _: self.rerun(), 20),
        ]

    def rerun(self) -> None:
        """All that `memobench rerun` does with a card before and after the run."""
        card, settings = again.read_repeatable(self.run)
        again.check_policy(card, settings.policy.get("path"))
        again.differences_here(card)

    def use(self, rng: random.Random) -> object:
        calls, weights = zip(*self.commands, strict=True)
        return rng.choices(calls, weights)[0](rng)


def check(tmp_path: Path, files: str, count: int) -> tuple[int, int]:
    bench = Bench(tmp_path)

    def prepare(rng: random.Random) -> None:
        mutations.fresh_copy(bench.source, bench.whole)
        mutations.damage(bench.run / rng.choice(files.split()), rng)

    found = mutations.ends_well(range(count), prepare, bench.use, bench.whole, ("run", "other", "out"))
    return found["result"], found["refused"]


KINDS = {"log": "episodes.jsonl episodes.jsonl episodes/one.1.jsonl", "card": "evaluation.json"}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that takes a name out of a file for a path would leave something in one of these folders."""
    (tmp_path / "whole").mkdir()
    monkeypatch.chdir(tmp_path / "whole")


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_evaluations(tmp_path: Path, kind: str) -> None:
    results, refused = check(tmp_path, KINDS[kind], 30)
    assert results > 4
    assert refused > 2


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_evaluations(tmp_path: Path, kind: str) -> None:
    check(tmp_path, KINDS[kind], 10_000)
