"""The policy that acts, its inputs and the episodes that were asked for: on every line of the log."""

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
from lerobot.policies.pi05.configuration_pi05 import PI05Config

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.acting import NOBODY, acting
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import read_episodes, write_episodes
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS, EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import read_protocol, read_runs
from lerobot_memobench.policies.baselines.configuration_baselines import (
    MemobenchBlindConfig,
    MemobenchExpertConfig,
    MemobenchRandomConfig,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.run.shards import merge
from lerobot_memobench.sim.object_layout import SIZE

TASK = "turn_on_the_stove_and_turn_it_off"
STATE = {"observation.state": PolicyFeature(FeatureType.STATE, (8,))}
OBJECT_POSES = {"observation.environment_state": PolicyFeature(FeatureType.ENV, (SIZE,))}
PICTURE = {"observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 256, 256))}
ACTION = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
POSES = "privileged object state"


def act(inputs: dict[str, PolicyFeature]) -> ACTConfig:
    sizes: dict[str, Any] = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1}
    sizes |= {"chunk_size": 4, "n_action_steps": 4, "use_vae": False, "pretrained_backbone_weights": None}
    return ACTConfig(device="cpu", push_to_hub=False, input_features=inputs, output_features=dict(ACTION), **sizes)


def checkpoint(folder: Path, inputs: dict[str, PolicyFeature], seed: int = 0) -> Path:
    """A small ACT with random weights."""
    torch.manual_seed(seed)
    config = act(STATE | inputs)
    ACTPolicy(config).save_pretrained(folder)
    shapes = {
        key: (3, 1, 1) if feature.type is FeatureType.VISUAL else feature.shape
        for key, feature in {**config.input_features, **ACTION}.items()
    }
    stats = {key: {"mean": torch.zeros(shape), "std": torch.ones(shape)} for key, shape in shapes.items()}
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder


def evaluated(policy: Path, out: Path, *more: str) -> int:
    words = [f"tasks={TASK}", "horizon=3", "env.render=fast", "videos=0", "batch_size=1"]
    return main(["eval", "env=memobench", f"policy={policy}", *words, f"output_dir={out}", *more])


# --- what is seen ---


@pytest.mark.parametrize(
    ("policy", "shown", "seen"),
    [
        (act(STATE | PICTURE), PIXELS, "pixels"),
        (act(STATE | PICTURE), BOTH, "pixels"),
        (act(STATE | PICTURE | OBJECT_POSES), BOTH, f"pixels, {POSES}"),
        (act(STATE | OBJECT_POSES), OBJECTS, POSES),
        (ACTConfig(device="cpu", push_to_hub=False), BOTH, f"pixels, {POSES}"),  # in training, all that is shown
        (PI05Config(device="cpu", input_features=STATE | PICTURE | OBJECT_POSES), BOTH, "pixels"),  # it ignores poses
        (MemobenchMemConfig(device="cpu"), PIXELS, "pixels"),
        (MemobenchMemConfig(device="cpu", size="small"), PIXELS, "pixels"),
        (MemobenchMemConfig(device="cpu", size="small", perception="objects"), OBJECTS, POSES),
        (
            MemobenchMemConfig(device="cpu", size="small", perception="objects", detector="package"),
            PIXELS,
            "detections",
        ),
        (MemobenchExpertConfig(), PIXELS, "privileged simulator state"),
        (MemobenchBlindConfig(), PIXELS, "privileged simulator state"),
        (MemobenchRandomConfig(), PIXELS, "nothing"),
        (RemoteConfig(), BOTH, "pixels"),
        (RemoteConfig(keys="a=image,b=environment_state"), BOTH, f"pixels, {POSES}"),
        (RemoteConfig(keys="b=state"), BOTH, "nothing"),
    ],
)
def test_every_kind_of_policy_says_what_it_saw(policy: Any, shown: str, seen: str) -> None:
    assert policy_inputs(policy, shown) == seen
    oracle = policy_inputs(policy, shown, oracle_memory=True)
    assert oracle == ("oracle memory text" if seen == "nothing" else f"{seen}, oracle memory text")


def test_every_account_names_the_inputs(tmp_path: Path) -> None:
    policy, out = checkpoint(tmp_path / "policy", PICTURE | OBJECT_POSES), tmp_path / "out"
    assert evaluated(policy, out, "episodes=1") == 0
    (record,) = read_episodes(out)
    assert record["inputs"] == f"pixels, {POSES}"
    assert record["run"]
    assert record["policy"].startswith("act ")
    assert json.loads((out / EVALUATION_FILE).read_text())["protocol"]["inputs"] == f"pixels, {POSES}"
    assert json.loads((out / "report.json").read_text())["inputs"] == f"pixels, {POSES}"
    assert (out / "report.md").read_text().count(f"Policy inputs: pixels, {POSES}.") == 4, "under every table"
    merged = tmp_path / "merged"
    assert merge(merged, [out]) == []
    assert read_protocol(merged)["inputs"] == f"pixels, {POSES}"
    assert {each["inputs"] for each in read_episodes(merged)} == {f"pixels, {POSES}"}


# --- whose episodes they are ---


def test_two_policies_are_not_one_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = (checkpoint(tmp_path / name, OBJECT_POSES, seed) for seed, name in enumerate(("first", "second")))
    out = tmp_path / "out"
    assert evaluated(first, out, "episodes=2") == 0
    records = read_episodes(out)
    for policy, more in ((second, ()), (first, ("replan=2",))):
        assert evaluated(policy, out, "episodes=2", "resume=true", *more) == 2
        assert "another protocol" in capsys.readouterr().err
    assert read_episodes(out) == records
    # The same policy goes on, wherever it runs.
    assert evaluated(first, out, "episodes=3", "resume=true", "device=cpu", "replan=4") == 0
    found = read_episodes(out)
    assert [record["episode"] for record in found] == [0, 1, 2]
    assert len({record["policy"] for record in found}) == 1
    assert len({record["run"] for record in found}) == 2

    assert evaluated(second, tmp_path / "other", "episodes=1") == 0
    with pytest.raises(MemobenchError, match=r"under different protocols \(policy\.sha256"):
        merge(tmp_path / "merged", [out, tmp_path / "other"])
    mixed = [*found, *({**record, "episode": 9} for record in read_episodes(tmp_path / "other"))]
    write_episodes(tmp_path / "mixed", mixed)
    with pytest.raises(MemobenchError, match="holds episodes of 2 policies"):
        read_runs([tmp_path / "mixed"])


def test_the_identity_follows_checkpoint_and_settings(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "policy", OBJECT_POSES)

    def identity(**changes: Any) -> str:
        config = PreTrainedConfig.from_pretrained(path)
        for name, value in changes.items():
            setattr(config, name, value)
        return str(acting(config, str(path), None, EnvSettings()).policy["identity"])

    assert identity() == identity(device="cuda") != identity(n_action_steps=2)
    found = acting(MemobenchRandomConfig(), None, range(7, 9), EnvSettings())
    assert (found.inputs, found.counts(8), found.counts(9)) == ("nothing", True, False)
    assert (NOBODY.protocol, NOBODY.line, NOBODY.counts(3)) == ({}, {}, True)


def test_logs_of_lerobots_own_commands_name_no_policy_and_stay_apart(tmp_path: Path) -> None:
    for _ in range(2):  # as LeRobot's training makes environments for each of its evaluations
        config = MemobenchEnvConfig(tasks=TASK, obs_type=OBJECTS, horizon=2, log_dir=str(tmp_path / "run"))
        (env,) = config.create_envs(1)["temporal"].values()
        env.reset(seed=[7])
        for _ in range(2):
            env.step([[0.0] * 7])
        env.close()
    runs = read_runs([tmp_path / "run", tmp_path / "run" / "evaluation-2"])
    assert [len(run.records) for run in runs] == [1, 1]
    assert [run.protocol["policy"] for run in runs] == [{}, {}]
