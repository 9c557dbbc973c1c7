"""The sealed test: every start of a policy on the sealed seeds is counted once, by the policy that ran it."""

from __future__ import annotations

import datetime as dt
import json
import shutil
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.datasets.generation import generate
from lerobot_memobench.envs.episode import Episode, generator, referent_of
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.protocol import SPLITS
from lerobot_memobench.run.card import card_of, extended
from lerobot_memobench.run.plan import EvaluationPlan, plan_line
from lerobot_memobench.run.rerun import plan_of_card, settings_on
from lerobot_memobench.run.sealed import counted, scenes_hash, user_ledger
from lerobot_memobench.run.shards import plan_shards
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.fake_loop import STOVE, FakeLoop, make_checkpoint

BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
COMMAND = ["test-sealed", "policy=memobench_random", f"tasks={STOVE}", "episodes=2"]
SEALED = ["env=memobench", *COMMAND[1:], "split=sealed"]
SHARDS = ["output_dir=b", "shards=2", "batch_size=1"]


@pytest.fixture(autouse=True)
def in_folder(fake_loop: FakeLoop) -> None:
    """An empty folder and ledger."""


def begun(plan: EvaluationPlan) -> dict[str, Any]:
    """The card of an evaluation that begins, as it is written."""
    return counted(plan, card_of(plan), print)


def numbers(*plans: EvaluationPlan) -> list[int]:
    return [begun(plan)["sealed"]["run"] for plan in plans]


def number(folder: str) -> int:
    found: int = json.loads(Path(folder, "evaluation.json").read_text())["sealed"]["run"]
    return found


def starts() -> int:
    return user_ledger().read_text().count('"started"') if user_ledger().exists() else 0


