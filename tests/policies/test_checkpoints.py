"""Checkpoints: inputs that fit the environment, complete weights, trusted processors, settings, damaged files."""

from __future__ import annotations

import dataclasses
import json
import random
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.factory import make_policy_config
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from safetensors.torch import load_file, save_file

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.commands.command_line import checkpoint_of, chosen_class, parse_words, read_words
from lerobot_memobench.conformance.subject import load_subject
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies import checkpoint
from lerobot_memobench.policies.checkpoint import (
    check_as_trained,
    check_checkpoint,
    check_processor_statistics,
    check_weights,
    checkpoint_type,
    shipped_policies,
)
from lerobot_memobench.policies.compatibility import cameras_read, check_features
from lerobot_memobench.policies.memobench_mem.checkpoints import require_agreement
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.rollouts.card import training_facts
from tests.support import mutations
from tests.support.lerobot_policies import make_config, save_checkpoint

TASK = "turn_on_the_stove_and_turn_it_off"
IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"
CAMERAS = ("image", "wrist_image")
SHOWN = env_to_policy_features(MemobenchEnvConfig())
PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")


def config(kind: str = "act", cameras: tuple[str, ...] = CAMERAS, side: int = 256, **more: Any) -> PreTrainedConfig:
    return make_config(kind, dict.fromkeys(cameras, side), **more)


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of ACT that fits the environment; tests that change it copy it."""
    return save_checkpoint(tmp_path_factory.mktemp("act") / "act", config())


@pytest.fixture
def copied(act: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(act, tmp_path / "act"))


@pytest.fixture
def memory_policy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(shipped_policies()["memobench_strict"], tmp_path / "memory_policy"))


def refused(checkpoint: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """Evaluate a checkpoint that is refused before LeRobot makes an environment; return the message."""
    out = checkpoint.parent / "out"
    words = (f"tasks={TASK}", "episodes=1", "horizon=3", "videos=0", "device=cpu", f"output_dir={out}")
    assert main(["eval", "env=memobench", f"policy={checkpoint}", *words, *more]) == 2
    assert not out.exists()
    return capsys.readouterr().err.strip().splitlines()[-1]


# --- inputs ---


@pytest.mark.parametrize(
    ("inputs", "named"),
    [
        ({"cameras": ("front", "wrist")}, '"observation.images.image": "observation.images.front"'),
        ({"cameras": ("wrist_image", "front")}, '{"observation.images.image": "observation.images.front"}'),
        ({"cameras": (*CAMERAS, "empty_camera_0")}, "no image for observation.images.empty_camera_0"),
        ({"state": 7}, f"{STATE} of 7 numbers"),
        ({"action": 6}, f"{ACTION} of 6 numbers"),
        ({"side": 128}, "observation.images.image of 128 x 128 pixels"),
        ({"kind": "diffusion", "side": 128}, "--policy.resize_shape"),
    ],
)
def test_inputs_that_differ_are_refused(inputs: dict[str, Any], named: str, tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=re.escape(named)):
        check_features(str(tmp_path), config(**inputs), SHOWN, {})


@pytest.mark.parametrize(
    ("cameras", "empty", "read"),
    [
        (("camera1", "camera2", "camera3"), 0, 3),
        (("camera1", "camera2", "camera3"), 1, 2),  # the command of SmolVLA's LIBERO checkpoint has empty_cameras=1
        (("image", "image2", "empty_camera_0"), 1, 2),
        (("camera1", "camera2", "camera3", "empty_camera_0"), 1, 3),
        (("camera1",), 2, 1),
    ],
)
def test_empty_cameras_fill_the_last_images(cameras: tuple[str, ...], empty: int, read: int) -> None:
    policy = config("smolvla", cameras, empty_cameras=empty)
    assert cameras_read(policy, {}) == [IMAGES + name for name in cameras[:read]]


def test_evaluation_refuses_unfit_checkpoints(copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = save_checkpoint(tmp_path / "it", config(cameras=("front", "wrist"), state=7))
    assert "--rename_map=" in refused(other, capsys, "convention=upright")
    renamed = json.dumps({IMAGES + "image": IMAGES + "front", IMAGES + "wrist_image": IMAGES + "wrist"})
    assert "of 7 numbers" in refused(other, capsys, "convention=upright", f"--rename_map={renamed}")
    rewrite(copied, lambda weights: weights.pop("model.action_head.weight"))
    assert "model.action_head.weight" in refused(copied, capsys)


# --- weights ---


def rewrite(checkpoint: Path, change: Callable[[dict[str, torch.Tensor]], object]) -> None:
    weights = load_file(checkpoint / "model.safetensors")
    change(weights)
    save_file(weights, checkpoint / "model.safetensors")


def test_incomplete_and_unfit_weights_are_refused(tmp_path: Path) -> None:
    policy = config(cameras=("image",))
    checkpoint = save_checkpoint(tmp_path / "it", policy)
    check_weights(str(checkpoint), policy)
    name = next(iter(load_file(checkpoint / "model.safetensors")))
    rewrite(checkpoint, lambda weights: weights.update({name: torch.zeros(3, 2, 1)}))
    with pytest.raises(MemobenchError, match=f"0 of .* missing and 1 have another shape, the first being {name}"):
        check_weights(str(checkpoint), policy)
    rewrite(checkpoint, lambda weights: weights.pop(name))
    with pytest.raises(MemobenchError, match=f"1 of .* missing and 0 have another shape, the first being {name}"):
        check_weights(str(checkpoint), policy)
    (checkpoint / "model.safetensors").unlink()
    with pytest.raises(MemobenchError, match=r"model\.safetensors"):
        check_checkpoint(str(checkpoint))


def test_weights_of_repositories_are_required_if_lerobot_would_use_random_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(MemobenchError, match=r"someone/pi .*pi05 .*random"):
        check_weights("someone/pi", config("pi05"))
    check_weights("someone/act", config())  # LeRobot refuses it


# --- processors ---


@dataclasses.dataclass
class ForeignStep(ProcessorStep):
    def __call__(self, transition: Any) -> Any:
        raise AssertionError("it was built and called")

    def transform_features(self, features: Any) -> Any:
        raise AssertionError


def add_step(checkpoint: Path, file: str, **step: Any) -> None:
    held = json.loads((checkpoint / file).read_text())
    held["steps"].insert(0, step)
    (checkpoint / file).write_text(json.dumps(held))


@pytest.mark.parametrize(("kind", "file"), [("copied", PIPELINES[1]), ("memory_policy", PIPELINES[0])])
def test_loading_runs_no_code_of_a_checkpoint(
    kind: str,
    file: str,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checkpoint, mark = request.getfixturevalue(kind), tmp_path / "mark"
    add_step(checkpoint, file, **{"class": "subprocess.check_call", "config": {"args": ["touch", str(mark)]}})
    monkeypatch.chdir(tmp_path)
    held = (f"policy={checkpoint}", "device=cpu", "output_dir=out")
    for words in (["eval", "env=memobench", f"tasks={TASK}", *held], ["train", "dataset=a/b", "steps=1", *held]):
        assert main(words) == 2
        assert "subprocess.check_call" in capsys.readouterr().err
    with pytest.raises(MemobenchError, match="check_call"):
        load_subject([f"policy={checkpoint}"], tmp_path)
    if kind == "memory_policy":
        with pytest.raises(MemobenchError, match="check_call"):
            MemobenchMemPolicy.from_pretrained(checkpoint)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("step", "named"),
    [
        ({"registry_name": "no_such_step"}, "no_such_step"),
        ({"registry_name": "foreign"}, __name__.rpartition(".")[2]),
        ({"registry_name": "rename_observations_processor", "class": "os.system"}, "os.system"),
        ({"registry_name": "rename_observations_processor", "config": {"a": [{"_target_": "os.system"}]}}, "_target_"),
        ({"registry_name": "action_tokenizer_processor", "config": {"action_tokenizer_name": "a/b"}}, "a/b"),
        (
            {
                "registry_name": "action_tokenizer_processor",
                "config": {"action_tokenizer_name": PI0FastConfig.action_tokenizer_name},
            },
            None,
        ),
        ({"registry_name": "pi05_prepare_state_tokenizer_processor_step"}, None),
        ({"registry_name": "memobench_gather_memory"}, None),
    ],
)
def test_only_steps_of_installed_packages_are_accepted(step: dict[str, Any], named: str | None, copied: Path) -> None:
    ProcessorStepRegistry.register("foreign")(ForeignStep)
    add_step(copied, PIPELINES[0], **step)
    try:
        with nullcontext() if named is None else pytest.raises(MemobenchError, match=named):
            check_checkpoint(str(copied))
    finally:
        ProcessorStepRegistry.unregister("foreign")


def test_checkpoints_of_earlier_lerobots_are_refused(copied: Path) -> None:
    (copied / PIPELINES[0]).unlink()
    with pytest.raises(MemobenchError, match="migrate_policy_normalization"):
        check_checkpoint(str(copied))


# --- settings of training ---


@pytest.mark.parametrize(
    ("name", "value", "fixed"),
    [("memory_stride", 4, True), ("optimizer_lr", 1.0, True), ("n_action_steps", 2, False)],
)
def test_settings_of_training_cannot_change_at_evaluation(name: str, value: object, fixed: bool) -> None:
    checkpoint = shipped_policies()["memobench_strict"]
    policy = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=["--device=cpu"])
    setattr(policy, name, value)
    with pytest.raises(MemobenchError, match=rf"policy\.{name}=") if fixed else nullcontext():
        check_as_trained(checkpoint, policy)
    with pytest.raises(MemobenchError, match=rf"policy\.{name}=") if fixed else nullcontext():
        assert getattr(MemobenchMemPolicy.from_pretrained(checkpoint, config=policy).config, name) == value


# --- damage ---

TRAINED = {"dataset": {"repo_id": "me/it", "root": None, "episodes": None}, "steps": 5}
RECIPE = """# A recipe.
policy: {type: act, chunk_size: 100}
dataset:
  repo_id: me/it
