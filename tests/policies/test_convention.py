"""A checkpoint runs on pictures of the convention that it was trained on, or is refused with the command for it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_policy_config

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.convention import chosen_convention
from lerobot_memobench.run.plan import plan_line
from lerobot_memobench.sim.convention import CONVENTIONS
from tests.support.fake_loop import make_checkpoint

OURS, THEIRS, NUMBERED = ("image", "wrist_image"), ("image", "image2"), ("camera1", "camera2")
RENAMED = {f"observation.images.{old}": f"observation.images.{new}" for old, new in zip(OURS, NUMBERED, strict=True)}
RENAMED_LIBERO = {"observation.images.image2": "observation.images.camera2"}
STOVE = "turn_on_the_stove_and_turn_it_off"


def features(cameras: tuple[str, ...]) -> dict[str, Any]:
    return {f"observation.images.{name}": {"type": "VISUAL", "shape": [3, 256, 256]} for name in cameras}


def saved(folder: Path, cameras: tuple[str, ...], **training: Any) -> Path:
    """Write a checkpoint without weights that fit; ``training``: repo_id and root of its dataset, and rename_map."""
    path = make_checkpoint(folder / "act", "act", input_features=features(cameras))
    renamed = training.pop("rename_map", {})
    if training or renamed:
        (path / "train_config.json").write_text(json.dumps({"dataset": training, "rename_map": renamed}))
    return path


def outcome(path: Path, asked: str | None) -> str:
    """Return "" if a checkpoint may run, else the message."""
    try:
        chosen_convention(str(path), PreTrainedConfig.from_pretrained(path), asked)
    except MemobenchError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("cameras", "training", "expected"),
    [
        (THEIRS, {}, "libero"),
        (THEIRS, {"repo_id": "me/kitchen"}, "libero"),
        (NUMBERED, {"repo_id": "me/kitchen", "rename_map": RENAMED_LIBERO}, "libero"),
        (("image", "empty_camera_0"), {"repo_id": "HuggingFaceVLA/libero"}, "libero"),
        (NUMBERED, {"repo_id": "lerobot/libero_object_image"}, "libero"),
        (OURS, {"repo_id": "physical-intelligence/libero"}, "libero"),
        (NUMBERED, {"repo_id": "me/my_LIBERO_subset"}, "libero"),
        (OURS, {}, "upright"),
        (OURS, {"repo_id": "memobench/memobench"}, "upright"),
        (NUMBERED, {"repo_id": "local/demos", "rename_map": RENAMED}, "upright"),
        (NUMBERED, {}, None),
        (("image",), {}, None),
        (("front", "top"), {"repo_id": "me/kitchen"}, None),
        (OURS, {"repo_id": "local/libero_scenes"}, None),
    ],
)
def test_what_a_checkpoint_states(
    tmp_path: Path, cameras: tuple[str, ...], training: dict[str, Any], expected: str | None
) -> None:
    path = saved(tmp_path, cameras, **training)
    accepted = {asked for asked in (None, "upright", "libero") if not outcome(path, asked)}
    assert accepted == {"libero": {"libero"}, "upright": {None, "upright"}, None: {"upright", "libero"}}[expected]
    for asked in {None, "upright", "libero"} - accepted:
        message = outcome(path, asked)
        for one in [expected] if expected else ["upright", "libero"]:
            assert f"lerobot eval env=memobench policy={path} convention={one}" in message
        assert "lerobot-eval" in message
        assert "--env.convention=" in message


@pytest.mark.parametrize("convention", ["upright", "libero"])
def test_the_dataset_on_this_machine_decides(tmp_path: Path, convention: str) -> None:
    """Also under LIBERO's name, and with a policy that reads one camera."""
    from lerobot_memobench.datasets.lerobot_format.layout import dataset_features

    described = dataset_features((256, 256), CONVENTIONS[convention].values())
    (tmp_path / "libero_scenes" / "meta").mkdir(parents=True)
    info = {"codebase_version": "v3.0", "total_episodes": 1, "features": described}
    (tmp_path / "libero_scenes" / "meta" / "info.json").write_text(json.dumps(info))
    path = saved(tmp_path, ("image",), repo_id="local/libero_scenes", root=str(tmp_path / "libero_scenes"))
    assert not outcome(path, convention)
    assert outcome(path, {"upright": "libero", "libero": "upright"}[convention])


def test_no_pictures_no_convention(tmp_path: Path) -> None:
    objects = {"observation.environment_state": {"type": "ENV", "shape": [208]}}
    path = make_checkpoint(tmp_path / "act", "act", input_features=objects)
    assert not outcome(path, None)
    policy = make_policy_config("memobench_mem", perception="objects", detector="package", device="cpu")
    with pytest.raises(MemobenchError, match="its detector reads them"):
        chosen_convention(None, policy, "libero")


def test_a_rename_map_does_not_hide_the_convention(tmp_path: Path) -> None:
    line = ["env=memobench", f"tasks={STOVE}", "episodes=1", f"policy={saved(tmp_path, THEIRS)}"]
    pairs = ({"wrist_image": "image2"}, {"image": "image2", "wrist_image": "image"})
    for names in pairs:
        renamed = {f"observation.images.{old}": f"observation.images.{new}" for old, new in names.items()}
        with pytest.raises(MemobenchError, match="expects pictures of convention=libero"):
            plan_line([*line, f"rename_map={json.dumps(renamed)}"])
    with pytest.raises(MemobenchError, match="did you mean 'libero'"):
        plan_line([*line, "convention=liberu"])
    ours = saved(tmp_path / "ours", OURS)
    back = json.dumps({"observation.images.image2": "observation.images.wrist_image"})
    with pytest.raises(MemobenchError, match="expects pictures of convention=upright"):
        plan_line([*line[:3], f"policy={ours}", "convention=libero", f"rename_map={back}"])
    plan = plan_line([*line[:3], "policy=memobench_random", "convention=libero"])
    assert plan.environment.features_map["pixels/image2"] == "observation.images.image2"


def test_lerobots_own_command_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs, unclear = saved(tmp_path, THEIRS), saved(tmp_path / "unclear", NUMBERED)

    def envs(path: Path, *flags: str, command: str = "lerobot-eval", **settings: Any) -> Any:
        monkeypatch.setattr(sys, "argv", [command, "--env.type=memobench", f"--policy.path={path}", *flags])
        return MemobenchEnvConfig(tasks=STOVE, log_dir=str(tmp_path / "log"), **settings).create_envs(1)

    with pytest.raises(MemobenchError, match=r"--policy\.path=.*--env\.convention=libero"):
        envs(theirs)
    with pytest.raises(MemobenchError, match="may expect upright pictures or mirrored ones"):
        envs(unclear)
    assert _executed(envs(theirs, "--env.convention=libero", convention="libero")) == 100
    assert envs(unclear, "--env.convention=upright")
    assert _executed(envs(theirs, command="lerobot-train")) is None, "a training may continue from any checkpoint"


def _executed(suites: Any) -> int | None:
    """Return the declared number of actions per plan, which is the least length of a hold."""
    ((env,),) = (suite.values() for suite in suites.values())
    found: int | None = env.call("get_wrapper_attr", "settings")[0].replan_steps
    return found
