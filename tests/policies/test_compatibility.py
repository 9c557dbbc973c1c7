"""Checkpoints of LeRobot's policies that were made for something else, or are not whole: one sentence by each command.

Nothing is simulated: a checkpoint is refused before LeRobot makes an environment.
"""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import struct
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from safetensors.torch import load_file, save_file

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.conformance.subject import load_subject
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import check_as_trained, check_checkpoint, check_weights, shipped_policies
from lerobot_memobench.policies.compatibility import SIZE_COUNTS, check_features
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    MAY_DIFFER,
    PI05_ALONE,
    MemobenchMemConfig,
)
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy

TASK = "turn_on_the_stove_and_turn_it_off"
IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"
CAMERAS = ("image", "wrist_image")
SHOWN = env_to_policy_features(MemobenchEnvConfig())
PI0_FAST = PI0FastConfig.action_tokenizer_name
TINY: dict[str, dict[str, Any]] = {
    "act": {
        "pretrained_backbone_weights": None,
        "use_vae": False,
        "dim_model": 32,
        "n_heads": 2,
        "dim_feedforward": 32,
        "n_encoder_layers": 1,
    },
    "diffusion": {"pretrained_backbone_weights": None, "down_dims": (16, 32), "n_groups": 4},
    "tdmpc": {"latent_dim": 8, "mlp_dim": 16, "image_encoder_hidden_dim": 8},
}


def config(
    kind: str = "act", cameras: tuple[str, ...] = CAMERAS, state: int = 8, action: int = 7, side: int = 256, **more: Any
) -> PreTrainedConfig:
    """Configuration of a policy that sees these cameras' square pictures and so many numbers."""
    return make_policy_config(
        kind,
        device="cpu",
        push_to_hub=False,
        input_features={
            STATE: PolicyFeature(FeatureType.STATE, (state,)),
            **{IMAGES + name: PolicyFeature(FeatureType.VISUAL, (3, side, side)) for name in cameras},
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (action,))},
        **TINY.get(kind, {}),
        **more,
    )


def saved(folder: Path, policy: PreTrainedConfig) -> Path:
    """Checkpoint of such a policy with random weights, as LeRobot writes one."""
    get_policy_class(policy.type)(policy).save_pretrained(folder)
    save_processors(folder, policy)
    return folder


def save_processors(folder: Path, policy: PreTrainedConfig) -> None:
    assert policy.input_features is not None
    assert policy.output_features is not None
    features = {**policy.input_features, **policy.output_features}
    shapes = {name: (3, 1, 1) if one.type is FeatureType.VISUAL else one.shape for name, one in features.items()}
    stats = {
        name: {
            "mean": torch.zeros(shape),
            "std": torch.ones(shape),
            "min": -torch.ones(shape),
            "max": torch.ones(shape),
        }
        for name, shape in shapes.items()
    }
    for pipeline in make_pre_post_processors(policy, dataset_stats=stats):
        pipeline.save_pretrained(folder)


def refused(checkpoint: Path, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """Evaluate; return the sentence that refuses it."""
    out = checkpoint.parent / "out"
    words = (f"tasks={TASK}", "episodes=1", "horizon=3", "videos=0", "device=cpu", f"output_dir={out}")
    assert main(["eval", "env=memobench", f"policy={checkpoint}", *words, *more]) == 2
    assert not out.exists()
    return capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        ({"cameras": ("front", "wrist")}, '"observation.images.image": "observation.images.front"'),
        ({"cameras": ("wrist_image", "front")}, '{"observation.images.image": "observation.images.front"}'),
        ({"cameras": (*CAMERAS, "empty_camera_0")}, "no picture for observation.images.empty_camera_0"),
        ({"state": 7}, "sees observation.state of 7 numbers, and the environment shows 8"),
        ({"action": 6}, "acts by action of 6 numbers, and the environment takes 7"),
        ({"side": 128}, "observation.images.image of 128 x 128 pixels .* shows 256 x 256"),
    ],
)
def test_other_inputs_than_in_training_are_refused(inputs: dict[str, Any], said: str, tmp_path: Path) -> None:
    save_processors(tmp_path, config(**inputs))
    with pytest.raises(MemobenchError, match=said if ".*" in said else re.escape(said)):
        check_features(str(tmp_path), config(**inputs), SHOWN, {})


def test_the_command_refuses_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "of 7 numbers" in refused(saved(tmp_path / "it", config(state=7)), capsys)


