from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_memobench.datasets.demonstration import digest, labels
from lerobot_memobench.datasets.lerobot_format.assembling import numeric_stats, write_dataset
from lerobot_memobench.datasets.lerobot_format.card import terms
from lerobot_memobench.datasets.lerobot_format.layout import dataset_features, is_dataset
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.datasets.staging import stage_demonstration
from lerobot_memobench.datasets.video import ImageHistograms
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import CLOCK
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import LIBERO, MEMOBENCH
from tests.support.kills import hashes

SIZE = 64
REPO = "local/test"


@pytest.fixture(scope="module")
def demos(make_demo, make_task):
    """Three episodes of two tasks; the last two begin with a demonstration prompt of 5 frames."""
    second = make_task("SU", name="other_task", memory_type="object")
    a = ["0" * 8 + "1" * 17, "0" * 20 + "1" * 5]
    b = ["0" * 9 + "1" * 21, "0" * 29 + "1"]
    return [
        make_demo(a, seed=10_000, size=SIZE),
        make_demo(b, task=second, seed=10_000, exec_start=5, size=SIZE, state_dim=8),
        make_demo(b, task=second, seed=10_001, exec_start=5, size=SIZE, state_dim=8),
    ]


@pytest.fixture(scope="module")
def dataset(demos, tmp_path_factory: pytest.TempPathFactory):
    """Their dataset, which no test changes."""
    from lerobot.datasets import LeRobotDataset

    root = write_dataset(demos, tmp_path_factory.mktemp("whole") / "ds", repo_id=REPO)
    return LeRobotDataset(REPO, root=root)


def test_every_frame_comes_back(dataset, demos):
    assert dataset.num_episodes == 3
    assert len(dataset) == sum(map(len, demos))
    assert dataset.fps == 20
    position = 0
    for number, demo in enumerate(demos):
        columns = labels(demo).columns()
        for t in range(len(demo)):
            item = dataset[position]
            assert item["episode_index"] == number
            assert item["frame_index"] == t
            assert item["index"] == position
            assert item["timestamp"] == np.float32(t / 20)
            assert item["task"] == demo.task.language
            np.testing.assert_array_equal(item["action"], demo.actions[t])
            np.testing.assert_array_equal(item["observation.state"], demo.proprio[t])
            for name, column in columns.items():
                value = item[name]
                assert value == column[t] if isinstance(value, str) else np.array_equal(value, column[t]), name
            for camera in ("image", "wrist_image"):
                seen = (item[f"observation.images.{camera}"] * 255).permute(1, 2, 0).numpy()
                shown = demo.images[camera].astype(np.float32)
                error = np.abs(seen - shown[t]).mean()
                assert error < 6
                # It is this frame and no neighbour: the bar stands elsewhere in those.
                assert all(error < np.abs(seen - shown[o]).mean() for o in (t - 1, t + 1) if 0 <= o < len(demo))
            position += 1


def test_episode_metadata(dataset, demos):
    for number, demo in enumerate(demos):
        episode = dataset.meta.episodes[number]
        assert episode["task_name"] == demo.task.name
        assert episode["memory_type"] == demo.task.memory_type
        assert episode["seed"] == demo.seed
        assert (episode["referent"], episode["variant"]) == ("fixed", 0)
        assert episode["exec_start_index"] == demo.exec_start
        assert episode["key_frames"] == labels(demo).key_frames.tolist()
        assert episode["scene_hash"] == "abc"
        assert episode["success"] is True
        assert episode["operations"] == demo.task.operations
        assert episode["digest"] == digest(demo)
        assert json.loads(episode["fixture_poses"]) == {"cabinet": list(range(7))}
        assert episode["tasks"] == [demo.task.language]


def test_episode_filter_and_delta_timestamps(dataset):
    from lerobot.datasets import LeRobotDataset

    chosen = LeRobotDataset(
        REPO,
        root=dataset.root,
        episode_filter=lambda episode: episode["memory_type"] == "object",
        delta_timestamps={"action": [0.0, 0.05, 0.1], "observation.images.image": [-0.05, 0.0]},
    )
    assert chosen.episodes == [1, 2]
    item = chosen[29]
    assert item["action"].shape == (3, 7)
    assert item["action_is_pad"].tolist() == [False, True, True]
    assert item["observation.images.image"].shape == (2, 3, SIZE, SIZE)


