"""Upload to a hub, and load and stream from it. The hub is a small server on this machine (``hub_server``)."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.push import push
from lerobot_memobench.errors import MemobenchError
from tests.support import hub_server
from tests.support.fork_server import ForkServer

REPO = "somebody/memobench"
IMPORTED = ("lerobot_memobench.datasets.push", "lerobot.datasets.streaming_dataset")


@pytest.fixture(scope="module")
def server():
    one = hub_server.Hub()
    yield one
    one.shutdown()
    one.server_close()


@pytest.fixture
def hub(server):
    """The hub, with nothing on it."""
    server.clear()
    return server


@pytest.fixture(scope="module")
def machine(server, tmp_path_factory):
    """Machines that know this hub only: huggingface_hub reads its settings when it is imported.

    The folder of its files is a link that leads to each machine's own.
    """
    home = tmp_path_factory.mktemp("machines") / "home"
    settings = {
        "HF_ENDPOINT": server.address,
        "HF_HOME": str(home),
        # This hub has no Xet storage, the chunked one of the real hub; large files go to it by LFS.
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "OMP_NUM_THREADS": "1",
    }
    environment = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | settings
    forks = ForkServer(IMPORTED, environment)

    def on_machine(code: str, own: Path, token: str | None = hub_server.TOKEN) -> subprocess.CompletedProcess[str]:
        """Run code on the machine whose folder this is."""
        own.mkdir(exist_ok=True)
        home.unlink(missing_ok=True)
        home.symlink_to(own)
        return forks.run(code, home.parent, **({} if token is None else {"HF_TOKEN": token}))

    yield on_machine
    forks.close()


@pytest.fixture
def folder(make_demo, make_task, tmp_path):
    other = make_task("SU", name="other_task", memory_type="object")
    demos = [
        make_demo(["000111", "000011"], size=64),
        make_demo(["000111", "000011"], task=other, size=64, seed=9, exec_start=2),
    ]
    return write_dataset(demos, tmp_path / "ds", repo_id=REPO)


PUSH = """
from lerobot_memobench.datasets.push import push
from lerobot_memobench.errors import MemobenchError
try:
    print(push({folder!r}, {repo!r}, tell=lambda said: print("told:", said)))
except MemobenchError as error:
    print("refused:", error)
"""

LOAD = """
import json
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
dataset = LeRobotDataset({repo!r})
item = dataset[7]
found = {{"episodes": dataset.num_episodes, "frames": len(dataset), "memory": item["memory"],
         "image": list(item["observation.images.image"].shape), "index": int(item["index"])}}
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
    told, address = pushed.stdout.splitlines()
    assert told == f"told: the feature caches in {folder} stay here: they are made anew where the dataset is trained on"
    assert address == f"{hub.address}/datasets/{REPO}", pushed.stderr
    there = hub.repos[REPO]
    ours = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert set(there) - {".gitattributes"} == {n for n in ours if not n.startswith((".cache", "feature_cache"))}
    same = {name for name in there if name not in (".gitattributes", "README.md")}
    assert all(there[name] == (folder / name).read_bytes() for name in same)
    assert list(hub.tags[REPO]) == ["v3.0"]

    hub.requests.clear()
    again = machine(code, tmp_path / "home")
    assert again.returncode == 0, again.stderr
    assert not any(request.startswith("PUT /lfs/") for request in hub.requests)

    loaded = machine(LOAD.format(repo=REPO), tmp_path / "elsewhere", token=None)
    assert loaded.returncode == 0, loaded.stderr
    assert json.loads(loaded.stdout.splitlines()[-1]) == {
        "episodes": 2,
        "frames": 12,
        "memory": "",
        "image": [3, 64, 64],
        "index": 7,
        "chosen": [1],
        "streamed": list(range(12)),
        "streamed_image": [3, 64, 64],
    }


COUNT = """
from pathlib import Path
from lerobot.datasets import LeRobotDataset
dataset = LeRobotDataset({repo!r})
frames = sum(1 for _ in dataset.hf_dataset)
print(dataset.num_episodes, len(dataset), frames)
"""


def test_an_earlier_larger_dataset_leaves_nothing(hub, machine, folder, make_demo, tmp_path):
    """Its further files would load as frames: LeRobot reads every table below data/."""
    earlier = Path(shutil.copytree(folder, tmp_path / "earlier"))
    table = next((earlier / "data").rglob("*.parquet"))
    shutil.copy(table, table.with_name("file-001.parquet"))  # as of a dataset of two files
    for extra in ("hdf5/old_demo.hdf5", "feature_cache/old/tokens.bin", "states/chunk-000/file-001.parquet"):
        (earlier / extra).parent.mkdir(parents=True, exist_ok=True)
        (earlier / extra).write_bytes(b"old")
    assert machine(PUSH.format(folder=str(earlier), repo=REPO), tmp_path / "home").returncode == 0
    hub.repos[REPO] |= {"feature_cache/old/tokens.bin": b"old", "hdf5/old_demo.hdf5": b"old", "notes.md": b"mine"}
    hub.requests.clear()
    pushed = machine(PUSH.format(folder=str(folder), repo=REPO), tmp_path / "home")
    assert (
        "told: 4 files that this dataset does not have, such as data/chunk-000/file-001.parquet, are" in pushed.stdout
    )
    ours = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert set(hub.repos[REPO]) - {".gitattributes"} == ours | {"notes.md"}
    loaded = machine(COUNT.format(repo=REPO), tmp_path / "elsewhere", token=None)
    assert loaded.stdout.split() == ["2", "12", "12"], loaded.stderr
    again = machine(PUSH.format(folder=str(folder), repo=REPO), tmp_path / "home")
    assert "told" not in again.stdout


