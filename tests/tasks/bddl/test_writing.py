"""The writer of BDDL problems."""

from __future__ import annotations

from lerobot_memobench.tasks.bddl.reading import parse_bddl
from lerobot_memobench.tasks.bddl.writing import format_bddl
from lerobot_memobench.tasks.catalogue import get_task, task_names


def test_print_and_parse_give_the_same_problem(bddl: str) -> None:
    problem = parse_bddl(bddl)
    assert parse_bddl(format_bddl(problem, "a comment (with parentheses)")) == problem
    for name in task_names():
        task = get_task(name)
        problem = parse_bddl(task.bddl_text, name)
        assert parse_bddl(format_bddl(problem)) == problem
