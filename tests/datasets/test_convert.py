"""Conversion of files in the published layout, by this package and by hand; the simulator gives what they lack."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lerobot_memobench.cli.data import convert as command
from lerobot_memobench.datasets import convert as convert_module
from lerobot_memobench.datasets.convert import convert
from lerobot_memobench.datasets.demonstration import Demonstration, digest, labels
from lerobot_memobench.datasets.hdf5.reading import Extras, PublishedFile
from lerobot_memobench.datasets.hdf5.restore import restore, task_of
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.lerobot_format.layout import is_dataset
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.datasets.recording import record_demonstration
from lerobot_memobench.datasets.replay import replay
from lerobot_memobench.datasets.staging import EpisodeStage
from lerobot_memobench.datasets.validate import validate
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.published_files import model_file, write_foreign, write_published
from tests.support.short_demonstrations import beginning, drawn_steps, with_pictures

STOVE = "turn_on_the_stove_and_turn_it_off"
BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
SIZE = 32


@pytest.fixture(scope="module")
def stove() -> Demonstration:
    return record_demonstration(get_task(STOVE), 10_000, image_size=SIZE)


@pytest.fixture(scope="module")
def short() -> Demonstration:
    """A few steps, some of them of a prompt."""
    return with_pictures(drawn_steps(BUTTER, 10_000, 12, 4), SIZE)


@pytest.fixture(scope="module")
def written(stove, short, tmp_path_factory) -> Path:
    """Both with the attributes of earlier versions."""
    folder = tmp_path_factory.mktemp("published")
    for demo in (stove, short):
        write_published(folder / f"{demo.task.name}_demo.hdf5", [demo] * 2)
    return folder


@pytest.fixture
def source(written, tmp_path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "source"))


def test_our_own_files_come_back_as_they_were(written, stove, short, tmp_path):
    summary = convert(written, tmp_path / "ds", repo_id="local/test")
    assert summary.exit_status == 0
    assert (summary.episodes, summary.problems) == (4, ())
    direct = write_dataset([short, short, stove, stove], tmp_path / "direct", repo_id="local/test")
    for folder in ("data", "videos", "states", "meta"):
        files = [path for path in (direct / folder).rglob("*") if path.is_file()]
        assert files
        for path in files:
            assert path.read_bytes() == (summary.folder / path.relative_to(direct)).read_bytes(), path
    assert replay(read_episode(summary.folder, 2)) is None
    assert not (tmp_path / "ds" / ".staging").exists()


def test_files_by_hand_without_key_frames(stove, tmp_path):
    """Checkpoint columns, proprioception and success are read off the states."""
    path = write_foreign(tmp_path / "stove.hdf5", stove)
    with PublishedFile(path) as file:
        found = file.read("demo_0")
        task = task_of(file, found)
        assert found.extras == Extras()
        assert (task.name, task.memory_type, task.family) == (STOVE, "temporal", stove.task.family)
        np.testing.assert_array_equal(restore(task, found).states, stove.states)
    summary = convert(path, tmp_path / "ds")
    assert summary.exit_status == 0
    episode = read_episode(tmp_path / "ds", 0)
    assert (episode.seed, episode.task_name, episode.whole["success"]) == (-1, STOVE, True)
    assert episode.whole["key_frames"] == labels(stove).key_frames.tolist()
    for name, column in labels(stove).columns().items():
        assert np.array_equal(episode.columns[name], column), name
    np.testing.assert_array_equal(episode.columns["observation.state"], stove.proprio)


def test_files_by_hand_with_key_frames_and_a_model_file(stove, tmp_path):
    path = write_foreign(tmp_path / "stove.hdf5", stove, key_frame=[30, 44], timestep_exec_start_idx=[5])
    with h5py.File(path, "a") as file:
        file["data/demo_0"].attrs["model_file"] = model_file(stove.task, stove.fixture_poses).replace(
            'name="flat_stove_1"', 'name="flat_stove_1_main"'
        )
    convert(path, tmp_path / "ds")
    episode = read_episode(tmp_path / "ds", 0)
    assert episode.whole["key_frames"] == [30, 44]
    assert episode.exec_start == 5
    for name, pose in stove.fixture_poses.items():
        np.testing.assert_allclose(episode.whole["fixture_poses"][name], pose, rtol=0, atol=1e-15)
    assert episode.columns["checkpoint.index"].tolist() == [0] * 31 + [1] * 14 + [2] * (len(stove) - 45)


def test_a_prompt_video_whose_end_is_not_told(tmp_path):
    butter = record_demonstration(get_task(BUTTER), 10_000, images=False)
    nothing = np.zeros((len(butter), 8, 8, 3), np.uint8)
    butter = replace(butter, images={"image": nothing, "wrist_image": nothing})
    path = write_foreign(tmp_path / "butter.hdf5", butter)
    with PublishedFile(path) as file:
        found = file.read("demo_0")
        restored = restore(task_of(file, found), found)
    assert restored.exec_start == butter.exec_start
    np.testing.assert_array_equal(restored.satisfied, butter.satisfied)
    assert restored.success
    moved = replace(found, states=found.states + np.linspace(0, 1, len(found.states))[:, None])
    with pytest.raises(MemobenchError, match="timestep_exec_start_idx is -1 for a task with a demonstration prompt"):
        restore(restored.task, moved)


def test_what_contradicts_itself_is_said(written, stove):
    with PublishedFile(written / f"{STOVE}_demo.hdf5") as file:
        found = file.read("demo_0")
        task = task_of(file, found)
    assert digest(restore(task, found)) == digest(stove)
    foreign = replace(found, extras=Extras())

    def said(reason: str, **change) -> None:
        metadata = found.metadata | change.pop("metadata", {})
        with pytest.raises(MemobenchError, match=reason):
            restore(task, replace(foreign, metadata=metadata, **change))

    said("key_frame .* is not in order", metadata={"key_frame": [50, 20]})
    said("outside of the execution", metadata={"key_frame": [20, 5000]})
    said("expected 2 frames", metadata={"key_frame": [20]})
    said("expected a frame or -1", metadata={"timestep_exec_start_idx": "first"})
    said("execution starts at frame 9999", metadata={"timestep_exec_start_idx": 9999})
    said("states have width 12, expected 47 of the joints of model_file", states=found.states[:, :12])
    said("not in order: frame 1 is earlier", states=found.states[::-1])
    said("not in order: frame 21 is earlier", states=found.states[[*range(20), 21, 20, *range(22, len(stove))]])
    said("the attribute 'model_file' is missing", model_file=" ")
    with pytest.raises(MemobenchError, match="the digest differs"):
        restore(task, replace(found, actions=found.actions[::-1]))


def test_the_rest_converts(source, stove, tmp_path):
    """Each kind of damage is named with file, group and reason; what is sound is in the dataset."""
    (source / "notes.hdf5").write_text("no HDF5")
    whole = (source / f"{BUTTER}_demo.hdf5").read_bytes()
    (source / f"{BUTTER}_demo.hdf5").write_bytes(whole[: len(whole) * 2 // 3])
    with h5py.File(source / f"{STOVE}_demo.hdf5", "a") as file:
        file["data"].attrs["num_demos"] = 5
        file.copy("data/demo_0", "data/demo_2")
        file.copy("data/demo_0", "data/demo_3")
        file["data/demo_1"].attrs["meta_data"] = "{"
        del file["data/demo_2"].attrs["num_samples"]
        file["data/demo_3/states"][:] = file["data/demo_3/states"][:][::-1]
    summary = convert(source, tmp_path / "ds")
    assert summary.exit_status == 1
    assert summary.episodes == 1
    told = [str(problem) for problem in summary.problems]
    assert [line.split(": ")[0] for line in told] == [
        "notes.hdf5",
        f"{BUTTER}_demo.hdf5",
        f"{STOVE}_demo.hdf5, data",
        f"{STOVE}_demo.hdf5, data/demo_1",
        f"{STOVE}_demo.hdf5, data/demo_2",
        f"{STOVE}_demo.hdf5, data/demo_3",
    ]
    for line, reason in zip(
        told,
        ["no HDF5 file", "cut off", "num_demos is 5", "no valid JSON", "num_samples", "not in order"],
        strict=True,
    ):
        assert reason in line
    assert not (tmp_path / "ds" / ".staging").exists()
    manifest = json.loads((tmp_path / "ds" / "manifest.json").read_text())
    assert len(manifest["left_out"]) == 6
    assert "Left out (6)" in (tmp_path / "ds" / "README.md").read_text()
    again = convert(source, tmp_path / "ds")
    assert (again.episodes, again.problems) == (summary.episodes, summary.problems)
    np.testing.assert_array_equal(read_episode(tmp_path / "ds", 0).columns["action"], stove.actions)


NO_TEXT = b"\xff\xfe broken"
"""Bytes that are no UTF-8, stored as if they were; h5py gives them back with lone surrogates."""

SURROGATE = "half a character"
"""Stands for the task's own metadata with one in its texts; JSON can say it, UTF-8 cannot."""

