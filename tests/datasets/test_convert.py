"""Conversion of files in the published layout, from a file, a folder and an archive."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lerobot_memobench.cli.data import convert as command
from lerobot_memobench.datasets import convert as convert_module
from lerobot_memobench.datasets import restore as restore_module
from lerobot_memobench.datasets.convert import convert, find_files
from lerobot_memobench.datasets.demonstration import Demonstration, digest
from lerobot_memobench.datasets.episodes import read_episode, read_info, read_manifest
from lerobot_memobench.datasets.hdf5 import NO_SEED, PublishedFile
from lerobot_memobench.datasets.layout import is_dataset
from lerobot_memobench.datasets.restore import ORIENTATIONS, restore, task_of
from lerobot_memobench.datasets.validate import images_of, replay
from lerobot_memobench.datasets.video import VideoWriter, frame_reader
from lerobot_memobench.datasets.write import write_dataset
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import in_words
from lerobot_memobench.sim.convention import convention_of
from tests.datasets.conftest import BUTTER, STOVE
from tests.support import libero_layout
from tests.support.kills import hashes, killed_at
from tests.support.libero_layout import write_published
from tests.support.short_demonstrations import beginning, drawn_steps, with_images

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0b' * 32}\nsize 48213\n"


@pytest.fixture(scope="module")
def short():
    """A few steps, some of them of a prompt."""
    return with_images(drawn_steps(BUTTER, 10_000, 12, 4), 128)


@pytest.fixture(scope="module")
def begun(stove):
    return with_images(beginning(stove, 20), 128)


def restored_exactly(demo: Demonstration) -> Demonstration:
    """Return a demonstration without what the layout does not hold."""
    return replace(demo, seed=NO_SEED, scene_hash="")


@pytest.fixture(scope="module")
def written(begun, short, tmp_path_factory) -> Path:
    """Two files of two short demonstrations."""
    folder = tmp_path_factory.mktemp("published")
    for demo in (begun, short):
        write_published(folder / f"{demo.task.name}_demo.hdf5", [demo] * 2)
    return folder


@pytest.fixture(scope="module")
def converted(written, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("converted") / "ds"
    assert convert(written, folder, repo_id="local/test").exit_status == 0
    return folder


# --- reading a file ---


@pytest.fixture
def path(make_demo, tmp_path):
    demos = [make_demo(["0010011", "0001111"], seed=10_000 + k, size=32) for k in range(2)]
    return write_published(tmp_path / "hdf5" / "synthetic_task_demo.hdf5", demos, scene="<mujoco/>")


def test_files_are_found_behind_links_and_in_capitals(tmp_path):
    folder, elsewhere = tmp_path / "folder", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    (elsewhere / "B.HDF5").touch()
    (folder / "a.H5").touch()
    (folder / "linked").symlink_to(elsewhere)
    with zipfile.ZipFile(tmp_path / "packed.ZIP", "w") as file:
        file.writestr("A.HDF5", "")
    found = {source.name: [file.name for file in find_files(source, tmp_path)[0]] for source in tmp_path.iterdir()}
    assert found == {"folder": ["a.H5", "linked/B.HDF5"], "elsewhere": ["B.HDF5"], "packed.ZIP": ["A.HDF5"]}


def external(group):
    group["obs"].create_dataset("other", (8,), np.uint8, external=[("/etc/hostname", 0, 8)])


def virtual(group):
    layout = h5py.VirtualLayout((7, 7), np.float64)
    layout[:] = h5py.VirtualSource("elsewhere.hdf5", "actions", (7, 7))
    del group["actions"]
    group.create_virtual_dataset("actions", layout)


def linked(group):
    del group["actions"]
    group["actions"] = h5py.SoftLink("/aside/actions")
    group.file["aside"] = h5py.ExternalLink("elsewhere.hdf5", "/")


def filtered(group):
    """Store actions as a filter does that is not installed here."""
    del group["actions"]
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((7, 7))
    layout.set_filter(32_999, h5py.h5z.FLAG_OPTIONAL)
    space = h5py.h5s.create_simple((7, 7))
    h5py.h5d.create(group.id, b"actions", h5py.h5t.NATIVE_DOUBLE, space, layout).write_direct_chunk((0, 0), b"packed")


def put(name, make):
    def change(group):
        old = group[name][:]
        del group[name]
        if make is not None:
            group[name] = make(old)

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (external, "'data/demo_1/obs/other' is read from another file"),
        (virtual, "'data/demo_1/actions' is read from another file"),
        (linked, "'aside' is read from another file"),
        (filtered, "actions is compressed by the HDF5 filter 32999"),
        (put("states", None), "'states' is missing"),
        (put("obs/robot0_eye_in_hand_image", None), "'obs/robot0_eye_in_hand_image' is missing"),
        (put("actions", lambda old: old[:-1]), "states 7, actions 6"),
        (put("actions", lambda old: old.astype(np.int64)), "actions has type int64"),
        (put("states", lambda old: np.where(np.arange(7)[:, None] == 3, np.nan, old)), "states .* frame 3"),
        (put("obs/agentview_image", lambda old: old[:, :16]), "different sizes"),
        (lambda group: group.attrs.__setitem__("num_samples", 8), "num_samples is 8"),
        (lambda group: group.attrs.__delitem__("meta_data"), "'meta_data' is missing"),
        (lambda group: group.attrs.__setitem__("meta_data", "{'key_frame': [2]}"), "meta_data is no valid JSON"),
    ],
)
def test_differences_of_a_group_are_named(path, tmp_path, change, reason):
    with h5py.File(tmp_path / "elsewhere.hdf5", "w") as file:
        file["actions"] = np.zeros((7, 7))
    with h5py.File(path, "a") as file:
        change(file["data/demo_1"])
    with pytest.raises(MemobenchError, match=reason), PublishedFile(path) as file:
        file.read("demo_1")


def test_files_that_cannot_be_opened(path, tmp_path):
    whole = path.read_bytes()
    (tmp_path / "cut.hdf5").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.hdf5").write_text("no HDF5")
    (tmp_path / "pointer.hdf5").write_text(POINTER)
    with h5py.File(tmp_path / "empty.hdf5", "w") as file:
        file.create_group("episodes")
    with h5py.File(tmp_path / "link.hdf5", "w") as file:
        file.create_group("data").attrs.update(bddl_file_name="a", bddl_file_content="b")
        file["data/demo_0"] = h5py.ExternalLink("elsewhere.hdf5", "/demo_0")
    os.mkfifo(tmp_path / "pipe.hdf5")
    with h5py.File(path, "a") as file:
        del file["data"].attrs["bddl_file_content"]
    for name, reason in {
        "cut.hdf5": "cut off",
        "text.hdf5": "no HDF5 file",
        "pointer.hdf5": "git lfs pull",
        "empty.hdf5": r"no group 'data' \(found episodes\)",
        "link.hdf5": "'data/demo_0' is read from another file",
        "pipe.hdf5": "is a pipe",
        "hdf5/synthetic_task_demo.hdf5": "'bddl_file_content' is missing",
        "absent.hdf5": "no such file",
    }.items():
        with pytest.raises(MemobenchError, match=reason), PublishedFile(tmp_path / name) as opened:
            opened.read("demo_0")
    with path.open("rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)  # as HDF5 locks files that it writes
        with pytest.raises(MemobenchError, match="is locked"):
            PublishedFile(path)


# --- conventions of images ---


@pytest.mark.parametrize("stored", ORIENTATIONS)
def test_the_first_image_decides_the_orientation(short, tmp_path, stored):
    rows, columns = ORIENTATIONS[stored]
    turned = replace(short, images={name: images[:, ::rows, ::columns] for name, images in short.images.items()})
    path = write_published(tmp_path / "short_demo.hdf5", [turned])
    summary = convert(path, tmp_path / "ds", repo_id="local/test", convention="libero")
    direct = write_dataset([restored_exactly(short)], tmp_path / "direct", repo_id="local/test", convention="libero")
    for folder in ("data", "videos", "states", "meta"):
        assert hashes(direct / folder) == hashes(tmp_path / "ds" / folder)
    assert not (tmp_path / "ds" / ".staging").exists()
    assert [note.reason for note in summary.notes] == (
        [] if stored == "upright" else [f"its images are {stored}: they are turned"]
    )


def test_images_unlike_the_scene_are_noted(short, tmp_path):
    """Without a near image, nothing is turned."""
    grey = {name: np.full_like(images, 128) for name, images in short.images.items()}
    mixed = {**short.images, "wrist_image": short.images["wrist_image"][:, ::-1]}
    for name, images in (("grey", grey), ("mixed", mixed)):
        path = write_published(tmp_path / name / "short_demo.hdf5", [replace(short, images=images)])
        summary = convert(path, tmp_path / name / "ds", repo_id="local/test")
        assert summary.episodes == 1
        assert "is not clear" in summary.notes[0].reason
        lone = replace(restored_exactly(short), images=images)
        direct = write_dataset([lone], tmp_path / name / "direct", repo_id="local/test")
        assert hashes(direct / "videos") == hashes(tmp_path / name / "ds" / "videos")


def test_a_scene_that_cannot_be_built_is_left_out(written, tmp_path, monkeypatch):
    def fail(task):
        raise MemobenchError(f"no scene of {task.name}")

    restore_module._simulation.cache_clear()
    monkeypatch.setattr(restore_module, "Simulation", fail)
    summary = convert(written, tmp_path / "ds")
    assert (summary.episodes, summary.folder, len(summary.problems)) == (0, None, 4)
    assert "no scene of" in summary.problems[0].reason


def test_a_dataset_states_its_convention(short, tmp_path):
    """By the names of its columns, in their description, its manifest and its card; replay agrees with its images."""
    path = write_published(tmp_path / "short_demo.hdf5", [short])
    for convention, wrist in (("upright", "wrist_image"), ("libero", "image2")):
        folder = tmp_path / convention
        convert(path, folder, convention=convention)
        info = read_info(folder)
        cameras = [f"observation.images.{name}" for name in ("image", wrist)]
        assert [name for name in info["features"] if "images" in name] == cameras
        assert convention_of(info["features"]) == convention
        assert read_manifest(folder)["request"]["convention"] == convention
        assert f"convention={convention}" in (folder / "README.md").read_text()
        frames = {name: frame_reader(folder, name)(0, [3])[0].permute(1, 2, 0).numpy() * 255 for name in cameras}
        for camera, frame in zip(("image", "wrist_image"), frames.values(), strict=True):
            true = short.images[camera][3].astype(float)
            apart = [np.abs(frame - image).mean() for image in (true, true[:, ::-1])]
            assert min(apart) < 8
            assert (apart[0] < apart[1]) == (convention == "upright")
        direct = write_dataset([short], tmp_path / f"direct {convention}", convention=convention)
        assert replay(read_episode(direct, 0), images=images_of(direct, 0)) is None


# --- restoring a demonstration ---


def test_prompt_without_stated_end(short, tmp_path):
    with PublishedFile(libero_layout.write(tmp_path / "butter.hdf5", short)) as file:
        found = file.read("demo_1")
        restored = restore(task_of(file, found), found)
    assert restored.exec_start == short.exec_start == 4
    np.testing.assert_array_equal(restored.satisfied, short.satisfied)
    moved = replace(found, states=found.states + np.linspace(0, 1, len(found.states))[:, None])
    with pytest.raises(MemobenchError, match="timestep_exec_start_idx is -1"):
        restore(restored.task, moved)


def test_contradictions_are_named(stove, tmp_path):
    with PublishedFile(write_published(tmp_path / "stove.hdf5", [stove])) as file:
        found = file.read("demo_0")
        task = task_of(file, found)
    assert digest(restore(task, found)) == digest(restored_exactly(stove))
    order = [*range(20), 21, 20, *range(22, len(stove))]
    for reason, change in [
        ("outside of the execution", {"metadata": {"key_frame": [20, 5000]}}),
        ("execution starts at frame 9999", {"metadata": {"timestep_exec_start_idx": 9999}}),
        ("states have width 12, expected 47", {"states": found.states[:, :12]}),
        ("frame 21 is earlier", {"states": found.states[order]}),
        ("no MJCF", {"model_file": "<scene/>"}),
    ]:
        change["metadata"] = found.metadata | change.get("metadata", {})
        with pytest.raises(MemobenchError, match=reason):
            restore(task, replace(found, **change))


# --- left-out files and demonstrations ---

NO_TEXT = b"\xff\xfe broken"
"""Bytes that are no UTF-8; h5py returns them with lone surrogates."""
BAD_DEMONSTRATIONS = [("meta_data", '"text"'), ("meta_data", NO_TEXT), ("model_file", 5)]
BAD_FILES = [
    ("bddl_file_content", 1.5),
    ("bddl_file_name", None),
    ("bddl_file_name", "tasks/.hidden/task_config.bddl"),
    ("memory_type", np.arange(3)),
    ("memory_type", "../outside"),
]


def spoil(attributes: h5py.AttributeManager, name: str, value: object) -> None:
    attributes.pop(name, None)
    if value is NO_TEXT:
        attributes.create(name, NO_TEXT, dtype=h5py.string_dtype())
    elif value is not None:
        attributes[name] = value


def test_bad_attributes_end_their_episode_or_file_only(written, tmp_path, monkeypatch):
    """Each is reported with file and group, the sound demonstrations are converted, and no name leads elsewhere."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder, sound = tmp_path / "folder", written / f"{STOVE}_demo.hdf5"
    many = folder / "many.hdf5"
    folder.mkdir()
    shutil.copy(sound, many)
    with h5py.File(many, "a") as file:
        del file["data"].attrs["num_demos"], file["data/demo_1"]
        for number, (name, value) in enumerate(BAD_DEMONSTRATIONS, 1):
            file.copy("data/demo_0", f"data/demo_{number}")
            spoil(file[f"data/demo_{number}"].attrs, name, value)
    for number, (name, value) in enumerate(BAD_FILES):
        path = folder / f"one_{number:02}.hdf5"
        shutil.copy(sound, path)
        with h5py.File(path, "a") as file:
            del file["data"].attrs["num_demos"], file["data/demo_1"]
            spoil(file["data"].attrs, name, value)
    summary = convert(folder, tmp_path / "ds")
    named = {(problem.file, problem.group.removeprefix("data/")) for problem in summary.problems}
    assert {group for file, group in named if file == "many.hdf5"} == {
        f"demo_{n}" for n in range(1, len(BAD_DEMONSTRATIONS) + 1)
    }
    assert {file for file, _ in named} - {"many.hdf5"} == {f"one_{n:02}.hdf5" for n in range(len(BAD_FILES))}
    assert all("\n" not in problem.reason for problem in summary.problems)
    assert (summary.episodes, summary.exit_status) == (1, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ds", "folder"]
    manifest = json.loads((tmp_path / "ds" / "manifest.json").read_text())
    assert len(manifest["left_out"]) == len(named)
    assert f"Left out ({len(named)})" in (tmp_path / "ds" / "README.md").read_text()
    assert convert(folder, tmp_path / "ds") == summary, "reported again"


# --- archives ---


def packed(folder: Path, path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*.h*5")):
            archive.write(file, f"some folder/{file.name}")
        archive.writestr("README.md", "about it")
        archive.writestr("__MACOSX/temporal/._a_demo.hdf5", "a fork")
    return path


def test_archive_equals_its_folder(written, converted, tmp_path):
    news, counted = [], []
    source = packed(written, tmp_path / "a.zip")
    summary = convert(source, tmp_path / "ds", repo_id="local/test", notify=news.append, progress=counted.append)
    assert (summary.episodes, summary.problems, summary.exit_status) == (4, (), 0)
    for part in ("data", "videos", "states", "meta"):
        assert hashes(tmp_path / "ds" / part) == hashes(converted / part)
    largest = max(file.stat().st_size for file in written.rglob("*.hdf5"))
    assert f"unpacked one by one (up to {in_words(largest)})" in news[0]
    assert [line.split(":")[0] for line in news[1:]] == ["file 1 of 2", "file 2 of 2"]
    assert ([each.done for each in counted], counted[-1].total) == ([1, 2, 3, 4], 4)
    assert convert(source, tmp_path / "ds", repo_id="local/test") == summary


@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("holder", "name", "call", "unpacked_again"),
    [(os, "replace", "_demo.hdf5", 2), (os, "replace", "00002.json", 1), (VideoWriter, "add", 70, 1)],
    ids=["while unpacking", "after inspection", "in the second file"],
)
def test_killed_conversion_continues(written, tmp_path, monkeypatch, holder, name, call, unpacked_again):
    source, unpacked, inner = packed(written, tmp_path / "a.zip"), [], convert_module.unpack_member
    killed_at(holder, name, call, lambda: convert(source, tmp_path / "ds"))
    assert not is_dataset(tmp_path / "ds")
    with pytest.raises(MemobenchError, match="convention='upright'"):
        convert(source, tmp_path / "ds", convention="libero")
    monkeypatch.setattr(convert_module, "unpack_member", lambda *args: unpacked.append(args) or inner(*args))
    assert convert(source, tmp_path / "ds").episodes == 4
    assert len(unpacked) == unpacked_again, "finished files are not unpacked again"


def test_bad_archives(written, tmp_path, monkeypatch, capsys):
    """Names that lead elsewhere are refused, damage is named, and the sound files are converted."""
    source, work = tmp_path / "a.zip", tmp_path / "work"
    work.mkdir()
    sound = (written / f"{BUTTER}_demo.hdf5").read_bytes()
    names = ["../out.hdf5", "/tmp/out.hdf5", "a/../../out.hdf5", "C:\\out.hdf5", ".hidden/a.hdf5", "two\nlines.hdf5"]
    with zipfile.ZipFile(source, "w") as archive:
        archive.writestr("good/a.hdf5", sound)
        archive.writestr("cut.hdf5", b"PAYLOAD" * 8)
        for name in names:
            archive.writestr(name, "x" * 50)
    source.write_bytes(source.read_bytes().replace(b"PAYLOADPAYLOAD", b"PAYLOADPAYL0AD", 1))
    monkeypatch.chdir(work)
    assert command(source, tmp_path / "ds") == 1
    out = capsys.readouterr().out
    assert list(work.iterdir()) == []
    assert not (tmp_path / "out.hdf5").exists()
    for name in [*names, "cut.hdf5"]:
        (line,) = [line for line in out.splitlines() if line.startswith(f"left out: {name.replace(chr(10), '?')}: ")]
        assert ("cannot be unpacked" if name == "cut.hdf5" else "names no file") in line
    assert read_episode(tmp_path / "ds", 1).record.task_name == BUTTER
    (tmp_path / "cut.zip").write_bytes(source.read_bytes()[:-100])
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as archive:
        archive.writestr("README.md", "about an empty archive")
    for name, reason in (("cut", "download it again"), ("empty", "found no HDF5 file")):
        with pytest.raises(MemobenchError, match=reason):
            convert(tmp_path / f"{name}.zip", tmp_path / "ds2")