def test_what_the_sentence_says_to_do_is_enough(tmp_path: Path) -> None:
    other = saved(tmp_path / "it", config(cameras=("front", "wrist")))
    with pytest.raises(MemobenchError, match="--rename_map=") as error:
        check_features(str(other), PreTrainedConfig.from_pretrained(other), SHOWN, {})
    told = str(error.value).partition("--rename_map='")[2].rstrip("'")
    check_features(str(other), PreTrainedConfig.from_pretrained(other), SHOWN, yaml.safe_load(told))
    with pytest.raises(MemobenchError, match=r"sees observation.images.front"):  # the other's name for what is there
        check_features(str(other), config(cameras=("front", "wrist")), SHOWN, {IMAGES + "image": IMAGES + "wrist"})


def test_a_rename_map_is_followed_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It maps the cameras; what is refused then is the number of joints."""
    other = saved(tmp_path / "it", config(cameras=("front", "wrist"), state=7))
    renamed = json.dumps({IMAGES + "image": IMAGES + "front", IMAGES + "wrist_image": IMAGES + "wrist"})
    assert "of 7 numbers" in refused(other, capsys, f"--rename_map={renamed}")


@pytest.mark.parametrize("kind", TINY)
def test_what_sees_the_environment_is_let_pass(kind: str, tmp_path: Path) -> None:
    cameras = ("image",) if kind == "tdmpc" else CAMERAS
    good = saved(tmp_path / "it", config(kind, cameras=cameras))
    check_features(str(good), PreTrainedConfig.from_pretrained(good), SHOWN, {})


def test_shipped_policies_are_let_pass() -> None:
    for folder in shipped_policies().values():
        shown = env_to_policy_features(MemobenchEnvConfig(obs_type="both"))
        check_features(str(folder), PreTrainedConfig.from_pretrained(folder), shown, {})


@pytest.mark.parametrize("kind", ["pi0", "pi05", "memobench_mem"])
def test_policies_that_resize_pictures_may_have_learned_from_others(kind: str, tmp_path: Path) -> None:
    check_features(str(tmp_path), config(kind, side=128), SHOWN, {})


def test_diffusion_may_resize_pictures(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"of 128 x 128 pixels .*, or with --policy.resize_shape on both"):
        check_features(str(tmp_path), config("diffusion", side=128), SHOWN, {})
    check_features(str(tmp_path), config("diffusion", side=128, resize_shape=(96, 96)), SHOWN, {})


def test_the_list_of_sizes_is_of_lerobots_policies() -> None:
    known = PreTrainedConfig.get_known_choices()
    for kind, setting in SIZE_COUNTS.items():
        assert kind in known
        assert setting is None or setting in known[kind].__dataclass_fields__


def test_policies_that_pad_are_known_by_their_statistics(tmp_path: Path) -> None:
    """One that went on from another lists that one's cameras and numbers; statistics are of what it learned from."""
    listed = config("pi05", cameras=("base_0_rgb", *CAMERAS, "empty_camera_0"), state=32, action=32)
    listed.normalization_mapping = dict.fromkeys(("VISUAL",), NormalizationMode.IDENTITY)
    with pytest.raises(MemobenchError, match=r"no picture for observation.images.base_0_rgb"):
        check_features(str(tmp_path), listed, SHOWN, {})
    statistics(tmp_path / "ours", {STATE: 8, ACTION: 7, **{IMAGES + name: 3 for name in CAMERAS}})
    check_features(str(tmp_path / "ours"), listed, SHOWN, {})
    statistics(tmp_path / "other", {STATE: 14, ACTION: 14, **{IMAGES + name: 3 for name in CAMERAS}})
    with pytest.raises(MemobenchError, match="of 14 numbers"):  # LeRobot pads 8 to 32 without a word
        check_features(str(tmp_path / "other"), listed, SHOWN, {})


def statistics(folder: Path, lengths: Mapping[str, int]) -> None:
    folder.mkdir()
    step = {"registry_name": "normalizer_processor", "config": {}, "state_file": "statistics.safetensors"}
    (folder / "policy_preprocessor.json").write_text(json.dumps({"name": "before", "steps": [step]}))
    tensors = {f"{name}.mean": torch.zeros(length) for name, length in lengths.items()}
    save_file(tensors | {f"{STATE}.count": torch.zeros(1)}, folder / "statistics.safetensors")


# --- weights ---


def rewritten(checkpoint: Path, change: Callable[[dict[str, torch.Tensor]], None]) -> None:
    weights = load_file(checkpoint / "model.safetensors")
    change(weights)
    save_file(weights, checkpoint / "model.safetensors")


def test_weights_that_are_not_there_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = saved(tmp_path / "it", config())
    rewritten(checkpoint, lambda weights: weights.pop("model.action_head.weight"))
    found = refused(checkpoint, capsys)
    assert "(act): 1 of " in found
    assert "the first being model.action_head.weight" in found
    (checkpoint / "model.safetensors").unlink()
    assert "holds no weights (model.safetensors)" in refused(checkpoint, capsys)


