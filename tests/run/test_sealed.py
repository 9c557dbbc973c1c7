"""The sealed seeds: who may run them, and how often they were."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.datasets.generation import generate
from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.policies.lerobot_config import checkpoint_files
from lerobot_memobench.protocol import SPLITS
from lerobot_memobench.run.card import card_of, extended, write_card
from lerobot_memobench.run.plan import EvaluationPlan, plan_line
from lerobot_memobench.run.rerun import asked_of, plan_of_card
from lerobot_memobench.run.sealed import counted, scenes_hash, user_ledger
from lerobot_memobench.run.shards import plan_shards
from lerobot_memobench.tasks.catalogue import get_task
from tests.support import logs

STOVE = "turn_on_the_stove_and_turn_it_off"
BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
LINE = ["env=memobench", f"tasks={STOVE}", "policy=memobench_random", "env.videos=0"]
SEALED = [*LINE, "split=sealed"]


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def begun(plan: EvaluationPlan, told: list[str] | None = None) -> dict[str, Any]:
    """The card of an evaluation that begins, as it is written."""
    return counted(plan, card_of(plan), (told if told is not None else []).append)


@pytest.mark.parametrize("name", ["paper", "validation", "sealed"])
def test_a_split_says_which_scenes_are_run(name: str) -> None:
    plan = plan_line([*LINE, f"split={name}", "episodes=3"])
    assert list(plan.seeds) == list(SPLITS[name][:3])
    assert plan.split == name
    assert plan.environment.seed_base == SPLITS[name].start


def test_scenes_that_are_run_with_each_variant_are_counted_once() -> None:
    line = ["env=memobench", "tasks=put_the_butter_into_the_bowl_from_the_prompt_video", "referent=random"]
    plan = plan_line([*line, "split=sealed", "evidence=true", "episodes=150"])
    assert plan.seeds == SPLITS["sealed"]
    with pytest.raises(MemobenchError, match="100007 to 100057 were asked for"):
        plan_line([*line, "split=sealed", "evidence=true", "episodes=151"])


def test_without_a_split_the_papers_seeds_are_run() -> None:
    assert plan_line(LINE).seeds == SPLITS["paper"] == range(7, 57)
    assert plan_line([*LINE, "seed=500"]).split is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["seed=100007"], "sealed test.*memobench test-sealed.*split=validation"),
        (["seed=99999", "episodes=20"], "seeds 99999 to 100018 reach into the sealed"),
        (["seed=100050", "env.seed_base=7"], "reach into the sealed"),
        (["split=validation", "seed=7"], "split=validation has the seeds 20000 to 29999, and 7 to 56 were asked for"),
        (["split=sealed", "episodes=51"], "at most 50 episodes"),
        (["split=valdation"], "did you mean 'validation'"),
    ],
)
def test_seeds_are_run_under_their_own_name(words: list[str], said: str) -> None:
    with pytest.raises(MemobenchError, match=said):
        plan_line([*LINE, *words])
    assert not user_ledger().exists()


@pytest.mark.parametrize(
    ("asked", "split"),
    [
        ({"episodes": 10, "seed_base": 100_050}, "sealed"),
        ({"episodes": 9, "seed_base": 100_000, "prompted_episodes": 1}, "sealed"),
        ({"episodes": 1, "seed_base": 99_999, "prompted_episodes": 9}, "sealed"),
        ({"episodes": 5, "seed_base": 7}, "paper"),
        ({"episodes": 8, "seed_base": 0}, "paper"),
        ({"episodes": 10_050}, "validation"),
        ({"episodes": 1, "prompted_episodes": 10_050}, "validation"),
        ({"episodes": 1, "seed_base": 29_999}, "validation"),
    ],
)
def test_no_demonstration_has_a_scene_on_which_policies_are_measured(
    tmp_path: Path, asked: dict[str, int], split: str
) -> None:
    """The largest number of episodes of any task counts, here of one without and of one with a prompt."""
    with pytest.raises(MemobenchError, match=f"reach into the split '{split}'"):
        generate([get_task(STOVE), get_task(BUTTER)], out=tmp_path / "data", **asked)
    assert not (tmp_path / "data").exists()


def numbers(*plans: EvaluationPlan) -> list[int]:
    return [begun(plan)["sealed"]["run"] for plan in plans]


def lines() -> list[str]:
    return user_ledger().read_text().splitlines()


def test_each_start_is_counted_and_going_on_is_none() -> None:
    told: list[str] = []
    plan = plan_line([*SEALED, "output_dir=a", "replan=5", "policy.smoothing=0"])
    first = begun(plan, told)
    assert counted(plan, dict(first), told.append)["sealed"] == first["sealed"]  # its card is read back by resume=true
    assert (first["sealed"]["run"], first["sealed"]["earlier"]) == (1, [])
    assert told[0].startswith("sealed test: run 1 of this policy with release ")
    second = begun(plan_line([*SEALED, "output_dir=b", "policy.smoothing=0"]), told)
    assert second["sealed"]["run"] == 2
    assert [start["suite"] for start in second["sealed"]["earlier"]] == ["published"]
    assert "run 2 of this policy" in told[-1]
    assert "the last before it on 2" in told[-1]
    assert begun(plan_line([*SEALED, "output_dir=c", "policy.smoothing=0.5"]))["sealed"]["run"] == 1  # another policy
    assert list(second)[-1] == "episodes"  # the card's writer puts one a line
    assert len(lines()) == 3


def test_neither_a_copied_nor_a_deleted_file_resets_the_count(tmp_path: Path) -> None:
    first = plan_line([*SEALED, "output_dir=a"])
    card = begun(first)
    Path("a").mkdir()
    write_card(Path("a"), card)
    shutil.copytree("a", "c")
    shutil.rmtree("a")
    assert numbers(first, plan_line([*SEALED, "output_dir=c"])) == [2, 3]
    copy = counted(plan_line([*SEALED, "output_dir=d"]), dict(card), print)  # gone on with elsewhere, with a's card
    assert copy["sealed"]["run"] == 4


def test_other_scenes_are_another_start() -> None:
    card = begun(plan_line([*SEALED, "output_dir=a", "episodes=1"]))
    wider = plan_line([*SEALED, "output_dir=a", "episodes=2"])
    assert counted(wider, extended(card, card_of(wider)), print)["sealed"]["run"] == 2


def test_a_card_commits_to_policy_scenes_and_time() -> None:
    card = begun(plan_line([*SEALED, "output_dir=a", "episodes=2"]))
    assert card["sealed"]["scenes"] == scenes_hash(card)
    assert (
        json.loads(lines()[0]).items() >= {key: card["sealed"][key] for key in ("policy", "scenes", "started")}.items()
    )
    other = card_of(plan_line([*SEALED, "output_dir=a", "episodes=2", "referent=random"]))
    assert scenes_hash(other) != card["sealed"]["scenes"]


def test_other_seeds_are_not_counted() -> None:
    assert "sealed" not in begun(plan_line([*LINE, "output_dir=a"]))
    assert not user_ledger().exists()


def test_the_parts_of_one_evaluation_are_one_start_and_a_part_that_runs_again_is_another() -> None:
    whole = plan_line([*SEALED, "output_dir=a", "shards=2", "episodes=2"])
    parts = [plan_line(job.arguments[1:]) for job in plan_shards(whole, (), print)]
    assert numbers(*parts) == [1, 1]
    assert numbers(*parts) == [2, 2]
    assert numbers(plan_line([*SEALED, "output_dir=b"]), parts[0], parts[1]) == [3, 4, 4]


def test_the_count_travels_with_a_checkpoint_and_is_no_part_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "act"
    folder.mkdir()
    features = {"observation.environment_state": {"type": "ENV", "shape": [208]}}
    (folder / "config.json").write_text(json.dumps({"type": "act", "input_features": features}))
    (folder / "model.safetensors").touch()
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).write_text(json.dumps({"steps": []}))
    files, line = checkpoint_files(folder), [f"policy={folder}" if "policy" in word else word for word in SEALED]
    assert numbers(plan_line([*line, "output_dir=a"])) == [1]
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another_user"))
    assert numbers(plan_line([*line, "output_dir=b"])) == [2]
    assert checkpoint_files(folder) == files
    for name in ("notes.txt", "other.json", "other.safetensors"):  # nothing loads them
        (folder / name).write_text("{}")
    assert numbers(plan_line([*line, "output_dir=c"])) == [3]
    steps = [{"registry_name": "to_batch_processor", "state_file": "other.safetensors"}]
    (folder / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    assert numbers(plan_line([*line, "output_dir=d"])) == [1]
    (folder / "other.safetensors").write_text("[]")
    assert numbers(plan_line([*line, "output_dir=e"])) == [1]


def test_a_damaged_ledger_is_read_as_far_as_it_can_be() -> None:
    begun(plan_line([*SEALED, "output_dir=a"]))
    with user_ledger().open("a") as file:
        file.write('{"run": \nnot JSON\n{"policy": 7}\n{"started": "2026')  # the last was cut off
    assert numbers(*(plan_line([*SEALED, f"output_dir={name}"]) for name in "bc")) == [2, 3]


def test_a_report_says_that_its_seeds_are_sealed_and_how_often_they_were_run(tmp_path: Path) -> None:
    plan = plan_line([*SEALED, "output_dir=a", "episodes=2"])
    write_episodes(tmp_path / "a", [logs.record(STOVE, k, seed=100_007 + k) for k in range(2)])
    assert "seeds 100007 to 100008 (sealed), " in headline(read_runs([tmp_path / "a"]))
    write_card(tmp_path / "a", begun(plan))
    assert "seeds 100007 to 100008 (sealed, run 1 of this policy), " in headline(read_runs([tmp_path / "a"]))


def test_a_sealed_card_is_repeated_as_another_run() -> None:
    card = begun(plan_line([*SEALED, "output_dir=a"]))
    card["asked"] = asked_of(card)
    plan = plan_of_card(card, Path("b"))
    assert plan.split == "sealed"
    assert begun(plan)["sealed"]["run"] == 2
    with pytest.raises(MemobenchError, match="sealed test"):
        plan_of_card({key: value for key, value in card.items() if key != "sealed"}, Path("c"))


def test_the_command_is_an_evaluation_of_that_split(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[list[str]] = []
    monkeypatch.setattr("lerobot_memobench.cli.lerobot.run", lambda line: found.append(line))
    assert main(["test-sealed", "policy=memobench_random", "--output_dir=x", "split=paper"]) == 0
    assert found == [
        ["eval", "env=memobench", "policy=memobench_random", "--output_dir=x", "split=paper", "split=sealed"]
    ]
