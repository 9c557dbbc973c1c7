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
from lerobot_memobench.conformance.streams import write_streams
from lerobot_memobench.envs.observations import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.command_line import parse_words, read_words
from lerobot_memobench.training.trainer import keep_in_memory, prepare
from lerobot_memobench.training.view import ViewOptions, write_view
from tests.support.held_dataset import LENGTHS as HELD_LENGTHS
from tests.support.held_dataset import STRETCHES, make_held_dataset
from tests.support.object_dataset import LENGTHS, PROMPTS

STATE, SLOTS, PICTURE = "observation.state", "observation.environment_state", "observation.images.image"


def opened(root: Path, **options: Any) -> LeRobotDataset:
    return LeRobotDataset("local/data", root=root, **options)


def inputs(root: Path) -> dict[str, FeatureType]:
    """Return the columns that LeRobot uses as inputs of a policy."""
    found = dataset_to_policy_features(opened(root).meta.features).items()
    return {name: one.type for name, one in found if one.type is not FeatureType.ACTION}


def test_view_holds_the_frames_after_the_prompt(pictured: Path, tmp_path: Path) -> None:
    """Pictures, state, action and time within the episode; chunks end with their episode."""
    write_view(pictured, tmp_path / "view", ViewOptions(obs_type=BOTH))
    times = {"action": [0.0, 0.05, 0.1]}
    whole, view = opened(pictured, delta_timestamps=times), opened(tmp_path / "view", delta_timestamps=times)
    assert view.num_frames == sum(LENGTHS) - sum(PROMPTS)
    first = 0
    for episode, (length, prompt) in enumerate(zip(LENGTHS, PROMPTS, strict=True)):
        begin, end = (view.meta.episodes[episode][name] for name in ("dataset_from_index", "dataset_to_index"))
        assert (begin, end) == (first, first + length - prompt)
        for frame in (0, 1, length - prompt - 1):
            there, here = whole[sum(LENGTHS[:episode]) + prompt + frame], view[first + frame]
            for name in (PICTURE, STATE, "action", "action_is_pad"):
                assert torch.equal(here[name], there[name]), (episode, frame, name)
            assert torch.equal(here[SLOTS], there["privileged.environment_state"])
            assert here["task"] == there["task"]
            assert here["timestamp"].item() == pytest.approx(there["timestamp"].item() - prompt / 20, abs=1e-5)
            assert (here["frame_index"], here["index"], here["episode_index"]) == (frame, first + frame, episode)
        first += length - prompt
    assert next((tmp_path / "view").rglob("*.mp4")).is_symlink()


def test_stretches_between_holds_are_episodes(tmp_path: Path) -> None:
    """Their chunks and windows end at the holds, pictures and texts stay those of the frames."""
    root = make_held_dataset(tmp_path / "held", pictures=True)
    write_view(root, tmp_path / "view", ViewOptions(obs_type=BOTH))
    times = {"action": [0.0, 0.05, 0.1], STATE: [-0.05, 0.0]}
    whole, view = opened(root), opened(tmp_path / "view", delta_timestamps=times)
    assert view.num_episodes == len(STRETCHES)
    assert view.num_frames == sum(end - start for start, end in STRETCHES)
    row = 0
    for episode, (start, end) in enumerate(STRETCHES):
        place = view.meta.episodes[episode]
        assert (place["dataset_from_index"], place["length"]) == (row, end - start)
        assert place["source_episode_index"] == (start >= HELD_LENGTHS[0])
        for frame in range(start, end):
            there, here = whole[frame], view[row]
            assert torch.equal(here[PICTURE], there[PICTURE]), (episode, frame)
            assert torch.equal(here[STATE][1], there[STATE])
            assert torch.equal(here["action"][0], there["action"])
            assert here["action_is_pad"].tolist() == [frame + k >= end for k in range(3)]
            assert here[f"{STATE}_is_pad"].tolist() == [frame == start, False]
            assert (here["frame_index"], here["index"], here["episode_index"]) == (frame - start, row, episode)
            for old, new in zip(there["language_persistent"], here["language_persistent"], strict=True):
                age = float(there["timestamp"]) - float(old["timestamp"])
                assert float(here["timestamp"]) - float(new["timestamp"]) == pytest.approx(age, abs=1e-5)
            row += 1
    assert not torch.equal(view[0][PICTURE], view[row - 1][PICTURE])
    in_memory = opened(tmp_path / "view", delta_timestamps=times, episodes=[1, 3])
    from_files = opened(tmp_path / "view", delta_timestamps=times, episodes=[1, 3])
    keep_in_memory(in_memory)
    for number in range(len(from_files)):
        for name in (STATE, "action", "action_is_pad", f"{STATE}_is_pad"):
            assert torch.equal(in_memory[number][name], from_files[number][name])


