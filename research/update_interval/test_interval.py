"""A policy fed at plans sees prompts and plans alone; the sweep names what it compares, and repeats its table."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_memobench.conformance.streams import Stream, write_streams
from lerobot_memobench.conformance.subject import Subject, load_subject
from lerobot_memobench.constants import ENDED, NO_CLOCK, OBS_PHASE, OBS_STEP
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import WEIGHTS_FILE, shipped_policies
from research.update_interval import __main__ as program
from research.update_interval.at_plans import FedAtPlansConfig, FedAtPlansPolicy, Row
from tests.support.logs import evaluation

STRICT = "memobench_strict"


class Counting:
    """A policy that plans three actions, the numbers of the frame and of those after it, once the prompt is over."""

    def __init__(self) -> None:
        self.config = SimpleNamespace(type="window")
        self.seen: list[int] = []

    def reset(self) -> None:
        self.rows = [SimpleNamespace(queue=deque[torch.Tensor]())]

    def select_action(self, batch: dict[str, Any]) -> torch.Tensor:
        self.seen.append(frame := int(batch["frame"]))
        self.rows[0].queue.extend(torch.tensor([frame + k]) for k in (1, 2) if batch[OBS_PHASE])
        return torch.tensor([[frame]])


def test_a_row_observes_its_prompt_and_its_plans() -> None:
    policy = Counting()
    row, actions = Row(policy), []
    for frame in range(9):
        step = float(NO_CLOCK if frame < 8 else ENDED)
        shown = {"frame": frame, OBS_PHASE: float(frame >= 2), OBS_STEP: step}
        actions.append(int(row.act({key: torch.tensor([value]) for key, value in shown.items()})))
    assert policy.seen == [0, 1, 2, 5, 8]
    assert actions == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert row.ended


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    folder = tmp_path_factory.mktemp("subject")
    data = write_streams(folder / "data", images=False, frames=13)
    return load_subject([f"policy={STRICT}", f"dataset={data}"], folder)


def strict(stream: Stream) -> Stream:
    """Return a stream without a clock in its execution."""
    frames = [{**frame, OBS_STEP: torch.tensor(float(NO_CLOCK))} for frame in stream.frames[stream.start :]]
    return replace(stream, frames=(*stream.frames[: stream.start], *frames))


@pytest.mark.parametrize(("replan", "hidden"), [(1, False), (3, True)])
def test_frames_between_plans_are_hidden(
    subject: Subject, monkeypatch: pytest.MonkeyPatch, replan: int, hidden: bool
) -> None:
    """It remembers every eighth frame: with prompts of 8 the ninth of the execution, at which it does not plan."""
    config = FedAtPlansConfig(weights=str(shipped_policies()[STRICT] / WEIGHTS_FILE), n_action_steps=replan)
    fed_at_plans = FedAtPlansPolicy(config)
    first, second = map(strict, subject.streams[:2])
    changed = first.showing(second.only(len(second) - 1), [first.start + 8])
    rolled = {}
    for policy in (fed_at_plans.inner, fed_at_plans):
        monkeypatch.setattr(subject, "policy", policy)
        rolled[policy] = [subject.roll([stream, second]) for stream in (first, changed)]
    (plain, plain_changed), (fed, fed_changed) = rolled[fed_at_plans.inner], rolled[fed_at_plans]
    assert np.array_equal(fed, fed_changed) is hidden
    assert not np.array_equal(plain, plain_changed)
    assert np.allclose(plain, fed, atol=2e-6) is not hidden
    if hidden:  # the clock of published tasks shows the policy that a frame is missing
        with pytest.raises(MemobenchError, match="did not observe step 16"):
            subject.roll(subject.streams[:1])


def test_the_table_names_both_intervals_and_is_made_again_of_the_kept_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = []

    def evaluate(words: list[str], log: Path, how: list[str]) -> None:
        given = dict(word.split("=", 1) for word in words[2:])
        ran.append((given["policy"] == "fed_at_plans", int(given["replan"])))
        good, card = 3, {"type": "memobench_mem", "settings": {"memory_stride": 8}}
        if given["policy"] == "fed_at_plans":
            good, card = 1, {"type": "fed_at_plans", "settings": {}}
        evaluation(Path(given["output_dir"]), good, policy=card, replan_steps=int(given["replan"]))

    monkeypatch.setattr(program, "run_once", evaluate)
    program.sweep(tmp_path / "first", [f"mine={STRICT}"], ["tasks=object"], keep=tmp_path / "kept")
    assert ran == [(False, 1), (False, 5), (True, 5), (False, 10), (True, 10), (False, 16), (True, 16)]
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert lines[0].startswith("| policy | plan interval | memory fed at |")
    assert "| mine | 1 | both | 8 | 8 | 75.0 " in lines[2]
    assert "| mine | 16 | each step | 8 | 8 | 75.0 " in lines[7]
    assert "| mine | 16 | each plan | 8 | 128 | 25.0 " in lines[8]
    assert "| -50.0 [" in lines[8]
    assert (tmp_path / "first" / "interval.png").stat().st_size > 10_000

    for sha256, replan in (("1", 10), ("2", 16)):
        policy = {"type": "memobench_mem", "settings": {}, "sha256": sha256}
        evaluation(tmp_path / "mixed" / f"each step, {replan}", 3, policy=policy, replan_steps=replan)
    with pytest.raises(MemobenchError, match="each step, 16 is of other weights of mixed"):
        program.show(tmp_path, ["mixed/each step, 10", "mixed/each step, 16"], tmp_path / "joined")

    evaluation(tmp_path / "other")
    program.store.keep(tmp_path, ["other"], tmp_path / "kept")  # of another program
    program.sweep(tmp_path / "again", kept=tmp_path / "kept")
    assert (capsys.readouterr().out, len(ran)) == (text, 7)
    assert (tmp_path / "again" / "interval.md").read_text() == text


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({}, "give one"),
        ({"policy": ["mine=x"], "kept": Path("kept")}, "give one"),
        ({"replan": [5], "kept": Path("kept")}, "give one"),
        ({"policy": [f"mine={STRICT}", f"mine={STRICT}"]}, "two policies of one name"),
        ({"policy": [f"mine={STRICT}"], "replan": [20]}, "interval of 20 and chunks of 16"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, given: dict[str, Any], named: str) -> None:
    with pytest.raises(MemobenchError, match=named):
        program.sweep(tmp_path, **given)