def test_statistics_hold_exact_quantiles(dataset, demos):
    actions = np.concatenate([demo.actions for demo in demos]).astype(np.float64)
    stats = dataset.meta.stats
    for key in ("q01", "q10", "q50", "q90", "q99"):
        np.testing.assert_allclose(stats["action"][key], np.quantile(actions, int(key[1:]) / 100, axis=0), rtol=1e-6)
        assert stats["observation.images.image"][key].shape == (3, 1, 1)
        assert stats["observation.state"][key].shape == (8,)
    np.testing.assert_allclose(stats["action"]["mean"], actions.mean(0), rtol=1e-6)
    assert stats["action"]["count"] == [len(dataset)]
    assert stats["checkpoint.completed"]["max"].tolist() == [1, 1, 0, 0, 0, 0]
    assert "memory" not in stats
    for value in stats["observation.images.wrist_image"].values():
        assert value.min() >= 0


def test_statistics_have_the_shapes_of_lerobots(dataset, demos):
    from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats

    reference = get_feature_stats(demos[0].actions, axis=0, keepdims=False)
    ours = numeric_stats(demos[0].actions)
    assert set(ours) == set(reference)
    for key, value in reference.items():
        assert ours[key].shape == value.shape
        # Of 25 numbers LeRobot's histogram takes quantiles between others than NumPy does.
        np.testing.assert_allclose(ours[key], value, atol=0.2 if key.startswith("q") else 1e-5)
    frames = demos[0].images["image"]
    reference = get_feature_stats(frames.transpose(0, 3, 1, 2), axis=(0, 2, 3), keepdims=True)
    histograms = ImageHistograms()
    for each in frames:
        histograms.add(each)
    ours = histograms.stats()
    assert set(ours) == set(reference)
    for key in set(reference) - {"count"}:
        np.testing.assert_allclose(ours[key], reference[key][0] / 255, atol=2 / 255)
    aggregate_stats([{"observation.images.image": ours}])  # raises on wrong shapes


def test_dataloader_batches(dataset):
    """By LeRobot's collate function; and by torch's own, with which `lerobot-dataset-viz` loads an episode."""
    from lerobot.datasets import LeRobotDataset
    from lerobot.utils.collate import lerobot_collate_fn

    episode = LeRobotDataset(REPO, root=dataset.root, episodes=[1])
    assert [len(batch["index"]) for batch in torch.utils.data.DataLoader(episode, batch_size=16)] == [16, 14]
    loader = torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True, collate_fn=lerobot_collate_fn)
    batch = next(iter(loader))
    for name in ("simple_subgoal", "grounded_subgoal", "coarse_subgoal", "memory", "task"):
        assert isinstance(batch[name], list)
        assert all(isinstance(text, str) for text in batch[name])
    assert (batch["checkpoint.completed"].shape, batch["checkpoint.completed"].dtype) == ((4, 6), torch.bool)
    assert {batch[name].dtype for name in ("checkpoint.index", "checkpoint.operation")} == {torch.int64}
    assert all(batch[name].shape == (4,) and batch[name].dtype == torch.float32 for name in CLOCK)
    assert batch["observation.images.image"].shape == (4, 3, SIZE, SIZE)


def test_phase_and_step_are_as_in_a_rollout(dataset, demos):
    """They have no statistics, so that LeRobot normalises them nowhere."""
    items = [dataset[number] for number in range(len(dataset))]
    expected = [clock for demo in demos for clock in zip(labels(demo).phase, labels(demo).step, strict=True)]
    assert [tuple(item[name].item() for name in CLOCK) for item in items] == expected
    assert expected[len(demos[0]) :][:7] == [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 0), (1, 1)]
    assert all(item[name].dtype == torch.float32 and item[name].shape == () for item in items for name in CLOCK)
    assert not set(dataset.meta.stats) & set(CLOCK)
    assert not [name for name in dataset.meta.episodes.column_names if name.startswith("stats/observation.step")]


def test_policy_features_are_images_state_clock_and_action_only(dataset):
    """Of objects, plain `lerobot-train` learns nothing where there are pictures."""
    from lerobot.configs import FeatureType
    from lerobot.utils.feature_utils import dataset_to_policy_features

    features = dataset_to_policy_features(dataset.meta.features)
    assert set(features) == {
        "observation.images.image",
        "observation.images.wrist_image",
        "observation.state",
        "action",
        *CLOCK,
    }
    assert dataset.meta.features["privileged.environment_state"]["shape"] == (208,)
    assert FeatureType.ENV not in {feature.type for feature in features.values()}
    assert features["observation.images.image"].shape == (3, SIZE, SIZE)


