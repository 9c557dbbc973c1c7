"""The identity of a policy in logs: it follows checkpoint and settings, and separates evaluations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_policy_config

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.episode_log import UNKNOWN_POLICY, read_episodes, write_episodes
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import read_protocol, read_runs
from lerobot_memobench.policies.baselines import MemobenchRandomConfig
from lerobot_memobench.policies.lerobot_config import acting, check_sizes
from lerobot_memobench.run.shards import merge
from lerobot_memobench.sim.object_layout import SIZE

TASK = "turn_on_the_stove_and_turn_it_off"
POSES = "privileged object state"


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return two small ACT checkpoints that differ only in their random weights."""
    sizes: dict[str, Any] = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1}
    sizes |= {"chunk_size": 4, "n_action_steps": 4, "use_vae": False, "pretrained_backbone_weights": None}
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (SIZE,)),
    }
    action = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    config = ACTConfig(device="cpu", push_to_hub=False, input_features=inputs, output_features=action, **sizes)
    shapes = {key: feature.shape for key, feature in {**inputs, **action}.items()}
    stats = {key: {"mean": torch.zeros(shape), "std": torch.ones(shape)} for key, shape in shapes.items()}
    folders = []
    for seed in range(2):
        torch.manual_seed(seed)
        folder = tmp_path_factory.mktemp(f"act_{seed}")
        for part in (ACTPolicy(config), *make_pre_post_processors(config, dataset_stats=stats)):
            part.save_pretrained(folder)
        folders.append(folder)
    return folders


def test_reports_name_the_inputs(tmp_path: Path, checkpoints: list[Path]) -> None:
    out = tmp_path / "out"
    words = [f"tasks={TASK}", "horizon=3", "videos=0", "batch_size=1", "episodes=1"]
    assert main(["eval", "env=memobench", f"policy={checkpoints[0]}", *words, f"output_dir={out}"]) == 0
    (record,) = read_episodes(out)
    assert record["run"]
    assert (record["inputs"], record["policy"][:4]) == (POSES, "act ")
    assert json.loads((out / EVALUATION_FILE).read_text())["protocol"]["inputs"] == POSES
    assert json.loads((out / "report.json").read_text())["inputs"] == POSES
    merge(tmp_path / "merged", [out])
    assert read_protocol(tmp_path / "merged")["inputs"] == POSES
    write_episodes(tmp_path / "mixed", [record, {**record, "episode": 9, "policy": "act 0"}])
    with pytest.raises(MemobenchError, match="2 policies"):
        read_runs([tmp_path / "mixed"])


def test_identity_follows_checkpoint_and_settings(checkpoints: list[Path]) -> None:
    def identity(path: Path = checkpoints[0], **changes: Any) -> str:
        config = PreTrainedConfig.from_pretrained(path)
        for name, value in changes.items():
            setattr(config, name, value)
        return str(acting(config, str(path), None, EnvSettings()).policy["identity"])

    assert identity() == identity(device="cuda")
    assert len({identity(), identity(n_action_steps=2), identity(checkpoints[1])}) == 3
    found = acting(MemobenchRandomConfig(), None, range(7, 9), EnvSettings())
    assert (found.inputs, found.counts(8), found.counts(9)) == ("nothing", True, False)
    unknown = UNKNOWN_POLICY
    assert (unknown.protocol, unknown.line, unknown.counts(3)) == ({}, {}, True)


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
