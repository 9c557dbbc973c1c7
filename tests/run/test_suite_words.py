"""``suite=`` on a command line: which tasks it knows is told before LeRobot is imported."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.arguments import check_task_names, split_words

STRICT, PUBLISHED = "open_and_close_the_microwave_a_given_number_of_times", "open_and_close_the_microwave"


@pytest.mark.parametrize(
    "words",
    [
        ["env=memobench", "suite=strict"],
        ["env=memobench", "suite=strict", f"tasks={STRICT},spatial"],
        ["--env.type=memobench", "--env.suite=strict", f"--env.tasks={STRICT}"],
        ["env=memobench", f"tasks={PUBLISHED}"],
        ["env=memobench", "--config_path=settings.yaml", f"tasks={STRICT}"],
    ],
)
def test_tasks_of_the_suite_are_known(words: list[str]) -> None:
    check_task_names(split_words(words))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env=memobench", f"tasks={STRICT}"], "task of the strict suite; say suite=strict"),
        (["env=memobench", "suite=strict", f"tasks={PUBLISHED}"], "task of the published suite"),
        (["env=memobench", "suite=strikt"], "suite is 'strikt'; did you mean 'strict'"),
    ],
)
def test_others_are_refused_in_a_sentence(words: list[str], said: str) -> None:
    with pytest.raises(MemobenchError) as error:
        check_task_names(split_words(words))
    assert said in str(error.value)
