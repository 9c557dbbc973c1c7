"""The models of all tasks are stock LIBERO's in every field that physics reads."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim.libero.scene import scene_spec
from lerobot_memobench.sim.worlds import get_scene
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.support.libero import needs_assets, record, simulate, some_of_all
from tests.support.scripts import load_script

EQUAL = 1e-9
"""Share of a field's magnitude within which a sum over it is equal: MuJoCo's versions round differently."""
DIMENSIONS = {
    "temporal": {38, 47},
    "spatial": {51, 77},
    "object": {58, 71, 97, 149},
    "procedural": {58, 71, 84},
}
"""Memory type -> lengths of a state in the published files."""


@needs_assets
@pytest.mark.parametrize("name", some_of_all(task_names()))
def test_the_model_is_stock_liberos(name: str) -> None:
    script, kept = load_script("libero_records"), record("models")
    assert list(kept["tasks"]) == sorted(task_names(), key=lambda one: str(script.task_files()[one]))
    wanted = dict(zip(kept["fields"], kept["fingerprints"][list(kept["tasks"]).index(name)], strict=True))
    model = get_scene(get_task(name).in_world("libero")).model
    differ = {
        field: (found.tolist(), wanted[field].tolist())
        for field, values in script.fields(model).items()
        for found in [script.fingerprint(values)]
        if not np.allclose(found, wanted[field], rtol=0, atol=EQUAL * (wanted[field][2] + 1e-6))
    }
    assert differ == {}
    assert 1 + model.nq + model.nv in DIMENSIONS[get_task(name).memory_type]


@needs_assets
@pytest.mark.slow
@pytest.mark.parametrize("name", task_names())
def test_visual_geoms_change_no_motion(name: str) -> None:
    sim = simulate(name)
    sim.reset(7)
    whole = scene_spec(sim.task, visuals=True).compile()
    ends = []
    for model in (copy.copy(sim.model), whole):
        data = mujoco.MjData(model)
        model.opt.disableflags = sim.model.opt.disableflags
        model.body_pos[:], model.body_quat[:] = sim.model.body_pos, sim.model.body_quat
        data.qpos[:] = sim.data.qpos
        for _ in range(250):
            mujoco.mj_step(model, data)
        ends.append(data.qpos.copy())
    assert np.array_equal(*ends)
