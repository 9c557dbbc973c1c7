"""Upload to a hub, and load and stream from it. The hub is a small server on this machine (``hub_server``)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_memobench.datasets.lerobot_format import write_dataset
from lerobot_memobench.datasets.push import push
from lerobot_memobench.errors import MemobenchError

from . import hub_server

REPO = "somebody/memobench"


@pytest.fixture
def hub():
    server = hub_server.Hub()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def folder(make_demo, make_task, tmp_path):
    other = make_task("SU", name="other_task", memory_type="object")
    demos = [make_demo(["000111", "000011"], size=64), make_demo(["000111", "000011"], task=other, size=64, seed=9)]
    return write_dataset(demos, tmp_path / "ds", repo_id=REPO)


def python(code: str, hub, home: Path, token: str | None = hub_server.TOKEN) -> subprocess.CompletedProcess:
    """Run code in a process that knows this hub only: huggingface_hub reads its settings when it is imported."""
    settings = {
        "HF_ENDPOINT": hub.address,
        "HF_HOME": str(home),
        # This hub has no Xet storage, the chunked one of the real hub; large files go to it by LFS.
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "OMP_NUM_THREADS": "1",
    }
    environment = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | settings
    if token is not None:
        environment["HF_TOKEN"] = token
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300)


PUSH = """
from lerobot_memobench.datasets.push import push
from lerobot_memobench.errors import MemobenchError
try:
    print(push({folder!r}, {repo!r}))
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


def test_push_load_and_stream(hub, folder, tmp_path):
    (folder / "memory_cache").mkdir()
    (folder / "memory_cache" / "big.bin").write_bytes(b"0" * 100)
    code = PUSH.format(folder=str(folder), repo=REPO)
    pushed = python(code, hub, tmp_path / "home")
    assert pushed.stdout.strip() == f"{hub.address}/datasets/{REPO}", pushed.stderr
    there = hub.repos[REPO]
    ours = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert set(there) - {".gitattributes"} == {n for n in ours if not n.startswith((".cache", "memory_cache"))}
    assert all(there[name] == (folder / name).read_bytes() for name in there if name != ".gitattributes")
    assert list(hub.tags[REPO]) == ["v3.0"]

    hub.requests.clear()
    again = python(code, hub, tmp_path / "home")
    assert again.returncode == 0, again.stderr
    assert not any(request.startswith("PUT /lfs/") for request in hub.requests)

    loaded = python(LOAD.format(repo=REPO), hub, tmp_path / "elsewhere", token=None)
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


def test_a_broken_off_upload_goes_on(hub, folder, tmp_path):
    """What arrived is not sent again; what was deleted there is."""
    code = PUSH.format(folder=str(folder), repo=REPO)
    hub.failing.append(f"/api/datasets/{REPO}/commit/main")
    assert "run the same command again to go on" in python(code, hub, tmp_path / "home").stdout
    assert hub.repos[REPO] == {}
    assert hub.tags[REPO] == {}
    sent = [request for request in hub.requests if request.startswith("PUT /lfs/")]
    assert len(sent) >= 4
    hub.requests.clear()
    assert python(code, hub, tmp_path / "home").returncode == 0
    assert not any(request.startswith("PUT /lfs/") for request in hub.requests)
    assert "meta/info.json" in hub.repos[REPO]

    del hub.repos[REPO]["manifest.json"]
    assert python(code, hub, tmp_path / "home").returncode == 0
    assert "manifest.json" in hub.repos[REPO]
    assert python(PUSH.format(folder=str(folder), repo="somebody/copy"), hub, tmp_path / "home").returncode == 0
    assert set(hub.repos["somebody/copy"]) == set(hub.repos[REPO])


def test_writing_needs_a_token(hub, folder, tmp_path):
    code = PUSH.format(folder=str(folder), repo=REPO)
    without = python(code, hub, tmp_path / "home", token=None)
    assert without.stdout.startswith(f"refused: there is no token to write to {REPO}: run `hf auth login`")
    wrong = python(code, hub, tmp_path / "home", token="hf_of_another")
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