def test_objects_are_an_input_where_there_are_no_pictures():
    from lerobot.utils.feature_utils import dataset_to_policy_features

    features = dataset_features(None)
    assert "privileged.environment_state" not in features
    assert set(dataset_to_policy_features(features)) == {
        "observation.environment_state",
        "observation.state",
        "action",
        *CLOCK,
    }


def test_language_rows_feed_lerobots_recipes(dataset, demos):
    from lerobot.configs.recipe import MessageTurn, TrainingRecipe
    from lerobot.datasets.language_render import render_sample

    assert dataset.meta.has_language_columns
    recipe = TrainingRecipe(
        messages=[
            MessageTurn(role="user", content="${task}", stream="high_level"),
            MessageTurn(role="user", content="done: ${memory}", stream="high_level", if_present="memory"),
            MessageTurn(role="assistant", content="${subtask}", stream="high_level", target=True),
        ]
    )
    for index in range(len(dataset)):
        item = dataset[index]
        rendered = render_sample(
            recipe=recipe,
            persistent=item["language_persistent"],
            events=[],
            t=item["timestamp"].item(),
            sample_idx=index,
            task=item["task"],
        )
        texts = [message["content"] for message in rendered["messages"]]
        memory = [f"done: {item['memory']}"] if item["memory"] else []
        assert texts == [item["task"], *memory, item["simple_subgoal"]]


def test_states_lie_beside_the_dataset(dataset, demos):
    for number, demo in enumerate(demos):
        episode = read_episode(dataset.root, number)
        np.testing.assert_array_equal(episode.columns["states"], demo.states)
        np.testing.assert_array_equal(episode.columns["action"], demo.actions)
        assert episode.columns["simple_subgoal"] == labels(demo).simple_subgoal
        assert (episode.task_name, episode.seed, episode.exec_start) == (
            demo.task.name,
            demo.seed,
            demo.exec_start,
        )


def test_without_images(make_demo, tmp_path):
    from lerobot.datasets import LeRobotDataset

    demo = make_demo(["0011", "0001"])
    dataset = LeRobotDataset(REPO, root=write_dataset([demo], tmp_path / "ds"))
    assert dataset.meta.video_keys == []
    assert not (dataset.root / "videos").exists()
    assert len(dataset) == 4
    np.testing.assert_array_equal(dataset[2]["action"], demo.actions[2])


def test_videos_and_data_are_split_at_lerobots_limits(demos, tmp_path, monkeypatch):
    import lerobot.datasets.feature_utils as feature_utils
    from lerobot.datasets import LeRobotDataset

    monkeypatch.setattr(feature_utils, "DEFAULT_VIDEO_FILE_SIZE_IN_MB", 1e-6)
    monkeypatch.setattr(feature_utils, "DEFAULT_DATA_FILE_SIZE_IN_MB", 1e-6)
    dataset = LeRobotDataset(REPO, root=write_dataset(demos, tmp_path / "ds"))
    assert len(list((dataset.root / "data").rglob("*.parquet"))) == 3
    assert len(list((dataset.root / "videos").rglob("*.mp4"))) == 6
    last = dataset[len(dataset) - 1]
    assert last["episode_index"] == 2
    seen = (last["observation.images.image"] * 255).permute(1, 2, 0).numpy()
    assert np.abs(seen - demos[2].images["image"][-1]).mean() < 6


def test_same_episodes_same_bytes(demos, tmp_path):
    one = hashes(write_dataset(demos, tmp_path / "one"))
    assert one == hashes(write_dataset(iter(demos), tmp_path / "two"))
    manifest = json.loads((tmp_path / "one" / "manifest.json").read_text())
    assert [row["digest"] for row in manifest["episodes"]] == [digest(demo) for demo in demos]
    assert "world" not in manifest["episodes"][0], "which is the package's own"
    names = list(json.loads((tmp_path / "one" / "meta" / "stats.json").read_text()))
    assert names[-2:] == ["observation.images.image", "observation.images.wrist_image"], "not in the order of a set"
    assert set(map(str, one)) >= {"README.md", "manifest.json", "meta/info.json", "meta/stats.json"}


def test_card(dataset):
    from huggingface_hub import DatasetCard

    card = DatasetCard.load(dataset.root / "README.md")
    assert "LeRobot" in card.data.tags
    assert card.data.license == "apache-2.0"
    for column in dataset_features((SIZE, SIZE)):
        assert f"`{column}`" in card.text
    assert "| object | here | 1 | 2 | 60 | 30.00 | 30.00 | 30.00 | 30 |" in card.text
    assert "|  | paper | 5 | 250 | 121,276 | 485.10 | 492.00 | 526.00 | 556 |" in card.text
    assert "5.0 in object tasks" in card.text
    assert "| 0–199 | 3 | 100.00 % | 50 | 3.33 % |" in card.text
    assert "| 1,500+ | 0 | 0.00 % | 25 | 1.67 % |" in card.text


