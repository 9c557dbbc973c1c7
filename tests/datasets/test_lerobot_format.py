"""A dataset in LeRobot's format: frames, metadata, statistics, card, and its assembly."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from huggingface_hub import DatasetCard
from lerobot.datasets import LeRobotDataset

from lerobot_memobench.constants import CLOCK, LIBERO
from lerobot_memobench.datasets.demonstration import digest, labels
from lerobot_memobench.datasets.episodes import read_episode
from lerobot_memobench.datasets.layout import dataset_features, is_dataset
from lerobot_memobench.datasets.stage import stage_demonstration
from lerobot_memobench.datasets.video import ImageHistograms
from lerobot_memobench.datasets.write import assemble, numeric_stats, write_dataset
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.kills import hashes

SIZE = 64
REPO = "local/test"


@pytest.fixture(scope="module")
def dataset(synthetic):
    return LeRobotDataset(REPO, root=synthetic)


def test_frames_are_equal_after_loading(dataset, demos):
    assert (dataset.num_episodes, len(dataset), dataset.fps) == (3, sum(map(len, demos)), 20)
    position = 0
    for number, demo in enumerate(demos):
        columns = labels(demo) | {"action": demo.actions, "observation.state": demo.proprio}
        assert read_episode(dataset.root, number).columns["states"].tolist() == demo.states.tolist()
        for t in range(0, len(demo), 3):
            item = dataset[position + t]
            assert (item["episode_index"], item["frame_index"], item["index"]) == (number, t, position + t)
            assert (item["timestamp"], item["task"]) == (np.float32(t / 20), demo.task.language)
            for name, column in columns.items():
                value = item[name]
                assert value == column[t] if isinstance(value, str) else np.array_equal(value, column[t]), name
            for camera in ("image", "wrist_image"):
                seen = (item[f"observation.images.{camera}"] * 255).permute(1, 2, 0).numpy()
                frames = demo.images[camera].astype(np.float32)
                error = np.abs(seen - frames[t]).mean()
                assert error < 6
                assert all(error < np.abs(seen - frames[o]).mean() for o in (t - 1, t + 1) if 0 <= o < len(demo))
        position += len(demo)


def test_instructions_are_in_the_present_tense(stove):
    columns = labels(stove)
    assert set(columns["subgoal.instruction"]) == {"switch the stove on", "switch the stove off again"}
    assert "switched the stove on" in columns["subgoal.intermediate"]


def test_statistics(dataset, demos):
    """Exact quantiles of numbers, no statistics of clock and texts, and LeRobot's shapes."""
    from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats

    actions, stats = np.concatenate([demo.actions for demo in demos]).astype(np.float64), dataset.meta.stats
    for key in ("q01", "q10", "q50", "q90", "q99"):
        np.testing.assert_allclose(stats["action"][key], np.quantile(actions, int(key[1:]) / 100, axis=0), rtol=1e-6)
    np.testing.assert_allclose(stats["action"]["mean"], actions.mean(0), rtol=1e-6)
    assert stats["action"]["count"] == [len(dataset)]
    assert stats["checkpoint.completed"]["max"].tolist() == [1, 1, 0, 0, 0, 0]
    assert not {"oracle_memory", *CLOCK} & set(stats)
    assert not [name for name in dataset.meta.episodes.column_names if name.startswith("stats/observation.step")]

    reference, ours = get_feature_stats(demos[0].actions, axis=0, keepdims=False), numeric_stats(demos[0].actions)
    assert {key: value.shape for key, value in ours.items()} == {key: value.shape for key, value in reference.items()}
    frames, histograms = demos[0].images["image"], ImageHistograms()
    reference = get_feature_stats(frames.transpose(0, 3, 1, 2), axis=(0, 2, 3), keepdims=True)
    for frame in frames:
        histograms.add(frame)
    ours = histograms.stats()
    assert set(ours) == set(reference)
    for key in set(reference) - {"count"}:
        np.testing.assert_allclose(ours[key], reference[key][0] / 255, atol=2 / 255)
    aggregate_stats([{"observation.images.image": ours}])  # raises on wrong shapes


def test_inputs_of_plain_lerobot_policies(dataset):
    """Objects are an input only if there are no images."""
    from lerobot.utils.feature_utils import dataset_to_policy_features

    cameras = {"observation.images.image", "observation.images.wrist_image"}
    common = {"observation.state", "action", *CLOCK}
    assert set(dataset_to_policy_features(dataset.meta.features)) == cameras | common
    assert dataset.meta.features["privileged.environment_state"]["shape"] == (208,)
    assert set(dataset_to_policy_features(dataset_features(None))) == {"observation.environment_state"} | common