BAD_IN_A_DEMONSTRATION = [
    ("seed", "many"),
    ("seed", np.uint64(2**63 + 1)),
    ("variant", np.arange(2)),
    ("fixture_poses", '{"flat_stove_1": [1, 2]}'),
    ("satisfied_intervals", "[[[0]], []]"),
    ("scene_hash", NO_TEXT),
    ("meta_data", '"text"'),
    ("meta_data", None),
    ("model_file", 5),
    ("num_samples", None),
    ("digest", np.arange(4)),
]
BAD_IN_A_FILE = [
    ("task_metadata", "{}"),
    ("task_metadata", NO_TEXT),
    ("task_metadata", SURROGATE),
    ("bddl_file_content", 1.5),
    ("bddl_file_name", None),
    ("memory_type", np.arange(3)),
]
"""`test_damage` draws others."""


def _spoil(attributes: h5py.AttributeManager, name: str, value: object) -> None:
    del attributes[name]
    if value is NO_TEXT:
        attributes.create(name, NO_TEXT, dtype=h5py.string_dtype())
    elif value is not None:
        attributes[name] = value


def test_a_bad_attribute_ends_its_episode_or_file_alone(stove, tmp_path):
    """Of another type or shape, no Unicode, JSON of something else, missing: each is named, the sound one converted."""
    source = tmp_path / "source"
    many = source / "many.hdf5"
    sound = write_published(tmp_path / "sound.hdf5", [with_pictures(beginning(stove, 20), SIZE)])
    source.mkdir()
    shutil.copy(sound, many)
    with h5py.File(many, "a") as file:
        del file["data"].attrs["num_demos"]
        for number, (name, value) in enumerate(BAD_IN_A_DEMONSTRATION, 1):
            file.copy("data/demo_0", f"data/demo_{number}")
            if name != "digest":
                del file[f"data/demo_{number}"].attrs["digest"]  # or all would be found by it
            _spoil(file[f"data/demo_{number}"].attrs, name, value)
    for number, (name, value) in enumerate(BAD_IN_A_FILE):
        path = source / f"one_{number:02}.hdf5"
        shutil.copy(sound, path)
        with h5py.File(path, "a") as file:
            del file["data"].attrs["num_demos"], file["data/demo_0"].attrs["digest"]
            if value is SURROGATE:
                value = file["data"].attrs["task_metadata"].replace("stove", "st\\ud800ve")
            _spoil(file["data"].attrs, name, value)
    summary = convert(source, tmp_path / "ds")
    named = [(problem.file, problem.group.removeprefix("data/")) for problem in summary.problems]
    expected = {("many.hdf5", f"demo_{n}") for n in range(1, len(BAD_IN_A_DEMONSTRATION) + 1)}
    assert {each for each in named if each[0] == "many.hdf5"} == expected
    assert {file for file, _ in named} - {"many.hdf5"} == {f"one_{n:02}.hdf5" for n in range(len(BAD_IN_A_FILE))}
    assert all("\n" not in problem.reason for problem in summary.problems)
    assert summary.episodes == 1
    assert validate(tmp_path / "ds")[0].disagreement is None


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("memory_type", "{outside}"),
        ("bddl_file_name", "tasks/.hidden/task_config.bddl"),
    ],
)
def test_no_name_in_a_file_leads_out_of_the_folder(source, tmp_path, monkeypatch, attribute, value):
    """The bad file is named, the others are converted, and nothing is written where the name leads."""
    outside, temporary = tmp_path / "outside", tmp_path / "temporary"
    outside.mkdir()
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    with h5py.File(source / f"{STOVE}_demo.hdf5", "a") as file:
        file["data"].attrs[attribute] = value.format(outside=outside)
    summary = convert(source, tmp_path / "ds")
    assert summary.episodes == 2
    assert [(problem.file, problem.group) for problem in summary.problems] == [
        (f"{STOVE}_demo.hdf5", f"data/demo_{k}") for k in range(2)
    ]
    assert all("names no file" in problem.reason for problem in summary.problems)
    assert list(outside.iterdir()) == []


