"""Generation without a simulator: synthetic demonstrations replace the recorded ones."""

from __future__ import annotations

import errno
import json
import os
import pathlib
import shutil
from dataclasses import replace
from pkgutil import resolve_name
from types import SimpleNamespace

import pytest

from lerobot_memobench.datasets import generate as recording
from lerobot_memobench.datasets.episodes import list_episodes, read_info
from lerobot_memobench.datasets.generate import generate
from lerobot_memobench.datasets.layout import is_dataset
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from tests.support.kills import hashes as tree_hash
from tests.support.kills import killed_at

pytestmark = pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")

FAILING_SEED = 10_002


@pytest.fixture
def tasks(make_task):
    return [make_task("SU", name="task_a"), make_task("SU", name="task_b", memory_type="object")]


@pytest.fixture
def recorded(make_demo, monkeypatch):
    """Replace the recording; return the list of recorded (task, seed). Seed 10,002 of task_a fails."""
    calls: list[tuple[str, int]] = []
    truth = ["0" * 6 + "1" * 9, "0" * 13 + "1" * 2]

    def record(episode, seed, settings, show):
        calls.append((episode.task.name, seed))
        fails = episode.task.name == "task_a" and seed == FAILING_SEED
        size = settings.image_size if settings.images else None
        demo = make_demo(truth, task=episode.task, seed=seed, size=size, success=not fails)
        for frame in range(len(demo)) if settings.images else ():
            show({camera: images[frame] for camera, images in demo.images.items()})
        return replace(demo, referent=settings.referent, images=None)

    def episode(task, settings):
        progress = SimpleNamespace(index=1, steps=1200)
        state = {"prompt_shown": None, "referent": "fixed", "lost": False, "fault": None}
        return SimpleNamespace(task=task, progress=progress, settings=EnvSettings(), **state)

    monkeypatch.setattr(recording, "compiled_episode", episode)
    monkeypatch.setattr(recording, "record", record)
    return calls


def run(tasks, out, episodes=2, **more):
    return generate(tasks, episodes, out, **{"image_size": 32, **more})


def test_summary_dataset_and_failures(tasks, recorded, tmp_path):
    news = []
    summary = run(tasks, tmp_path / "ds", episodes=3, progress=news.append)
    assert [(each.task_name, each.frames) for each in summary.episodes] == [("task_a", 15)] * 3 + [("task_b", 15)] * 3
    assert [(a.done, a.total, a.task_name, a.seed) for a in news][1:3] == [
        (2, 6, "task_a", 10_001),
        (3, 6, "task_a", 10_002),
    ]
    ((task_name, seed, reason),) = [(f.task_name, f.seed, f.failure) for f in summary.failures]
    assert (task_name, seed) == ("task_a", FAILING_SEED)
    assert "1200 steps (1 of 2 checkpoints" in reason
    assert {"README.md", "data", "manifest.json", "meta", "states", "videos"} == {
        path.name for path in (tmp_path / "ds").iterdir()
    }
    card = (tmp_path / "ds" / "README.md").read_text()
    assert f"task_a, seed {FAILING_SEED}: {reason}" in card
    assert "2/3" in card
    manifest = json.loads((tmp_path / "ds" / "manifest.json").read_text())
    assert [row["episode_index"] for row in manifest["episodes"]] == [0, 1, None, 2, 3, 4]
    before = tree_hash(tmp_path / "ds")
    recorded.clear()
    assert run(tasks, tmp_path / "ds", episodes=3) == summary, "a finished run is reported again"
    with pytest.raises(MemobenchError, match="episodes=3, now 4"):
        run(tasks, tmp_path / "ds", episodes=4)
    (tmp_path / "ds" / "manifest.json").unlink()
    with pytest.raises(MemobenchError, match="did not make"):
        run(tasks, tmp_path / "ds", episodes=3)
    assert (recorded, tree_hash(tmp_path / "ds")) == ([], {k: v for k, v in before.items() if k != "manifest.json"})
    summary = run(tasks[:1], tmp_path / "none", episodes=1, seed_base=FAILING_SEED)
    assert (summary.folder, is_dataset(tmp_path / "none")) == (None, False)


def test_unfinished_run_is_continued_or_finished_early(tasks, recorded, tmp_path, monkeypatch):
    reference = tree_hash_of_run(tasks, tmp_path / "undisturbed")
    inner = recording.record

    def broken(episode, seed, settings, show):
        if (episode.task.name, seed) == ("task_b", 10_000):
            raise RuntimeError("power cut")
        return inner(episode, seed, settings, show)

    monkeypatch.setattr(recording, "record", broken)
    with pytest.raises(RuntimeError, match="power cut") as caught:
        run(tasks, tmp_path / "ds")
    assert "while recording task_b, seed 10000" in caught.value.__notes__
    assert not is_dataset(tmp_path / "ds")
    monkeypatch.setattr(recording, "record", inner)
    recorded.clear()
    early = tmp_path / "early"
    shutil.copytree(tmp_path / "ds", early)
    run(tasks, tmp_path / "ds")
    assert recorded == [("task_b", 10_000), ("task_b", 10_001)]
    assert tree_hash(tmp_path / "ds") == reference

    recorded.clear()
    summary = run(tasks, early, finish=True)
    assert recorded == []
    assert [(each.task_name, each.failure) for each in summary.episodes] == [("task_a", None)] * 2
    assert summary.tasks == ("task_a", "task_b")
    assert len(list_episodes(early)) == 2
    assert "2 of 4 seeds were run" in (early / "README.md").read_text()
    assert not (early / ".staging").exists()
    with pytest.raises(MemobenchError, match="finished_early=True"):
        run(tasks, early)
    for folder in (early, tmp_path / "none"):
        with pytest.raises(MemobenchError, match="no unfinished run"):
            run(tasks, folder, finish=True)
    assert not (tmp_path / "none").exists()