steps: 100
"""


@pytest.mark.parametrize("kind", ["checkpoint", "recipe"])
@pytest.mark.parametrize("count", [200, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])])
def test_damaged_files_end_in_a_result_or_an_error(act: Path, tmp_path: Path, kind: str, count: int) -> None:
    source, whole = tmp_path / "source", tmp_path / "whole"
    whole.mkdir()
    folder = Path(shutil.copytree(act, source / "it"))
    (folder / "model.safetensors").write_bytes(b"")
    (folder / "train_config.json").write_text(json.dumps(TRAINED))
    names = ["recipe.yaml"] if kind == "recipe" else ["config.json", *sorted(file.name for file in folder.glob("*_*"))]
    (folder / "recipe.yaml").write_text(RECIPE)
    damaged = whole / "it"

    def prepare(rng: random.Random) -> None:
        mutations.fresh_copy(source, whole)
        name = rng.choice(names)
        mutations.damage(damaged / name, rng, mutations.mutated_json if "json" in name else mutations.mutated_bytes)

    def use(_: random.Random) -> None:
        if kind == "recipe":
            words = read_words("train", parse_words([f"config_path={damaged / 'recipe.yaml'}"]))
            words.default("dataset.repo_id", "a/b").build()
            return
        training_facts(damaged)
        check_checkpoint(str(damaged))
        checkpoint_type(str(damaged))
        check_processor_statistics(damaged)
        require_agreement(damaged, None, MemobenchMemConfig(device="cpu"), training=True)

    found = mutations.ends_well(range(count), prepare, use, whole, ("it",))
    assert min(found["result"], found["refused"]) > count / 8


def test_a_policy_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package has one trained policy, and a folder that is none."""
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path / "shipped")
    folder = tmp_path / "shipped" / "memobench_strict"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text('{"type": "memobench_mem"}')
    (tmp_path / "shipped" / "notes").mkdir()
    assert checkpoint.shipped_policies() == {"memobench_strict": folder}
    assert checkpoint_of("memobench_strict", {"act"}) == str(folder)
    assert checkpoint.checkpoint_type(str(folder)) == "memobench_mem"
    assert checkpoint_of("notes", {"act"}) is None
    assert checkpoint.portable_path(str(folder)) == "memobench_strict"
    assert checkpoint.portable_path("outputs/train/me") == "outputs/train/me"
    mine = tmp_path / "here" / "memobench_strict"
    mine.mkdir(parents=True)
    (mine / "config.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "here")
    assert checkpoint_of("memobench_strict", {"act"}) == str(folder), "a known name, wherever the command is run"
    assert checkpoint_of("./memobench_strict", {"act"}) == "memobench_strict", "a folder is named by a path"
    assert checkpoint.local_folder("memobench_strict") == folder


def test_liberos_xvla_and_unknown_types_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="action_mode=auto"):
        check_features(str(tmp_path), make_policy_config("xvla", device="cpu"), SHOWN, {})
    (tmp_path / "config.json").write_text('{"type": "of_a_plugin"}')
    with pytest.raises(MemobenchError, match="'of_a_plugin', which no installed package registers"):
        chosen_class(PreTrainedConfig, "policy", {"path": str(tmp_path)})
