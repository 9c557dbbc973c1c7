"""Counts of the benchmarks of the evaluation; times are not tested."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.policies.baselines.configuration_baselines import MemobenchRandomConfig
from lerobot_memobench.policies.baselines.modeling_baselines import MemobenchRandomPolicy
from research.speed import evaluation
from research.speed.claims import BENCHMARKS
from research.speed.evaluation import Cost, Stopwatch, evaluate_once, observing_every, step_bare


def test_a_step_costs_what_passes_from_the_first_to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation.time, "perf_counter", iter([10.0, 18.0]).__next__)
    monkeypatch.setattr(evaluation.time, "process_time", iter([1.0, 5.0]).__next__)
    watch = Stopwatch()
    for _ in range(4):
        watch.step()
    watch.end()
    assert watch.cost == (2.0, 1.0)


def test_the_policy_looks_as_often_as_it_is_told() -> None:
    policy = MemobenchRandomPolicy(MemobenchRandomConfig())
    for every, looks in ((0, []), (1, [1, 2, 3, 4, 5, 6]), (3, [3, 6])):
        with observing_every(every):
            assert [number for number in range(1, 7) if policy.needs_observation()] == looks


def test_both_sides_draw_the_same_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment alone, and the whole of LeRobot's evaluation."""
    import lerobot_memobench.registration  # noqa: F401

    drawn: list[int] = []
    draw = Episode.images

    def images(self: Episode) -> Any:
        drawn.append(self.step_index)
        return draw(self)

    monkeypatch.setattr(Episode, "images", images)
    for every, frames in ((1, [0, 1, 2, 3, 4, 5, 6]), (4, [0, 4, 6])):
        for side in (lambda every=every: step_bare(every, 6), lambda every=every: evaluate_once(every, 0, 6)):
            drawn.clear()
            assert side().wall > 0
            assert drawn == frames


def test_a_total_counts_what_is_before_the_first_step_and_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two tasks whose resets take 1 and 3 s and whose steps 0.1 s, in two processes."""

    def seconds(tasks: str, steps: int, processes: int, every: int) -> tuple[dict[str, float], float]:
        return {"a": 1 + 0.1 * steps, "b": 3 + 0.1 * steps}, 20 + 2 * 0.05 * steps

    monkeypatch.setattr(evaluation, "seconds", seconds)
    monkeypatch.setattr(evaluation, "machine", lambda: "here")
    found = evaluation.rollouts_total(processes=2)
    assert found["hours"] == pytest.approx(1500 * (2 + 1200 * 0.1) / 2 / 3600, abs=0.01)
    assert (found["ms_per_step"], found["cpu_ms_per_step"], found["s_before_the_first_step"]) == (100, 50, 2)


def test_the_documented_benchmarks_are_there() -> None:
    folder = Path(__file__).parents[2]
    text = (folder / "docs/guides/evaluate.md").read_text()
    assert "python -m research.speed eval_loop" in text
    assert "eval_loop" in BENCHMARKS
    assert "benchmarks/rollouts_total.py" in text
    assert (folder / "benchmarks" / "rollouts_total.py").is_file()


def test_the_rule_is_shown_as_a_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cost of a step with the rule and without, of one and of two evaluations at once."""
    asked: list[tuple[Any, ...]] = []

    class Side:
        def __init__(self, opened: Any, environment: dict[str, str]) -> None:
            self.ruled = environment.get("MEMOBENCH_THREADS") is not None

        def ask(self, do: Any, *args: Any) -> None:
            asked.append((do.__name__, *args))
            self.cost = {
                ("evaluate_apart", True): Cost(0.012, 0.012),
                ("evaluate_apart", False): Cost(0.018, 0.030),
                ("bare_apart", True): Cost(0.010, 0.010),
                ("bare_apart", False): Cost(0.012, 0.015),
            }[do.__name__, self.ruled]

        def answer(self) -> Cost:
            return self.cost

        def close(self) -> None:
            pass

    monkeypatch.setattr(evaluation, "Apart", Side)
    monkeypatch.setattr(evaluation, "machine", lambda: "here")
    one, two = evaluation.thread_rule(rounds=1, steps=3)
    assert (one.ours, one.theirs, one.ratio) == (12, 18, 1.5)
    assert (one.detail["over_bare"], one.detail["over_bare_before"]) == (0.2, 0.5)
    assert (one.detail["cpu_ours"], one.detail["cpu_theirs"], one.detail["cpu_ratio"]) == (12, 30, 2.5)
    assert (two.ours, two.theirs) == (6, 9)
    assert "over_bare" not in two.detail
    assert len(asked) == 2 * 2 * 4  # warm-up and one round, both ways: one, bare, two of two


@pytest.mark.slow
def test_the_rule_is_measured() -> None:
    one, two = evaluation.thread_rule(rounds=1, steps=5)
    assert one.ours > 0
    assert two.theirs > 0
