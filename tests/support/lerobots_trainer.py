"""LeRobot's trainer in the process of the test, which has its imports already and can watch the policy."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest

from lerobot_memobench.training import command


def run_in_this_process(flags: Sequence[str]) -> int:
    from lerobot_memobench.training import samples

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-train", *flags])
        patch.setattr(samples.lerobot_train, "make_train_eval_datasets", samples.open_datasets)
        samples.lerobot_train.main()
    return 0


@contextmanager
def trainer_in_this_process() -> Iterator[None]:
    """Let ``lerobot train`` call LeRobot's trainer instead of starting a process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "run_lerobot", run_in_this_process)
        yield
