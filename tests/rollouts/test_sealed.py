"""The sealed test: its scenes are in no dataset, and each evaluation draws a salt."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.constants import SPLITS
from lerobot_memobench.datasets.generate import generate
from lerobot_memobench.envs.episode import Episode, generator, referent_of
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import headline, read_runs
from lerobot_memobench.rollouts.card import card_of
from lerobot_memobench.rollouts.plan import card_settings, plan_line
from lerobot_memobench.rollouts.rerun import plan_of_evaluation
from lerobot_memobench.rollouts.shards import plan_shards
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.fake_loop import STOVE, FakeLoop

BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
COMMAND = ["test-sealed", "policy=memobench_random", f"tasks={STOVE}", "episodes=2"]
SEALED = ["env=memobench", *COMMAND[1:], "split=sealed"]
SHARDS = ["output_dir=b", "shards=2", "batch_size=1"]


@pytest.fixture(autouse=True)
def in_folder(fake_loop: FakeLoop) -> None:
    """An empty folder."""


def card_in(folder: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path(folder, "evaluation.json").read_text())
    return found


@pytest.mark.parametrize(
    ("asked", "split"),
    [
        ({"episodes": 10, "seed_base": 100_050}, "sealed"),
        ({"episodes": 1, "seed_base": 99_999, "prompted_episodes": 9}, "sealed"),
        ({"episodes": 8, "seed_base": 0}, "paper"),
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


def test_resumed_and_repeated_runs_keep_the_salt(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    fake_loop.killed_after(1, "eval", *SEALED, "output_dir=a")
    salt = card_in("a")["protocol"]["salt"]
    assert main([*COMMAND, "output_dir=a", "resume=true"]) == 0
    assert {each["salt"] for each in read_runs([Path("a")])[0].records} == {salt} == {card_in("a")["protocol"]["salt"]}
    assert all(text in headline(read_runs([Path("a")])) for text in ("(sealed)", f"salt {salt}"))
    assert main(["rerun", "a", "--out", "again"]) == 0
    assert card_in("again")["protocol"]["salt"] == salt
    capsys.readouterr()
    assert main([*COMMAND, f"salt={SALT}", "output_dir=a", "resume=true"]) == 2
    assert f"salt: {salt} and {SALT}" in capsys.readouterr().err
    assert main([*COMMAND, "shard=1/2", "output_dir=b"]) == 2
    assert "shard=1/2 of a sealed test without salt=" in capsys.readouterr().err
    card = card_of(plan_line([*SEALED, "output_dir=c"]))
    assert plan_of_evaluation(card, card_settings(card), Path("d")).split == "sealed"
    del card["protocol"]["salt"]
    with pytest.raises(MemobenchError, match="test-sealed"):
        plan_of_evaluation(card, card_settings(card), Path("d"))


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
