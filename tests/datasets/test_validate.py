"""`validate` compares every column and image of episodes; statistics are compared and completed."""

from __future__ import annotations

import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.io_utils import load_tasks, write_tasks

from lerobot_memobench.cli import data as commands
from lerobot_memobench.datasets.episodes import read_episode, read_info
from lerobot_memobench.datasets.layout import image_key
from lerobot_memobench.datasets.statistics import check_statistics, complete, lacking, measured
from lerobot_memobench.datasets.validate import images_of, replay
from lerobot_memobench.datasets.video import VideoWriter
from lerobot_memobench.errors import MemobenchError
from tests.datasets.conftest import FRAMES, as_recorded

FRAME = 3


def other(value: Any) -> Any:
    if isinstance(value, list):
        return [*value[:-1], other(value[-1])]
    if isinstance(value, bool):
        return not value
    return value + ("x" if isinstance(value, str) else 1)


def change(folder: Path, pattern: str, name: str, row: int) -> None:
    (path,) = folder.glob(pattern)
    table = pq.read_table(path)
    place, field = table.schema.get_field_index(name), table.schema.field(name)
    if name == "language_persistent":  # Python values do not convert to its types
        changed = table.column(name).take([None if each == row else each for each in range(len(table))])
    else:
        values = table.column(name).to_pylist()
        values[row] = other(values[row])
        changed = pa.array(values, field.type)
    pq.write_table(table.set_column(place, field, changed), path)


def difference(folder: Path, images: bool = False) -> str:
    try:
        return str(replay(read_episode(folder, 1), images=images_of(folder, 1) if images else None))
    except MemobenchError as error:
        return str(error)


MESSAGES = {
    "action": "action or held (they alone are in the episode's hash",
    "executed_action": "states at frame 4",  # the state after it
    "held": "states at frame 4",
    "episode_index": "meta/episodes has length=6, but it has 5 frames",
    "task_index": "task at frame 3",
}
"""Column -> beginning of its message where this is not column and frame."""
EPISODE_COLUMNS = ("task_name", "memory_type", "family", "operations", "seed", "referent", "variant", "success")
EPISODE_COLUMNS += ("exec_start_index", "key_frames", "scene_hash", "digest", "length")


def test_every_column_is_compared(simulated, copy):
    (path,) = (simulated / "data").rglob("*.parquet")
    assert difference(simulated) == "None"
    for name in pq.read_schema(path).names:
        folder = copy(simulated)
        change(folder, "data/**/*.parquet", name, FRAMES + FRAME)
        assert difference(folder).startswith(MESSAGES.get(name, f"{name} at frame {FRAME}")), name
    for name in EPISODE_COLUMNS:
        folder = copy(simulated)
        change(folder, "meta/episodes/**/*.parquet", name, 1)
        assert difference(folder).startswith(f"meta/episodes has {name}=")
    folder = copy(simulated)
    change(folder, "states/**/*.parquet", "state", FRAMES + FRAME)
    assert difference(folder).startswith(f"states at frame {FRAME}")
    folder = copy(simulated)
    tasks = load_tasks(folder)
    write_tasks(tasks.rename(index={tasks.index[0]: "put the milk into the bowl"}), folder)
    assert difference(folder).startswith("task at frame 0: recorded 'put the milk into the bowl'")


