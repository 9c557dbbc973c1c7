"""Who acts, on what inputs, and which episodes were asked for: told by LeRobot's command line, kept by every line."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.pi05.configuration_pi05 import PI05Config

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.acting import acting
from lerobot_memobench.envs.command_line import asked_seeds, policy_being_run
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import read_episodes, read_protocol_file, write_episodes
from lerobot_memobench.envs.observations import BOTH, OBJECTS, PIXELS, policy_inputs
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import read_protocol, read_runs
from lerobot_memobench.policies.baselines.configuration_baselines import (
    MemobenchBlindConfig,
    MemobenchExpertConfig,
    MemobenchRandomConfig,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.run.lerobot_commands import call_lerobot
from lerobot_memobench.run.merging import merge
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


def lerobot_eval(policy: Path, out: Path, *more: str, episodes: int = 1, batch: int = 1) -> int:
    """Run LeRobot's own `lerobot-eval`."""
    flags = [f"--policy.path={policy}", "--policy.device=cpu", "--env.type=memobench", f"--env.tasks={TASK}"]
    flags += ["--env.horizon=3", "--env.render=fast", "--seed=7", "--eval.use_async_envs=false"]
    flags += [f"--eval.n_episodes={episodes}", f"--eval.batch_size={batch}", f"--output_dir={out}"]
    return call_lerobot("eval", [*flags, *more])


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
        (MemobenchExpertConfig, PIXELS, "privileged simulator state"),
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


def test_object_poses_are_refused_or_named(tmp_path: Path) -> None:
    """By `lerobot-eval`, which ended in a KeyError, and by `lerobot eval`, which showed them without a word."""
    policy = checkpoint(tmp_path / "policy", PICTURE | OBJECT_POSES)
    with pytest.raises(MemobenchError, match=r"lacks inputs of the policy \(privileged .* set it to both"):
        lerobot_eval(policy, tmp_path / "plain")
    assert not (tmp_path / "plain" / "episodes").exists()
    assert lerobot_eval(policy, tmp_path / "plain", "--env.obs_type=both") == 0
    (record,) = read_episodes(tmp_path / "plain")
    assert record["inputs"] == f"pixels, {POSES}"
    assert record["policy"] == read_protocol_file(tmp_path / "plain")["policy"]["identity"]
    assert record["run"]

    ours = tmp_path / "ours"
    words = [f"tasks={TASK}", "episodes=1", "horizon=3", "env.render=fast", "videos=0"]
    assert main(["eval", "env=memobench", f"policy={policy}", *words, f"output_dir={ours}"]) == 0
    assert read_episodes(ours)[0]["policy"] == record["policy"], "the same policy by both commands"
    assert memobench(["compare", str(ours), str(tmp_path / "plain")]) == 0, "under one protocol, replan interval too"
    assert json.loads((ours / "card.json").read_text())["protocol"]["inputs"] == f"pixels, {POSES}"
    assert f"| inputs | pixels, {POSES} |" in (ours / "card.md").read_text()
    assert json.loads((ours / "report.json").read_text())["inputs"] == f"pixels, {POSES}"
    assert (ours / "report.md").read_text().count(f"Policy inputs: pixels, {POSES}.") == 4, "under every table"

    out, page = tmp_path / "report", tmp_path / "page"
    formats = [word for name in ("table", "markdown", "csv", "latex", "json") for word in ("--format", name)]
    assert memobench(["report", str(ours), str(tmp_path / "plain"), *formats, "--out", str(out)]) == 0
    for file in sorted(path for path in out.iterdir() if path.is_file()):  # CSV files, in a folder, are data alone
        assert f"pixels, {POSES}" in " ".join(file.read_text().split()), file.name
    assert memobench(["html", str(ours), "--out", str(page)]) == 0
    assert f"inputs: pixels, {POSES}" in (page / "index.html").read_text()

    merged = tmp_path / "merged"
    assert merge(merged, [tmp_path / "plain"]) == []
    assert read_protocol(merged)["inputs"] == f"pixels, {POSES}"
    assert read_protocol(merged)["policy"]["identity"] == record["policy"]
    assert {each["inputs"] for each in read_episodes(merged)} == {f"pixels, {POSES}"}


# --- whose episodes they are ---