@pytest.mark.parametrize("kind", TINY)
def test_weights_of_another_shape_are_refused(kind: str, tmp_path: Path) -> None:
    policy = config(kind, cameras=("image",))
    checkpoint = saved(tmp_path / "it", policy)
    check_weights(str(checkpoint), policy)
    name = next(iter(load_file(checkpoint / "model.safetensors")))
    rewritten(checkpoint, lambda weights: weights.update({name: torch.zeros(3, 2, 1)}))
    with pytest.raises(MemobenchError, match=f"0 of .* are missing and 1 have another shape, the first being {name}"):
        check_weights(str(checkpoint), policy)


@pytest.mark.parametrize("kind", ["pi0", "pi05"])
def test_large_policies_are_compared_by_the_head_of_their_file(kind: str, tmp_path: Path) -> None:
    """LeRobot prints that it could not load them, and goes on with random weights; nothing of 3 B is made here."""
    policy = config(kind)
    policy.device = "meta"
    with torch.device("meta"):
        built = get_policy_class(kind)(policy)
    parameters = {name.removeprefix("model."): tuple(tensor.shape) for name, tensor in built.state_dict().items()}
    policy.device = "cpu"
    head_of(tmp_path / "model.safetensors", parameters)
    check_weights(str(tmp_path), policy)
    parameters.pop("action_in_proj.weight")
    head_of(tmp_path / "model.safetensors", parameters)
    with pytest.raises(MemobenchError, match=r"1 of .* the first being model.action_in_proj.weight"):
        check_weights(str(tmp_path), policy)


def head_of(file: Path, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Write a file of such tensors with a hole in the place of their numbers."""
    entries, end = {}, 0
    for name, shape in shapes.items():
        size = 4 * int(torch.tensor(shape).prod())
        entries[name] = {"dtype": "F32", "shape": shape, "data_offsets": [end, end + size]}
        end += size
    head = json.dumps(entries).encode()
    with file.open("wb") as out:
        out.write(struct.pack("<Q", len(head)) + head)
        out.truncate(out.tell() + end)


def test_weights_of_a_repository_are_asked_for_where_lerobot_goes_on_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(MemobenchError, match=r"nobody/pi holds no weights .* pi05 would go on with random ones"):
        check_weights("nobody/pi", config("pi05"))
    check_weights("nobody/act", config())  # LeRobot refuses it by itself


def test_a_configuration_of_other_shapes_is_refused_before_memory_is_reserved(tmp_path: Path) -> None:
    """These widths would take terabytes."""
    checkpoint = saved(tmp_path / "act", config())
    policy = PreTrainedConfig.from_pretrained(checkpoint)
    policy.dim_feedforward = 10**10  # type: ignore[attr-defined]
    ours = tmp_path / "ours"
    shutil.copytree(shipped_policies()["memobench_small"], ours)
    held = json.loads((ours / "config.json").read_text())
    (ours / "config.json").write_text(json.dumps(held | {"max_action_dim": 10**10}))
    for refused in (lambda: check_weights(checkpoint, policy), lambda: MemobenchMemPolicy.from_pretrained(ours)):
        with pytest.raises(MemobenchError, match=r"[1-9]\d* have another shape"):
            refused()


# --- processors ---

PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")


@dataclasses.dataclass
class Stranger(ProcessorStep):
    """A step of a package that is no plugin."""

    def __call__(self, transition: Any) -> Any:
        raise AssertionError("it was built and called")

    def transform_features(self, features: Any) -> Any:
        raise AssertionError


def poisoned(checkpoint: Path, file: str, **step: Any) -> None:
    held = json.loads((checkpoint / file).read_text())
    held["steps"].insert(0, step)
    (checkpoint / file).write_text(json.dumps(held))


@pytest.mark.parametrize("kind", ["act", "memobench_mem"])
@pytest.mark.parametrize("file", PIPELINES)
def test_a_checkpoint_runs_no_code(
    kind: str, file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither by a command that loads it, nor by a policy of ours that is loaded by hand."""
    checkpoint, mark = tmp_path / "it", tmp_path / "mark"
    if kind == "act":
        saved(checkpoint, config())
    else:
        shutil.copytree(shipped_policies()["memobench_small"], checkpoint)
    poisoned(checkpoint, file, **{"class": "subprocess.check_call", "config": {"args": ["touch", str(mark)]}})
    monkeypatch.chdir(tmp_path)
    held = (f"policy={checkpoint}", "device=cpu", "output_dir=out")
    for words in (["eval", "env=memobench", f"tasks={TASK}", *held], ["train", "dataset=a/b", "steps=1", *held]):
        assert main(words) == 2
        assert "subprocess.check_call" in capsys.readouterr().err
    with pytest.raises(MemobenchError, match="check_call"):
        load_subject([f"policy={checkpoint}"], tmp_path)
    if kind == "memobench_mem":
        with pytest.raises(MemobenchError, match="check_call"):
            MemobenchMemPolicy.from_pretrained(checkpoint)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("step", "named"),
    [
        ({"registry_name": "no_such_step"}, "no package registers"),
        ({"registry_name": "strangers"}, "test_compatibility registers"),
        ({"registry_name": "rename_observations_processor", "class": "os.system"}, "os.system"),
        ({"registry_name": "rename_observations_processor", "config": {"a": [{"_target_": "os.system"}]}}, "_target_"),
        ({"registry_name": "action_tokenizer_processor", "config": {"action_tokenizer_name": "a/b"}}, "a/b"),
        ({"registry_name": "action_tokenizer_processor", "config": {"action_tokenizer_name": PI0_FAST}}, None),
        ({"registry_name": "pi05_prepare_state_tokenizer_processor_step"}, None),
        ({"registry_name": "memobench_gather_memory"}, None),
    ],
)
def test_steps_are_registered_by_installed_packages(step: dict[str, Any], named: str | None, tmp_path: Path) -> None:
    ProcessorStepRegistry.register("strangers")(Stranger)
    checkpoint = saved(tmp_path / "it", config())
    poisoned(checkpoint, PIPELINES[0], **step)
    try:
        with nullcontext() if named is None else pytest.raises(MemobenchError, match=named):
            check_checkpoint(str(checkpoint))
    finally:
        ProcessorStepRegistry.unregister("strangers")


