"""The leak test passes LeRobot's policies, and catches policies that are broken on purpose."""

from __future__ import annotations

import ast
import runpy
from collections import deque
from collections.abc import Callable, Iterable
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


CHECKS: dict[str, Callable[[Callable[[], Any], Any], None]] = {
    "reset": lambda make, subject: leak_test.test_reset_clears_the_state(subject),
    "rows": lambda make, subject: leak_test.test_rows_are_independent(subject),
    "chunks": lambda make, subject: leak_test.test_history_holds_the_frames_under_action_chunks(subject),
    "instances": leak_test.test_instances_share_no_state,
}


def outcomes(make: Callable[[], Any], checks: Iterable[str] = CHECKS) -> dict[str, str]:
    """Return the tests that a policy does not pass, and the reasons."""
    subject, found = leak_test.Subject(make), {}
    for name in checks:
        try:
            CHECKS[name](make, subject)
        except AssertionError as error:
            found[name] = str(error)
        except pytest.skip.Exception as error:
            found[name] = f"skipped: {error}"
    return found


def test_sound_policies_pass() -> None:
    assert outcomes(leak_test.FACTORIES["diffusion"]) == {}
    assert outcomes(factory(Sound)) == {}
    (skipped,) = outcomes(leak_test.FACTORIES["act"]).items()
    assert skipped == ("chunks", "skipped: it remembers no frame, or plans at every step")


BROKEN = {
    "reset": (KeepsItsQueue, "in reset()"),
    "rows": (MixesRows, "for each row"),
    "chunks": (ForgetsBetweenPlans, "while actions are queued"),
    "instances": (SharesItsQueue, "in the class"),
}


@pytest.mark.parametrize("check", BROKEN)
def test_each_broken_policy_is_caught(check: str) -> None:
    kind, advice = BROKEN[check]
    assert advice in outcomes(factory(kind), [check])[check]


def test_the_file_has_no_import_of_this_package_and_no_assertion_that_optimisation_removes() -> None:
    nodes = [*ast.walk(ast.parse(Path(leak_test.__file__).read_text()))]
    modules = [node.module for node in nodes if isinstance(node, ast.ImportFrom)]
    assert not any(str(module).startswith("lerobot_memobench") for module in modules)
    assert not [node for node in nodes if isinstance(node, ast.Assert)]
