"""Whole commands on a small dataset and on a file in the published layout, damaged in any way.

Each ends in a result or in a sentence, whether a value, a text, a column or a byte is another.
"""

from __future__ import annotations

import contextlib
import json
import random
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.io_utils import load_tasks, write_tasks

from lerobot_memobench.cli import data as commands
from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.hdf5.writing import write_task_file
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.datasets.replay import replay
from lerobot_memobench.datasets.staging import stage_demonstration
from lerobot_memobench.datasets.validate import Verdict, validate
from lerobot_memobench.errors import MemobenchError
from tests.support import mutations
from tests.support.short_demonstrations import drawn_steps, with_pictures
from tests.support.videos import encode_video

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
FRAMES, EXEC_START, SIZE = 6, 2, 32
DATASET, FILES = "dataset", "published"

Damage = Callable[[Path, random.Random], None]


def demonstration(seed: int = 10_000) -> Demonstration:
    """Six steps of a task with a prompt, and small pictures."""
    return with_pictures(drawn_steps(TASK, seed, FRAMES, EXEC_START), SIZE)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, and the same demonstration twice in a file of the published layout."""
    folder, demo = tmp_path_factory.mktemp("whole"), demonstration()
    write_dataset([demo], folder / "source" / DATASET)
    staged = stage_demonstration(demo, folder / "staged", ("hdf5",))
    file = folder / "source" / FILES / f"{TASK}_demo.hdf5"
    write_task_file(file, staged.hdf5_attributes, [staged.hdf5] * 2)
    return folder / "source"


# --- what is damaged ---


def any_json(folder: Path, rng: random.Random) -> None:
    """info.json, stats.json or manifest.json, now and then the card."""
    names = ("meta/info.json", "meta/info.json", "meta/stats.json", "manifest.json")
    mutations.damage(folder / rng.choice(names), rng)
    if rng.random() < 0.05:
        mutations.damage(folder / "README.md", rng, mutations.mutated_bytes)


def any_bytes(folder: Path, rng: random.Random) -> None:
    """A parquet file or a video."""
    paths = [path for suffix in ("parquet", "mp4") for path in sorted(folder.rglob(f"*.{suffix}"))]
    mutations.damage(rng.choice(paths), rng, mutations.mutated_bytes)


def any_column(folder: Path, rng: random.Random) -> None:
    """A parquet file with another value, which may change its column's type, without a column, or without rows."""
    path = rng.choice(sorted(folder.rglob("*.parquet")))
    table = pq.read_table(path)
    if rng.random() < 0.05:
        pq.write_table(table.slice(0, rng.randrange(table.num_rows)), path)
        return
    number = rng.randrange(table.num_columns)
    name, values = table.column_names[number], table.column(number).to_pylist()
    row = rng.randrange(len(values))
    if isinstance(values[row], str) and values[row][:1] in ("{", "[") and rng.random() < 0.8:
        values[row] = mutations.mutated_json(values[row].encode(), rng).decode(errors="replace")
    else:
        values[row] = mutations.mutated_value(values[row], rng)
    pq.write_table(table.drop_columns([name]), path)
    if rng.random() < 0.8:
        with contextlib.suppress(pa.ArrowException, TypeError, ValueError, OverflowError):  # parquet has no such value
            pq.write_table(table.set_column(number, name, pa.array(values)), path)


def any_attribute(folder: Path, rng: random.Random) -> None:
    """An attribute of a file in the published layout, or what a JSON text among them says."""
    with h5py.File(next(folder.glob("*.hdf5")), "r+") as file:
        group = rng.choice([file["data"], file["data"], *file["data"].values()])
        key = rng.choice(list(group.attrs))
        value: Any = group.attrs[key]
        if rng.random() < 0.1:
            del group.attrs[key]
            return
        if isinstance(value, str) and rng.random() < 0.7:
            mutate = mutations.mutated_json if value[:1] in ("{", "[") else mutations.mutated_bytes
            value = mutate(value.encode(), rng).decode(errors="replace")
        else:
            value = rng.choice([*mutations.VALUES, np.float32(1), np.array(["a", "b"], "S")])
        try:
            group.attrs[key] = value
        except (TypeError, ValueError, OverflowError, OSError):  # HDF5 takes no such value
            group.attrs[key] = np.array([1.5, np.nan])


def any_array(folder: Path, rng: random.Random) -> None:
    """An array of a file in the published layout: gone, of another type or shape, or with another number in it."""
    with h5py.File(next(folder.glob("*.hdf5")), "r+") as file:
        group = rng.choice(list(file["data"].values()))
        names: list[str] = []
        group.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        name = rng.choice(names)
        values = group[name][()]
        del group[name]
        kind = rng.randrange(6)
        if kind == 0:
            group.create_group(name)
        elif kind == 1:
            group[name] = values.astype(rng.choice(["f2", "i8", "S5", "u1", "f8"]))
        elif kind == 2:
            group[name] = rng.choice([values[:-1], values[:0], values[..., None], values[:, :1], values.ravel()])
        elif kind < 5:
            place = rng.randrange(values.size)
            values.flat[place] = rng.choice([0, 255, np.nan, 1e30, -1]) if values.dtype.kind == "f" else 255
            group[name] = values


def bytes_of_file(folder: Path, rng: random.Random) -> None:
    """Bytes of a file in the published layout."""
    mutations.damage(next(folder.glob("*.hdf5")), rng, mutations.mutated_bytes)


# --- what is typed ---


