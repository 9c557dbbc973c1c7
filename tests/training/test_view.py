"""A view holds the dataset's frames after the prompt, and the columns of the chosen inputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.observations import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.training.trainer import ViewOptions, write_view
from tests.support.held_dataset import LENGTHS, STRETCHES, make_held_dataset

STATE, SLOTS, IMAGE = "observation.state", "observation.environment_state", "observation.images.image"


def opened(root: Path, **options: Any) -> LeRobotDataset:
    return LeRobotDataset("local/data", root=root, **options)


def inputs(root: Path) -> set[str]:
    """Return the columns that LeRobot uses as inputs of a policy."""
    found = dataset_to_policy_features(opened(root).meta.features).items()
    return {name for name, one in found if one.type is not FeatureType.ACTION}


def test_stretches_between_prompts_and_holds_are_episodes(tmp_path: Path) -> None:
    """Chunks and windows end with them; images, objects and texts stay those of the frames."""
    root = make_held_dataset(tmp_path / "held", images=True)
    write_view(root, tmp_path / "view", ViewOptions(obs_type=BOTH))
    times = {"action": [0.0, 0.05, 0.1], STATE: [-0.05, 0.0]}
    whole, view = opened(root), opened(tmp_path / "view", delta_timestamps=times)
    assert (view.num_episodes, view.num_frames) == (len(STRETCHES), sum(end - start for start, end in STRETCHES))
    assert next((tmp_path / "view").rglob("*.mp4")).is_symlink()
    row = 0
    for episode, (start, end) in enumerate(STRETCHES):
        place = view.meta.episodes[episode]
        assert (place["dataset_from_index"], place["dataset_to_index"]) == (row, row + end - start)
        assert place["source_episode_index"] == (start >= LENGTHS[0])
        for frame in range(start, end):
            there, here = whole[frame], view[row]
            assert torch.equal(here[IMAGE], there[IMAGE]), (episode, frame)
            assert torch.equal(here[SLOTS], there["privileged.environment_state"])
            assert torch.equal(here[STATE][1], there[STATE])
            assert torch.equal(here["action"][0], there["action"])
            assert here["task"] == there["task"]
            assert here["action_is_pad"].tolist() == [frame + k >= end for k in range(3)]
            assert here[f"{STATE}_is_pad"].tolist() == [frame == start, False]
            assert (here["frame_index"], here["index"], here["episode_index"]) == (frame - start, row, episode)
            assert here["timestamp"].item() == pytest.approx((frame - start) / 20, abs=1e-5)
            for old, new in zip(there["language_persistent"], here["language_persistent"], strict=True):
                assert new["content"] == old["content"]
                age = float(there["timestamp"]) - float(old["timestamp"])
                assert float(here["timestamp"]) - float(new["timestamp"]) == pytest.approx(age, abs=1e-5)
            row += 1
    assert not torch.equal(view[0][IMAGE], view[row - 1][IMAGE])


@pytest.mark.parametrize(
    ("obs_type", "seen"), [(PIXELS, {STATE, IMAGE}), (OBJECTS, {STATE, SLOTS}), (BOTH, {STATE, SLOTS, IMAGE})]
)
def test_lerobot_finds_the_chosen_inputs(obs_type: str, seen: set[str], imaged: Path, tmp_path: Path) -> None:
    write_view(imaged, tmp_path / "view", ViewOptions(obs_type=obs_type))
    assert inputs(tmp_path / "view") == seen
    stats = opened(tmp_path / "view").meta.stats
    assert seen <= {*stats}
    assert np.array_equal(stats[STATE]["mean"], opened(imaged).meta.stats[STATE]["mean"])


@pytest.mark.parametrize(("data", "obs_type"), [("synthetic", OBJECTS), ("objects", PIXELS), ("objects", BOTH)])
def test_missing_observations_are_refused(
    data: str, obs_type: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    with pytest.raises(MemobenchError, match=obs_type):
        write_view(request.getfixturevalue(data), tmp_path / "view", ViewOptions(obs_type=obs_type))
    assert not (tmp_path / "view").exists()


def test_command_writes_a_view(imaged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "view"
    assert memobench(["view", str(imaged), "--obs-type", OBJECTS, "--out", str(out)]) == 0
    assert inputs(out) == {STATE, SLOTS}
    for words in (["--out", str(out)], ["--out", str(tmp_path / "b"), "--obs-type", "some"]):
        assert memobench(["view", str(imaged), *words]) == 2
    assert memobench(["view", str(out), "--out", str(tmp_path / "again")]) == 0
    first, again = opened(out), opened(tmp_path / "again")
    assert len(first) == len(again)
    assert [*again.meta.episodes["source_episode_index"]] == [*range(first.num_episodes)], "those of the view"
