"""LIBERO's suites: tasks, instructions and initial states as in the wheel hf-libero 0.1.4."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task, initial_states, suite_of, task_names
from lerobot_memobench.tasks.formula import atoms
from lerobot_memobench.tasks.task import LIBERO_SUITES


def test_suites_hold_130_tasks_of_other_names_than_the_catalogue() -> None:
    names = [name for suite in LIBERO_SUITES for name in task_names(suite=suite)]
    assert [len(task_names(suite=suite)) for suite in LIBERO_SUITES] == [10, 10, 10, 10, 90]
    assert len({*names, *task_names(suite=None)}) == 130 + 60


def test_goals_are_conjunctions_of_libero_s_predicates() -> None:
    """Counts of LIBERO's files."""
    tasks = [get_task(name) for suite in LIBERO_SUITES for name in task_names(suite=suite)]
    counts = Counter(atom.predicate for task in tasks for atom in atoms(task.goal))
    assert counts == {"in": 63, "on": 61, "close": 11, "turnon": 8, "open": 7, "turnoff": 1}
    assert not any(task.checkpoints or task.prompt or task.variants for task in tasks)
    assert all(task.suite == task.memory_type == suite_of(task.name) for task in tasks)


def test_initial_states_are_those_of_libero() -> None:
    """Width and sum of LIBERO's array, and its fields: time, the arm, then objects 0.9 m above the floor or higher."""
    states = initial_states("put_the_bowl_on_the_plate")
    assert (states.shape, states.dtype) == ((50, 79), np.float64)
    np.testing.assert_allclose(states[:, 1:8].mean(axis=0)[[1, 3, 5]], [-0.16, -2.44, 2.22], atol=0.03)
    assert not np.array_equal(states[0], states[1])
    with pytest.raises(ValueError, match="read-only"):
        states[0, 0] = 1.0


def test_unknown_names_are_refused_with_the_nearest_one() -> None:
    with pytest.raises(MemobenchError, match="did you mean 'put_the_bowl_on_the_plate'"):
        get_task("put_the_bowl_on_a_plate")
    with pytest.raises(MemobenchError, match="did you mean 'put_the_bowl_on_the_plate'"):
        initial_states("put_the_bowl_on_a_plate")
    with pytest.raises(MemobenchError, match="did you mean 'libero_goal'"):
        task_names(suite="libero_goals")
