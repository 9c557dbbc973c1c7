"""`validate` compares everything: each damage alone, in the second of two episodes, is named with its place."""

from __future__ import annotations

import json
import shutil
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
from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.datasets.replay import replay
from lerobot_memobench.datasets.validate import Verdict, validate
from lerobot_memobench.errors import MemobenchError
from tests.datasets.test_damage import FRAMES, demonstration
from tests.support.videos import encode_video


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    demos = [demonstration(10_000), demonstration(10_001)]
    moved = replace(demos[1], executed=demos[1].actions, actions=demos[1].actions * np.float32(0.5))
    return write_dataset([demos[0], moved], tmp_path_factory.mktemp("two") / "ds")


def other(value: Any) -> Any:
    """Return another value of the same type."""
    if isinstance(value, list):
        return [*value[:-1], other(value[-1])]
    if isinstance(value, bool):
        return not value
    return value + ("x" if isinstance(value, str) else 1)


def change(path: Path, name: str, row: int) -> None:
    """Change one value of a parquet file."""
    table = pq.read_table(path)
    place, field = table.schema.get_field_index(name), table.schema.field(name)
    if name == "language_persistent":  # of types that Python's values do not become
        changed = table.column(name).take([None if each == row else each for each in range(len(table))])
    else:
        values = table.column(name).to_pylist()
        values[row] = other(values[row])
        changed = pa.array(values, field.type)
    pq.write_table(table.set_column(place, field, changed), path)


