"""Atoms hold where they hold in stock LIBERO."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_memobench.tasks.formula import Atom
from tests.support.libero import needs_assets, record, simulate
from tests.support.scripts import load_script


@needs_assets
@pytest.mark.parametrize("name", load_script("libero_records").PREDICATES)
def test_predicates_are_stock_liberos(name: str) -> None:
    sim, kept = simulate(name), record("predicates")
    atoms = [Atom(word, tuple(names)) for word, *names in (str(one).split() for one in kept[f"{name}:atoms"])]
    fixtures = dict(zip(sim.fixture_poses(), kept[f"{name}:fixtures"], strict=True))
    state, found = np.zeros(sim.state_dim), []
    for qpos in kept[f"{name}:qpos"]:
        state[1 : 1 + sim.model.nq] = qpos / 1e6
        sim.set_state(state, fixtures)
        found.append([sim.holds(atom) for atom in atoms])
    differ = {
        str(atom): int(count) for atom, count in zip(atoms, (found != kept[f"{name}:answers"]).sum(axis=0), strict=True)
    }
    assert differ == dict.fromkeys(map(str, atoms), 0)
