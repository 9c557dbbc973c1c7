"""A checkpoint runs on images of the convention that it was trained on, or is refused with the command for it."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_policy_config

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.commands.command_line import parse_words
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.compatibility import chosen_convention
from lerobot_memobench.rollouts.plan import plan_line, read_settings, with_names
from lerobot_memobench.sim.convention import CONVENTIONS
from tests.support.fake_loop import make_checkpoint

OURS, THEIRS, NUMBERED = ("image", "wrist_image"), ("image", "image2"), ("camera1", "camera2")
RENAMED = {f"observation.images.{old}": f"observation.images.{new}" for old, new in zip(OURS, NUMBERED, strict=True)}
RENAMED_LIBERO = {"observation.images.image2": "observation.images.camera2"}
STOVE = "turn_on_the_stove_and_turn_it_off"


def features(cameras: tuple[str, ...]) -> dict[str, Any]:
    return {f"observation.images.{name}": {"type": "VISUAL", "shape": [3, 256, 256]} for name in cameras}


def saved(folder: Path, cameras: tuple[str, ...], **training: Any) -> Path:
    """Write a checkpoint without weights that fit.

    ``training``: repo_id and root of its dataset, rename_map, and the same of its processor's ``step``.
    """
    path = make_checkpoint(folder / "act", "act", input_features=features(cameras))
    if step := training.pop("step", None):
        steps = [{"registry_name": "rename_observations_processor", "config": {"rename_map": step}}]
        (path / "policy_preprocessor.json").write_text(json.dumps({"name": "before", "steps": steps}))
    renamed = training.pop("rename_map", {})
    if training or renamed:
        (path / "train_config.json").write_text(json.dumps({"dataset": training, "rename_map": renamed}))
    return path


def outcome(path: Path, asked: str | None) -> str:
    """Return the convention in which a checkpoint runs, else the message."""
    try:
        return str(chosen_convention(str(path), PreTrainedConfig.from_pretrained(path), asked))
    except MemobenchError as error:
        return str(error)


@pytest.mark.parametrize(
    ("cameras", "training", "expected"),
    [
        (THEIRS, {}, "libero"),
        (NUMBERED, {"repo_id": "me/kitchen", "rename_map": RENAMED_LIBERO}, "libero"),
        (NUMBERED, {"step": RENAMED_LIBERO}, "libero"),
        (NUMBERED, {"step": RENAMED}, "upright"),
        (("image", "empty_camera_0"), {"repo_id": "HuggingFaceVLA/libero"}, "libero"),
        (OURS, {"repo_id": "physical-intelligence/libero"}, "libero"),
        (NUMBERED, {"repo_id": "me/my_LIBERO_subset"}, "libero"),
        (OURS, {}, "upright"),
        (NUMBERED, {"repo_id": "local/demos", "rename_map": RENAMED}, "upright"),
        (NUMBERED, {}, None),
        (("front", "top"), {"repo_id": "me/kitchen"}, None),
        (OURS, {"repo_id": "local/libero_scenes"}, None),
    ],
)
def test_what_a_checkpoint_states(
    tmp_path: Path, cameras: tuple[str, ...], training: dict[str, Any], expected: str | None
) -> None:
    path = saved(tmp_path, cameras, **training)
    found = {asked: outcome(path, asked) for asked in (None, "upright", "libero")}
    runs = {asked: convention for asked, convention in found.items() if convention in CONVENTIONS}
    both = {"upright": "upright", "libero": "libero"}
    assert runs == ({None: expected, expected: expected} if expected else both)
    for message in set(found.values()) - {*CONVENTIONS}:
        for one in [expected] if expected else both:
            assert f"lerobot eval env=memobench policy={path} convention={one}" in message
        assert "lerobot-eval" in message
        assert "--env.convention=" in message


@pytest.mark.parametrize("convention", ["upright", "libero"])
def test_the_dataset_on_this_machine_decides(tmp_path: Path, convention: str) -> None:
    """Also under LIBERO's name, and with a policy that reads one camera."""
    from lerobot_memobench.datasets.layout import dataset_features

    described = dataset_features((256, 256), CONVENTIONS[convention].values())
    (tmp_path / "libero_scenes" / "meta").mkdir(parents=True)
    info = {"codebase_version": "v3.0", "total_episodes": 1, "features": described}
    (tmp_path / "libero_scenes" / "meta" / "info.json").write_text(json.dumps(info))
    path = saved(tmp_path, ("image",), repo_id="local/libero_scenes", root=str(tmp_path / "libero_scenes"))
    assert outcome(path, None) == outcome(path, convention) == convention
    assert "expects images" in outcome(path, {"upright": "libero", "libero": "upright"}[convention])


