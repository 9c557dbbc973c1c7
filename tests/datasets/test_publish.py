"""Push to a hub, load and stream from it, and describe a dataset. The hub is a local server (`hub_server`)."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lerobot_memobench.datasets.card import TABLES_FILE, describe, push
from lerobot_memobench.datasets.layout import MANIFEST_FILE
from lerobot_memobench.errors import MemobenchError
from tests.support import hub_server
from tests.support.fork_server import ForkServer

REPO = "local/test"
IMPORTED = ("lerobot_memobench.datasets.card", "lerobot.datasets.streaming_dataset")


@pytest.fixture(scope="module")
def server():
    one = hub_server.Hub()
    yield one
    one.shutdown()
    one.server_close()


@pytest.fixture
def hub(server):
    server.clear()
    return server


@pytest.fixture(scope="module")
def machine(server, tmp_path_factory):
    """Return a function that runs code on a machine with this hub: huggingface_hub reads settings when imported.

    The folder of its files is a link to each machine's own folder.
    """
    home = tmp_path_factory.mktemp("machines") / "home"
    settings = {
        "HF_ENDPOINT": server.address,
        "HF_HOME": str(home),
        # This hub has no Xet storage; large files use LFS.
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "OMP_NUM_THREADS": "1",
    }
    environment = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | settings
    forks = ForkServer(IMPORTED, environment)

    def on_machine(code: str, own: Path, token: str | None = hub_server.TOKEN) -> subprocess.CompletedProcess[str]:
        """Run code on the machine with the folder ``own``."""
        own.mkdir(exist_ok=True)
        home.unlink(missing_ok=True)
        home.symlink_to(own)
        return forks.run(code, home.parent, **({} if token is None else {"HF_TOKEN": token}))

    yield on_machine
    forks.close()


@pytest.fixture
def folder(synthetic, copy):
    return copy(synthetic)


PUSH = """
from lerobot_memobench.datasets.card import push
from lerobot_memobench.errors import MemobenchError
try:
    print(push({folder!r}, {repo!r}, notify=lambda text: print("note:", text)))
except MemobenchError as error:
    print("refused:", error)
"""

LOAD = """
import json
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
dataset = LeRobotDataset({repo!r})
item = dataset[7]
found = {{"episodes": dataset.num_episodes, "frames": len(dataset), "index": int(item["index"])}}
chosen = LeRobotDataset({repo!r}, episode_filter=lambda episode: episode["memory_type"] == "object")
found["chosen"] = list(chosen.episodes)
stream = StreamingLeRobotDataset({repo!r}, shuffle=False, buffer_size=1)
found["streamed"] = sorted(int(item["index"]) for item in stream)
found["streamed_image"] = list(next(iter(stream))["observation.images.wrist_image"].shape)
print(json.dumps(found))
"""


def test_push_load_and_stream(hub, machine, folder, tmp_path):
    (folder / "feature_cache").mkdir()
    (folder / "feature_cache" / "big.bin").write_bytes(b"0" * 100)
    code = PUSH.format(folder=str(folder), repo=REPO)
    pushed = machine(code, tmp_path / "home")
    note, address = pushed.stdout.splitlines()
    assert note.startswith("note: the feature caches")
    assert address == f"{hub.address}/datasets/{REPO}", pushed.stderr
    there = hub.repos[REPO]
    ours = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert set(there) - {".gitattributes"} == {n for n in ours if not n.startswith((".cache", "feature_cache"))}
    same = {name for name in there if name not in (".gitattributes", "README.md")}
    assert all(there[name] == (folder / name).read_bytes() for name in same)
    assert list(hub.tags[REPO]) == ["v3.0"]
    card = there["README.md"].decode()
    assert 'root="<this folder>"' in (folder / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    assert f'LeRobotDataset("{REPO}")' in example
    for part in ("\nlicense: other\n", "## Limitations", "name information that only", "CC BY 4.0"):
        assert part in card

    hub.requests.clear()
    assert machine(code, tmp_path / "home").returncode == 0
    assert not any(request.startswith("PUT /lfs/") for request in hub.requests), "unchanged files are not sent again"

    code = example + "print(len(dataset), len(execution))" + LOAD.format(repo=REPO)
    loaded = machine(code, tmp_path / "elsewhere", token=None)
    assert loaded.returncode == 0, loaded.stderr
    counts, found = loaded.stdout.splitlines()[-2:]
    assert counts.split() == ["85", "75"]
    assert json.loads(found) == {
        "episodes": 3,
        "frames": 85,
        "index": 7,
        "chosen": [1, 2],
        "streamed": list(range(85)),
        "streamed_image": [3, 64, 64],
    }


def test_files_of_an_earlier_dataset_are_deleted(hub, machine, folder, tmp_path):
    """LeRobot would load its further tables."""
    code = PUSH.format(folder=str(folder), repo=REPO)
    assert machine(code, tmp_path / "home").returncode == 0
    table = next((folder / "data").rglob("*.parquet"))
    hub.repos[REPO] |= dict.fromkeys(
        ["feature_cache/old/a.bin", "hdf5/old_demo.hdf5", "states/chunk-000/file-001.parquet", "notes.md"], b"old"
    )
    hub.repos[REPO] |= {"data/chunk-000/file-001.parquet": table.read_bytes()}
    pushed = machine(code, tmp_path / "home")
    assert pushed.returncode == 0, pushed.stderr
    ours = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert set(hub.repos[REPO]) - {".gitattributes"} == ours | {"notes.md"}


KILL = """
import os, signal
from huggingface_hub import HfApi
inner = HfApi.preupload_lfs_files
def killed(*words, **more):
    inner(*words, **more)
    os.kill(os.getpid(), signal.SIGKILL)