def test_images_that_cannot_be_read_are_a_problem_of_their_group(source, tmp_path):
    """A byte is changed within a compressed frame; only reading the frame shows it."""
    path = source / f"{STOVE}_demo.hdf5"
    with h5py.File(path) as file:
        chunk = file["data/demo_0/obs/agentview_image"].id.get_chunk_info(40)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + 2 : chunk.byte_offset + chunk.size] = b"\xff" * (chunk.size - 2)
    path.write_bytes(data)
    summary = convert(path, tmp_path / "ds")
    assert summary.episodes == 1
    (problem,) = summary.problems
    assert problem.group == "data/demo_0"
    assert "its images cannot be read from frame 32 on" in problem.reason


def test_a_task_that_is_not_the_catalogues_of_its_name_is_told(written, stove, tmp_path, capsys):
    """The dataset holds the file's; what finds tasks by name finds another, and everybody is told."""
    assert convert(written, tmp_path / "same").notes == ()
    folder = tmp_path / "by hand"
    folder.mkdir()
    path = write_foreign(folder / "stove.hdf5", stove)
    assert convert(path, tmp_path / "hand").notes == ()
    with h5py.File(path, "a") as file:
        text = file["data"].attrs["bddl_file_content"]
        file["data"].attrs["bddl_file_content"] = text.replace(stove.task.language, "switch the stove on and off")
        file.copy("data/demo_0", "data/demo_1")
    summary = convert(path, tmp_path / "ds")
    (note,) = summary.notes
    assert str(note) == (
        f"stove.hdf5: not as the catalogue's {STOVE}: instruction; the dataset holds the file's, but `lerobot eval` "
        "and `memobench validate` know the catalogue's by that name"
    )
    assert (summary.episodes, summary.problems, summary.exit_status) == (2, (), 0)
    assert convert(path, tmp_path / "ds") == summary
    assert str(note) in (tmp_path / "ds" / "README.md").read_text()
    assert read_episode(tmp_path / "ds", 0).columns["task"][0] == "switch the stove on and off"
    command(path, tmp_path / "ds")
    assert f"note: {note}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("layout", "attributes", "cameras"),
    [
        ("LIBERO's", ["bddl_file_name", "bddl_file_content", "problem_info"], ["agentview_rgb", "eye_in_hand_rgb"]),
        ("robomimic's", ["env_args"], ["agentview_image", "robot0_eye_in_hand_image"]),
        ("robomimic's", ["env_args"], []),
    ],
)
def test_neighbouring_layouts_are_recognised(written, tmp_path, layout, attributes, cameras):
    """In one sentence for the file, not one for each demonstration; what is sound beside it is converted."""
    source = tmp_path / "source"
    source.mkdir()
    shutil.copy(written / f"{BUTTER}_demo.hdf5", source)
    with h5py.File(source / "a.hdf5", "w") as file:
        for key in attributes:
            file.require_group("data").attrs[key] = "{}"
        for number in range(3):
            group = file.create_group(f"data/demo_{number}")
            group.attrs["num_samples"] = 4
            group["states"], group["actions"] = np.zeros((4, 9)), np.zeros((4, 7))
            group.create_group("obs")
            for camera in cameras:
                group[f"obs/{camera}"] = np.zeros((4, 8, 8, 3), np.uint8)
    summary = convert(source, tmp_path / "ds")
    (problem,) = summary.problems
    assert problem.reason.startswith(f"it is in {layout} layout, which lacks the checkpoints (meta_data)")
    assert problem.reason.endswith("describe its task as docs/develop/add_a_task.md shows")
    lacks = [] if layout == "LIBERO's" else ["bddl_file_name", "bddl_file_content"]
    lacks += [] if "agentview_image" in cameras else ["obs/agentview_image", "obs/robot0_eye_in_hand_image"]
    assert all(f"'{each}'" in problem.reason for each in lacks)
    assert summary.episodes == 2