def test_no_images_no_convention(tmp_path: Path) -> None:
    objects = {"observation.environment_state": {"type": "ENV", "shape": [208]}}
    path = make_checkpoint(tmp_path / "act", "act", input_features=objects)
    assert outcome(path, None) == "None", "that of the environment"
    policy = make_policy_config("memobench_mem", perception="objects", detector="package", device="cpu")
    with pytest.raises(MemobenchError, match="its detector reads them"):
        chosen_convention(None, policy, "libero")


def test_a_rename_map_does_not_hide_the_convention(tmp_path: Path) -> None:
    line = ["env=memobench", f"tasks={STOVE}", "episodes=1", f"policy={saved(tmp_path, THEIRS)}"]
    pairs = ({"wrist_image": "image2"}, {"image": "image2", "wrist_image": "image"})
    for names in pairs:
        renamed = {f"observation.images.{old}": f"observation.images.{new}" for old, new in names.items()}
        for words in ([], ["convention=libero"]):
            with pytest.raises(MemobenchError, match="found upright in rename_map, which does not mirror images"):
                plan_line([*line, f"rename_map={json.dumps(renamed)}", *words])
    ours = saved(tmp_path / "ours", OURS)
    back = json.dumps({"observation.images.image2": "observation.images.wrist_image"})
    with pytest.raises(MemobenchError, match="expects images of convention=upright"):
        plan_line([*line[:3], f"policy={ours}", "convention=libero", f"rename_map={back}"])
    plan = plan_line([*line[:3], "policy=memobench_random", "convention=libero"])
    assert plan.environment.features_map["pixels/image2"] == "observation.images.image2"


