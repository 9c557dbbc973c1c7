"""One process of a training by LeRobot's own loop, alone or as one of two in shards (FSDP), on a CPU.

accelerate shards on GPUs alone, so its state is told otherwise. Gathering to main memory frees what it has gathered
where that lies in main memory already, so it is left out. All else is accelerate's, LeRobot's and torch's own.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.state import PartialState
from accelerate.utils import DistributedType, FullyShardedDataParallelPlugin
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_train import train
from torch.distributed import fsdp

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

RANKS, BATCH, UPDATES = 2, 4, 4
SAVED = UPDATES // 2
"""After how many updates a checkpoint is saved besides."""


def configuration(root: Path, out: Path, ranks: int, **policy: Any) -> TrainPipelineConfig:
    """Return a training's configuration, of the same joint batches for any number of ranks."""
    return TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(root)),
        # Regression draws no noise, which the ranks would draw alike.
        policy=MemobenchMemConfig(
            device="cpu", push_to_hub=False, chunk_size=6, n_action_steps=6, memory_frames=8, objective="regression",
            **policy,
        ),
        output_dir=out,
        steps=UPDATES,
        batch_size=BATCH * RANKS // ranks,
        save_freq=SAVED,
        num_workers=0,
        env_eval_freq=0,
    )  # fmt: skip


def sharded() -> Accelerator:
    """Return the accelerator that LeRobot makes under ``accelerate launch --use_fsdp``."""
    accelerator = Accelerator(step_scheduler_with_optimizer=False, cpu=True)
    for state in (accelerator.state, PartialState()):
        state.distributed_type, state.device = DistributedType.FSDP, torch.device("cpu")
    accelerator.state.fsdp_plugin = FullyShardedDataParallelPlugin()
    return accelerator


def stay_in_memory() -> None:
    """Let nothing that is gathered be moved to main memory, where it is."""
    for name in ("FullStateDictConfig", "FullOptimStateDictConfig"):
        theirs = getattr(fsdp, name)
        setattr(fsdp, name, lambda theirs=theirs, **named: theirs(**{**named, "offload_to_cpu": False}))


def run_rank(root: str, out: str, **policy: Any) -> None:
    """Train from the beginning, in shards."""
    stay_in_memory()
    sys.argv = ["lerobot-train"]
    train(configuration(Path(root), Path(out), RANKS, **policy), accelerator=sharded())


def resume_rank(out: str) -> None:
    """Go on with the first checkpoint of a run in shards."""
    stay_in_memory()
    config = Path(out) / "checkpoints" / f"{SAVED:06d}" / "pretrained_model" / "train_config.json"
    sys.argv = ["lerobot-train", f"--config_path={config}", "--resume=true", f"--output_dir={out}"]
    train(accelerator=sharded())  # LeRobot's parser makes the configuration
