"""The strategies of the limits solve a scene each, and their table states the ceiling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.tasks.catalogue import get_task, task_names
from research.necessity.adversaries import NEAR, Seat, directions
from research.necessity.limits import CUT, EVENTS_BY_INDEX, LIMITS, PLAN, _present_plan, applies, limits, rollout

ORDERING = "turn_the_stove_on_and_off_once_then_put_the_frying_pan_on_it"


def test_the_phase_of_plans_counts_the_cut_plans() -> None:
    episode = Episode(get_task(ORDERING))
    episode.reset(20_000)
    seat = Seat(episode, Expert(episode.task, episode.sim, np.random.default_rng(0)), np.random.default_rng(0))
    home = np.zeros(3)
    for events in CUT:
        seat.frames.extend([home] * (PLAN - len(seat.frames) % PLAN) if events == 1 else [])
        while _present_plan(seat)[0] != seat.elapsed:  # stand near home when a plan begins
            seat.frames.append(home)
        seat.frames[-1] = NEAR * directions()[events - 1]
        seat.frames.extend([home] * (2 * PLAN))
        while (seat.elapsed % PLAN) != 0:  # a hold ends at a multiple of the declared plan
            seat.frames.append(home)
        assert EVENTS_BY_INDEX[seat.elapsed - _present_plan(seat)[0]] == events


def test_each_strategy_applies_to_temporal_tasks_alone() -> None:
    found = {
        name: sum(applies(name, get_task(task)) for task in task_names("temporal", suite="strict")) for name in LIMITS
    }
    assert list(found.values()) == [10, 10, 5, 4]


def test_a_table_of_public_holds_replaces_a_memory() -> None:
    assert rollout(ORDERING, "a clock, public holds", 20_001)["success"]


@pytest.mark.slow
def test_the_table_states_the_ceiling(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    limits(tmp_path, scenes=1)
    assert "| phase of plans | ordering | 25.0 |" in capsys.readouterr().out
