"""The published task folders, compiled and reset as they are: our own catalogue is not asked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import load_task
from lerobot_memobench.tasks.progress import Progress

SHARED = Path(__file__).resolve().parents[3] / "shared"
FOLDERS = sorted(path.parent for path in (SHARED / "upstream_tasks").glob("*/*/task_config.bddl"))


@pytest.mark.skipif(not FOLDERS, reason="no published task folders beside the checkout")
def test_there_are_thirty() -> None:
    assert len(FOLDERS) == 30


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_reset_and_step(folder: Path) -> None:
    """Each scene compiles to the published state size, starts as its BDDL says, and answers its own goals' atoms."""
    facts = {task["name"]: task for task in json.loads((SHARED / "spec" / "catalogue.json").read_text())}
    # One folder came without metadata; its scene and goal are whole, and only checkpoints need the file.
    task = load_task(folder, require_metadata=False)
    sim = Simulation(task)
    assert 1 + sim.model.nq + sim.model.nv == facts[folder.name]["state_dim"]
    hashes = set()
    for seed in (7, 8):
        sim.reset(seed)
        hashes.add(sim.scene_hash())
        for atom in task.init:
            if len(atom.args) == 1:
                assert sim.holds(atom), f"seed {seed}: {atom} does not hold"
        sim.step(NO_OP)
        assert np.isfinite(sim.data.qpos).all()
        progress = Progress(task)  # asks the simulator every atom of goal and checkpoints
        progress.step(sim.holds)
        assert not progress.success
        assert progress.index == 0
    assert len(hashes) == 2
