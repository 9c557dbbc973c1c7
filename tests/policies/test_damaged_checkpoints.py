"""Checkpoints and recipes that were damaged in any way: what reads them before a run ends in a result or a sentence."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from lerobot_memobench.policies.checkpoint import check_checkpoint, checkpoint_type
from lerobot_memobench.policies.memobench_mem.checkpoints import require_agreement, require_statistics
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.run.arguments import read_arguments, split_arguments
from lerobot_memobench.run.card import training_facts
from tests.support import mutations

FEATURES = {"observation.state": {"type": "STATE", "shape": [8]}, "action": {"type": "ACTION", "shape": [7]}}
STEP = {
    "registry_name": "normalizer_processor",
    "config": {"norm_map": {"STATE": "QUANTILES", "ACTION": "QUANTILES"}, "features": FEATURES},
    "state_file": "statistics.safetensors",
}
FILES = {
    "config.json": {"type": "act", "chunk_size": 50},
    "policy_preprocessor.json": {"name": "before", "steps": [{"registry_name": "rename_observations_processor"}, STEP]},
    "policy_postprocessor.json": {"name": "after", "steps": [STEP]},
    "train_config.json": {"dataset": {"repo_id": "me/it", "root": None, "episodes": None}, "steps": 5},
}
RECIPE = """# A recipe.
policy: {type: act, chunk_size: 50}
dataset:
  repo_id: me/it
steps: 100
"""


def checkpoint(folder: Path) -> None:
    folder.mkdir(parents=True)
    for name, content in FILES.items():
        (folder / name).write_text(json.dumps(content))
    save_file({key: np.ones(2, np.float32) for key in ("observation.state.mean", "action.mean")}, folder / "x.tmp")
    (folder / "x.tmp").rename(folder / "statistics.safetensors")
    (folder / "model.safetensors").write_bytes(b"")
    (folder / "recipe.yaml").write_text(RECIPE)


def check(tmp_path: Path, files: list[str], count: int) -> tuple[int, int]:
    source, whole = tmp_path / "source", tmp_path / "whole"
    whole.mkdir()
    checkpoint(source / "it")
    folder = whole / "it"

    def prepare(rng: random.Random) -> None:
        mutations.fresh_copy(source, whole)
        name = rng.choice(files)
        mutations.damage(folder / name, rng, mutations.mutated_json if "json" in name else mutations.mutated_bytes)

    def use(_: random.Random) -> None:
        if files == ["recipe.yaml"]:
            read_arguments("train", split_arguments([f"config_path={folder / 'recipe.yaml'}"]))
            return
        training_facts(folder)
        check_checkpoint(str(folder))
        checkpoint_type(str(folder))
        require_statistics(folder)
        require_agreement(folder, None, MemobenchMemConfig(device="cpu"), training=True)

    found = mutations.ends_well(range(count), prepare, use, whole, ("it",))
    return found["result"], found["refused"]


KINDS = {"checkpoint": [*FILES, "statistics.safetensors"], "recipe": ["recipe.yaml"]}


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_checkpoints(tmp_path: Path, kind: str) -> None:
    results, refused = check(tmp_path, KINDS[kind], 400)
    assert results > 50
    assert refused > 50


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_checkpoints(tmp_path: Path, kind: str) -> None:
    results, refused = check(tmp_path, KINDS[kind], 10_000)
    print(f"{kind}: {results} results, {refused} refused")
