"""Datasets to train on, and trainings by the words of the command."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def imaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.support.synthetic_dataset import make_object_dataset

    return make_object_dataset(tmp_path_factory.mktemp("data") / "imaged", images=True)


@pytest.fixture(scope="session")
def train() -> Callable[..., None]:
    def run(*words: str) -> None:
        from lerobot_memobench.commands.command_line import parse_words, read_words
        from lerobot_memobench.training.command import complete_training, with_last_checkpoint
        from lerobot_memobench.training.loop import train as loop

        given = with_last_checkpoint(parse_words(["policy.device=cpu", "seed=3", *words]))
        loop(complete_training(read_words("train", given)))

    return run


def read_losses(run: Path) -> list[tuple[int, str, str, float]]:
    """Return step, ``train`` or ``eval``, name and value of each row of a run's log."""
    with (run / "losses.csv").open(newline="") as file:
        return [(int(step), mode, name, float(value)) for step, mode, name, value in [*csv.reader(file)][1:]]


def hashes(checkpoint: Path) -> dict[str, str]:
    """Return the hash of every tensor of a checkpoint, the optimizer's and the random state's among them."""
    found: dict[str, str] = {}
    for path in sorted(checkpoint.rglob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 (not a dict)
                tensor: Any = file.get_tensor(name).contiguous().reshape(-1)
                found[f"{path.name} {name}"] = hashlib.sha256(tensor.view(torch.uint8).numpy().tobytes()).hexdigest()
    return found