def test_the_papers_world_comes_back_and_has_terms_of_its_own(demos, make_task, tmp_path):
    from huggingface_hub import DatasetCard

    name = "put_the_artichoke_into_the_top_drawer_of_the_cabinet"
    spatial = replace(demos[0], task=make_task("SU", name=name, memory_type="spatial").in_world(LIBERO))
    classes = sorted({*get_task(name).objects.values()})
    for folder, demo, licence in (
        ("boxes", replace(spatial, stand_ins=tuple(classes)), "other"),
        ("scans", replace(spatial, stand_ins=tuple(classes[1:])), "cc-by-nc-4.0"),
        ("converted", replace(demos[0], task=demos[0].task.in_world(LIBERO), seed=-1), "cc-by-nc-4.0"),
    ):
        root = write_dataset([demo], tmp_path / folder)
        assert read_episode(root, 0).world == LIBERO
        (row,) = json.loads((root / "manifest.json").read_text())["episodes"]
        assert (row["world"], row["stand_ins"]) == (LIBERO, list(demo.stand_ins))
        card = DatasetCard.load(root / "README.md")
        assert card.data.license == licence
        assert ("boxes stand in for them: " in card.text) == bool(demo.stand_ins)
    assert terms([{"task_name": name, "memory_type": "spatial", "seed": -1}])[0] == "cc-by-nc-4.0", "placed in ours"
    assert digest(spatial) != digest(replace(spatial, task=spatial.task.in_world(MEMOBENCH)))


def test_a_folder_in_use_is_left_alone(dataset, demos, tmp_path):
    before = hashes(dataset.root)
    with pytest.raises(MemobenchError, match="already holds a finished dataset"):
        write_dataset(demos, dataset.root)
    assert hashes(dataset.root) == before
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("precious")
    with pytest.raises(MemobenchError, match=r"thesis\.tex"):
        write_dataset(demos, other)
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]
    with pytest.raises(MemobenchError, match="is a file"):
        write_dataset(demos, other / "thesis.tex")


def test_failed_writing_leaves_nothing(make_demo, tmp_path):
    def demonstrations():
        yield make_demo(["01"], size=16)
        raise RuntimeError("reader broke")

    with pytest.raises(RuntimeError, match="reader broke"):
        write_dataset(demonstrations(), tmp_path / "ds")
    assert not (tmp_path / "ds").exists()


def test_mixed_images_are_refused(make_demo, tmp_path):
    with pytest.raises(MemobenchError, match="some episodes"):
        write_dataset([make_demo(["01"]), make_demo(["01"], size=16)], tmp_path / "ds")
    assert not is_dataset(tmp_path / "ds")


def test_damaged_staged_episode_is_named(make_demo, tmp_path):
    from lerobot_memobench.datasets.lerobot_format.assembling import assemble

    staged = stage_demonstration(make_demo(["01"]), tmp_path / "ds" / ".staging" / "episodes" / "000000")
    path = staged.folder / "arrays.npz"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(MemobenchError, match=r"arrays\.npz is damaged"):
        assemble([staged], tmp_path / "ds")


@pytest.mark.slow
def test_lerobots_viewer_shows_it(dataset, tmp_path):
    """As docs/guides/data.md says it, without a display: every frame of an episode, and nothing of the others."""
    reader = pytest.importorskip("rerun.experimental", reason="rerun-sdk is not installed (the extra viz)").RrdReader
    words = ["--repo-id", REPO, "--root", str(dataset.root), "--episode-index", "1", "--num-workers", "0"]
    words += ["--display-compressed-images", "--save", "1", "--output-dir", str(tmp_path)]
    command = "from lerobot.scripts.lerobot_dataset_viz import main; main()"
    subprocess.run([sys.executable, "-c", command, *words], check=True)
    shown: Counter[str] = Counter()
    for chunk in reader(tmp_path / "local_test_episode_1.rrd").store().stream():
        shown[chunk.entity_path] += chunk.num_rows
    entities = ("/action", "/state", "/observation.images.image", "/observation.images.wrist_image")
    assert {entity: shown[entity] for entity in entities} == dict.fromkeys(entities, 30)
