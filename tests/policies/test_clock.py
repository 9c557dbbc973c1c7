"""When an episode begins, how its steps are counted and when it has ended, with and without a clock."""

from __future__ import annotations

import pytest

from lerobot_memobench.policies.memobench_mem.rollout import Rollout
from lerobot_memobench.protocol import ENDED, EXECUTION, NO_CLOCK, PROMPT

PUBLISHED = [(PROMPT, 0), (PROMPT, 1), (EXECUTION, 0), (EXECUTION, 1), (EXECUTION, 1), (PROMPT, 0)]
STRICT = [(PROMPT, 0), (PROMPT, 1), *[(EXECUTION, NO_CLOCK)] * 3, *[(EXECUTION, ENDED)] * 2, (PROMPT, 0)]
WITHOUT_PROMPT = [*[(EXECUTION, NO_CLOCK)] * 3, *[(EXECUTION, ENDED)] * 2, *[(EXECUTION, NO_CLOCK)] * 2]


@pytest.mark.parametrize(
    ("clocks", "positions", "begins", "frozen"),
    [
        (PUBLISHED, [0, 1, 2, 3, 3, 0], [0, 5], [4]),
        (STRICT, [0, 1, 2, 3, 4, 4, 4, 0], [0, 7], [5, 6]),
        (WITHOUT_PROMPT, [0, 1, 2, 2, 2, 0, 1], [0, 5], [3, 4]),
    ],
)
def test_a_row_counts_the_steps_of_its_episode(
    clocks: list[tuple[int, int]], positions: list[int], begins: list[int], frozen: list[int]
) -> None:
    written: list[int] = []
    rollout = Rollout(remembers=True, stride=1)
    found = [rollout.observe([clock], lambda rows, k=k: written.append(k)) for k, clock in enumerate(clocks)]  # type: ignore[misc]
    assert [steps[0] for steps, _, _ in found] == positions
    assert [k for k, (_, started, _) in enumerate(found) if started[0]] == begins
    assert [k for k, (_, _, stands) in enumerate(found) if stands[0]] == frozen
    assert written == [k for k in range(len(clocks)) if k not in frozen]