def test_nothing_usable_leaves_nothing(tmp_path):
    (tmp_path / "a.hdf5").write_text("no HDF5")
    summary = convert(tmp_path / "a.hdf5", tmp_path / "ds")
    assert summary.folder is None
    assert summary.exit_status == 1
    assert not (tmp_path / "ds").exists()
    for missing in ("absent", "."):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(MemobenchError, match=r"does not exist|found no HDF5 file"):
            convert(tmp_path / "empty" / missing, tmp_path / "ds")
        assert not (tmp_path / "ds").exists()


def test_a_full_disk_ends_a_conversion_in_a_sentence(written, tmp_path, monkeypatch):
    """The episode that met it is not one that cannot be used, and the next run makes it."""
    path, told = written / f"{BUTTER}_demo.hdf5", []
    with monkeypatch.context() as patch:
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        patch.setattr(EpisodeStage, "publish", lambda *_: (_ for _ in ()).throw(full))
        with pytest.raises(MemobenchError, match=r"ds cannot be written \(No space left on device.*finished.*stay"):
            convert(path, tmp_path / "ds", tell=told.append)
    assert re.match(r"1 file of [\d.]+ KiB: about [\d.]+ KiB in .*ds, [\d.]+ [KM]iB until it is finished", told[0])
    assert not is_dataset(tmp_path / "ds")
    summary = convert(path, tmp_path / "ds")
    assert (summary.episodes, summary.problems) == (2, ())
    (video,) = (tmp_path / "ds" / "videos" / "observation.images.image").rglob("*.mp4")
    video.write_bytes(video.read_bytes()[:-50])
    with pytest.raises(MemobenchError, match=r"file-000\.mp4 is cut off or damaged at byte"):
        convert(path, tmp_path / "ds")


