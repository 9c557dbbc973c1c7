"""Datasets of LIBERO's convention in training, views and conformance."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy_config

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.commands.command_line import parse_words, read_words
from lerobot_memobench.conformance.streams import write_streams
from lerobot_memobench.conformance.subject import load_subject
from lerobot_memobench.datasets.episodes import read_info
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.objects import VIEWS
from lerobot_memobench.sim.convention import convention_of
from lerobot_memobench.training.data import check_environment
from lerobot_memobench.training.features import detected_slots
from lerobot_memobench.training.trainer import ViewOptions, prepare, write_view
from tests.support.fake_loop import make_checkpoint
from tests.support.synthetic_dataset import write_robot

NAMES = ("observation.images.image", "observation.images.image2")
CAMERAS_OF = {"upright": VIEWS, "libero": NAMES}


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same short episodes in both conventions."""
    folder = tmp_path_factory.mktemp("conventions")
    return {name: write_streams(folder / name, frames=3, convention=name) for name in ("upright", "libero")}


def checkpoint(folder: Path, *cameras: str) -> Path:
    features = {f"observation.images.{name}": {"type": "VISUAL", "shape": [3, 256, 256]} for name in cameras}
    return make_checkpoint(folder / "act", "act", input_features=features)


@pytest.mark.parametrize(("old", "new"), [("upright", "libero"), ("libero", "upright")])
def test_a_view_turns_videos_into_the_other_convention(
    both: dict[str, Path], tmp_path: Path, old: str, new: str
) -> None:
    """Equal to a dataset that was written in it, but for the second encoding."""
    write_view(both[new], tmp_path / "wanted", ViewOptions())
    line = ["view", str(both[old]), "--convention", new, "--obs-type", "pixels_agent_pos"]
    assert memobench([*line, "--out", str(tmp_path / "turned")]) == 0
    wanted, turned = (LeRobotDataset("local/view", root=tmp_path / name) for name in ("wanted", "turned"))
    assert convention_of(wanted.meta.features) == new, "a view keeps the convention of its dataset"
    assert turned.meta.features == wanted.meta.features  # so that LeRobot merges them
    assert {*turned.meta.stats} == {*wanted.meta.stats}
    names = [name for name in turned.meta.stats if name.startswith("observation.images")]
    assert len(names) == 2
    for name in names:
        for key in ("mean", "std", "q01", "q99"):
            assert np.allclose(turned.meta.stats[name][key], wanted.meta.stats[name][key], atol=0.01), (name, key)
    assert len(turned) == len(wanted)
    unlike: list[float] = []
    for frame in range(len(wanted)):
        there, here = wanted[frame], turned[frame]
        for name in names:
            assert (here[name] - there[name]).abs().mean() < 0.01
            unlike.append(float((here[name].flip(-1) - there[name]).abs().mean()))
        for name in ("observation.state", "action", "timestamp"):
            assert torch.equal(here[name], there[name])
    assert max(unlike) > 0.05  # some frames are nearly symmetric
    again = ["view", str(tmp_path / "turned"), "--convention", new, "--prompts", "--out", str(tmp_path / "same")]
    assert memobench(again) == 0
    assert next((tmp_path / "same").rglob("*.mp4")).is_symlink()


@pytest.fixture
def liberos(tmp_path: Path) -> Path:
    """A dataset of another package with LIBERO's names, whose images are PNG in the tables."""
    return write_robot(tmp_path / "made", dict.fromkeys(NAMES, (16, 24)), 3, 3, episodes=2)


def test_a_view_turns_images_to_the_bit(liberos: Path, tmp_path: Path) -> None:
    write_view(liberos, tmp_path / "upright", ViewOptions(convention="upright"))
    write_view(tmp_path / "upright", tmp_path / "back", ViewOptions(convention="libero"))
    first, upright, back = (
        LeRobotDataset("local/view", root=root) for root in (liberos, tmp_path / "upright", tmp_path / "back")
    )
    assert convention_of(upright.meta.features) == "upright"
    for frame in range(len(first)):
        for there, here in zip(NAMES, VIEWS, strict=True):
            assert torch.equal(upright[frame][here], first[frame][there].flip(-1))
            assert torch.equal(back[frame][there], first[frame][there])
            assert np.array_equal(upright.meta.stats[here]["mean"], first.meta.stats[there]["mean"])
        for name in ("observation.state", "action"):
            assert torch.equal(upright[frame][name], first[frame][name])


