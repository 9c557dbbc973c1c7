"""Difficulties of strict tasks: variants and horizon; the standard one is the suite as published."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_memobench.constants import ACTION_DIM
from lerobot_memobench.envs.episode import Episode, referent_of
from lerobot_memobench.envs.episode_log import episode_record, read_log, write_episodes
from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import protocol_phrases, read_runs
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import DIFFICULTIES, STANDARD, STRICT, Difficulty
from tests.support.logs import facts
from tools.board.check import first_variant_mismatch

STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"


@pytest.mark.parametrize(("difficulty", "most"), list(zip(DIFFICULTIES, (2, 3, 5, 8), strict=True)))
def test_a_difficulty_draws_all_counts_up_to_its_own(difficulty: Difficulty, most: int) -> None:
    task = get_task(STOVE).at(difficulty)
    drawn = Counter(referent_of(task, seed).language for seed in range(20_000, 20_000 + 3 * most))
    words = ("once", "twice", *(f"{word} times" for word in ["three", "four", "five", "six", "seven", "eight"]))
    asked = {f"turn the stove on and off {times}, leaving everything as it was": 3 for times in words[:most]}
    assert drawn == asked


@pytest.mark.parametrize(("difficulty", "horizon", "cut"), [("hard", 2000, False), ("hard", 1500, True)])
def test_a_horizon_below_that_of_the_difficulty_cuts_off(difficulty: str, horizon: int, cut: bool) -> None:
    settings = EnvSettings(suite=STRICT, difficulty=difficulty, horizon=horizon)
    ended = SimpleNamespace(settings=settings, exec_steps=horizon, _limit=horizon, success=False, lost=False)
    assert Episode.cut_off.fget(ended) == cut  # type: ignore[attr-defined]


def test_only_counting_tasks_have_harder_variants() -> None:
    for name in task_names(suite=STRICT):
        drawn = {len(get_task(name).at(difficulty).random_variants) for difficulty in DIFFICULTIES}
        assert (len(drawn) > 1) == (get_task(name).family == "counting")


@pytest.mark.parametrize(("difficulty", "horizon"), [("easy", 1200), ("standard", 1200), ("extreme", 3200)])
def test_a_difficulty_sets_the_horizon(difficulty: str, horizon: int) -> None:
    settings = EnvSettings(suite=STRICT, difficulty=difficulty)
    assert settings.horizon == horizon
    assert EnvSettings(suite=STRICT, difficulty=difficulty, horizon=700).horizon == 700
    assert settings.changed(difficulty="hard").horizon == 2000


def test_the_expert_counts_to_eight() -> None:
    episode = Episode(get_task(STOVE).at("extreme"), EnvSettings(suite=STRICT, difficulty="extreme"))
    episode.reset(20_000, variant=7)
    while not episode.done:
        episode.step(episode.expert_action())
    assert (episode.success, episode.progress.index) == (True, 4)
    assert episode.exec_steps > 1200


def test_a_difficulty_is_for_strict_tasks_and_known() -> None:
    with pytest.raises(MemobenchError, match="difficulty=hard is for strict tasks; set suite=strict"):
        EnvSettings(difficulty="hard")
    with pytest.raises(MemobenchError, match="easy"):
        EnvSettings(suite=STRICT, difficulty="esay")


def test_a_log_of_a_difficulty_is_checked_and_described_as_such(tmp_path: Path) -> None:
    settings = EnvSettings(suite=STRICT, difficulty="hard", horizon=2)
    episode = Episode(get_task(STOVE), settings)
    lines = []
    for number in range(5):
        episode.reset(20_000 + number)
        while not episode.done:
            episode.step(np.zeros(ACTION_DIM))
        lines.append(episode_record(episode, number, 0.1))
    assert max(line["variant"] for line in lines) > 2
    write_evaluation(tmp_path, facts(settings.protocol_block | {"seed_base": 20_000}))
    write_episodes(tmp_path, lines)
    records = read_log(tmp_path)
    assert first_variant_mismatch(records) is None
    assert "variant" in str(first_variant_mismatch([record | {"difficulty": STANDARD} for record in records]))
    (run,) = read_runs([tmp_path])
    assert "difficulty hard" in protocol_phrases(run)
