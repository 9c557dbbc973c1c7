"""Two ranks with a batch between them learn what one process with the joint batch learns."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import torch

from lerobot_memobench.policies.memobench_mem.training import means_over_ranks
from tests.support import rank_case


@pytest.fixture(scope="module")
def ranks(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("ranks")
    command = [sys.executable, rank_case.__file__]
    running = [subprocess.Popen([*command, str(rank), str(folder)]) for rank in range(2)]
    assert [process.wait() for process in running] == [0, 0]
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.parametrize("number", range(len(rank_case.CASES)), ids=lambda n: f"{n}-{rank_case.CASES[n][0]}")
def test_two_ranks_are_one_batch(ranks: Any, number: int) -> None:
    joint = rank_case.step(*rank_case.CASES[number], slice(None))
    first, second = (rank[number] for rank in ranks)
    close = {"rtol": 1e-5, "atol": 1e-6}
    torch.testing.assert_close((first["loss"] + second["loss"]) / 2, joint["loss"], **close)
    assert first["top1"] == second["top1"] == joint["top1"]
    for name in joint.keys() - {"loss", "top1"}:
        torch.testing.assert_close(first[name], joint[name], **close)
        torch.testing.assert_close(second[name], joint[name], **close)
    if rank_case.CASES[number][0] == "contrastive":
        torch.testing.assert_close(first["loss"], joint["loss"], **close)
        assert "alignment.log_temperature" in joint


def test_what_a_curve_keeps_is_of_all_ranks(ranks: Any) -> None:
    assert [rank[-1] for rank in ranks] == [{"loss": 1.5, "per_dim": [0]}, {"loss": 1.5, "per_dim": [1]}]
    assert means_over_ranks({"loss": 2.0}) == {"loss": 2.0}
