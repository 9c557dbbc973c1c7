"""Generation without a simulator: recording is replaced by synthetic demonstrations."""

from __future__ import annotations

import errno
import json
import os
import pathlib
import shutil
import signal
from dataclasses import replace
from pkgutil import resolve_name
from types import SimpleNamespace

import pytest

from lerobot_memobench.datasets import generation, recording
from lerobot_memobench.datasets.generation import generate, slurm_of
from lerobot_memobench.datasets.lerobot_format.layout import episode_count, is_dataset
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.slurm import run_part
from lerobot_memobench.tasks.catalogue import DEMO_TASK, get_task
from tests.support.kills import hashes as tree_hash
from tests.support.sbatch import Sbatch

pytestmark = pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")

FAILING_SEED = 10_002


@pytest.fixture
def tasks(make_task):
    return [make_task("SU", name="task_a"), make_task("SU", name="task_b", memory_type="object")]


@pytest.fixture
def recorded(make_demo, monkeypatch):
    """Replace the recording; the list of (task, seed) recorded so far. Seed 10,002 of task_a fails."""
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


def test_summary_and_dataset(tasks, recorded, tmp_path):
    from lerobot.datasets import LeRobotDataset

    heard = []
    summary = run(tasks, tmp_path / "ds", progress=heard.append)
    assert summary.exit_status == 0
    assert [(t.name, t.episodes, t.solved, t.frames) for t in summary.tasks] == [
        ("task_a", 2, 2, (15, 15)),
        ("task_b", 2, 2, (15, 15)),
    ]
    assert [(a.done, a.total, a.task_name, a.seed) for a in heard] == [
        (1, 4, "task_a", 10_000),
        (2, 4, "task_a", 10_001),
        (3, 4, "task_b", 10_000),
        (4, 4, "task_b", 10_001),
    ]
    dataset = LeRobotDataset("local/test", root=tmp_path / "ds")
    assert dataset.num_episodes == 4
    assert sorted(path.name for path in (tmp_path / "ds").iterdir()) == [
        "README.md",
        "data",
        "manifest.json",
        "meta",
        "states",
        "videos",
    ]


def test_failures_are_reported_everywhere(tasks, recorded, tmp_path):
    summary = run(tasks, tmp_path / "ds", episodes=3)
    assert summary.exit_status == 1
    assert [(f.task_name, f.seed) for f in summary.failures] == [("task_a", FAILING_SEED)]
    assert "goal not reached in 1200 steps (1 of 2 checkpoints" in summary.failures[0].reason
    assert (summary.tasks[0].solved, summary.tasks[0].episodes) == (2, 3)
    card = (tmp_path / "ds" / "README.md").read_text()
    assert f"task_a, seed {FAILING_SEED}: goal not reached" in card
    assert "2/3" in card
    manifest = json.loads((tmp_path / "ds" / "manifest.json").read_text())
    assert [row["episode_index"] for row in manifest["episodes"]] == [0, 1, None, 2, 3, 4]
    summary = run(tasks[:1], tmp_path / "nothing", episodes=1, seed_base=FAILING_SEED)
    assert (summary.folder, summary.exit_status, is_dataset(tmp_path / "nothing")) == (None, 1, False)


def test_finished_run_is_only_reported(tasks, recorded, tmp_path):
    first = run(tasks, tmp_path / "ds")
    before = tree_hash(tmp_path / "ds")
    recorded.clear()
    assert run(tasks, tmp_path / "ds") == first
    assert recorded == []
    with pytest.raises(MemobenchError, match="finished dataset with episodes=2, now 3"):
        run(tasks, tmp_path / "ds", episodes=3)
    assert tree_hash(tmp_path / "ds") == before


def test_an_unfinished_run_goes_on_or_is_finished_early(tasks, recorded, tmp_path, monkeypatch):
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
    assert [(task.name, task.solved, task.episodes) for task in summary.tasks] == [("task_a", 2, 2), ("task_b", 0, 0)]
    assert episode_count(early) == 2
    assert "2 of 4 seeds were run" in (early / "README.md").read_text()
    assert not (early / ".staging").exists()
    with pytest.raises(MemobenchError, match="finished_early=True"):
        run(tasks, early)
    for folder in (early, tmp_path / "nothing"):
        with pytest.raises(MemobenchError, match="no unfinished run"):
            run(tasks, folder, finish=True)
    assert not (tmp_path / "nothing").exists()


def tree_hash_of_run(tasks, out):
    run(tasks, out)
    return tree_hash(out)