def test_chosen_episodes_are_those_of_the_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    root = make_held_dataset(tmp_path / "held")
    words = ["policy=act", "policy.device=cpu", f"dataset={root}", "dataset.episodes=[1]"]
    found = prepare(read_words("train", parse_words(words)).build(), None, None, print)
    assert found.dataset.episodes == [2, 3]


@pytest.mark.parametrize(
    ("obs_type", "seen"),
    [(PIXELS, {STATE, PICTURE}), (OBJECTS, {STATE, SLOTS}), (BOTH, {STATE, SLOTS, PICTURE})],
)
def test_lerobot_finds_the_chosen_inputs(obs_type: str, seen: set[str], pictured: Path, tmp_path: Path) -> None:
    write_view(pictured, tmp_path / "view", ViewOptions(obs_type=obs_type))
    assert set(inputs(tmp_path / "view")) == seen
    stats = opened(tmp_path / "view").meta.stats
    assert seen <= set(stats)
    theirs = opened(pictured).meta.stats
    assert np.array_equal(stats[STATE]["mean"], theirs[STATE]["mean"])


def test_language_timestamps_move_with_their_frames(tmp_path: Path) -> None:
    root = write_streams(tmp_path / "streams", frames=9)
    write_view(root, tmp_path / "view", ViewOptions(obs_type=PIXELS))
    whole, view = opened(root), opened(tmp_path / "view")
    start = view.meta.episodes[1]["dataset_from_index"]
    of_whole = int(whole.meta.episodes[1]["dataset_to_index"] - view.meta.episodes[1]["length"])
    there, here = whole[of_whole], view[start]
    for old, new in zip(there["language_persistent"], here["language_persistent"], strict=True):
        assert new["content"] == old["content"]
        age = float(there["timestamp"]) - float(old["timestamp"])
        assert float(here["timestamp"]) - float(new["timestamp"]) == pytest.approx(age, abs=1e-5)


def test_missing_observations_are_refused(synthetic: Path, objects: Path, tmp_path: Path) -> None:
    for root, obs_type in ((synthetic, OBJECTS), (objects, PIXELS), (objects, BOTH)):
        with pytest.raises(MemobenchError, match=f"obs_type={obs_type}"):
            write_view(root, tmp_path / "view", ViewOptions(obs_type=obs_type))
    assert not (tmp_path / "view").exists()


def test_trainings_share_a_view(pictured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    given = read_words("train", parse_words(["policy=act", "policy.device=cpu", f"dataset={pictured}"])).build()
    notes: list[str] = []
    for _ in range(2):
        found = prepare(given, None, OBJECTS, notes.append)
    folder = Path(str(found.dataset.root))
    assert set(inputs(folder)) == {STATE, SLOTS}
    assert not [note for note in notes if "pixels" in note]
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    kept = prepare(given, True, None, notes.append)
    assert "observation.phase" not in str(kept.policy.input_features)
    assert "observation.images.image" in str(kept.policy.input_features)
    (note,) = (note for note in notes if "pixels" in note)
    assert "pixels, and policy=act does not resize them" in note
    assert "evaluate it with observation_height=48 observation_width=48" in note
    given.dataset.episodes = [7]
    with pytest.raises(MemobenchError, match=r"episodes=\[7\]"):
        prepare(given, None, None, notes.append)


def test_command_writes_a_view(pictured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "view"
    assert memobench(["view", str(pictured), "--obs-type", OBJECTS, "--out", str(out)]) == 0
    assert set(inputs(out)) == {STATE, SLOTS}
    for words in (["--out", str(out)], ["--out", str(tmp_path / "b"), "--obs-type", "some"]):
        assert memobench(["view", str(pictured), *words]) == 2
    assert memobench(["view", str(out), "--out", str(tmp_path / "again")]) == 0
    first, again = opened(out), opened(tmp_path / "again")
    assert len(first) == len(again)
    assert [*again.meta.episodes["source_episode_index"]] == [*range(first.num_episodes)], "those of the view"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["policy=vqbet"], "policy=vqbet cannot read"),
        (["policy=xvla", "env=memobench"], "processors of LIBERO"),
    ],
)
def test_inputs_that_a_policy_cannot_have_are_refused(
    synthetic: Path, words: list[str], named: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    given = read_words("train", parse_words([*words, "policy.device=cpu", f"dataset={synthetic}"])).build()
    with pytest.raises(MemobenchError, match=named):
        prepare(given, None, None, print)
    assert not [*tmp_path.rglob("info.json")]