# --- forms of earlier versions ---


def test_statistics_among_weights_are_an_earlier_form(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = saved(tmp_path / "it", config())
    for file in checkpoint.glob("policy_*"):
        file.unlink()
    key = "normalize_inputs.buffer_observation_state.mean"
    rewritten(checkpoint, lambda weights: weights.update({key: torch.zeros(8)}))
    found = refused(checkpoint, capsys)
    assert f"lerobot.processor.migrate_policy_normalization --pretrained-path {checkpoint}" in found


def test_a_configuration_without_a_type_is_an_earlier_form(tmp_path: Path) -> None:
    checkpoint = saved(tmp_path / "it", config())
    (checkpoint / "config.json").write_text(json.dumps({"input_shapes": {STATE: [8]}, "output_shapes": {ACTION: [7]}}))
    with pytest.raises(MemobenchError, match=r"names no policy type; .* train it again"):
        check_checkpoint(str(checkpoint))


# --- fixed by training ---

ALL = [field.name for field in dataclasses.fields(MemobenchMemConfig)]
NAMES = [name for name in ALL if name not in PI05_ALONE]
"""Those of LeRobot 0.6.1's pi0.5 and ours; its main has more, which have one value here."""


@pytest.mark.parametrize("name", NAMES)
def test_what_is_fixed_by_training_stays(name: str) -> None:
    checkpoint = shipped_policies()["memobench_small"]
    policy = PreTrainedConfig.from_pretrained(checkpoint)
    check_as_trained(checkpoint, policy)
    setattr(policy, name, object() if name != "device" else "cpu")
    if name in MAY_DIFFER:
        check_as_trained(checkpoint, policy)
        return
    with pytest.raises(MemobenchError, match=rf"--policy\.{name}=.* leave {name} out"):
        check_as_trained(checkpoint, policy)


@pytest.mark.parametrize("word", ["memory_stride=4", "align=contrastive"])
def test_neither_command_changes_what_is_fixed(word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = tmp_path / "it"
    shutil.copytree(shipped_policies()["memobench_small"], checkpoint)
    said = refused(checkpoint, capsys, "--env.obs_type=environment_state_agent_pos", f"--policy.{word}")
    assert f"--policy.{word} cannot be followed" in said


def test_what_is_loaded_by_hand_acts_as_it_was_trained() -> None:
    checkpoint = shipped_policies()["memobench_small"]
    policy = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=["--device=cpu", "--n_action_steps=2"])
    assert MemobenchMemPolicy.from_pretrained(checkpoint, config=policy).config.n_action_steps == 2
    policy = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=["--device=cpu", "--memory_stride=2"])
    with pytest.raises(MemobenchError, match=r"--policy.memory_stride=2 cannot be followed: .* was trained with"):
        MemobenchMemPolicy.from_pretrained(checkpoint, config=policy)
