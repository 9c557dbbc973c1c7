"""The controls against logs made by hand and against the paper's own table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.controls import by_replan, paired, relabelled
from lerobot_memobench.evaluation.memory_controls import contrasts, gap_closed, prefix_curves, published_contrasts
from lerobot_memobench.evaluation.metrics import summarise
from lerobot_memobench.paper import raw_tables
from tests.support.logs import SETTINGS, record

STOVE = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it"
DRAWERS = "check_all_three_drawers_of_the_cabinet"


def rollout(
    episode: int,
    done: list[bool],
    operations: str = "SUU",
    task: str = STOVE,
    memory_type: str = "temporal",
    success: bool | None = None,
    **changes: Any,
) -> dict[str, Any]:
    steps = [10 * (k + 1) if it else None for k, it in enumerate(done)]
    succeeded = all(done) if success is None else success
    marks = zip(operations, steps, steps, strict=True)
    return record(task, episode, marks, memory_type=memory_type, success=succeeded, **changes)


def rollouts(reached: list[int], **changes: Any) -> list[dict[str, Any]]:
    """One rollout per number: so many of its three checkpoints were satisfied, from the first."""
    return [rollout(i, [k < count for k in range(3)], **changes) for i, count in enumerate(reached)]


# --- oracle memory ---


@pytest.mark.parametrize(
    ("standard", "oracle", "closed"),
    [(0.5, 0.75, 0.5), (0.0, 0.3, 0.3), (0.5, 0.25, -0.5), (1.0, 1.0, None), (0.996, 0.968, None), (None, 0.5, None)],
)
def test_share_of_the_gap(standard: float | None, oracle: float, closed: float | None) -> None:
    found = gap_closed(standard, oracle)
    assert found == (None if closed is None else pytest.approx(closed))


def test_published_shares_are_those_of_the_text() -> None:
    """Paper: "oracle memory closes 45.5% of the MUR gap and 54.9% of the MCR gap, but only 20.2% of the MSR gap"."""
    found = published_contrasts(raw_tables()["oracle_memory"])
    shares = {metric: round(100 * (found["average"][metric].closed.value or 0), 1) for metric in ("MSR", "MUR", "MCR")}
    assert shares == {"MSR": 20.2, "MUR": 45.5, "MCR": 54.9}
    assert found["object"]["MSR"].closed.value is None, "0.4 points are no gap to share out"
    assert found["procedural"]["MCR"].standard is None


def test_published_average_follows_from_the_memory_types() -> None:
    found = published_contrasts(raw_tables()["oracle_memory"])
    for metric in ("SR", "MSR", "MUR", "MCR"):
        for side in ("standard", "other"):
            cells = [getattr(found[name][metric], side) for name in ("temporal", "spatial", "object", "procedural")]
            known = [cell for cell in cells if cell is not None]
            assert getattr(found["average"][metric], side) == pytest.approx(sum(known) / len(known), abs=1.01e-3)


def test_contrasts_of_a_log_made_by_hand() -> None:
    standard = rollouts([1, 1, 0, 0]) + rollouts([3, 3, 3, 0], task="other", memory_type="spatial")
    oracle = rollouts([3, 1, 1, 0]) + rollouts([3, 3, 3, 3], task="other", memory_type="spatial")
    found = contrasts(standard, oracle, draws=400)
    temporal, average = found["temporal"], found["average"]
    assert (temporal["MSR"].standard, temporal["MSR"].other) == (0.5, 0.75)
    assert temporal["MSR"].closed.value == pytest.approx(0.5)
    assert temporal["MUR"].closed.value == pytest.approx(0.25)
    assert temporal["SR"].difference.value == pytest.approx(0.25)
    assert temporal["MCR"].standard is None
    assert found["spatial"]["SR"].closed.value == pytest.approx(1.0)
    # (0.5 + 0.75) / 2 and (0.75 + 1) / 2
    assert (average["MSR"].standard, average["MSR"].other) == (pytest.approx(0.625), pytest.approx(0.875))
    assert average["MSR"].closed.value == pytest.approx(2 / 3)


def test_averages_are_those_of_the_report() -> None:
    rng = np.random.default_rng(3)
    a, b = (
        rollouts(rng.integers(0, 4, 20).tolist())
        + rollouts(rng.integers(0, 4, 10).tolist(), task="x", operations="SSC")
        + rollouts(rng.integers(0, 4, 30).tolist(), task="y", memory_type="spatial", operations="SUC")
        for _ in range(2)
    )
    found, summaries = contrasts(a, b, draws=100), (summarise(a), summarise(b))
    for metric in ("SR", "MSR", "MUR", "MCR"):
        assert found["average"][metric].standard == pytest.approx(summaries[0].average[metric].value)
        assert found["average"][metric].other == pytest.approx(summaries[1].average[metric].value)
        assert found["temporal"][metric].standard == pytest.approx(summaries[0].memory_types["temporal"][metric].value)


def test_pairs_narrow_the_interval() -> None:
    """The oracle adds exactly one success to what the standard does: drawn together, the difference hardly varies."""
    standard = rollouts([3, 0] * 25)
    oracle = rollouts([3, 0] * 24 + [3, 3])
    interval = contrasts(standard, oracle)["temporal"]["SR"].difference
    assert interval.low is not None
    assert interval.high is not None
    assert interval.low <= 0.02 <= interval.high
    # Wilson's interval of one pair in 50 that differs reaches 0.105; a bootstrap alone would end at 0.06.
    assert 0.1 < interval.high - interval.low < 0.12, "independent samples of 50 would give about 0.4"


def test_equal_outcomes_are_no_certainty() -> None:
    standard, oracle = rollouts([0, 0]), rollouts([3, 3])
    found = contrasts(standard, oracle)["temporal"]["SR"]
    assert found.difference.value == found.closed.value == 1
    assert found.difference.low is not None
    assert found.closed.low is not None
    assert max(found.difference.low, found.closed.low) < 0.4
    (curve,) = prefix_curves(standard, standard)
    assert all(one.value == 0 and one.low < -0.4 and one.high > 0.4 for one in curve.differences)


def test_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    """100 pairs of evaluations of policies with known rates: 95 % intervals of the share of the gap."""
    rng = np.random.default_rng(11)
    covered = 0
    for _ in range(100):
        luck = rng.random((60, 2))
        standard = rollouts([3 * int(x < 0.2) for x in luck[:, 0]])
        oracle = rollouts([3 * int(x < 0.6) for x in luck[:, 1]])
        closed = contrasts(standard, oracle, draws=300)["temporal"]["SR"].closed
        assert closed.low is not None
        assert closed.high is not None
        covered += closed.low <= 0.5 <= closed.high
    assert 85 <= covered <= 100


def test_only_episodes_of_both_are_compared() -> None:
    a, b, alone = paired(rollouts([1, 2, 3]), list(reversed(rollouts([3, 3]))))
    assert ([r["episode"] for r in a], [r["episode"] for r in b], alone) == ([0, 1], [0, 1], 1)
    with pytest.raises(MemobenchError, match="no episode in common"):
        paired(rollouts([1]), rollouts([1], task="other"))
    with pytest.raises(MemobenchError, match="given twice"):
        paired(rollouts([1]) * 2, rollouts([1]))
    with pytest.raises(MemobenchError, match=r"other checkpoints in one evaluation \(SUU\) than in the other \(SUC\)"):
        paired(rollouts([1]), rollouts([1], operations="SUC"))


def test_replan_intervals_are_kept_apart() -> None:
    groups = by_replan(rollouts([1], replan_steps=50) + rollouts([1], replan_steps=None) + rollouts([1]))
    assert list(groups) == [5, 50, None]


# --- shuffled memory ---


def test_prefix_curves_as_published() -> None:
    """50 rollouts that come as far as the paper's give its curves: 76, 52, 8 and 90, 24, 2."""

    def reach(first: int, second: int, third: int) -> list[int]:
        return [3] * third + [2] * (second - third) + [1] * (first - second) + [0] * (50 - first)

    (curve,) = prefix_curves(rollouts(reach(38, 26, 4)), rollouts(reach(45, 12, 1)), draws=200)
    assert curve.normal == pytest.approx((0.76, 0.52, 0.08, 0.08))
    assert curve.other == pytest.approx((0.90, 0.24, 0.02, 0.02))
    assert [difference.value for difference in curve.differences] == pytest.approx([0.14, -0.28, -0.06, -0.06])
    assert curve.differences[1].high is not None
    assert curve.differences[1].high < 0