def test_an_unfinished_run_of_another_request_is_not_mixed_in(tasks, recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "assemble", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(tasks, tmp_path / "ds")
    monkeypatch.undo()
    with pytest.raises(MemobenchError, match="unfinished run with images=True, now False") as told:
        run(tasks, tmp_path / "ds", images=False)
    assert f"delete {tmp_path / 'ds' / '.staging'} to start again or name another folder" in str(told.value)
    edited = [replace(tasks[0], bddl_text="another goal"), tasks[1]]
    with pytest.raises(MemobenchError, match="unfinished run with task_files"):
        run(edited, tmp_path / "ds")


def test_two_runs_at_once(tasks, recorded, tmp_path):
    with pytest.raises(MemobenchError, match="another run is writing"):
        run(tasks, tmp_path / "ds", progress=lambda _: run(tasks, tmp_path / "ds"))


def test_tasks_with_a_prompt_have_a_number_of_their_own(tasks, recorded, tmp_path):
    shown = replace(tasks[1], prompt=get_task(DEMO_TASK).prompt)
    summary = run([tasks[0], shown], tmp_path / "ds", episodes=1, prompted_episodes=3, images=False)
    assert [(task.name, task.episodes) for task in summary.tasks] == [("task_a", 1), ("task_b", 3)]
    assert recorded == [("task_a", 10_000), *(("task_b", 10_000 + i) for i in range(3))]
    assert "1 seeds per task (3 of those with a prompt)" in (tmp_path / "ds" / "README.md").read_text()
    with pytest.raises(MemobenchError, match="prompted_episodes=3, now None was asked for"):
        run([tasks[0], shown], tmp_path / "ds", episodes=1, images=False)


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ({"episodes": 0}, "at least 1"),
        ({"prompted_episodes": 0}, "at least 1"),
        ({"workers": 0}, "at least 1"),
        ({"seed_base": 7}, "split"),
        ({"tasks": []}, "0 tasks"),
        ({"tasks": "twice"}, "named twice"),
        ({"tasks": "two worlds"}, "two worlds"),
    ],
)
def test_what_cannot_be_asked_for(tasks, recorded, tmp_path, asked, named):
    chosen = {"twice": tasks[:1] * 2, "two worlds": [tasks[0], tasks[1].in_world("libero")]}
    given = asked.pop("tasks", tasks)
    with pytest.raises(MemobenchError, match=named):
        run(chosen.get(given, given) if isinstance(given, str) else given, tmp_path / "ds", **asked)
    assert not (tmp_path / "ds").exists()


# --- disks ---

KEPT = r"ds cannot be written \(.*are free there\): make room, or name another folder; finished episodes stay"
FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
IN_C = RuntimeError("Can't write data (file write failed: errno = 28, error message = 'No space left on device')")
"""As HDF5 tells of it, in an error of its own."""


@pytest.mark.parametrize(
    ("place", "error"),
    [
        ("lerobot_memobench.datasets.staging.np.savez_compressed", FULL),
        ("lerobot_memobench.datasets.video.VideoWriter.close", IN_C),
        ("lerobot_memobench.datasets.staging.flush_to_disk", FULL),
        ("lerobot_memobench.datasets.lerobot_format.assembling.ParquetFiles.write", IN_C),
        ("lerobot_memobench.datasets.lerobot_format.assembling.write_card", FULL),
    ],
)
def test_a_full_disk_is_one_sentence_and_loses_nothing(tasks, recorded, tmp_path, monkeypatch, place, error):
    """It fills up at the third episode, or when the dataset is made of them; with room the same command goes on."""
    reference = tree_hash_of_run(tasks, tmp_path / "undisturbed")
    calls = []

    def full(*args, **kwargs):
        calls.append(place)
        if len(calls) > (2 if "savez" in place else 4) or "lerobot_format" in place:
            raise error
        return inner(*args, **kwargs)

    module, name = place.rsplit(".", 1)
    holder = resolve_name(module)
    inner = getattr(holder, name)
    recorded.clear()
    with monkeypatch.context() as patch:
        patch.setattr(holder, name, full)
        with pytest.raises(MemobenchError, match=KEPT) as told:
            run(tasks, tmp_path / "ds")
    assert "\n" not in str(told.value)
    assert not is_dataset(tmp_path / "ds")
    staged = sorted(path.name for path in (tmp_path / "ds" / ".staging" / "episodes").iterdir())
    assert staged == [f"{number:06d}" for number in range(len(staged))], "and nothing half-made"
    assert len(staged) >= 2
    made = len(recorded)
    run(tasks, tmp_path / "ds")
    assert len(recorded) - made == 4 - len(staged)
    assert tree_hash(tmp_path / "ds") == reference


def test_a_folder_that_cannot_be(tasks, recorded, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match=r"ds cannot be written \(Not a directory"):
        run(tasks, tmp_path / "file" / "ds")
    assert recorded == []