def test_the_names_of_a_training_are_those_of_its_evaluation(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Where the environment has them, and no other names were asked for."""
    names = {
        f"observation.images.{old}": f"observation.images.{new}" for old, new in zip(THEIRS, NUMBERED, strict=True)
    }
    path = saved(tmp_path, NUMBERED, repo_id="lerobot/libero", rename_map=names | {"observation.images.top": "top"})
    asked = read_settings(parse_words(["env=memobench", f"policy={path}"]))
    for convention, expected in (("libero", names), ("upright", dict([*names.items()][:1]))):
        assert with_names(asked, MemobenchEnvConfig(convention=convention)).rename_map == expected
    mine = replace(asked, rename_map={"observation.images.image": "mine"})
    assert with_names(mine, MemobenchEnvConfig(convention="libero")) == mine
    assert outcome(path, None) == "libero"
    assert f"images have convention=libero, as in the training of {path}" in caplog.text


@contextmanager
def refused(message: str) -> Iterator[None]:
    """Expect that LeRobot's command ends with one sentence."""
    with pytest.raises(SystemExit) as stop:
        yield
    assert re.search(message, str(stop.value.__cause__))


@pytest.mark.parametrize("mode", ["ee6d", "auto"])
def test_lerobots_command_cannot_run_an_xvla(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    """It would get LIBERO's pipelines, of absolute poses."""
    path = make_checkpoint(tmp_path / "xvla", "xvla", input_features=features(THEIRS), action_mode=mode)
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", "--env.type=memobench", f"--policy.path={path}"])
    with refused({"ee6d": "absolute poses", "auto": "run `lerobot eval"}[mode]):
        MemobenchEnvConfig(tasks=STOVE, log_dir=str(tmp_path / "log")).create_envs(1)
    if mode == "ee6d":
        with pytest.raises(MemobenchError, match="absolute poses of two hands"):
            plan_line(["env=memobench", f"tasks={STOVE}", "episodes=1", f"policy={path}"])


def test_camera_name_mapping_of_a_command(tmp_path: Path) -> None:
    """A checkpoint with the names of a LIBERO model card needs no ``rename_map``."""
    names = {"agentview_image": "camera1", "robot0_eye_in_hand_image": "camera2"}
    path = saved(tmp_path, NUMBERED, rename_map=RENAMED_LIBERO)
    line = ["env=memobench", f"tasks={STOVE}", "episodes=1", f"policy={path}"]
    plan = plan_line([*line, f"camera_name_mapping={json.dumps(names)}"])
    assert plan.environment.camera_name_mapping == names
    assert plan.environment.features_map["pixels/camera2"] == "observation.images.camera2"
    unclear = saved(tmp_path / "unclear", NUMBERED)
    mapping = f"camera_name_mapping={json.dumps(names)}"
    assert plan_line([*line[:3], f"policy={unclear}", mapping]).environment.convention == "libero"
    ours = saved(tmp_path / "ours", OURS)
    with pytest.raises(MemobenchError, match=r"expects images of convention=upright.*, and found libero"):
        plan_line([*line[:3], f"policy={ours}", mapping])
    with pytest.raises(MemobenchError, match="expected a mapping"):
        plan_line([*line, "camera_name_mapping=[camera1]"])


def test_lerobots_own_command_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs, unclear = saved(tmp_path, THEIRS), saved(tmp_path / "unclear", NUMBERED)

    def envs(path: Path, *flags: str, command: str = "lerobot-eval", **settings: Any) -> Any:
        monkeypatch.setattr(sys, "argv", [command, "--env.type=memobench", f"--policy.path={path}", *flags])
        return MemobenchEnvConfig(tasks=STOVE, log_dir=str(tmp_path / "log"), **settings).create_envs(1)

    assert _shown(envs(theirs)) == {"image", "image2"}
    with refused(r"--policy\.path=.*--env\.convention=libero"):
        envs(theirs, "--env.convention=upright")
    settings = tmp_path / "settings.yaml"
    settings.write_text("env: {type: memobench, convention: upright}")
    with refused("and found upright"):
        envs(theirs, f"--config_path={settings}")
    names = {"observation.images.wrist_image": "observation.images.image2"}
    with refused("which does not mirror images"):
        envs(theirs, f"--rename_map={json.dumps(names)}")
    with refused("may expect upright images or mirrored ones"):
        envs(unclear)
    assert _executed(envs(theirs, "--env.convention=libero", convention="libero")) == 100
    assert envs(unclear, "--env.convention=upright")


def test_several_suites_take_the_convention_of_the_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = ["--env.type=memobench", f"--policy.path={saved(tmp_path, OURS)}", "--eval.n_episodes=1"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags])
    config = MemobenchEnvConfig(task="libero_object,libero_goal", task_ids=[0], log_dir=str(tmp_path / "log"))
    for suite, envs in config.create_envs(1).items():
        assert _shown({suite: envs}) == {*OURS}
    assert {key for key in config.features_map if key.startswith("pixels/")} == {f"pixels/{name}" for name in OURS}


@pytest.mark.parametrize(("policy", "executed"), [("--policy.type=act", 100), ("--policy.type=vqbet", 5), ("", 100)])
def test_lerobots_commands_evaluate_with_the_plans_of_their_policies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, policy: str, executed: int
) -> None:
    """A training may continue from any checkpoint."""
    flags = ["--dataset.repo_id=local/demos", policy or f"--policy.path={saved(tmp_path, THEIRS)}"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags, "--env.type=memobench"])
    strict = MemobenchEnvConfig(tasks="10", suite="strict", log_dir=str(tmp_path / "log"))
    assert _executed(strict.create_envs(1)) == executed
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", "--policy.type=memobench_expert", "--env.type=memobench"])
    assert _executed(MemobenchEnvConfig(suite="strict", tasks="10").create_envs(1)) == 1
    file = tmp_path / "train_config.json"
    file.write_text(json.dumps({"dataset": {"repo_id": "local/demos"}, "policy": {"type": "vqbet"}}))
    monkeypatch.setattr(sys, "argv", ["lerobot_train.py", f"--config_path={file}"])
    assert _executed(MemobenchEnvConfig(suite="strict", tasks="10").create_envs(1)) == 5


def _shown(suites: Any) -> set[str]:
    ((env,),) = (suite.values() for suite in suites.values())
    return {*env.single_observation_space["pixels"]}


def _executed(suites: Any) -> int | None:
    """Return the declared number of actions per plan, which is the least length of a hold."""
    ((env,),) = (suite.values() for suite in suites.values())
    found: int | None = env.call("get_wrapper_attr", "settings")[0].replan_steps
    return found
