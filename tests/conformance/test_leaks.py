"""The leak test passes LeRobot's policies, and catches policies that are broken on purpose."""

from __future__ import annotations

import ast
import inspect
import re
import runpy
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

leak_test = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "examples" / "leak_test.py")))
HISTORY, CHUNK = 3, 4


class Sound(nn.Module):
    """A policy that plans `CHUNK` actions from the last `HISTORY` observations of each row."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(HISTORY * 5, CHUNK * 2)
        self.reset()

    def reset(self) -> None:
        self.history: deque[Tensor] = deque(maxlen=HISTORY)
        self.queue: deque[Tensor] = deque()

    def observe(self, state: Tensor) -> None:
        self.history.extend([state] * (HISTORY if not self.history else 1))

    def plan(self) -> None:
        chunk = self.layer(torch.cat([*self.history], dim=-1)).unflatten(-1, (CHUNK, 2))
        self.queue.extend(chunk.transpose(0, 1))

    def select_action(self, batch: dict[str, Tensor]) -> Tensor:
        self.observe(batch["observation.state"])
        if not self.queue:
            self.plan()
        return self.queue.popleft()


class KeepsItsQueue(Sound):
    """reset() clears the history and not the queue."""

    def reset(self) -> None:
        queue: deque[Tensor] = getattr(self, "queue", deque())
        super().reset()
        self.queue = queue


class MixesRows(Sound):
    """The history is that of the first row."""

    def observe(self, state: Tensor) -> None:
        super().observe(state[:1].expand_as(state))


class ForgetsBetweenPlans(Sound):
    """Observations are remembered at plans only."""

    def select_action(self, batch: dict[str, Tensor]) -> Tensor:
        if not self.queue:
            self.observe(batch["observation.state"])
            self.plan()
        return self.queue.popleft()


class SharesItsQueue(Sound):
    """All instances have one queue."""

    shared: ClassVar[deque[Tensor]] = deque()

    def reset(self) -> None:
        super().reset()
        self.queue = self.shared
        self.queue.clear()


def factory(kind: type[Sound]) -> Callable[[], Any]:
    return lambda: (kind(), lambda generator: {"observation.state": torch.rand(5, generator=generator)})


BROKEN: dict[str, tuple[type[Sound], str]] = {
    "test_reset_clears_the_state": (KeepsItsQueue, "in reset()"),
    "test_rows_are_independent": (MixesRows, "for each row"),
    "test_history_holds_the_frames_under_action_chunks": (ForgetsBetweenPlans, "while actions are queued"),
    "test_instances_share_no_state": (SharesItsQueue, "in the class"),
}
"""Test -> policy that fails it, and the advice."""


def run(test: str, make: Callable[[], Any], subject: Any) -> None:
    fixtures = {"make": make, "subject": subject}
    function = getattr(leak_test, test)
    function(**{name: fixtures[name] for name in inspect.signature(function).parameters})


def test_sound_policies_pass() -> None:
    skipped = []
    for name, make in {**leak_test.FACTORIES, "sound": factory(Sound)}.items():
        subject = leak_test.Subject(make)
        for test in BROKEN:
            try:
                run(test, make, subject)
            except pytest.skip.Exception as error:
                skipped.append((name, str(error)))
    assert skipped == [("act", "it remembers no frame, or plans at every step")]


@pytest.mark.parametrize("test", BROKEN)
def test_each_broken_policy_is_caught(test: str) -> None:
    kind, advice = BROKEN[test]
    make = factory(kind)
    with pytest.raises(AssertionError, match=re.escape(advice)):
        run(test, make, leak_test.Subject(make))


def test_the_file_has_no_import_of_this_package_and_no_assertion_that_optimisation_removes() -> None:
    nodes = [*ast.walk(ast.parse(Path(leak_test.__file__).read_text()))]
    modules = [node.module for node in nodes if isinstance(node, ast.ImportFrom)]
    assert not any(str(module).startswith("lerobot_memobench") for module in modules)
    assert not [node for node in nodes if isinstance(node, ast.Assert)]
