"""Memory reads: attention of each fusion, entries of each mechanism, rows of a rollout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.memory import OURS
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memory_reads import chunk_reads
from tests.support.small_policy import made_for_training

REFUSED = ("motion",)  # has no attention weights
LENGTH = 20
"""Frames of the dataset's second episode, which begins with a prompt of 8 frames."""


def acting(root: Path, **fields: Any) -> tuple[MemobenchMemPolicy, list[dict[str, Any]]]:
    """Return a policy and observations of two rows; the second is six frames behind."""
    policy, before, _, dataset = made_for_training(
        root, **{"perception": "objects", "size": "tiny", "memory_stride": 2, "frames": 4, **fields}
    )
    episode = range(dataset.meta.episodes[1]["dataset_from_index"], dataset.meta.episodes[1]["dataset_to_index"])

    def observed(index: int) -> dict[str, Any]:
        row = dataset.hf_dataset[index]
        keys = ("state", "environment_state", "phase", "step")
        return {f"observation.{key}": row[f"observation.{key}"].reshape(-1) for key in keys} | {"task": "open it"}

    rows = [[observed(episode[k]), observed(episode[max(k - 6, 0)])] for k in range(LENGTH)]
    batches = [before(torch.utils.data.default_collate(pair)) for pair in rows]
    for number, batch in enumerate(batches):
        batch["observation.raw_state"] = batch["observation.raw_state"] + number % 2  # a hand that does not stall
    return policy.eval(), batches


def rolled(policy: MemobenchMemPolicy, batches: list[dict[str, Any]]) -> torch.Tensor:
    policy.reset()
    torch.manual_seed(3)
    return torch.stack([policy.select_action(batch) for batch in batches])


@pytest.mark.parametrize("fusion", ["modulation", pytest.param("context", marks=pytest.mark.slow)])
def test_reads_of_sampled_frames_change_no_action(root: Path, fusion: str) -> None:
    policy, batches = acting(root, memory_fusion=fusion)
    plain = rolled(policy, batches)
    assert policy.memory_reads() == [[], []]
    policy.watch_memory()
    assert torch.equal(rolled(policy, batches), plain)
    ahead, behind = policy.memory_reads()
    # Chunks of 6 actions from the execution's first frame on; of frames 0, 2, ... four are sampled.
    assert [(read["step"], read["entries"]) for read in ahead] == [(8, [0, 2, 4, 8]), (14, [0, 4, 8, 14])]
    # Frozen until frame 6, then six frames behind.
    assert [(read["step"], read["entries"]) for read in behind] == [(8, [0, 2, 4, 8])]
    for read in (*ahead, *behind):
        assert min(read["weights"]) > 0
        whole = sum(read["weights"])
        assert whole == pytest.approx(1, abs=1e-4) if fusion == "modulation" else 0.01 < whole < 0.99
    assert behind[0]["weights"] == pytest.approx(ahead[0]["weights"], abs=1e-5)
    policy.watch_memory(False)
    rolled(policy, batches)
    assert policy.memory_reads() == [[], []]


def test_tokens_are_summed_per_entry() -> None:
    tokens, mask = torch.zeros(2, 4, 8), torch.tensor([[1, 1, 1, 1], [1, 1, 0, 0]], dtype=torch.bool)
    layers = [torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.7, 0.3, 0.0, 0.0]])] * 2
    slots = chunk_reads([5, 9], MemoryTokens(tokens, mask), layers)
    assert [(read["step"], read["entries"]) for read in slots] == [(5, [-4, -3, -2, -1]), (9, [-2, -1])]
    # Tokens that mix three entries; the third is padding.
    shares = torch.tensor([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]).expand(2, -1, -1)
    sources = shares, torch.tensor([[0.0, 12.4, -1.0]] * 2)
    looked_up = chunk_reads([20, 30], MemoryTokens(tokens, mask, sources=sources), layers)
    assert [read["entries"] for read in looked_up] == [[0, 12]] * 2
    assert looked_up[0]["weights"] == pytest.approx([0.2, 0.8])
    assert looked_up[1]["weights"] == pytest.approx([0.85, 0.15])


DEFAULT = ("bank", "motion")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in DEFAULT else pytest.mark.slow) for name in OURS]
)
def test_every_memory_reports_its_reads(root: Path, name: str) -> None:
    policy, batches = acting(root, memory=name)
    if name in REFUSED:
        with pytest.raises(MemobenchError, match=f"memory={name}"):
            policy.watch_memory()
        return
    policy.watch_memory()
    rolled(policy, batches)
    for row in policy.memory_reads():
        assert [read["step"] for read in row] == [8, 14][: len(row)]
        for read in row:
            assert read["entries"]
            assert max(read["entries"]) <= read["step"]
            assert min(read["weights"]) >= 0
            assert sum(read["weights"]) <= 1 + 1e-4
            assert max(read["weights"]) > 0
