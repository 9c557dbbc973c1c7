"""LIBERO checkpoints of small random networks: memory tasks, further training on our data, and memory tasks again.

No command names a convention or, after the training on LIBERO's data, a rename map. The configurations are those of
the published checkpoints. SmolVLA begins with a checkpoint like `lerobot/smolvla_base`, which LeRobot's trainer makes
one like `lerobot/smolvla_libero`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import FeatureType, NormalizationMode

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.conformance.streams import write_streams
from lerobot_memobench.envs.evaluation_file import read_evaluation
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.lerobot_policies import (
    make_config,
    save_checkpoint,
    shrink_paligemma,
    tiny_smolvlm,
)

TASK = "turn_on_the_stove_and_turn_it_off"
IMAGES = "observation.images."
RENAMED = {f"{IMAGES}image": f"{IMAGES}camera1", f"{IMAGES}image2": f"{IMAGES}camera2"}
SHORT = {"chunk_size": 4, "n_action_steps": 4}
LENGTHS = {"observation.state": 8, "action": 7}
"""Statistics name no images, as those of the published checkpoints."""


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same short demonstrations in both conventions."""
    folder = tmp_path_factory.mktemp("demonstrations")
    return {name: write_streams(folder / name, frames=9, task=TASK, convention=name) for name in ("upright", "libero")}


def train(policy: Path, dataset: Path, run: Path, *words: str) -> Path:
    usual = ("steps=2", "batch_size=2", "num_workers=0", "save_freq=2", "policy.device=cpu")
    assert main(["train", f"policy={policy}", f"dataset={dataset}", f"output_dir={run}", *usual, *words]) == 0
    return run / "checkpoints" / "last" / "pretrained_model"


def evaluated(policy: Path, out: Path) -> tuple[str, dict[str, str]]:
    """Run one short episode of a memory task; return the convention and the names of its images."""
    words = (f"tasks={TASK}", "episodes=1", "horizon=3", "eval.use_async_envs=false", f"output_dir={out}")
    assert main(["eval", "env=memobench", f"policy={policy}", *words]) == 0
    card = read_evaluation(out, whole=True)
    return card["protocol"]["convention"], card["settings"]["rename_map"]


def check(path: Path, datasets: dict[str, Path], out: Path, names: dict[str, str], capsys: Any) -> None:
    """Evaluate a checkpoint, continue its training in its convention, and evaluate the result."""
    assert evaluated(path, out / "before") == ("libero", names)
    assert main(["train", f"policy={path}", f"dataset={datasets['upright']}", "policy.device=cpu"]) == 2
    assert "--convention libero" in capsys.readouterr().err
    trained = train(path, datasets["libero"], out / "train")
    assert json.loads((trained / "train_config.json").read_text())["rename_map"] == names
    changed = [(one / "model.safetensors").read_bytes() for one in (path, trained)]
    assert changed[0] != changed[1]
    assert evaluated(out / "train", out / "after") == ("libero", names)


@pytest.mark.slow
def test_pi05(
    datasets: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shrink_paligemma(monkeypatch, get_task(TASK).language)
    both = dict.fromkeys((FeatureType.STATE.value, FeatureType.ACTION.value), NormalizationMode.MEAN_STD)
    config = make_config(
        "pi05",
        {"image": 256, "image2": 256, "empty_camera_0": 224},
        **SHORT,
        empty_cameras=1,
        num_inference_steps=2,
        tokenizer_max_length=64,
        normalization_mapping={FeatureType.VISUAL.value: NormalizationMode.IDENTITY, **both},
    )
    path = save_checkpoint(tmp_path / "pi05_libero_finetuned", config, LENGTHS)
    training = {"dataset": {"repo_id": "HuggingFaceVLA/libero"}, "rename_map": {}}
    (path / "train_config.json").write_text(json.dumps(training))
    check(path, datasets, tmp_path, {}, capsys)


@pytest.mark.slow
def test_smolvla(datasets: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = make_config(
        "smolvla",
        {"camera1": 256, "camera2": 256, "camera3": 256},
        state=6,
        **SHORT,
        num_vlm_layers=2,
        num_steps=2,
        vlm_model_name=str(tiny_smolvlm(tmp_path, get_task(TASK).language)),
    )
    base = save_checkpoint(tmp_path / "smolvla_base", config, LENGTHS)
    words = (f"rename_map={json.dumps(RENAMED)}", "policy.empty_cameras=1")
    path = train(base, datasets["libero"], tmp_path / "smolvla_libero", *words)
    training = json.loads((path / "train_config.json").read_text())
    training["dataset"] |= {"repo_id": "lerobot/libero", "root": None}
    (path / "train_config.json").write_text(json.dumps(training))
    check(path, datasets, tmp_path, RENAMED, capsys)
