"""Generation without a simulator: recording is replaced by synthetic demonstrations."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import pathlib
import re
import resource
import shutil
import signal
import subprocess
import sys
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from types import SimpleNamespace

import dill
import pytest

from lerobot_memobench.datasets import generation, recording
from lerobot_memobench.datasets.generation import generate
from lerobot_memobench.datasets.lerobot_format.layout import episode_count, is_dataset
from lerobot_memobench.datasets.video import VideoWriter
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs import processes
from lerobot_memobench.tasks.catalogue import BOWL, get_task
from tests.support.kills import hashes as tree_hash
from tests.support.kills import killed_at

pytestmark = pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")

FAILING_SEED = 10_002
needs_datatrove = pytest.mark.skipif(find_spec("datatrove") is None, reason="datatrove is not installed")


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
        told = {"prompt_shown": None, "horizon": 1200, "referent": "fixed", "lost": False, "fault": None}
        return SimpleNamespace(task=task, progress=progress, **told)

    monkeypatch.setattr(recording, "compiled_episode", episode)
    monkeypatch.setattr(recording, "record", record)
    monkeypatch.setattr(recording, "model_file", lambda task, poses: "<mujoco/>")
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


@pytest.mark.parametrize("demonstration_prompt", [True, False])
def test_the_card_says_whether_prompts_are_in_it(tasks, recorded, tmp_path, demonstration_prompt):
    run(tasks, tmp_path / "ds", demonstration_prompt=demonstration_prompt)
    card = (tmp_path / "ds" / "README.md").read_text()
    assert ("referent fixed, demonstration prompts left out." in card) == (not demonstration_prompt)


def test_nothing_but_failures_makes_no_dataset(tasks, recorded, tmp_path):
    summary = run(tasks[:1], tmp_path / "ds", episodes=1, seed_base=FAILING_SEED)
    assert summary.folder is None
    assert summary.exit_status == 1
    assert not is_dataset(tmp_path / "ds")


def test_finished_run_is_only_reported(tasks, recorded, tmp_path):
    first = run(tasks, tmp_path / "ds")
    before = tree_hash(tmp_path / "ds")
    recorded.clear()
    assert run(tasks, tmp_path / "ds") == first
    assert recorded == []
    with pytest.raises(MemobenchError, match="finished dataset with episodes=2, now 3"):
        run(tasks, tmp_path / "ds", episodes=3)
    assert tree_hash(tmp_path / "ds") == before


@pytest.mark.parametrize("frames", [None, "absent", "5"])
def test_a_manifest_that_does_not_say_how_long_an_episode_is(tasks, recorded, tmp_path, frames):
    run(tasks, tmp_path / "ds")
    file = tmp_path / "ds" / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["episodes"][0]["frames"] = frames
    if frames == "absent":
        del manifest["episodes"][0]["frames"]
    file.write_text(json.dumps(manifest))
    with pytest.raises(MemobenchError, match=r"found (no frames in )?episodes\[0\].*take the dataset from its source"):
        run(tasks, tmp_path / "ds")


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
    assert f"delete {tmp_path / 'ds' / '.staging'} to start anew or name another folder" in str(told.value)
    edited = [replace(tasks[0], bddl_text="another goal"), tasks[1]]
    with pytest.raises(MemobenchError, match="unfinished run with task_files"):
        run(edited, tmp_path / "ds")


def test_two_runs_at_once(tasks, recorded, tmp_path):
    with pytest.raises(MemobenchError, match="another run is writing"):
        run(tasks, tmp_path / "ds", progress=lambda _: run(tasks, tmp_path / "ds"))


def test_a_worker_that_is_killed(tasks, recorded, tmp_path, monkeypatch):
    def submit(_self, _function):
        future = Future()
        future.set_exception(BrokenProcessPool("gone"))
        return future

    monkeypatch.setattr(processes.ProcessPoolExecutor, "submit", submit)
    with pytest.raises(MemobenchError, match="one of 2 worker processes was killed"):
        run(tasks, tmp_path / "ds", workers=2)
    monkeypatch.undo()


def test_tasks_with_a_prompt_have_a_number_of_their_own(tasks, recorded, tmp_path):
    shown = replace(tasks[1], prompt=get_task(BOWL).prompt)
    summary = run([tasks[0], shown], tmp_path / "ds", episodes=1, prompted_episodes=3, images=False)
    assert [(task.name, task.episodes) for task in summary.tasks] == [("task_a", 1), ("task_b", 3)]
    assert recorded == [("task_a", 10_000), *(("task_b", 10_000 + i) for i in range(3))]
    assert "1 seeds per task (3 of those with a prompt)" in (tmp_path / "ds" / "README.md").read_text()
    with pytest.raises(MemobenchError, match="prompted_episodes=3, now None was asked for"):
        run([tasks[0], shown], tmp_path / "ds", episodes=1, images=False)


@pytest.mark.parametrize("where", ["mine", "mine/checkpoints/000100/pretrained_model", "mine/pretrained_model"])
def test_a_learner_is_named_by_its_run(tmp_path, where):
    (tmp_path / where).mkdir(parents=True)
    (tmp_path / where / "model.safetensors").write_bytes(b"weights")
    name, _, digest = generation.policy_text(str(tmp_path / where)).partition(" ")
    assert name == "mine"
    assert digest == hashlib.sha256(b"weights").hexdigest()[:16]


@pytest.mark.parametrize("arguments", [{"episodes": 0}, {"prompted_episodes": 0}, {"workers": 0}])
def test_nothing_to_do(tasks, recorded, tmp_path, arguments):
    with pytest.raises(MemobenchError, match="each must be at least 1"):
        run(tasks, tmp_path / "ds", **arguments)
    assert not (tmp_path / "ds").exists()


def test_no_task_or_the_same_twice(tasks, recorded, tmp_path):
    with pytest.raises(MemobenchError, match="0 tasks"):
        run([], tmp_path / "ds")
    with pytest.raises(MemobenchError, match="named twice"):
        run([tasks[0], tasks[0]], tmp_path / "ds")


def test_both_formats(tasks, recorded, tmp_path):
    import h5py

    run(tasks, tmp_path / "plain", episodes=3)
    run(tasks, tmp_path / "both", episodes=3, formats={"hdf5", "lerobot"})
    plain, both = tree_hash(tmp_path / "plain"), tree_hash(tmp_path / "both")
    files = {f"hdf5/{name}_demo.hdf5" for name in ("task_a", "task_b")}
    assert set(both) == set(plain) | files
    assert {name for name in plain if plain[name] != both[name]} == {"manifest.json"}  # it says what was asked for
    with h5py.File(tmp_path / "both" / "hdf5" / "task_a_demo.hdf5") as file:
        assert [file[f"data/demo_{k}"].attrs["seed"] for k in range(2)] == [10_000, 10_001]
        assert file["data"].attrs["num_demos"] == 2
        assert file["data"].attrs["total"] == 30

    recorded.clear()
    run(tasks, tmp_path / "hdf5", episodes=3, formats=["hdf5"])
    assert len(recorded) == 6
    alone = tree_hash(tmp_path / "hdf5")
    assert set(alone) == files | {"manifest.json"}
    assert all(alone[name] == both[name] for name in files)
    recorded.clear()
    assert run(tasks, tmp_path / "hdf5", episodes=3, formats=["hdf5"]).exit_status == 1  # reported, not made again
    assert recorded == []
    with pytest.raises(MemobenchError, match="finished dataset with formats"):
        run(tasks, tmp_path / "hdf5", episodes=3)


def test_hdf5_killed_at_every_change_to_the_disk(tasks, recorded, tmp_path):
    out, formats = tmp_path / "ds", ("hdf5",)
    run(tasks, tmp_path / "undisturbed", formats=formats)
    reference = tree_hash(tmp_path / "undisturbed")
    killed = 0
    for call in range(1, 400, 13):
        shutil.rmtree(out, ignore_errors=True)
        if not kill_at(call, lambda: run(tasks, out, formats=formats)):
            break
        killed += 1
        run(tasks, out, formats=formats)
        assert {k: v for k, v in tree_hash(out).items() if not k.startswith(".staging")} == reference, call
    assert killed > 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"formats": ["parquet"]}, "found format 'parquet', known are 'hdf5', 'lerobot'"),
        ({"formats": []}, "no format was asked for"),
        ({"formats": ["hdf5"], "images": False}, "'hdf5' was asked for without images"),
        ({"executor": "condor"}, "found executor 'condor', known are"),
        ({"executor": "processes", "executor_options": {"partition": "cpu"}}, "takes none"),
        (
            {"executor": "local", "executor_options": {"tasks": 4}},
            "found option 'tasks' for executor 'local', did you mean 'local_tasks'",
        ),
        ({"executor": "slurm"}, "executor 'slurm' needs (partition and time|datatrove)"),
    ],
)
def test_what_cannot_be_asked_for(tasks, recorded, tmp_path, arguments, message):
    with pytest.raises(MemobenchError, match=message):
        run(tasks, tmp_path / "ds", **arguments)
    assert not (tmp_path / "ds").exists()


def test_hdf5_is_of_this_packages_own_world(tasks, recorded, tmp_path):
    with pytest.raises(MemobenchError, match=r"'hdf5' was asked for with world=libero"):
        run([task.in_world("libero") for task in tasks], tmp_path / "ds", formats=["hdf5"])


@needs_datatrove
def test_datatroves_local_executor_makes_the_same(tasks, recorded, tmp_path):
    heard = []
    run(tasks, tmp_path / "here", episodes=3)
    run(tasks, tmp_path / "there", episodes=3, executor="local", progress=heard.append)
    assert tree_hash(tmp_path / "here") == tree_hash(tmp_path / "there")
    assert len(heard) == heard[-1].done == heard[-1].total == 6


@needs_datatrove
def test_ray_is_asked_for_without_being_there(tasks, recorded, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MemobenchError, match="executor 'ray' needs ray, which is not installed"):
        run(tasks, tmp_path / "ds", executor="ray")


# --- disks ---

KEPT = r"ds cannot be written \(.*are free there\): make room, or name another folder; what is finished stays"
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


def test_a_file_that_may_grow_no_further(tasks, recorded, tmp_path):
    """The system's own refusal (EFBIG), in the middle of a write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(MemobenchError, match=r"ds cannot be written \(File too large"):
            run(tasks, tmp_path / "ds")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list((tmp_path / "ds" / ".staging" / "episodes").iterdir()) == []
    assert run(tasks, tmp_path / "ds").exit_status == 0


