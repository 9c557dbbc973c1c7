"""Published scenes in which an object is thrown, or still moves, before the first action, and the listed ones."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import pytest

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.episode_log import episode_record
from lerobot_memobench.evaluation.metrics import notes_on
from lerobot_memobench.protocol import PAPER, PUBLISHED_MUJOCO, SPLITS
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.support.libero import simulate

PAGE = Path(__file__).parents[2] / "results" / "unsettled_scenes.md"
LISTED = {
    name: [int(seed) for seed in seeds.split(", ")]
    for name, seeds in re.findall(r"^\| `(.+?)` \|.*\| ([\d, ]+) \|$", PAGE.read_text(), re.MULTILINE)
}
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"


def unsettled(name: str, seeds: range | list[int]) -> list[int]:
    """Return the seeds of a task whose scenes do not settle."""
    sim, found = simulate(name), []
    for seed in seeds:
        sim.reset(seed)
        if not sim.settled:
            found.append(seed)
    return found


def test_list_is_of_published_tasks_and_the_papers_seeds() -> None:
    assert {*LISTED} < {*task_names(suite="published")}
    assert sum(map(len, LISTED.values())) == 72
    assert all({*seeds} <= {*SPLITS[PAPER]} for seeds in LISTED.values())


@pytest.mark.skipif(mujoco.__version__ != PUBLISHED_MUJOCO, reason="of another MuJoCo")
@pytest.mark.parametrize("name", [SWAP, "put_the_milk_picked_up_in_the_prompt_video_on_the_plate"])
def test_listed_scenes_are_those_that_do_not_settle(name: str) -> None:
    seeds = [7, 8, 22, 28, 29]
    assert unsettled(name, seeds) == [s for s in seeds if s in LISTED.get(name, [])]


@pytest.mark.slow
@pytest.mark.skipif(mujoco.__version__ != PUBLISHED_MUJOCO, reason="of another MuJoCo")
@pytest.mark.parametrize("name", task_names(suite=None))
def test_all_listed_scenes(name: str) -> None:
    """Of strict tasks there are none: such scenes are drawn again."""
    assert unsettled(name, SPLITS[PAPER]) == LISTED.get(name, [])


def test_report_counts_them() -> None:
    episode = Episode(get_task(SWAP), demonstration_prompt=False)
    lines = []
    for number, seed in enumerate((22, 7)):
        episode.reset(seed)
        lines.append(episode_record(episode, number, 1.0))
    assert [line.get("settled") for line in lines] == [False, None]
    (note,) = [note for note in notes_on(lines) if "thrown" in note]
    assert f"before the first action in 1 of 2 scenes of {SWAP};" in note
    assert not [note for note in notes_on(lines[1:]) if "thrown" in note]