def describe(whole: Path) -> None:
    commands.describe(whole / DATASET, whole / "out")


def validate_dataset(whole: Path) -> None:
    commands.validate(whole / DATASET)


def validate_files(whole: Path) -> None:
    commands.validate(whole / FILES)


def convert(whole: Path) -> None:
    commands.convert(whole / FILES, whole / "out")


COUNTS = {describe: (3, 2_000), validate_dataset: (5, 8_000), convert: (4, 5_000), validate_files: (4, 5_000)}
"""Command -> how often it meets each damage, and how often in the slow test: 10,000 times each damage."""

KINDS: dict[str, tuple[Callable[[Path], None], Damage, str]] = {
    f"{command.__name__}, {damage.__name__}": (command, damage, place)
    for place, calls, damages in (
        (DATASET, (describe, validate_dataset), (any_json, any_bytes, any_column)),
        (FILES, (convert, validate_files), (any_attribute, any_array, bytes_of_file)),
    )
    for command in calls
    for damage in damages
}


def check(source: Path, tmp_path: Path, kind: str, slow: bool, monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    command, damage, place = KINDS[kind]
    whole = tmp_path / "whole"
    whole.mkdir()
    monkeypatch.chdir(whole)

    def prepare(rng: random.Random) -> None:
        mutations.fresh_copy(source, whole)
        damage(whole / place, rng)

    seeds = range(COUNTS[command][slow])
    return mutations.ends_well(seeds, prepare, lambda _: command(whole), whole, (DATASET, FILES, "out"))


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_data(source: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check(source, tmp_path, kind, False, monkeypatch)["result"]


def test_what_is_whole_gives_a_result(source: Path, tmp_path: Path) -> None:
    assert commands.validate(source / DATASET) == 0
    assert commands.validate(source / FILES) == 0
    assert commands.convert(source / FILES, tmp_path / "out") == 0
    assert commands.describe(source / DATASET, tmp_path / "description") == 0


@pytest.mark.slow
@pytest.mark.timeout(36_000)
@pytest.mark.parametrize("kind", KINDS)
def test_much_damaged_data(source: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = check(source, tmp_path, kind, True, monkeypatch)
    print(f"{kind}: {found['result']} results, {found['refused']} refused")


# --- each damage alone, in the second of two episodes ---


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    demos = [demonstration(10_000), demonstration(10_001)]
    moved = replace(demos[1], executed=demos[1].actions, actions=demos[1].actions * np.float32(0.5))
    return write_dataset([demos[0], moved], tmp_path_factory.mktemp("two") / DATASET)


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
    "episode_index": "meta/episodes says length=6, but it has 5 frames",
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


@pytest.mark.parametrize("name", EPISODES.split())
def test_every_column_of_episodes_is_compared(two: Path, tmp_path: Path, name: str) -> None:
    folder = Path(shutil.copytree(two, tmp_path / "ds"))
    (path,) = (folder / "meta" / "episodes").rglob("*.parquet")
    change(path, name, 1)
    assert found_without_pictures(folder).startswith(f"meta/episodes says {name}=")


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
    assert any("data holds 12 rows, meta/info.json tells of 999; the" in str(each) for each in told), told


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


def test_pictures_in_hdf5_are_compared(source: Path, tmp_path: Path) -> None:
    files = Path(shutil.copytree(source / FILES, tmp_path / "files"))
    (path,) = files.glob("*.hdf5")
    with h5py.File(path, "r+") as file:
        file["data/demo_1/obs/robot0_eye_in_hand_image"][-1] = 0
    first, second = validation(files)
    assert first.disagreement is None
    assert str(second.disagreement).startswith(f"observation.images.wrist_image at frame {FRAMES - 1}: recorded")


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
    ids=[
        "table cut",
        "table zeroed",
        "episodes cut",
        "statistics cut",
        "tasks gone",
        "video cut",
        "video gone",
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
    assert last.endswith("generate it or take it from its source again"), last


def test_a_feature_larger_than_memory_is_told_before_it_is_taken(source: Path, tmp_path: Path) -> None:
    """LeRobot would take memory for all that it tells of: 23 GB of six frames, and the kernel ended the process."""
    folder = shutil.copytree(source / DATASET, tmp_path / "dataset")
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["features"]["privileged.environment_state"]["shape"][0] *= 10**6
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(MemobenchError, match=r"more than 50,000,000 numbers of privileged\.environment_state"):
        commands.describe(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("pattern", ["data/**/*.parquet", "states/**/*.parquet", "videos/*wrist_image/**/*.mp4"])
def test_a_file_that_is_cut_off_is_named_with_what_to_do(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], pattern: str
) -> None:
    """By validating as by describing, however long its name is."""
    folder = Path(shutil.copytree(source / DATASET, tmp_path / ("long" * 60)))
    (path,) = folder.glob(pattern)
    for damaged in (path.read_bytes()[: path.stat().st_size * 2 // 3], bytes(path.stat().st_size)):
        path.write_bytes(damaged)
        assert commands.validate(folder) == 1
        verdict = capsys.readouterr().out.splitlines()[0]
        assert verdict.startswith(f"episode 0: {path} cannot be read ("), verdict
        assert verdict.endswith("generate it or take it from its source again"), verdict
        with pytest.raises(MemobenchError) as told:
            commands.describe(folder, tmp_path / "out")
        assert str(told.value).startswith(f"{path} "), told.value
        assert str(told.value).endswith("generate it or take it from its source again")
        assert not (tmp_path / "out").exists()