def test_the_command_names_what_disagrees(two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.validate(two) == 0
    assert "2 of 2 episodes agree" in capsys.readouterr().out
    folder = Path(shutil.copytree(two, tmp_path / "ds"))
    (path,) = (folder / "data").rglob("*.parquet")
    change(path, "checkpoint.index", FRAMES + FRAME)
    assert commands.validate(folder) == 1
    printed = capsys.readouterr().out
    assert f"episode 1: checkpoint.index at frame {FRAME}" in printed
    assert "1 of 2 episodes agree, and files" in printed, "the table has other bytes than those written"


def validation(folder: Path) -> list[Verdict]:
    """Return the verdicts on episodes."""
    return [verdict for verdict in validate(folder) if not verdict.of_file]


def found(folder: Path) -> str:
    """Return the verdict on the second episode; the first one agrees."""
    first, second = validation(folder)
    assert first.disagreement is None, first
    assert second.subject == "episode 1"
    return str(second.disagreement)


def found_without_pictures(folder: Path) -> str:
    """Return the verdict on the second episode, of which nothing is drawn; the first one is not replayed."""
    try:
        return str(replay(read_episode(folder, 1)))
    except MemobenchError as error:
        return str(error)


FRAME = 3
COLUMNS = {
    "action": "action (it alone is in the episode's hash",
    "executed_action": "states at frame 4",  # where it leads
    "checkpoint.index": "",
    "checkpoint.operation": "",
    "checkpoint.completed": "",
    "checkpoint.event": "",
    "coarse_subgoal": "",
    "episode_index": "meta/episodes has length=6, but it has 5 frames",
    "episode_info": "",
    "frame_index": "",
    "grounded_subgoal": "",
    "index": "",
    "language_persistent": "",
    "memory": "",
    "observation.state": "",
    "observation.phase": "",
    "observation.step": "",
    "simple_subgoal": "",
    "task_index": "task at frame 3",
    "timestamp": "",
}
"""Column -> how the sentence begins that names it, where that is not the column and the frame."""


def test_every_column_of_frames_is_compared(two: Path, tmp_path: Path) -> None:
    (path,) = (two / "data").rglob("*.parquet")
    names = pq.read_schema(path).names
    objects = {name for name in names if name.endswith("environment_state")}
    assert set(names) == set(COLUMNS) | objects
    assert len(objects) == 1
    for name, begins in {**COLUMNS, **dict.fromkeys(objects, "")}.items():
        folder = Path(shutil.copytree(two, tmp_path / name))
        change(folder / path.relative_to(two), name, FRAMES + FRAME)
        verdict = (found if name == "memory" else found_without_pictures)(folder)
        assert verdict.startswith(begins or f"{name} at frame {FRAME}"), name


EPISODES = """task_name memory_type family operations seed referent variant success exec_start_index key_frames
scene_hash digest length"""


def test_every_column_of_episodes_is_compared(two: Path, tmp_path: Path) -> None:
    (path,) = (two / "meta" / "episodes").rglob("*.parquet")
    for name in EPISODES.split():
        folder = Path(shutil.copytree(two, tmp_path / name))
        change(folder / path.relative_to(two), name, 1)
        assert found_without_pictures(folder).startswith(f"meta/episodes has {name}=")


def test_states_and_instruction_are_compared(two: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(two, tmp_path / "states"))
    (path,) = (folder / "states").rglob("*.parquet")
    change(path, "state", FRAMES + FRAME)
    assert found(folder).startswith(f"states at frame {FRAME}")
    folder = Path(shutil.copytree(two, tmp_path / "tasks"))
    tasks = load_tasks(folder)
    write_tasks(tasks.rename(index={tasks.index[0]: "put the milk into the bowl"}), folder)
    told = [str(verdict.disagreement) for verdict in validation(folder)]
    assert all(
        each.startswith("task at frame 0: recorded 'put the milk into the bowl', replayed 'put") for each in told
    )


def test_a_number_of_frames_that_are_not_there_is_named(two: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(two, tmp_path / "ds"))
    info = json.loads((folder / "meta" / "info.json").read_text())
    (folder / "meta" / "info.json").write_text(json.dumps(info | {"total_frames": 999}))
    told = [verdict.disagreement for verdict in validate(folder) if verdict.subject == "meta/info.json"]
    assert any("data holds 12 rows, meta/info.json names 999; the" in str(each) for each in told), told


def decoded(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.parametrize(
    ("camera", "frames", "first"),
    [
        ("image", slice(FRAMES, None), 0),
        ("wrist_image", slice(-1, None), FRAMES - 1),
        ("wrist_image", slice(FRAMES, FRAMES + 1), 0),
    ],
    ids=["all", "last", "first"],
)
def test_a_video_of_something_else_is_named(two: Path, tmp_path: Path, camera: str, frames: slice, first: int) -> None:
    folder = Path(shutil.copytree(two, tmp_path / "ds"))
    (path,) = (folder / "videos" / f"observation.images.{camera}").rglob("*.mp4")
    pictures = decoded(path)
    assert len(pictures) == 2 * FRAMES
    pictures[frames] = 0
    encode_video(pictures, path)
    assert found(folder).startswith(f"observation.images.{camera} at frame {first}: recorded 'a picture")


def test_exchanged_cameras_and_episodes_are_named(two: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(two, tmp_path / "cameras"))
    one, another = sorted((folder / "videos").iterdir())
    one.rename(folder / "aside")
    another.rename(one)
    (folder / "aside").rename(another)
    told = [str(verdict.disagreement) for verdict in validation(folder)]
    assert all(each.startswith("observation.images.image at frame 0: recorded 'a picture 1") for each in told)
    folder = Path(shutil.copytree(two, tmp_path / "episodes"))
    (path,) = (folder / "videos" / "observation.images.image").rglob("*.mp4")
    encode_video(np.roll(decoded(path), FRAMES, axis=0), path)
    assert all(str(v.disagreement).startswith("observation.images.image at frame 0") for v in validation(folder))


# --- what trains ---

SMALL = {
    "pretrained_backbone_weights": "null",
    "push_to_hub": "false",
    "device": "cpu",
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 16,
    "n_encoder_layers": 1,
    "use_vae": "false",
    "chunk_size": 2,
    "n_action_steps": 2,
}
TRAIN = ["train", "policy=act", *(f"policy.{key}={value}" for key, value in SMALL.items()), "batch_size=4"]


def zeroed(path: Path) -> None:
    """Leave a table's end, which tells what is in it, and none of its values."""
    data = path.read_bytes()
    path.write_bytes(data[:4] + bytes(len(data) * 3 // 4) + data[4 + len(data) * 3 // 4 :])


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


@pytest.mark.parametrize(
    ("pattern", "damage"),
    [
        ("data/**/*.parquet", cut),
        pytest.param("data/**/*.parquet", zeroed, marks=pytest.mark.slow),
        ("meta/episodes/**/*.parquet", cut),
        pytest.param("meta/stats.json", cut, marks=pytest.mark.slow),
        ("meta/tasks.parquet", Path.unlink),
        ("videos/*wrist_image/**/*.mp4", cut),
        pytest.param("videos/*wrist_image/**/*.mp4", Path.unlink, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_training_names_the_damaged_file(
    two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], pattern: str, damage: Any, workers: int
) -> None:
    folder = Path(shutil.copytree(two, tmp_path / "ds"))
    (path,) = folder.glob(pattern)
    damage(path)
    run = tmp_path / "run"
    assert lerobot([*TRAIN, f"dataset={folder}", f"output_dir={run}", "steps=3", f"num_workers={workers}"]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith((f"lerobot: {path} ", f"lerobot: {path}: ")), last


def test_a_feature_larger_than_memory_is_refused(two: Path, tmp_path: Path) -> None:
    """LeRobot would allocate all of it: 23 GB for six frames."""
    folder = shutil.copytree(two, tmp_path / "dataset")
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["features"]["privileged.environment_state"]["shape"][0] *= 10**6
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(MemobenchError, match=r"privileged\.environment_state"):
        commands.describe(folder, tmp_path / "out")


@pytest.mark.parametrize("pattern", ["data/**/*.parquet", "states/**/*.parquet", "videos/*wrist_image/**/*.mp4"])
def test_a_file_that_is_cut_off_is_named(two: Path, tmp_path: Path, pattern: str) -> None:
    """By validating as by describing, however long its name is."""
    folder = Path(shutil.copytree(two, tmp_path / ("long" * 60)))
    (path,) = folder.glob(pattern)
    for damaged in (path.read_bytes()[: path.stat().st_size * 2 // 3], bytes(path.stat().st_size)):
        path.write_bytes(damaged)
        assert any(f"{path} cannot be read (" in str(verdict.disagreement) for verdict in validate(folder))
        with pytest.raises(MemobenchError) as caught:
            commands.describe(folder, tmp_path / "out")
        assert str(caught.value).startswith(f"{path} ")
        assert not (tmp_path / "out").exists()
