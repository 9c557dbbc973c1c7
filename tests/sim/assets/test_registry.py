"""Which builder makes which class."""

from __future__ import annotations

import mujoco
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.assets import registry
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import Builder
from lerobot_memobench.sim.assets.kitchen import build_kitchen
from lerobot_memobench.sim.assets.registry import build_asset, register


def kitchen() -> mujoco.MjSpec:
    """Return a kitchen with the solver options of the published stack."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 20
    build_kitchen(spec)
    return spec


def test_unknown_class_names_the_nearest() -> None:
    spec = mujoco.MjSpec()
    with pytest.raises(MemobenchError, match="microwave"):
        build_asset(spec, "oven_1", "microwav")


def test_registered_builder_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_builders", dict(registry._builders))

    def cube(b: Builder) -> Asset:
        b.collision("box", (0.01, 0.01, 0.01), 0.01)
        return b.object((-0.01, -0.01, -0.01), (0.01 * b.variant, 0.01, 0.01))

    register("cork__3", cube)
    spec = mujoco.MjSpec()
    assert build_asset(spec, "a", "cork__3").high[0] == pytest.approx(0.03)
    assert build_asset(spec, "b", "cork__1").high[0] != pytest.approx(0.01)