def test_a_broken_off_conversion_goes_on(written, tmp_path, monkeypatch):
    reference = convert(written / f"{BUTTER}_demo.hdf5", tmp_path / "reference")
    made: list[str] = []
    inner = convert_module.ConversionJob.run

    def run(job):
        if job.group == "demo_1" and "demo_1" not in made:
            made.append("demo_1")
            raise KeyboardInterrupt
        made.append(job.group)
        inner(job)

    monkeypatch.setattr(convert_module.ConversionJob, "run", run)
    with pytest.raises(KeyboardInterrupt):
        convert(written / f"{BUTTER}_demo.hdf5", tmp_path / "ds")
    assert not is_dataset(tmp_path / "ds")
    with pytest.raises(MemobenchError, match="unfinished run with upside_down=False, now True"):
        convert(written / f"{BUTTER}_demo.hdf5", tmp_path / "ds", upside_down=True)
    convert(written / f"{BUTTER}_demo.hdf5", tmp_path / "ds")
    assert made == ["demo_0", "demo_1", "demo_1"]
    for path in reference.folder.rglob("*"):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / "ds" / path.relative_to(reference.folder)).read_bytes(), path


def test_metadata_that_is_none(source, tmp_path):
    """A task that its file does not describe is left out, in one sentence without anybody's temporary folder."""
    path = source / f"{STOVE}_demo.hdf5"
    with h5py.File(path, "a") as file:
        del file["data"].attrs["task_metadata"]
        file["data/demo_0"].attrs["meta_data"] = json.dumps({"memory": []})
        del file["data/demo_1"].attrs["digest"]  # it is of the task by its real name
        file["data"].attrs["bddl_file_name"] = "C:\\tasks\\own task\\task_config.bddl"
    summary = convert(path, tmp_path / "ds")
    (problem,) = summary.problems
    assert problem.reason.startswith("meta_data lacks 'operating_type', 'subtask_goals'")
    assert os.sep + "tmp" not in problem.reason
    assert read_episode(tmp_path / "ds", 0).task_name == "own task"
