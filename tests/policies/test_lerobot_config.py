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
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, Acting
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.policies.baselines import MemobenchRandomConfig
from lerobot_memobench.policies.checkpoint import acting, check_sizes
from lerobot_memobench.rollouts.shards import merge
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


def evaluated(policy: Path, out: Path, *more: str) -> int:
    words = [f"tasks={TASK}", "horizon=3", "videos=0", "batch_size=1"]
    return main(["eval", "env=memobench", f"policy={policy}", *words, f"output_dir={out}", *more])


def test_reports_name_the_inputs_and_merges_refuse_another_policy(tmp_path: Path, checkpoints: list[Path]) -> None:
    (first, second), out = checkpoints, tmp_path / "out"
    assert evaluated(first, out, "episodes=1") == 0
    (record,) = read_episodes(out)
    assert (record["inputs"], record["policy"][:4]) == (POSES, "act ")
    assert json.loads((out / EVALUATION_FILE).read_text())["protocol"]["inputs"] == POSES
    assert json.loads((out / "report.json").read_text())["inputs"] == POSES
    merged = tmp_path / "merged"
    merge(merged, [out])
    assert read_runs([merged])[0].protocol["inputs"] == POSES
    assert evaluated(second, tmp_path / "other", "episodes=1") == 0
    with pytest.raises(MemobenchError, match=r"policy\.sha256"):
        merge(tmp_path / "both", [out, tmp_path / "other"])


def test_identity_follows_checkpoint_and_settings(checkpoints: list[Path]) -> None:
    def identity(path: Path = checkpoints[0], **changes: Any) -> str:
        config = PreTrainedConfig.from_pretrained(path)
        for name, value in changes.items():
            setattr(config, name, value)
        return str(acting(config, str(path), EnvSettings()).policy["identity"])

    assert identity() == identity(device="cuda")
    assert len({identity(), identity(n_action_steps=2), identity(checkpoints[1])}) == 3
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
