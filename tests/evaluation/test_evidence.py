"""Evidence rates against logs made by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.evaluation.comparison import compare_evaluations
from lerobot_memobench.evaluation.evidence import evidence_of
from lerobot_memobench.evaluation.html import facts
from lerobot_memobench.evaluation.metrics import summary_of
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.logs import rollout, write_log

Policy = Callable[[int, int], int | None]
"""Scene and variant -> choice."""


def rollouts(
    task: str, memory_type: str, policy: Policy, scenes: int = 10, variants: int = 3, chance: float | None = 1 / 3
) -> list[dict[str, Any]]:
    found = []
    for episode in range(scenes * variants):
        scene, variant = divmod(episode, variants)
        choice = policy(scene, variant)
        fields = {"seed": 7 + scene, "variant": variant, "choice": choice, "variants": variants, "chance": chance}
        right = choice == variant
        found.append(rollout(task, memory_type, "SC", [True, right], right, episode, referent="drawn", **fields))
    return found


def remembers(scene: int, variant: int) -> int:
    return variant


def stubborn(scene: int, variant: int) -> int:
    """Choose by the scene, without the prompt."""
    return scene % 3


def hesitant(scene: int, variant: int) -> int | None:
    return variant if scene % 2 else None


def test_who_ignores_the_past_is_exactly_at_chance() -> None:
    found = evidence_of(rollouts("bowl", "object", stubborn))
    rate, notes = found.tasks["bowl"], found.notes
    assert (rate.scenes, rate.variants, rate.chance) == (10, 3, pytest.approx(1 / 3))
    assert rate.rates["follows"].value == pytest.approx(1 / 3)
    assert len(notes) == 1
    assert "10 effective scenes" in notes[0]
    assert rate.p > 0.5
    low, high = rate.rates["follows"].low, rate.rates["follows"].high
    assert low < 0.15
    assert high > 0.6, "ten scenes are few, even where all agree"


def test_answers_are_right_wrong_or_missing_and_pairs_are_reliable() -> None:
    records = rollouts("bowl", "object", remembers, scenes=12)
    for record in records[:3]:  # a scene: none given, one of no variant, one right
        record["choice"] = record["variant"] if record["variant"] == 2 else None
        record["answered"] = record["variant"] != 0
    found = evidence_of(records).tasks["bowl"]
    rates = {name: rate.value for name, rate in found.rates.items()}
    assert rates["undecided"] == rates["wrong"] == pytest.approx(1 / 36)
    assert rates["follows"] == pytest.approx(34 / 36)
    assert rates["right"] == pytest.approx(34 / 35)
    assert rates["reliable"] == pytest.approx(11 / 12)
    assert found.p < 0.001


def test_answers_are_exchanged_among_variants_of_one_instruction() -> None:
    """Of two hidden things a policy that opens the top drawer is right at chance, and no better by permutation."""
    name = "find_the_tomato_or_the_biscuit_hidden_in_two_of_the_drawers"
    task = get_task(name)
    variants = [task.variant(k) for k in task.random_variants]

    def top(scene: int, variant: int) -> int:
        asked = variants[variant]
        same = [
            one.variant_index for one in variants if one.language == asked.language and "top" in str(one.checkpoints[0])
        ]
        return variant if variant in same else same[0]

    found = evidence_of(rollouts(name, "spatial", top, scenes=6, variants=12)).tasks[name]
    assert found.rates["follows"].value == pytest.approx(1 / 3)
    assert found.p == 1.0


def test_an_average_is_of_memory_types_and_without_tasks_whose_instruction_tells() -> None:
    records = [
        *rollouts("bowl", "object", remembers),
        *rollouts("milk", "object", stubborn, variants=2, chance=1 / 2, scenes=9),
        *rollouts("drawer", "spatial", hesitant),
        *rollouts("count", "temporal", stubborn, chance=None),
    ]
    found = evidence_of(records)
    assert set(found.memory_types) == {"object", "spatial"}
    milk = found.tasks["milk"].rates["follows"].value
    assert milk == pytest.approx(6 / 18)  # of three answers, the third is none of the two that may be right
    spatial = found.tasks["drawer"].rates
    assert (spatial["follows"].value, spatial["undecided"].value, spatial["right"].value) == (0.5, 0.5, 1.0)
    average = found.average
    assert average.rates["follows"].value == pytest.approx(((1 + 6 / 18) / 2 + 0.5) / 2)
    assert average.rates["right"].value == pytest.approx(((1 + 6 / 18) / 2 + 0.5) / 1.5), "half of one type is decided"
    assert average.chance == pytest.approx(((1 / 3 + 1 / 2) / 2 + 1 / 3) / 2)
    assert average.scenes == 29


def test_scenes_that_were_not_run_with_every_variant_are_left_out() -> None:
    found = evidence_of(rollouts("bowl", "object", remembers)[:-1])
    assert found.tasks["bowl"].scenes == 9
    assert found.notes[0].startswith("2 rollouts of scenes")
    found = evidence_of(rollouts("bowl", "object", remembers) + rollouts("milk", "object", remembers, 1)[:-1])
    assert set(found.tasks) == {"bowl"}
    assert found.notes[0].endswith("no rate of milk")


def test_intervals_of_all_rates_are_over_scenes(tmp_path: Path) -> None:
    """Ten scenes whose three variants end alike are no thirty independent rollouts; the rate itself is the same."""
    plain = [rollout("bowl", "object", "SC", [True, k < 15], k < 15, k) for k in range(30)]
    alike = rollouts("bowl", "object", lambda scene, variant: variant if scene < 5 else None)
    rate, independent = (summary_of(records).average["SR"] for records in (alike, plain))
    assert (rate.value, rate.n, rate.trials, independent.trials) == (0.5, 30, 10, 30)
    widths = []
    for records in (alike, plain):
        none = [{**record, "success": False, "failure": "storage_failure"} for record in records]
        for name, lines in (("a", none), ("b", records)):
            write_log(tmp_path / f"{name}{len(widths)}", lines)
        first, second = read_runs([tmp_path / f"{name}{len(widths)}" for name in "ab"])
        low, high = compare_evaluations(first, second, permutations=10).contrasts[0].interval
        widths.append(high - low)
    assert widths[0] > 1.4 * widths[1], "by about the square root of three"


def evaluation(folder: Path, policy: Policy) -> str:
    records = rollouts("bowl", "object", policy) + rollouts("count", "temporal", policy, chance=None)
    return str(write_log(folder, records))


def test_the_rate_joins_every_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = evaluation(tmp_path / "run", stubborn)
    assert main(["report", folder]) == 0
    assert "each scene with each variant" in " ".join(capsys.readouterr().out.split())
    written = json.loads((tmp_path / "run" / "report.json").read_text())["evidence"]
    assert written["average"]["follows"]["percent"] == written["average"]["chance"] == 33.3
    assert written["tasks"]["bowl"]["right"]["percent"] == 33.3
    assert written["tasks"]["count"]["chance"] is None
    assert written["tasks"]["bowl"]["choices"]["1"] == {"0": 4, "1": 3, "2": 3}
    assert "## Evidence" in (tmp_path / "run" / "report.md").read_text()
    assert "follows the evidence 33.3 %, chance 33.3 %" in facts(read_runs([folder])[0])