LEROBOTS_PUSH = """
from huggingface_hub.repocard import RepoCard
from lerobot.datasets import LeRobotDataset
RepoCard.validate = lambda *_, **__: None  # it asks huggingface.co, whatever the endpoint is
LeRobotDataset({repo!r}, root={folder!r}).push_to_hub()
"""


def test_the_card_on_the_hub_loads_from_there(hub, machine, folder, tmp_path):
    """Its example is run as it stands; the card in the folder says how to load that."""
    assert machine(PUSH.format(folder=str(folder), repo="somebody/else"), tmp_path / "home").returncode == 0
    card = hub.repos["somebody/else"]["README.md"].decode()
    assert 'root="<this folder>"' in (folder / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    assert 'LeRobotDataset("somebody/else")' in example
    ran = machine(example + "print(len(dataset), len(execution))", tmp_path / "elsewhere", token=None)
    assert ran.stdout.split() == ["12", "10"], ran.stderr
    assert card.startswith("---\nlicense: apache-2.0\n")
    for part in (
        "## Limitations",
        "name what only the prompt shows",
        "## Licence\n\nApache-2.0",
        "leaves out the frames",
    ):
        assert part in card, part


def test_a_dataset_without_a_card_is_pushed_with_one(hub, machine, folder, tmp_path):
    for lost in ("README.md", "manifest.json"):
        (folder / lost).unlink()
    shutil.rmtree(folder / "states")
    assert machine(PUSH.format(folder=str(folder), repo=REPO), tmp_path / "home").returncode == 0
    card = hub.repos[REPO]["README.md"].decode()
    for part in (
        "2 demonstrations of 2 robot",
        "has edited this dataset",
        f'LeRobotDataset("{REPO}")',
        "other_task | SU",
    ):
        assert part in card, part


def test_a_broken_off_upload_goes_on(hub, machine, folder, tmp_path):
    """What arrived is not sent again; what was deleted there is."""
    code = PUSH.format(folder=str(folder), repo=REPO)
    hub.failing.append(f"/api/datasets/{REPO}/commit/main")
    assert "run the same command again to go on" in machine(code, tmp_path / "home").stdout
    assert hub.repos[REPO] == {}
    assert hub.tags[REPO] == {}
    sent = [request for request in hub.requests if request.startswith("PUT /lfs/")]
    assert len(sent) >= 4
    hub.requests.clear()
    assert machine(code, tmp_path / "home").returncode == 0
    assert not any(request.startswith("PUT /lfs/") for request in hub.requests)
    assert "meta/info.json" in hub.repos[REPO]

    del hub.repos[REPO]["manifest.json"]
    assert machine(code, tmp_path / "home").returncode == 0
    assert "manifest.json" in hub.repos[REPO]
    assert machine(PUSH.format(folder=str(folder), repo="somebody/copy"), tmp_path / "home").returncode == 0
    assert set(hub.repos["somebody/copy"]) == set(hub.repos[REPO])


KILL = """
import os, signal
from huggingface_hub import HfApi
inner = HfApi.{name}
def killed(*words, **more):
    {after} and inner(*words, **more)
    os.kill(os.getpid(), signal.SIGKILL)
HfApi.{name} = killed
"""


@pytest.mark.parametrize(
    ("name", "after"),
    [("create_repo", True), ("preupload_lfs_files", True), ("upload_folder", True), ("upload_file", True)],
)
def test_a_killed_upload_goes_on(hub, machine, folder, tmp_path, name, after):
    code = PUSH.format(folder=str(folder), repo=REPO)
    assert machine(code, tmp_path / "home").returncode == 0
    undisturbed = (dict(hub.repos[REPO]), list(hub.tags[REPO]))
    hub.clear()
    assert machine(KILL.format(name=name, after=after) + code, tmp_path / "home").returncode != 0
    assert not hub.tags[REPO], "LeRobot loads no dataset without its tag"
    assert machine(code, tmp_path / "home").returncode == 0
    assert (hub.repos[REPO], list(hub.tags[REPO])) == undisturbed


def test_writing_needs_a_token(hub, machine, folder, tmp_path):
    code = PUSH.format(folder=str(folder), repo=REPO)
    without = machine(code, tmp_path / "home", token=None)
    assert without.stdout.startswith(f"refused: there is no token to write to {REPO}: run `hf auth login`")
    wrong = machine(code, tmp_path / "home", token="hf_of_another")
    assert wrong.stdout.startswith(f"refused: the hub refused to write to {REPO} (401): the token is not valid")
    assert hub.repos == {}
    assert not (folder / ".cache").exists()


def test_what_cannot_be_pushed(folder, tmp_path):
    with pytest.raises(MemobenchError, match="is no finished dataset"):
        push(tmp_path, REPO, token="hf_x")
    with pytest.raises(MemobenchError, match="expected user/name"):
        push(folder, "memobench", token="hf_x")
    with pytest.raises(MemobenchError, match="does not allow"):
        push(folder, "some body/memo bench", token="hf_x")