def decoded(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.parametrize(
    ("camera", "frames", "first"), [("wrist_image", slice(-1, None), FRAMES - 1), ("image", "other episode", 0)]
)
def test_other_images_are_found(simulated, copy, camera, frames, first):
    folder = copy(simulated)
    image, wrist = (next((folder / "videos" / image_key(name)).rglob("*.mp4")) for name in ("image", "wrist_image"))
    path = image if camera == "image" else wrist
    frames_in_file = decoded(path)
    assert len(frames_in_file) == 2 * FRAMES
    if frames == "other episode":
        frames_in_file = np.roll(frames_in_file, FRAMES, axis=0)
    else:
        frames_in_file[frames] = 0
    writer = VideoWriter(path)
    for frame in frames_in_file:
        writer.add(frame)
    writer.close()
    assert difference(folder, images=True).startswith(f"{image_key(camera)} at frame {first}: recorded 'an image")


class Pool(ThreadPoolExecutor):
    """Threads that get pickled checks, like processes."""

    def submit(self, call):
        return super().submit(pickle.loads(pickle.dumps(call)))  # noqa: S301


def test_command_prints_disagreements(simulated, copy, capsys, monkeypatch):
    monkeypatch.setattr("lerobot_memobench.datasets.validate.process_pool", Pool)
    folder = copy(simulated)
    change(folder, "data/**/*.parquet", "checkpoint.index", FRAMES + FRAME)
    assert commands.validate(folder, workers=2) == 1
    printed = capsys.readouterr().out
    assert f"episode 1: checkpoint.index at frame {FRAME}" in printed
    assert "1 of 2 episodes agree, and files" in printed, "the hash of the table differs"


def test_replay_compares_fields_of_the_episode(stove, simulated, tmp_path):
    satisfied = stove.satisfied.copy()
    satisfied[5] = True
    found = replay(as_recorded(replace(stove, satisfied=satisfied)))
    assert (found.column, found.frame) == ("checkpoint.completed", 5)
    assert str(replay(as_recorded(replace(stove, success=False)))) == "success: recorded False, replayed True"
    assert replay(as_recorded(replace(stove, seed=10_001))).column == "states"
    episode = read_episode(simulated, 0)
    assert (
        replay(replace(episode, record=episode.record.model_copy(update={"key_frames": [1, 2]}))).column == "key_frames"
    )
    columns = {key: value for key, value in episode.columns.items() if key != "states"}
    columns["observation.state"] = columns["observation.state"] + np.float32(1e-3)
    assert replay(replace(episode, columns=columns)).column == "observation.state", "without states/"
    for folder, number, named in ((tmp_path, 0, "is no dataset"), (simulated, 99, "no episode 99")):
        with pytest.raises(MemobenchError, match=named):
            read_episode(folder, number)


# --- statistics ---


def test_missing_statistics_are_computed(synthetic, copy):
    root = copy(synthetic)
    path, names = root / "meta" / "stats.json", measured(read_info(root)["features"])
    check_statistics(root, names)
    whole, camera = json.loads(path.read_text()), image_key("image")
    left = {name: {key: one[key] for key in one if key[0] != "q"} for name, one in whole.items() if name != camera}
    path.write_text(json.dumps(left))
    needed = {"action": ("q01", "q99"), camera: ("mean", "std"), "observation.state": ("mean", "std")}
    assert lacking(root, needed) == ["action", camera]
    news: list[str] = []
    complete(root, lacking(root, needed), news.append)
    again = json.loads(path.read_text())
    assert lacking(root, needed) == []
    assert (again["action"], again["observation.state"]) == (whole["action"], left["observation.state"])
    np.testing.assert_allclose(again[camera]["mean"], whole[camera]["mean"], atol=0.02)
    assert all(name in news[0] for name in ("action", camera))


def test_other_statistics_are_found(synthetic, copy):
    root = copy(synthetic)
    path, names = root / "meta" / "stats.json", measured(read_info(root)["features"])
    whole = path.read_text()
    for name, key, value in (
        ("action", "mean", 0.5),
        ("action", "q99", 7.0),
        ("observation.state", "count", 29),
        (image_key("image"), "std", 0.9),
    ):
        stats = json.loads(whole)
        changed = np.asarray(stats[name][key])
        changed.flat[0] = value
        stats[name][key] = changed.tolist()
        path.write_text(json.dumps(stats))
        with pytest.raises(MemobenchError, match=f"^{key} of {name} is"):
            check_statistics(root, [name] if name in names else names)