def test_a_view_needs_images_of_a_known_convention(liberos: Path, tmp_path: Path) -> None:
    objects = write_streams(tmp_path / "objects", images=False, frames=3)
    info = liberos / "meta" / "info.json"
    unknown = info.read_text().replace("images.image2", "images.wrist_image")
    for root, obs_type, named in ((objects, None, "no images"), (liberos, "environment_state_agent_pos", "has")):
        with pytest.raises(MemobenchError, match=named):
            write_view(root, tmp_path / "view", ViewOptions(obs_type=obs_type, convention="libero"))
    info.write_text(unknown)
    with pytest.raises(MemobenchError, match=r"it is unknown whether .*wrist_image are upright or mirrored"):
        write_view(liberos, tmp_path / "view", ViewOptions(convention="libero"))
    assert not (tmp_path / "view").exists()


@pytest.mark.parametrize("dataset", ["upright", "libero"])
@pytest.mark.parametrize("other", ["upright", "libero"])
def test_images_of_a_training_have_one_convention(
    both: dict[str, Path], tmp_path: Path, dataset: str, other: str
) -> None:
    """Those of its evaluations, and those of the checkpoint that it continues; memory policies have the same check."""
    meta = LeRobotDataset("local/data", root=both[dataset]).meta
    new = make_policy_config("act", device="cpu", push_to_hub=False)
    evaluated: Any = SimpleNamespace(policy=new, env=MemobenchEnvConfig(convention=other), rename_map={})
    path = checkpoint(tmp_path, *(name.removeprefix("observation.images.") for name in CAMERAS_OF[other]))
    continued: Any = SimpleNamespace(
        policy=PreTrainedConfig.from_pretrained(path), env=None, rename_map={}, resume=False
    )
    continued.policy.pretrained_path = path
    for config, named in (
        (evaluated, f"set env.convention={dataset}"),
        (continued, f"convention={other}.*has convention={dataset}.*--convention {other}"),
    ):
        with nullcontext() if dataset == other else pytest.raises(MemobenchError, match=named):
            check_environment(config, meta, meta.features)


def test_names_of_images_in_a_continued_training(
    both: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the checkpoint's training, where the dataset has them; else the error proposes a map."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = checkpoint(tmp_path, "camera1", "camera2", "camera3")
    words = [f"policy={path}", f"dataset={both['libero']}"]

    def renamed() -> Any:
        return prepare(read_words("train", parse_words(words)).build(), None, None, lambda note: None).rename_map

    names = {
        f"observation.images.{old}": f"observation.images.camera{k + 1}" for k, old in enumerate(("image", "image2"))
    }
    with pytest.raises(MemobenchError, match=re.escape(f"rename_map='{json.dumps(names)}'")):
        renamed()
    training = {"dataset": {"repo_id": "lerobot/libero"}, "rename_map": names | {"observation.images.top": "top"}}
    (path / "train_config.json").write_text(json.dumps(training))
    assert renamed() == names
    words.append(f"rename_map={json.dumps(dict(zip(names, [*names.values()][::-1], strict=True)))}")
    assert renamed() != names


def test_a_detector_reads_upright_images(both: dict[str, Path]) -> None:
    with pytest.raises(MemobenchError, match="a detector reads upright ones"):
        detected_slots(both["libero"], lambda *_: None, dict(zip(VIEWS, NAMES, strict=True)), "observation.state")  # type: ignore[arg-type]


def test_conformance_needs_the_checkpoints_convention(
    both: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a dataset, its observations have it."""
    theirs, ours = checkpoint(tmp_path, "image", "image2"), checkpoint(tmp_path / "ours", "image", "wrist_image")
    for path, other in ((theirs, "upright"), (ours, "libero")):
        with pytest.raises(MemobenchError, match=f"expects images of convention=.*, and found {other}"):
            load_subject([f"policy={path}", f"dataset={both[other]}"], tmp_path)
    monkeypatch.setattr("lerobot_memobench.conformance.subject.check_weights", lambda *_: 1 / 0)
    with pytest.raises(MemobenchError, match="division by zero"):  # after the observations were written
        load_subject([f"policy={theirs}"], tmp_path)
    assert convention_of(read_info(tmp_path / "streams")["features"]) == "libero"