def test_each_start_is_counted_once(
    fake_loop: FakeLoop, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_weights(*asked: object) -> None:
        raise MemobenchError("the weights cannot be loaded")

    with monkeypatch.context() as patch:
        patch.setattr("lerobot_memobench.run.run.evaluate", no_weights)
        assert main([*COMMAND, "output_dir=a"]) == 2
    assert (starts(), Path("a").exists()) == (0, False), "no scene was shown"
    fake_loop.killed_after(1, "eval", *SEALED, "output_dir=a")
    for _ in range(2):  # the second time all is done
        assert main([*COMMAND, "output_dir=a", "resume=true"]) == 0
    assert (starts(), number("a")) == (1, 1)
    assert "sealed, run 1 of this policy" in headline(read_runs([Path("a")]))
    shutil.rmtree("a/episodes")
    Path("a/episodes.jsonl").unlink()
    capsys.readouterr()
    assert main([*COMMAND, "output_dir=a"]) == 0
    assert (starts(), number("a")) == (2, 2)
    assert "run 2 of this policy" in capsys.readouterr().err
    assert main([*COMMAND, "output_dir=b", "policy.seed=7"]) == 0  # another policy
    assert (starts(), number("b")) == (3, 1)
    assert main(["report", "b"]) == 0
    user_ledger().write_text(user_ledger().read_text() + '{"run": \nnot JSON\n{"policy": 7}\n{"started": "2026')
    assert main([*COMMAND, "output_dir=c"]) == 0  # a damaged ledger is read as far as possible
    assert number("c") == 3
    assert main(["rerun", "c", "--out", "again"]) == 0
    assert number("again") == 4


def test_other_scenes_are_another_start() -> None:
    card = begun(plan_line([*SEALED, "output_dir=a", "replan=5"]))
    assert card["sealed"]["scenes"] == scenes_hash(card)
    committed = {key: card["sealed"][key] for key in ("policy", "scenes", "started")}
    assert json.loads(user_ledger().read_text()).items() >= committed.items()
    wider = plan_line([*SEALED, "output_dir=a", "episodes=3"])
    found = counted(wider, extended(card, card_of(wider)), print)["sealed"]
    assert (found["run"], [start["suite"] for start in found["earlier"]]) == (2, ["published"])
    other = card_of(plan_line([*SEALED, "output_dir=a", "referent=random"]))
    assert scenes_hash(other) != card["sealed"]["scenes"]
    plain = plan_line(["env=memobench", "policy=memobench_random", "output_dir=a"])
    assert "sealed" not in begun(plain)


def test_the_parts_of_one_evaluation_are_one_start() -> None:
    whole = plan_line([*SEALED, "output_dir=a", "shards=2", "batch_size=1"])
    parts = [plan_line(job.arguments[1:]) for job in plan_shards(whole, (), print)]
    assert numbers(*parts) == [1, 1]
    assert numbers(*parts) == [2, 2], "a part that runs again is another start"
    assert numbers(plan_line([*SEALED, "output_dir=b"]), parts[0], parts[1]) == [3, 4, 4]


@pytest.mark.parametrize("clock", ["set back", "at rest"])
def test_the_clock_does_not_matter(clock: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Starts are counted in the order of the ledger, whatever their times."""
    times = iter(range(2030, 2000, -1) if clock == "set back" else [2030] * 30)

    class Clock(dt.datetime):
        @classmethod
        def now(cls, tz: dt.tzinfo | None = None) -> dt.datetime:
            return dt.datetime(next(times), 1, 1, tzinfo=tz)

    monkeypatch.setattr("lerobot_memobench.run.sealed.dt.datetime", Clock)
    plan = plan_line([*SEALED, "output_dir=a"])
    first, second, third = (begun(plan)["sealed"] for _ in range(3))
    assert [start["run"] for start in (first, second, third)] == [1, 2, 3]
    assert [start["started"] for start in third["earlier"]] == [first["started"], second["started"]]
    parts = [plan_line(job.arguments[1:]) for job in plan_shards(plan_line([*SEALED, *SHARDS]), (), print)]
    assert numbers(*parts, *parts, plan) == [4, 4, 5, 5, 6]


def test_a_checkpoint_is_known_by_its_files() -> None:
    folder = make_checkpoint(Path("checkpoint"))
    line = [*SEALED, f"policy={folder}"]
    assert numbers(plan_line([*line, "output_dir=a"]), plan_line([*line, "output_dir=b"])) == [1, 2]
    (folder / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes() + b" ")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"seed": 3}))
    assert numbers(plan_line([*line, "output_dir=c"])) == [1]


def test_a_ledger_that_cannot_be_written_ends_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(Path("file").absolute()))
    assert main([*COMMAND, "output_dir=a"]) == 2
    assert "XDG_STATE_HOME" in capsys.readouterr().err
    assert not Path("a").exists()


def test_a_sealed_card_is_repeated_as_another_run() -> None:
    card = begun(plan_line([*SEALED, "output_dir=a"]))
    card["asked"] = settings_on(card)
    plan = plan_of_card(card, Path("b"))
    assert (plan.split, numbers(plan)) == ("sealed", [2])
    with pytest.raises(MemobenchError, match="test-sealed"):
        plan_of_card({key: value for key, value in card.items() if key != "sealed"}, Path("c"))


@pytest.mark.parametrize(
    ("asked", "split"),
    [
        ({"episodes": 10, "seed_base": 100_050}, "sealed"),
        ({"episodes": 1, "seed_base": 99_999, "prompted_episodes": 9}, "sealed"),
        ({"episodes": 8, "seed_base": 0}, "paper"),
        ({"episodes": 1, "prompted_episodes": 10_050}, "validation"),
        ({"episodes": 1, "seed_base": 29_999}, "validation"),
    ],
)
def test_demonstrations_have_no_scene_of_an_evaluation(tmp_path: Path, asked: dict[str, int], split: str) -> None:
    """The largest number of episodes of any task counts, here of one without and of one with a prompt."""
    with pytest.raises(MemobenchError, match=f"'{split}'"):
        generate([get_task(STOVE), get_task(BUTTER)], out=tmp_path / "data", **asked)
    assert not (tmp_path / "data").exists()


# --- the salt ---

MILK = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
SALTED = ["env=memobench", "policy=memobench_random", "split=sealed", "suite=strict", f"tasks={MILK}", "batch_size=1"]
SALT = "00000000000000000000000000000012"


def salt_of(*words: str) -> str | None:
    return plan_line([*SALTED, *words]).environment.salt


def test_each_sealed_evaluation_draws_a_salt() -> None:
    """Variants and holds of one salt cannot be known before; scenes are those of the seed."""
    first, second = salt_of(), salt_of()
    assert first is not None
    assert first != second
    assert salt_of(f"salt={SALT}") == SALT, "digits are no number"
    public = ["env=memobench", "policy=memobench_random", "suite=strict"]
    assert plan_line(public).environment.salt is None
    with pytest.raises(MemobenchError, match="salt=, which is of the sealed test"):
        plan_line([*public, f"salt={SALT}"])
    with pytest.raises(MemobenchError, match="expected 32 hexadecimal digits"):
        plan_line([*SALTED, "salt=12"])


def test_salt_changes_variants_and_holds_only() -> None:
    task, salts = get_task(MILK), (None, "0" * 32, SALT)
    drawn = {salt: [referent_of(task, seed, salt).variant_index for seed in SPLITS["sealed"]] for salt in salts}
    assert len({tuple(variants) for variants in drawn.values()}) == 3
    assert {tuple(sorted(variants)) for variants in drawn.values()} == {(0,) * 25 + (1,) * 25}, "still balanced"
    episodes = [Episode(task, suite="strict", demonstration_prompt=False, salt=salt) for salt in salts]
    for episode in episodes:
        episode.reset(100_007)
    assert len({episode.scene_hash for episode in episodes}) == 1
    assert len({tuple(episode.draw_holds()) for episode in episodes}) == 3


def test_draws_without_a_salt_are_those_of_earlier_versions() -> None:
    task = get_task("find_the_artichoke_or_the_chestnut_hidden_in_two_of_the_drawers")
    seed = [7, zlib.crc32(task.name.encode())]
    assert referent_of(task, 7).variant_index == np.random.default_rng([*seed, 1]).permutation(task.random_variants)[0]
    assert generator(task, 7, 5).random() == np.random.default_rng([*seed, 5]).random()


def card_in(folder: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path(folder, "evaluation.json").read_text())
    return found


def test_resumed_and_repeated_runs_keep_the_salt(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    fake_loop.killed_after(1, "eval", *SEALED, "output_dir=a")
    salt = card_in("a")["protocol"]["salt"]
    assert main([*COMMAND, "output_dir=a", "resume=true"]) == 0
    assert {each["salt"] for each in card_in("a")["episodes"]} == {salt} == {card_in("a")["protocol"]["salt"]}
    assert f"salt {salt}" in headline(read_runs([Path("a")]))
    assert main(["rerun", "a", "--out", "again"]) == 0
    assert card_in("again")["protocol"]["salt"] == salt
    capsys.readouterr()
    assert main([*COMMAND, f"salt={SALT}", "output_dir=a", "resume=true"]) == 2
    assert f"salt: {salt} and {SALT}" in capsys.readouterr().err
    assert main([*COMMAND, "shard=1/2", "output_dir=b"]) == 2
    assert "shard=1/2 of a sealed test without salt=" in capsys.readouterr().err
    card = begun(plan_line([*SEALED, "output_dir=c"]))
    for earlier in (card["protocol"], card["settings"]["env"]):
        del earlier["salt"]
    card["asked"] = settings_on(card)
    assert plan_of_card(card, Path("d")).environment.salt is None, "an earlier version drew without a salt"


def test_parts_share_the_salt_and_merge(fake_loop: FakeLoop) -> None:
    whole = plan_line([*SEALED, *SHARDS])
    for job in plan_shards(whole, (), print)[:1]:
        assert lerobot(job.arguments) == 0
    resumed = plan_line([*SEALED, *SHARDS, "resume=true"])
    assert resumed.environment.salt == whole.environment.salt
    for job in plan_shards(resumed, (), print):
        assert lerobot(job.arguments) == 0
    assert main(["merge", "b"]) == 0
    assert card_in("b")["protocol"]["salt"] == whole.environment.salt
    assert {each["salt"] for each in card_in("b")["episodes"]} == {whole.environment.salt}
