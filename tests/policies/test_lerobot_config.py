"""The identity of a policy in logs: it follows checkpoint and settings, and separates evaluations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import make_policy_config

from lerobot_memobench.envs.evaluation_file import Acting
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines import MemobenchRandomConfig
from lerobot_memobench.policies.checkpoint import acting, check_sizes
from lerobot_memobench.sim.object_layout import SIZE
from tests.support.lerobot_policies import make_config, save_checkpoint


def test_identity_follows_checkpoint_and_settings(tmp_path: Path) -> None:
    saved = make_config("act", {}, objects=SIZE, use_vae=False)
    first, second = (save_checkpoint(tmp_path / name, saved) for name in ("first", "second"))  # of other weights

    def identity(path: Path = first, **changes: Any) -> str:
        config = PreTrainedConfig.from_pretrained(path)
        for name, value in changes.items():
            setattr(config, name, value)
        return str(acting(config, str(path), EnvSettings()).policy["identity"])

    assert identity() == identity(device="cuda")
    assert len({identity(), identity(n_action_steps=2), identity(second)}) == 3
    assert acting(MemobenchRandomConfig(), None, EnvSettings()).inputs == "nothing"
    asked = Acting(seeds=range(7, 9))
    assert [asked.counts(8), asked.counts(9), Acting().counts(9)] == [True, False, True]


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ({"chunk_size": 10**9}, "policy.chunk_size=1000000000; expected at most 100000"),
        ({"dim_feedforward": 10**12}, "policy.dim_feedforward=1000000000000"),
        ({"input_features": {"observation.state": PolicyFeature(FeatureType.STATE, (10**12,))}}, "shape.0="),
    ],
)
def test_sizes_that_no_machine_holds_are_refused(setting: dict[str, Any], named: str) -> None:
    check_sizes(make_policy_config("act", device="cpu"))
    with pytest.raises(MemobenchError, match=named):
        check_sizes(make_policy_config("act", device="cpu", **{"n_action_steps": 1} | setting))
