from __future__ import annotations

from lerobot_memobench.tasks import get_task
from lerobot_memobench.tasks.memory_text import memory_text, with_memory


def test_memory_grows_by_one_intermediate_text_per_checkpoint() -> None:
    task = get_task("turn_on_the_stove_and_turn_it_off")
    texts = [checkpoint.language[1] for checkpoint in task.checkpoints]
    assert memory_text(task, 0) == ""
    assert memory_text(task, 1) == texts[0]
    assert memory_text(task, len(texts)) == "; ".join(texts)


def test_prompt_says_that_nothing_is_done_yet() -> None:
    assert with_memory("Put it back", "") == "Put it back Memory: nothing yet"
    assert with_memory("Put it back", "took it") == "Put it back Memory: took it"