@pytest.fixture
def disk(tmp_path):
    """A disk of its own, of half a MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("nothing may be mounted here")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_real_disk_that_fills_up_and_one_that_is_closed(tasks, recorded, disk, monkeypatch):
    monkeypatch.setattr(generation, "FRAMES", {"published": {}})
    monkeypatch.setattr(generation, "check_room", lambda *_: None)  # it would be refused before
    with pytest.raises(MemobenchError, match=r"ds cannot be written \(No space left on device; .* are free there"):
        run(tasks, disk / "ds", episodes=40, image_size=64)
    assert not is_dataset(disk / "ds")
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    with pytest.raises(MemobenchError, match=r"ds cannot be written \(Read-only file system"):
        run(tasks, disk / "ds", episodes=40, image_size=64)
    subprocess.run(["mount", "-o", "remount,rw,size=64m", disk], check=True)
    made = len(recorded)
    run(tasks, disk / "ds", episodes=40, image_size=64)
    assert 0 < len(recorded) - made < 80, "what was finished is not made again"


def test_a_folder_that_cannot_be(tasks, recorded, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MemobenchError, match=r"ds cannot be written \(Not a directory"):
        run(tasks, tmp_path / "file" / "ds")
    assert recorded == []


def test_size_and_time_are_told_before_the_first_episode(tasks, recorded, tmp_path, monkeypatch):
    told = []
    run(tasks, tmp_path / "ds", tell=lambda said: told.append((len(recorded), said)))
    ((before, said),) = told
    assert before == 0
    assert said.startswith("4 demonstrations of some 1,420 frames, in about 1 min with 1 at a time: about 1.2 MiB in ")
    assert "2.4 MiB until it is finished" in said
    assert "MAY NOT" not in said
    run(tasks, tmp_path / "ds", tell=lambda said: told.append((len(recorded), said)))
    assert len(told) == 1, "a finished one is only reported"
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_500_000))
    run(tasks, tmp_path / "near", tell=lambda said: told.append((len(recorded), said)))
    assert "1.4 MiB are free there; THAT MAY NOT BE ENOUGH" in told[1][1]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=500_000))
    made = len(recorded)
    with pytest.raises(MemobenchError, match=r"would take about 1\.2 MiB in .*488\.3 KiB are free there: make room"):
        run(tasks, tmp_path / "far")
    assert len(recorded) == made


def test_the_estimates_are_those_of_the_full_runs():
    """docs/research/full_run, with_images and strict_run: the tables of the runs themselves."""
    docs = Path(__file__).parents[2] / "docs" / "research"
    for suite, run_of in (("published", "full_run"), ("strict", "strict_run")):
        text = (docs / run_of / "tables.md").read_text()
        for kind, frames in generation.FRAMES[suite].items():
            mean = float(re.search(rf"\| {kind} \| here \| \d+ \| \d+ \| [\d,]+ \| ([\d.]+)", text)[1])
            assert frames == pytest.approx(mean, rel=0.02)
        each = int(re.search(r"([\d,]+) bytes per frame", text)[1].replace(",", ""))
        assert generation.run_size(1, ("lerobot",), None) == pytest.approx(each, rel=0.05)
    each = re.search(r"([\d,]+) bytes per frame", (docs / "with_images" / "tables.md").read_text())[1]
    assert generation.run_size(1, ("lerobot",), 256) == pytest.approx(int(each.replace(",", "")), rel=0.05)


# --- damage ---


@pytest.fixture(scope="module")
def finished_once(tmp_path_factory):
    return tmp_path_factory.mktemp("finished") / "ds"


@pytest.fixture
def finished(tasks, recorded, finished_once):
    """A finished dataset in both formats, made once; tests damage copies."""
    if not finished_once.exists():
        run(tasks, finished_once, formats=("lerobot", "hdf5"))
    return finished_once


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("data/**/*.parquet", r"data/chunk-000/file-000\.parquet cannot be read"),
        ("meta/episodes/**/*.parquet", r"meta/episodes/chunk-000/file-000\.parquet cannot be read"),
        ("states/**/*.parquet", r"states/chunk-000/file-000\.parquet cannot be read"),
        ("videos/*wrist_image/**/*.mp4", r"wrist_image/chunk-000/file-000\.mp4 is cut off or damaged at byte"),
        ("hdf5/task_b*", r"task_b_demo\.hdf5: it is no HDF5 file, or was cut off"),
    ],
)
@pytest.mark.parametrize("how", ["cut", "gone"])
def test_a_damaged_dataset_is_not_called_finished(tasks, recorded, finished, tmp_path, pattern, said, how):
    out = Path(shutil.copytree(finished, tmp_path / "ds"))
    (path,) = out.glob(pattern)
    if how == "gone":
        path.unlink()
        said = "tells of|cannot be read|there is no such file"
    else:
        path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(MemobenchError, match=said):
        run(tasks, out, formats=("lerobot", "hdf5"))


SBATCH = """#!/bin/sh
echo "$@" >> "$SBATCH_LOG"
for word in "$@"; do script="$word"; done
cat "$script" >> "$SBATCH_LOG"
echo "Submitted batch job 4711"
"""


@needs_datatrove
def test_slurm_gets_a_script_and_a_last_job(tasks, recorded, tmp_path, monkeypatch):
    """With a stand-in for sbatch: what it is given, and what the jobs then do when they run."""
    log, tools = tmp_path / "sbatch.log", tmp_path / "bin"
    tools.mkdir()
    (tools / "sbatch").write_text(SBATCH)
    (tools / "scontrol").write_text("#!/bin/sh\necho node1\n")
    for tool in tools.iterdir():
        tool.chmod(0o755)
    monkeypatch.setenv("SLURM_NODELIST", "node1")
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("SBATCH_LOG", str(log))
    out = tmp_path / "ds"
    options = {"partition": "cpu", "time": "04:00:00", "mem_per_cpu_gb": 4, "env_command": ". /opt/venv/bin/activate"}
    asked = {"executor": "slurm", "executor_options": options, "workers": 3}
    summary = run(tasks, out, **asked)
    assert (summary.submitted, summary.folder, recorded) == (True, None, [])
    script = log.read_text()
    for line in (
        "#SBATCH --partition=cpu",
        "#SBATCH --time=04:00:00",
        "#SBATCH --mem-per-cpu=4G",
        "#SBATCH --array=0-2%3",
        ". /opt/venv/bin/activate",
        f"launch_pickled_pipeline {out}_slurm/make/executor.pik",
        f"launch_pickled_pipeline {out}_slurm/finish/executor.pik",
        "--dependency=afterany:4711",
    ):
        assert line in script, line

    # What the array's tasks and the last job do on their machines.
    for part, ranks in (("make", range(3)), ("finish", range(1))):
        for rank in ranks:
            monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(rank))
            with open(tmp_path / "ds_slurm" / part / "executor.pik", "rb") as file:
                dill.load(file).run()  # noqa: S301 - datatrove wrote it, in this test
    assert len(recorded) == 4
    run(tasks, tmp_path / "here")
    assert tree_hash(out) == tree_hash(tmp_path / "here")


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


@pytest.mark.parametrize(
    ("holder", "name", "call", "after"),
    [
        (os, "replace", "ds/meta", False),
        (os, "replace", "ds/meta", True),
        (VideoWriter, "add", 41, False),
        (VideoWriter, "close", 3, True),
    ],
    ids=["before the last move", "after the last move", "while pictures are encoded", "when a video is written"],
)
def test_killed_in_assembly_and_in_encoding(tasks, recorded, tmp_path, holder, name, call, after):
    run(tasks, tmp_path / "undisturbed")
    killed_at(holder, name, call, lambda: run(tasks, tmp_path / "ds"), after=after)
    assert is_dataset(tmp_path / "ds") == (after and name == "replace")
    run(tasks, tmp_path / "ds")
    assert tree_hash(tmp_path / "ds") == tree_hash(tmp_path / "undisturbed")


def test_a_world_without_its_files_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("MEMOBENCH_LIBERO_ASSETS", str(tmp_path / "nothing"))
    task = get_task("check_the_top_drawer_of_the_cabinet").in_world("libero")
    with pytest.raises(MemobenchError, match=r"MEMOBENCH_LIBERO_ASSETS is .* which is no folder"):
        generate([task], 1, tmp_path / "out")
    assert not (tmp_path / "out").exists()
