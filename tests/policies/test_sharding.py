"""Training in shards (FSDP): two processes learn, average, save and go on as one does."""

from __future__ import annotations

import gc
import shutil
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from accelerate import state as accelerates
from accelerate.utils import DistributedType
from lerobot.configs import FeatureType, PolicyFeature
from safetensors.torch import load_file

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import GATHER_SHARDS, PREPARE, installed
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.sharding import prepare_shards
from tests.support.fork_server import ForkServer

CASE = "tests.support.shard_case"
RANKS, UPDATES, SAVED = 2, 4, 2
FILES = ("pretrained_model/model.safetensors", "pretrained_model/training_weights.safetensors")
"""The average, and the trained weights."""


@pytest.fixture(scope="module")
def forks() -> Iterator[ForkServer]:
    server = ForkServer([CASE])
    yield server
    server.close()


@pytest.fixture(scope="module")
def in_ranks(forks: ForkServer, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], None]:
    """Run a call of the case in two processes that train together."""

    def run(call: str) -> None:
        folder = tmp_path_factory.mktemp("ranks")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = str(free.getsockname()[1])
        code = f"from {CASE} import *; {call}"
        together = {"WORLD_SIZE": str(RANKS), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": "1"}
        running = [
            forks.start(code, folder / f"{rank}.txt", None, **together, RANK=str(rank), LOCAL_RANK=str(rank))
            for rank in range(RANKS)
        ]
        assert [fork.wait() for fork in running] == [0] * RANKS, (folder / "0.txt").read_text()[-3000:]

    return run


def differences(first: Path, second: Path, updates: int) -> dict[str, float]:
    """Return file -> the mean difference between the weights of two runs."""
    found = {}
    for file in FILES:
        mine, others = (load_file(run / "checkpoints" / f"{updates:06d}" / file) for run in (first, second))
        assert mine.keys() == others.keys()
        apart = [(mine[name].float() - others[name].float()).abs().flatten() for name in mine]
        found[file] = float(torch.cat(apart).mean())
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "tolerance"),
    [({}, 1e-6), ({"dtype": "bfloat16", "gradient_checkpointing": True}, 3e-5)],
    ids=["float32", "bfloat16"],
)
def test_two_ranks_in_shards_are_one_process(
    in_ranks: Callable[[str], None],
    forks: ForkServer,
    dataset_root: Path,
    tmp_path: Path,
    policy: dict[str, Any],
    tolerance: float,
) -> None:
    alone, shards, resumed = tmp_path / "alone", tmp_path / "shards", tmp_path / "resumed"
    made = f"configuration(Path({str(dataset_root)!r}), Path({str(alone)!r}), 1, **{policy})"
    ended = forks.run(f"from {CASE} import *; sys.argv = ['lerobot-train']; train({made})", tmp_path)
    assert ended.returncode == 0, ended.stderr
    in_ranks(f"run_rank({str(dataset_root)!r}, {str(shards)!r}, **{policy})")
    for updates in (SAVED, UPDATES):
        assert max(differences(alone, shards, updates).values()) < tolerance

    shutil.copytree(shards, resumed, symlinks=True)
    shutil.rmtree(resumed / "checkpoints" / f"{UPDATES:06d}")
    in_ranks(f"resume_rank({str(resumed)!r})")
    assert max(differences(shards, resumed, UPDATES).values()) < 1e-7

    # What these tolerances are measured by: how far weights and average are from one another.
    average, trained = (load_file(resumed / "checkpoints" / f"{UPDATES:06d}" / file) for file in FILES)
    apart = [(average[name.removeprefix("weights.")] - one).abs().flatten() for name, one in trained.items()]
    assert torch.cat(apart).mean() > 1e-4


@pytest.fixture
def told_sharded(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Let accelerate say that this process trains in shards."""
    plugin = SimpleNamespace(fsdp_version=1)
    state = SimpleNamespace(distributed_type=DistributedType.FSDP, fsdp_plugin=plugin)
    monkeypatch.setattr(accelerates, "is_initialized", lambda: True)
    monkeypatch.setattr(accelerates, "AcceleratorState", lambda: state)
    return plugin


def test_what_does_not_go_with_shards_is_refused(told_sharded: SimpleNamespace) -> None:
    policy: Any = SimpleNamespace(config=MemobenchMemConfig(device="cpu", push_to_hub=True, repo_id="me/mine"))
    with pytest.raises(MemobenchError, match="push_to_hub=false"):
        prepare_shards(policy)
    with pytest.raises(MemobenchError, match="adapters"):
        MemobenchMemPolicy.wrap_with_peft(policy)
    told_sharded.fsdp_version = 2
    with pytest.raises(MemobenchError, match="fsdp_version=2"):
        prepare_shards(policy)


def test_what_is_frozen_stays_whole(told_sharded: SimpleNamespace) -> None:
    features = {"observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 96, 96))}
    settings = MemobenchMemConfig(device="cpu", push_to_hub=False, dtype="bfloat16", input_features=features)
    settings.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    policy = MemobenchMemPolicy(settings, load_base=False)
    prepare_shards(policy)
    kept = {one for module in told_sharded.ignored_modules for one in module.parameters()}
    assert {one for one in policy.parameters() if not one.requires_grad} == kept
    assert {one.dtype for one in policy.parameters() if one.requires_grad} == {torch.float32}
    assert told_sharded.mixed_precision_policy.reduce_dtype is torch.float32
    assert {PREPARE, GATHER_SHARDS} <= set(installed())
    del policy
    gc.collect()
    assert not {PREPARE, GATHER_SHARDS} & set(installed())
