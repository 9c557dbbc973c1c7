"""A clock is found where there is one, and chance where there is none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_memobench.datasets.lerobot_format.reading import RecordedEpisode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import HORIZON, IDLE_STEPS
from lerobot_memobench.tasks.catalogue import get_task, task_names
from research.clock import decisions as decisions_module
from research.clock.decisions import CONTINUE, STOP, Decision, chance, decisions

STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"
ORDER = "check_all_three_drawers_once_each_in_the_given_order"
FIND = "find_the_tomato_or_the_biscuit_hidden_in_two_of_the_drawers"
MILK = "put_only_the_milk_pointed_out_in_the_prompt_video_on_the_plate"
START = 30


def recorded(name: str, variant: int, home: list[int], end: int = 300) -> RecordedEpisode:
    """Return a demonstration whose hand is home before and at ``START``, and at some frames later for three frames."""
    arm = np.tile(np.arange(end + 10, dtype=np.float32)[:, None], 8) + 1
    for frame in (range(START + 1), *(range(START + step, START + step + 3) for step in home)):
        arm[list(frame)] = 0
    columns = {
        "observation.state": arm,
        "observation.environment_state": np.zeros((end + 10, 208), np.float32),
        "observation.step": np.arange(end + 10, dtype=np.float32),
    }
    return RecordedEpisode(name, variant, 20_000, "drawn", START, columns, {"key_frames": [START, end]})


@pytest.mark.parametrize(
    ("name", "variant", "home", "answers"),
    [
        (STOVE, 0, [100], [CONTINUE, STOP]),
        (STOVE, 2, [50, 100, 150], [CONTINUE, CONTINUE, CONTINUE, STOP]),
        (ORDER, 4, [50, 100], ["0", "1", "2"]),
    ],
)
def test_decisions_are_taken_whenever_the_hand_has_come_home(
    name: str, variant: int, home: list[int], answers: list[str]
) -> None:
    found = decisions(recorded(name, variant, home), 3)
    assert [one.answer for one in found] == answers
    assert [one.step for one in found] == [0, *home]
    assert {one.episode for one in found} == {3}
    assert len({one.present[-1] for one in found}) == 1, "the instruction is known"


@pytest.mark.parametrize("name", [FIND, MILK])
def test_a_prompt_is_asked_for_at_the_first_frame(name: str) -> None:
    task = get_task(name)
    found = [one for k in task.random_variants for one in decisions(recorded(name, k, [40]), k)]
    assert [one.step for one in found] == [0] * task.num_variants
    assert len({(one.answer, one.present[-1]) for one in found}) == {FIND: 6, MILK: 2}[name]


def test_chance_is_that_of_the_draw() -> None:
    three = [Decision(0, 0, np.zeros(1), str(done)) for done in range(3)]
    found = {name: chance(get_task(name), three) for name in (STOVE, ORDER, FIND, MILK)}
    assert found == pytest.approx({STOVE: 6 / 9, ORDER: 1 / 3, FIND: 1 / 3, MILK: 1 / 2})
    assert all(0 < chance(get_task(name), three) <= 2 / 3 for name in task_names(suite="strict"))


def counted(episodes: int) -> list[Decision]:
    """Return decisions of two events that take 200 to 300 steps each, where the present tells nothing."""
    rng, found = np.random.default_rng(0), []
    for episode in range(episodes):
        steps = np.cumsum([0, *rng.integers(200, 300, 2)])
        scene = rng.random(4)
        for step, answer in zip(steps, (CONTINUE, CONTINUE, STOP), strict=True):
            found.append(Decision(episode, int(step), np.array([*scene, 1], np.float32), answer))
    return found


def test_a_clock_is_found_and_idling_takes_it_away(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sklearn", reason="the environment is older than requirements.lock: make setup")
    from research.clock import study as module

    monkeypatch.setattr(module, "read_decisions", lambda folder: {STOVE: counted(30)})
    (found,) = module.study(Path("nowhere"), [0, IDLE_STEPS, 100 * HORIZON])
    assert (found["demonstrations"], found["decisions"]) == (30, 90)
    assert found["right"][module.STEP][0] > 0.95
    assert found["right"][module.PRESENT][0] > 0.95
    assert found["right"][module.STEP][IDLE_STEPS] < 0.85
    assert abs(found["right"][module.STEP][100 * HORIZON] - 2 / 3) < 0.08
    # The last of three decisions is taken some 500 steps after the first, the earliest of the others 250 after it.
    assert found["right"][module.BOUND][0] > 0.95
    assert (
        found["right"][module.STEP][IDLE_STEPS] - 0.02
        < found["right"][module.BOUND][IDLE_STEPS]
        < 2 / 3 + 500 / IDLE_STEPS / 3
    )
    assert found["right"][module.BOUND][100 * HORIZON] == pytest.approx(2 / 3, abs=0.005)
    assert abs(found["right"][module.PRESENT][100 * HORIZON] - 2 / 3) < 0.12
    table = module.markdown([found])
    assert f"| counting: `{STOVE}` | 30 | 90 | 67 | 100 |" in table
    assert "points above chance in" in table
    monkeypatch.setattr(module, "read_decisions", lambda folder: {STOVE: counted(4)})
    with pytest.raises(MemobenchError, match=r"4 demonstrations of turn_the_stove.*at least 5 are needed"):
        list(module.study(Path("nowhere"), [0]))


def test_a_dataset_without_strict_tasks_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decisions_module, "list_episodes", lambda folder: [])
    with pytest.raises(MemobenchError, match="no demonstrations of strict tasks; generate some: --suite strict"):
        decisions_module.read_decisions(Path("folder"))


def test_a_prompt_whose_length_differs_by_variant_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sklearn", reason="the environment is older than requirements.lock: make setup")
    from research.clock import prompts as module

    told = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
    rng = np.random.default_rng(0)

    def shown(episodes: int, apart: int, referent: str = "random") -> list[SimpleNamespace]:
        variants = rng.integers(2, size=episodes)
        return [
            SimpleNamespace(
                record=SimpleNamespace(
                    task_name=told,
                    referent=referent,
                    variant=int(variant),
                    exec_start_index=int(100 + apart * variant + rng.integers(10)),
                )
            )
            for variant in variants
        ]

    def measured(places: list[SimpleNamespace]) -> list[module.PromptLengths]:
        monkeypatch.setattr(module, "list_episodes", lambda folder: places)
        return list(module.prompt_lengths(Path("folder")))

    (apart,) = measured(shown(60, 40))
    (alike,) = measured(shown(600, 0))
    assert (apart.demonstrations, apart.variants, apart.chance, apart.right) == (60, 2, 0.5, 1.0)
    assert abs(alike.right - 0.5) < 0.08
    assert f"| `{told}` | 60 | 2 | {apart.shortest}–{apart.longest} | 50 | 100 |" in module.prompts_table([apart])
    with pytest.raises(MemobenchError, match=r"4 demonstrations of put_the_milk.*at least 5 are needed"):
        measured(shown(4, 40))
    with pytest.raises(MemobenchError, match=r"no prompts that show one of several variants; generate some: --tasks"):
        measured(shown(60, 40, referent="fixed"))
