"""Trained policies that come with the package: found by name, known by it on other machines."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
import torch
from safetensors.torch import save_file

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies import checkpoint
from lerobot_memobench.policies.checkpoint import SHIPPED
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.run.arguments import checkpoint_of
from lerobot_memobench.run.card import encoded
from lerobot_memobench.tasks.catalogue import DEMO_TASK, task_names
from tests.support.scripts import load_script


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with one trained policy, and a folder that is none."""
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path / "shipped")
    for name, config in (("memobench_small", {"type": "memobench_mem"}), ("notes", None)):
        (tmp_path / "shipped" / name).mkdir(parents=True)
        if config is not None:
            (tmp_path / "shipped" / name / "config.json").write_text(json.dumps(config))
    return tmp_path / "shipped"


def test_a_policy_is_found_by_its_name(shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = shipped / "memobench_small"
    assert checkpoint.shipped_policies() == {"memobench_small": folder}
    assert checkpoint_of("memobench_small", {"act"}) == str(folder)
    assert checkpoint.checkpoint_type(str(folder)) == "memobench_mem"
    assert checkpoint_of("notes", {"act"}) is None
    assert checkpoint.portable_path(str(folder)) == "memobench_small"
    assert checkpoint.portable_path("outputs/train/me") == "outputs/train/me"
    mine = tmp_path / "here" / "memobench_small"
    mine.mkdir(parents=True)
    (mine / "config.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "here")
    assert checkpoint_of("memobench_small", {"act"}) == str(folder), "a known name, wherever the command is run"
    assert checkpoint_of("./memobench_small", {"act"}) == "memobench_small", "a folder is named by a path"
    assert checkpoint.local_folder("memobench_small") == folder


def test_a_name_that_is_nearly_one_is_told(shipped: Path) -> None:
    from lerobot.configs.eval import EvalPipelineConfig

    from lerobot_memobench.run.arguments import choice_settings

    with pytest.raises(MemobenchError, match="did you mean 'memobench_small'"):
        choice_settings(EvalPipelineConfig, "policy", "memobench_smal")


# -- the script that ships them ------------------------------------------------------------------------------------


@pytest.fixture
def script() -> ModuleType:
    return load_script("ship_policy")


def test_a_card_tells_how_the_demonstrations_were_made(script: ModuleType, tmp_path: Path) -> None:
    source = tmp_path / "pretrained_model"
    source.mkdir()
    policy = encoded(MemobenchMemConfig(device="cpu", size="small", perception="objects", memory_stride=4))
    told = {"policy": policy, "dataset": {"root": str(tmp_path / "data")}, "batch_size": 6, "steps": 5, "seed": 1}
    told["output_dir"] = str(tmp_path / "run")
    (source / "train_config.json").write_text(json.dumps(told))

    def card(*merged: Path) -> str:
        parts = {tmp_path / "data": merged} if merged else {}
        return str(script.card("mine", source, {"a": torch.zeros(3)}, None, parts))

    assert "not at hand" in card()
    (tmp_path / "data" / "meta").mkdir(parents=True)
    request = {"tasks": [DEMO_TASK], "episodes": 3, "seed_base": 10_000, "referent": "random", "perturb": True}
    request |= {"images": False, "image_size": 256, "demonstration_prompt": True}
    made = [{"task_name": DEMO_TASK, "seed": seed, "failure": None, "frames": 9} for seed in (10_000, 10_001)]
    manifest = {"request": request, "episodes": [*made, {"task_name": DEMO_TASK, "seed": 10_002, "failure": "it fell"}]}
    (tmp_path / "data" / "manifest.json").write_text(json.dumps(manifest))
    assert "Trained on 2 demonstrations by the scripted expert, of 1 task;" in card()
    options = "--episodes 3 --seed-base 10000 --referent random --perturb --no-images"
    assert f"memobench generate --tasks {DEMO_TASK} --suite published {options} " in card()
    assert "policy.memory_stride=4 batch_size=6 steps=5 seed=1\n" in card()
    for name in ("few", "more"):
        (tmp_path / name / "meta").mkdir(parents=True)
    more = {"request": request | {"seed_base": 10_003}, "episodes": [{**made[0], "seed": 10_003}]}
    (tmp_path / "more" / "manifest.json").write_text(json.dumps(more))
    (tmp_path / "data" / "manifest.json").rename(tmp_path / "few" / "manifest.json")
    both = card(tmp_path / "few", tmp_path / "more")
    assert "Trained on 3 demonstrations by the scripted expert, of 1 task;" in both
    assert both.count("memobench generate") == 2
    assert "--new_root=outputs/data " in both
    assert "--operation.roots='[outputs/few, outputs/more]'" in both
    later = tmp_path / "later"
    later.mkdir()
    policy |= {"pretrained_path": str(source), "optimizer_lr": 1e-4}
    again = {**told, "policy": policy, "dataset": {"root": str(tmp_path / "more")}, "output_dir": str(later)}
    (later / "train_config.json").write_text(json.dumps(again))
    source = later
    text = card(tmp_path / "few", tmp_path / "more")
    assert "perception=objects size=small \\\n    dataset=outputs/data policy.memory_stride=4 batch_size=6 " in text
    assert "train policy=outputs/run \\\n    dataset=outputs/more policy.optimizer_lr=0.0001 batch_size=6 " in text
    assert text.count("memobench generate") == 2, "what both were trained on is made once"
    back = {**again, "policy": {**policy, "memory_stride": 8}}
    assert " policy.memory_stride=8 " in script.training(back, told, named=False)[1], "what is usual again is said"
    again["policy"]["pretrained_path"] = str(SHIPPED / "memobench_small")
    (later / "train_config.json").write_text(json.dumps(again))
    text = str(script.card("mine", source, {"a": torch.zeros(3)}, None, {}, commits=[("data/more", "0123abc")]))
    assert "It went on from `memobench_small` as of commit `" in text
    assert "The expert that made outputs/more is that of commit `0123abc`." in text
    assert "lerobot train policy=memobench_small \\\n    dataset=outputs/more " in text
    assert text.count("lerobot train") == 1
    again["dataset"]["episodes"] = [0, 1, 2, 7, 9, 10]
    (later / "train_config.json").write_text(json.dumps(again))
    text = str(script.card("mine", source, {"a": torch.zeros(3)}, None, {}))
    assert '    episodes="[$(seq -s, 0 2),$(seq -s, 7 7),$(seq -s, 9 10)]" \\\n    dataset=outputs/more ' in text
    strict = {**request, "tasks": task_names(suite="strict"), "referent": "drawn"}
    assert script.generation(strict)[:6] == ["--tasks", "all", "--suite", "strict", "--episodes", "3"]
    assert "--referent" not in script.generation(strict)
    moved = script.generation({**strict, "policy": "outputs/my policy 0123456789abcdef"})
    assert moved[moved.index("--policy") + 1] == "outputs/my policy"
    assert script.driver({"policy": "memobench_small 0123456789abcdef"}) == "memobench_small"


def test_the_card_tells_of_the_errors_of_eyes(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    source.mkdir(parents=True)
    config = MemobenchMemConfig(device="cpu", size="small", perception="objects", detection_noise=1.0)
    config.save_pretrained(source)
    save_file({"a": torch.zeros(3)}, source / "model.safetensors")
    told = {"policy": encoded(config), "dataset": {"root": "gone"}, "batch_size": 6, "steps": 5, "seed": 1}
    (source / "train_config.json").write_text(json.dumps({**told, "output_dir": str(tmp_path / "run")}))
    monkeypatch.setattr(script, "SHIPPED", tmp_path / "shipped")
    text = (script.ship(tmp_path / "run", "seeing", None, {}, []) / "README.md").read_text()
    assert "reads objects." in text
    assert "policy.detection_noise=1.0" in text.partition("lerobot train")[2]


def test_a_card_tells_every_setting_that_is_not_the_sizes(script: ModuleType) -> None:
    import draccus

    given = {
        "task_weights": {"prompted": 2.0},
        "chunk_size": 8,
        "memory_fusion": "context",
        "memory_settings": {"frames": 16},
    }
    usual = {"device": "cpu", "size": "small", "perception": "objects"}
    policy = encoded(MemobenchMemConfig(**usual, **given))
    words = script.settings(policy)
    assert {word.partition("=")[0] for word in words} == {f"policy.{name}" for name in given}
    shared = [f"--{name}={value}" for name, value in usual.items()]
    again = draccus.parse(MemobenchMemConfig, args=[*shared, *("--" + word.removeprefix("policy.") for word in words)])
    assert encoded(again) == policy