def test_files_without_images_and_at_lerobots_size_limits(demos, make_demo, tmp_path, monkeypatch):
    import lerobot.datasets.feature_utils as feature_utils

    demo = make_demo(["0011", "0001"])
    plain = LeRobotDataset(REPO, root=write_dataset([demo], tmp_path / "plain"))
    assert not (plain.root / "videos").exists()
    np.testing.assert_array_equal(plain[2]["action"], demo.actions[2])
    monkeypatch.setattr(feature_utils, "DEFAULT_VIDEO_FILE_SIZE_IN_MB", 1e-6)
    monkeypatch.setattr(feature_utils, "DEFAULT_DATA_FILE_SIZE_IN_MB", 1e-6)
    split = LeRobotDataset(REPO, root=write_dataset(demos, tmp_path / "split"))
    assert len(list((split.root / "data").rglob("*.parquet"))) == 3
    assert len(list((split.root / "videos").rglob("*.mp4"))) == 6
    last = split[len(split) - 1]
    seen = (last["observation.images.image"] * 255).permute(1, 2, 0).numpy()
    assert last["episode_index"] == 2
    assert np.abs(seen - demos[2].images["image"][-1]).mean() < 6


def test_equal_episodes_give_equal_files(synthetic, demos, tmp_path):
    assert hashes(synthetic) == hashes(write_dataset(iter(demos), tmp_path / "again", repo_id=REPO))
    manifest = json.loads((synthetic / "manifest.json").read_text())
    assert [row["digest"] for row in manifest["episodes"]] == [digest(demo) for demo in demos]
    assert manifest["episodes"][0]["world"] == LIBERO
    names = list(json.loads((synthetic / "meta" / "stats.json").read_text()))
    assert names[-2:] == ["observation.images.image", "observation.images.wrist_image"], "not in the order of a set"


def test_card(synthetic):
    card = DatasetCard.load(synthetic / "README.md")
    assert (card.data.license, "LeRobot" in card.data.tags) == ("other", True)
    for column in dataset_features((SIZE, SIZE)):
        assert f"`{column}`" in card.text
    assert "| object | here | 1 | 2 | 60 | 30.00 | 30.00 | 30.00 | 30 |" in card.text


def test_terms_depend_on_scans_and_source(demos, make_task, tmp_path):
    name = "put_the_artichoke_into_the_top_drawer_of_the_cabinet"
    spatial = replace(demos[0], task=make_task("SU", name=name, memory_type="spatial"))
    classes = sorted({*get_task(name).objects.values()})
    for folder, demo, licence in (
        ("boxes", replace(spatial, stand_ins=tuple(classes)), "other"),
        ("scans", replace(spatial, stand_ins=tuple(classes[1:])), "cc-by-nc-4.0"),
        ("converted", replace(demos[0], seed=-1), "cc-by-nc-4.0"),
    ):
        root = write_dataset([demo], tmp_path / folder)
        assert read_episode(root, 0).record.world == LIBERO
        (row,) = json.loads((root / "manifest.json").read_text())["episodes"]
        assert (row["world"], row["stand_ins"]) == (LIBERO, list(demo.stand_ins))
        card = DatasetCard.load(root / "README.md")
        assert card.data.license == licence
        assert ("replace missing scans" in card.text) == bool(demo.stand_ins)


def test_refused_destinations_and_episodes(synthetic, demos, make_demo, tmp_path):
    before, other = hashes(synthetic), tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("precious")
    for folder, named in ((synthetic, "finished dataset"), (other, "thesis"), (other / "thesis.tex", "is a file")):
        with pytest.raises(MemobenchError, match=named):
            write_dataset(demos, folder)
    assert hashes(synthetic) == before
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]
    linked = tmp_path / "linked"
    linked.mkdir()
    (linked / ".staging").symlink_to(tmp_path)  # `episodes` in it would be removed
    (tmp_path / "episodes").mkdir()
    with pytest.raises(MemobenchError, match=r"\.staging is a link"):
        write_dataset(demos, linked)
    assert (tmp_path / "episodes").is_dir()
    with pytest.raises(MemobenchError, match="some episodes"):
        write_dataset([make_demo(["01"]), make_demo(["01"], size=16)], tmp_path / "mixed")
    assert not is_dataset(tmp_path / "mixed")

    def demonstrations():
        yield make_demo(["01"], size=16)
        raise RuntimeError("reader broke")

    with pytest.raises(RuntimeError, match="reader broke"):
        write_dataset(demonstrations(), tmp_path / "broken")
    assert not (tmp_path / "broken").exists(), "failed writing leaves no files"
    staged = stage_demonstration(make_demo(["01"]), tmp_path / "ds" / ".staging" / "episodes" / "000000")
    path = staged.folder / "arrays.npz"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(MemobenchError, match=r"arrays\.npz cannot be read"):
        assemble([staged], tmp_path / "ds")