def test_two_policies_are_not_one_evaluation(tmp_path: Path) -> None:
    first, second = (checkpoint(tmp_path / name, OBJECT_POSES, seed) for seed, name in enumerate(("first", "second")))
    shown = "--env.obs_type=environment_state_agent_pos"
    assert lerobot_eval(first, tmp_path / "out", shown, episodes=3, batch=2) == 0
    records = read_episodes(tmp_path / "out")
    assert [record["episode"] for record in records] == [0, 1, 2], "LeRobot ran a fourth, in a batch of two"
    assert memobench(["report", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "report.json").read_text())["average"]["n"] == 3

    with pytest.raises(MemobenchError, match=r"holds episodes of another policy \(policy.identity: act .* another fol"):
        lerobot_eval(second, tmp_path / "out", shown)
    with pytest.raises(MemobenchError, match=r"replan_steps: 4 and 2; policy\.identity"):
        lerobot_eval(first, tmp_path / "out", shown, "--policy.n_action_steps=2")
    assert read_episodes(tmp_path / "out") == records
    # The same policy goes on, whatever is said of where it runs, or said that is so anyway.
    assert (
        lerobot_eval(first, tmp_path / "out", shown, "--policy.n_action_steps=4", "--env.resume=true", episodes=4) == 0
    )
    found = read_episodes(tmp_path / "out")
    assert [record["episode"] for record in found] == [0, 1, 2, 3]
    assert len({record["policy"] for record in found}) == 1
    assert len({record["run"] for record in found}) == 2

    assert lerobot_eval(second, tmp_path / "other", shown) == 0
    with pytest.raises(MemobenchError, match=r"under other protocols \(policy\.identity"):
        merge(tmp_path / "merged", [tmp_path / "out", tmp_path / "other"])
    mixed = [*found, *({**record, "episode": 9} for record in read_episodes(tmp_path / "other"))]
    write_episodes(tmp_path / "mixed", mixed)
    with pytest.raises(
        MemobenchError, match=r"holds episodes of 2 policies: act \w+ .* and act \w+ .* folder of its own"
    ):
        read_runs([tmp_path / "mixed"])


def test_evaluations_within_a_training_are_kept_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"
    line = [
        "lerobot-train",
        "--policy.type=act",
        "--dataset.repo_id=a/b",
        "--env.type=memobench",
        f"--output_dir={out}",
    ]
    monkeypatch.setattr(sys, "argv", [*line, "--eval.n_episodes=1", "--seed=7"])
    config = MemobenchEnvConfig(task=TASK, obs_type=OBJECTS, horizon=2)
    for _ in range(2):  # as LeRobot's training makes them for each of its evaluations
        (env,) = config.create_envs(1)["temporal"].values()
        env.reset(seed=[7])
        for _ in range(2):
            env.step([[0.0] * 7])
        env.close()
    folders = sorted(path.name for path in out.iterdir())
    assert folders == ["evaluation-1", "evaluation-2"]
    runs = read_runs([out / name for name in folders])
    assert [len(run.records) for run in runs] == [1, 1]
    assert len({run.records[0]["policy"] for run in runs}) == 2
    assert runs[0].records[0]["policy"].startswith("act in training")
    assert len({run.method for run in runs}) == 2
    assert {run.summary.inputs for run in runs} == {POSES}
    with pytest.raises(MemobenchError, match="under other protocols"):
        merge(tmp_path / "merged", [out / name for name in folders])


def test_nobody_is_told_outside_of_lerobots_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["notebook"])
    found = acting(policy_being_run(), None, asked_seeds(), PIXELS, False)
    assert (found.protocol, found.line, found.counts(3)) == ({}, {}, True)


def test_a_file_of_settings_tells_who_acts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"policy": {"type": "memobench_random", "seed": 3}, "seed": 7, "eval": {"n_episodes": 2}}
    (tmp_path / "eval.json").write_text(json.dumps(told))
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--config_path={tmp_path / 'eval.json'}"])
    found = acting(policy_being_run(), None, asked_seeds(), PIXELS, False)
    assert (found.policy["type"], found.inputs, found.seeds) == ("memobench_random", "nothing", range(7, 9))
    (tmp_path / "eval.json").write_text(json.dumps({**told, "policy": {"type": "memobench_random", "seed": 4}}))
    assert acting(policy_being_run(), None, asked_seeds(), PIXELS, False).policy["identity"] != found.policy["identity"]