def tree_hash_of_run(tasks, out):
    run(tasks, out)
    return tree_hash(out)


def test_convention_of_the_images(tasks, recorded, tmp_path):
    folder = run(tasks[:1], tmp_path / "ds", 1, convention="libero").folder
    names = [name for name in read_info(folder)["features"] if "images" in name]
    assert names == ["observation.images.image", "observation.images.image2"]
    with pytest.raises(MemobenchError, match="with convention='libero', now 'upright'"):
        run(tasks[:1], tmp_path / "ds", 1)


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ({"episodes": 0}, "at least 1"),
        ({"seed_base": 7}, "split"),
        ({"convention": "liber"}, "did you mean 'libero'"),
        ({"tasks": []}, "0 tasks"),
        ({"tasks": "twice"}, "named twice"),
    ],
)
def test_invalid_requests(tasks, recorded, tmp_path, asked, named):
    given = asked.pop("tasks", tasks)
    with pytest.raises(MemobenchError, match=named):
        run(tasks[:1] * 2 if given == "twice" else given, tmp_path / "ds", **asked)
    assert not (tmp_path / "ds").exists()


# --- disks ---

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
IN_C = RuntimeError("Can't write data (file write failed: errno = 28, error message = 'No space left on device')")
"""As libraries in C report it."""


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("lerobot_memobench.datasets.stage.np.savez_compressed", FULL),
        ("lerobot_memobench.datasets.write.ParquetFiles.write", IN_C),
    ],
)
def test_full_disk_keeps_finished_episodes(tasks, recorded, tmp_path, monkeypatch, place, error):
    """The disk is full at the third episode, or in the assembly; the same command continues."""
    reference = tree_hash_of_run(tasks, tmp_path / "undisturbed")
    calls = []

    def full(*args, **kwargs):
        calls.append(place)
        if len(calls) > 2 or "ParquetFiles" in place:
            raise error
        return inner(*args, **kwargs)

    module, name = place.rsplit(".", 1)
    holder = resolve_name(module)
    inner = getattr(holder, name)
    recorded.clear()
    with monkeypatch.context() as patch:
        patch.setattr(holder, name, full)
        with pytest.raises(MemobenchError, match=r"ds cannot be written .*finished episodes stay"):
            run(tasks, tmp_path / "ds")
    assert not is_dataset(tmp_path / "ds")
    staged = sorted(path.name for path in (tmp_path / "ds" / ".staging" / "episodes").iterdir())
    assert staged == [f"{number:06d}" for number in range(len(staged))], "complete episodes only"
    assert len(staged) >= 2
    made = len(recorded)
    run(tasks, tmp_path / "ds")
    assert len(recorded) - made == 4 - len(staged)
    assert tree_hash(tmp_path / "ds") == reference


@pytest.mark.parametrize(
    ("holder", "name", "call"),
    [
        (pathlib.Path, "rename", 2),
        (os, "replace", "manifest.json"),
        *(pytest.param(os, "fsync", call, marks=pytest.mark.slow) for call in (1, 13, 25)),
    ],
)
def test_killed_runs_continue(tasks, recorded, tmp_path, holder, name, call):
    reference = tree_hash_of_run(tasks, tmp_path / "undisturbed")
    killed_at(holder, name, call, lambda: run(tasks, tmp_path / "ds"))
    assert not is_dataset(tmp_path / "ds")
    run(tasks, tmp_path / "ds")
    assert tree_hash(tmp_path / "ds") == reference


def test_second_run_in_one_folder_is_refused(tasks, recorded, tmp_path):
    with pytest.raises(MemobenchError, match="another run is writing"):
        run(tasks, tmp_path / "ds", progress=lambda _: run(tasks, tmp_path / "ds"))


def test_disk_space_is_checked_before_the_first_episode(tasks, recorded, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match="Not a directory"):
        run(tasks, tmp_path / "file" / "ds")
    assert recorded == []
    reports = []
    run(tasks, tmp_path / "ds", notify=lambda text: reports.append((len(recorded), text)))
    ((before, text),) = reports
    assert before == 0
    assert text.startswith("4 demonstrations of about 1,420 frames")
    assert "MAY NOT" not in text
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_500_000))
    run(tasks, tmp_path / "near", notify=lambda text: reports.append((len(recorded), text)))
    assert "MAY NOT BE ENOUGH" in reports[1][1]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=500_000))
    made = len(recorded)
    with pytest.raises(MemobenchError, match="make room"):
        run(tasks, tmp_path / "far")
    assert len(recorded) == made