HfApi.preupload_lfs_files = killed
"""


def test_killed_upload_continues(hub, machine, folder, tmp_path):
    code = PUSH.format(folder=str(folder), repo=REPO)
    assert machine(code, tmp_path / "home").returncode == 0
    undisturbed = (dict(hub.repos[REPO]), list(hub.tags[REPO]))
    hub.clear()
    assert machine(KILL + code, tmp_path / "home").returncode != 0
    assert not hub.tags[REPO], "LeRobot loads no dataset without its tag"
    assert machine(code, tmp_path / "home").returncode == 0
    assert (hub.repos[REPO], list(hub.tags[REPO])) == undisturbed


def test_refused_uploads(hub, machine, folder, tmp_path):
    code = PUSH.format(folder=str(folder), repo=REPO)
    assert "`hf auth login`" in machine(code, tmp_path / "home", token=None).stdout
    assert "(401)" in machine(code, tmp_path / "home", token="hf_of_another").stdout
    assert hub.repos == {}
    assert not (folder / ".cache").exists()
    for dataset, repo, named in (
        (tmp_path, REPO, "is no finished dataset"),
        (folder, "memobench", "expected user/name"),
        (folder, "some body/memo bench", "does not allow"),
    ):
        with pytest.raises(MemobenchError, match=named):
            push(dataset, repo, token="hf_x")


# --- describe ---


def test_description(synthetic, tmp_path, monkeypatch):
    """Of a folder whose name is a pattern of `glob`."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    dataset = shutil.copytree(synthetic, tmp_path / "ds [v2]")
    files = describe(dataset, tmp_path / "out")
    assert [file.name for file in files] == [TABLES_FILE, MANIFEST_FILE]
    kept = json.loads((tmp_path / "out" / MANIFEST_FILE).read_text())["tasks"]
    whole = json.loads((dataset / MANIFEST_FILE).read_text())["episodes"]
    assert {(task, seed, digest) for task, seeds in kept.items() for seed, digest in seeds.items()} == {
        (row["task_name"], str(row["seed"]), row["digest"]) for row in whole
    }
    tables = (tmp_path / "out" / TABLES_FILE).read_text()
    assert "| other_task | SU | 2/2 | 30.0 |" in tables
    assert "## Columns" not in tables
    earlier = [file.read_bytes() for file in files]
    with monkeypatch.context() as patch:
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        patch.setattr("pathlib.Path.write_bytes", lambda *_: (_ for _ in ()).throw(full))
        with pytest.raises(MemobenchError, match="No space left on device"):
            describe(dataset, tmp_path / "out")
    assert [file.read_bytes() for file in files] == earlier
    assert sorted((tmp_path / "out").iterdir()) == sorted(files)