def test_a_disk_without_room_is_refused_before_the_first_episode(tasks, recorded, tmp_path, monkeypatch):
    reports = []
    run(tasks, tmp_path / "ds", tell=lambda text: reports.append((len(recorded), text)))
    ((before, text),) = reports
    assert before == 0
    assert text.startswith("4 demonstrations of some 1,420 frames")
    assert "MAY NOT" not in text
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_500_000))
    run(tasks, tmp_path / "near", tell=lambda text: reports.append((len(recorded), text)))
    assert "MAY NOT BE ENOUGH" in reports[1][1]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=500_000))
    made = len(recorded)
    with pytest.raises(MemobenchError, match="make room"):
        run(tasks, tmp_path / "far")
    assert len(recorded) == made


# --- damage ---


@pytest.mark.parametrize(
    "pattern",
    ["data/**/*.parquet", "meta/episodes/**/*.parquet", "states/**/*.parquet", "videos/*wrist_image/**/*.mp4"],
)
@pytest.mark.parametrize("how", ["cut", "gone"])
def test_a_damaged_dataset_is_not_called_finished(tasks, recorded, tmp_path, pattern, how):
    run(tasks, tmp_path / "ds")
    (path,) = (tmp_path / "ds").glob(pattern)
    content = path.read_bytes()
    path.unlink()
    if how == "cut":
        path.write_bytes(content[:-100])
    with pytest.raises(MemobenchError, match=path.name if how == "cut" else "rows|cannot be read"):
        run(tasks, tmp_path / "ds")


def test_slurm_makes_the_same(tasks, recorded, tmp_path, monkeypatch):
    """With a stand-in for sbatch: nothing is made where the command is given; the jobs make the whole dataset."""
    sbatch, out = Sbatch(tmp_path / "bin", monkeypatch), tmp_path / "ds"
    slurm = slurm_of(out, ("--partition=cpu",))
    summary = run(tasks, out, slurm=slurm, workers=3)
    assert (summary.submitted, summary.folder, recorded) == (True, None, [])
    make, _ = sbatch.calls
    assert {"--array=0-2%3", "--mem=4G", "--partition=cpu"} <= set(make)
    for member in range(3):
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(member))
        run_part("make", slurm.logs)
    run_part("finish", slurm.logs)
    assert len(recorded) == 4
    assert tree_hash(out) == tree_hash_of_run(tasks, tmp_path / "here")


def kill_at(call: int, work) -> bool:
    """Do ``work`` in a child that ends, as by kill -9, before the ``call``-th change to the disk; whether it did.

    A child that hangs, which a fork of a process with threads may, is killed too: that is a kill like any other.
    """
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) in (9, -signal.SIGALRM)
    signal.alarm(60)
    count = 0

    def fatal(inner):
        def outer(*args, **kwargs):
            nonlocal count
            count += 1
            if count == call:
                os._exit(9)
            return inner(*args, **kwargs)

        return outer

    try:
        for module, name in [
            (os, "replace"),
            (os, "fsync"),
            (pathlib.Path, "rename"),
            (pathlib.Path, "replace"),
            (pathlib.Path, "mkdir"),
            (pathlib.Path, "write_text"),
            (shutil, "rmtree"),
        ]:
            setattr(module, name, fatal(getattr(module, name)))
        work()
        os._exit(0)
    except BaseException:
        os._exit(1)


@pytest.mark.parametrize("every", [23, pytest.param(2, marks=pytest.mark.slow)])
def test_killed_at_every_change_to_the_disk(tasks, recorded, tmp_path, every):
    """Kill at every n-th change, resume, compare with an undisturbed run, byte for byte."""
    out = tmp_path / "ds"
    reference = tree_hash_of_run(tasks, tmp_path / "undisturbed")
    killed = unfinished = 0
    for call in range(1, 400, every):
        shutil.rmtree(out, ignore_errors=True)
        if not kill_at(call, lambda: run(tasks, out)):
            break
        killed += 1
        unfinished += not is_dataset(out)
        # Once more, at another place, then to the end.
        kill_at(call + 2, lambda: run(tasks, out))
        if is_dataset(out):
            assert {k: v for k, v in tree_hash(out).items() if not k.startswith(".staging")} == reference
        run(tasks, out)
        assert tree_hash(out) == reference, f"killed at change {call}"
    assert killed > 3
    assert unfinished > 3


def test_a_world_without_its_files_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("MEMOBENCH_LIBERO_ASSETS", str(tmp_path / "nothing"))
    task = get_task("check_the_top_drawer_of_the_cabinet").in_world("libero")
    with pytest.raises(MemobenchError, match=r"MEMOBENCH_LIBERO_ASSETS is .* which is no folder"):
        generate([task], 1, tmp_path / "out")
    assert not (tmp_path / "out").exists()