def test_a_checkpoint_after_a_missed_one_does_not_count() -> None:
    (curve,) = prefix_curves([rollout(0, [False, True, True])], [rollout(0, [True, True, False])], draws=10)
    assert curve.normal == (0.0, 0.0, 0.0, 0.0)
    assert curve.other == (1.0, 1.0, 0.0, 0.0)


# --- granularity ---


def test_labels_of_another_level() -> None:
    records = [rollout(0, [True, True, False], operations="SUC", task=DRAWERS)]
    (changed,) = relabelled(records, {DRAWERS: "SUU"})
    assert [c["operation"] for c in changed["checkpoints"]] == ["S", "U", "U"]
    assert [c["operation"] for c in records[0]["checkpoints"]] == ["S", "U", "C"]
    assert relabelled(records, {}) == records
    with pytest.raises(MemobenchError, match="another version of the task"):
        relabelled(records, {DRAWERS: "SU"})


# --- commands ---


def folder(path: Path, records: list[dict[str, Any]]) -> str:
    write_episodes(path, records)
    return str(path)


def test_two_policies_are_no_sweep_of_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = []
    for name, digest in (("a", "aaaa"), ("b", "bbbb")):
        words.append(folder(tmp_path / name, rollouts([1, 1, 0, 0])))
        (tmp_path / name / "protocol.json").write_text(json.dumps({"policy": {"type": "act", "sha256": digest}}))
    assert main(["controls", "oracle", *words, "--oracle", words[0]]) == 2
    assert "are of two policies (sha256 aaaa and bbbb)" in " ".join(capsys.readouterr().err.split())


def test_an_evaluation_in_anothers_place_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Swapped, or given twice, it would be a difference of the wrong sign, or none."""
    for name, oracle in (("plain", False), ("oracle", True)):
        folder(tmp_path / name, rollouts([1, 2]))
        (tmp_path / name / "protocol.json").write_text(json.dumps({"oracle_memory": oracle}))
    for name, shuffled, level in (("normal", False, "coarse"), ("shuffled", True, "fine")):
        folder(tmp_path / name, rollouts([1, 2]))
        told = {"type": "memobench_mem", "settings": {"shuffle_subgoals": shuffled, "subgoal_level": level}}
        protocol = {**SETTINGS, "tasks": [STOVE], "episodes": 2}
        (tmp_path / name / "card.json").write_text(json.dumps({"protocol": protocol, "policy": told}))
    levels = ["--coarse", "shuffled", "--intermediate", "normal", "--fine", "normal"]
    for words, said in (
        (["oracle", "oracle", "--oracle", "plain"], "oracle is of oracle_memory=True"),
        (["oracle", "plain", "--oracle", "plain"], "plain is of oracle_memory=False"),
        (["shuffled", "shuffled", "normal"], "shuffled is of shuffle_subgoals=True"),
        (["shuffled", "normal", "normal"], "normal is of shuffle_subgoals=False"),
        (["granularity", *levels], "shuffled is of subgoal_level=fine"),
    ):
        placed = [words[0], *(str(tmp_path / word) if word.isalpha() else word for word in words[1:])]
        assert main(["controls", *placed]) == 2, words
        assert said in " ".join(capsys.readouterr().err.split())
    assert main(["controls", "shuffled", str(tmp_path / "normal"), str(tmp_path / "shuffled")]) == 0


def test_oracle_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    standard = folder(tmp_path / "standard", rollouts([1, 1, 0, 0]))
    oracle = folder(tmp_path / "oracle", rollouts([3, 1, 1, 0, 2]))
    out = tmp_path / "out"
    assert main(["controls", "oracle", standard, "--oracle", oracle, "--with", "paper", "--out", str(out)]) == 0
    written = json.loads((out / "oracle.json").read_text())
    assert written["5"]["temporal"]["MSR"]["closed"]["value"] == 50.0
    assert written["paper"]["average"]["MUR"]["closed"]["value"] == 45.5
    assert "1 rollout without a partner left out" in written["notes"][0]
    shown = capsys.readouterr().out
    assert "13.5/52.9" in shown
    assert "13.5/52.9" in (out / "oracle.md").read_text()


def test_shuffled_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    normal = folder(tmp_path / "normal", rollouts([3, 2, 1, 0]))
    shuffled = folder(tmp_path / "shuffled", rollouts([1, 1, 1, 0]))
    assert main(["controls", "shuffled", normal, shuffled, "--with", "paper", "--out", str(tmp_path)]) == 0
    (curve,) = json.loads((tmp_path / "shuffled.json").read_text())["5"]
    assert curve["normal"] == [75.0, 50.0, 25.0, 25.0]
    assert curve["other"] == [75.0, 0.0, 0.0, 0.0]
    assert "76.0" in capsys.readouterr().out, "the paper's first prefix"


def test_granularity_command(tmp_path: Path) -> None:
    levels = {}
    for level, reached in (("coarse", [3, 3, 0]), ("intermediate", [2, 2, 2]), ("fine", [2, 0, 0])):
        levels[level] = folder(tmp_path / level, rollouts(reached, operations="SUC", task=DRAWERS))
    arguments = [word for level, path in levels.items() for word in (f"--{level}", path)]
    assert main(["controls", "granularity", *arguments, "--with", "paper", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "granularity.json").read_text())
    # The third checkpoint is a Compression, but an Update in the labels of the fine level.
    assert written["coarse"]["average"] == {"SR": 66.7, "MSR": 66.7, "MUR": 66.7, "MCR": 66.7}
    assert written["intermediate"]["average"] == {"SR": 0.0, "MSR": 100.0, "MUR": 100.0, "MCR": 0.0}
    assert written["intermediate"]["own_labels"] == written["intermediate"]["average"]
    assert written["fine"]["average"] == {"SR": 0.0, "MSR": 33.3, "MUR": 33.3, "MCR": 0.0}
    assert written["fine"]["own_labels"] == {"SR": 0.0, "MSR": 33.3, "MUR": 16.7, "MCR": None}
    assert "paper" in (tmp_path / "granularity.md").read_text()


def test_levels_at_different_replan_intervals_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = []
    for level, replan in (("coarse", 5), ("intermediate", 5), ("fine", 20)):
        words += [f"--{level}", folder(tmp_path / level, rollouts([1], replan_steps=replan))]
    assert main(["controls", "granularity", *words]) == 2
    assert "fine 20" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"replan_steps": 50}, "no replan interval in common"), ({"referent": "random"}, "different protocols")],
)
def test_unlike_evaluations_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], said: str
) -> None:
    a = folder(tmp_path / "a", rollouts([1, 2]))
    b = folder(tmp_path / "b", rollouts([1, 2], **changes))
    assert main(["controls", "oracle", a, "--oracle", b]) == 2
    assert said in capsys.readouterr().err
