"""`scripts/publish.py`: its plan, its refusals, uploads to a hub and an index on this machine, and the invitations."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_memobench.policies.checkpoint import checkpoint_files, shipped_policies
from lerobot_memobench.rollouts.plan import plan_line
from scripts.invitations import GUESTS, Guest, invitation
from tests.support.hub_server import Hub
from tests.support.index_server import Index
from tests.support.scripts import load_script
from tests.test_docs import check, commands

publish = load_script("publish")


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub() as server:
        yield server


@pytest.fixture
def index(tmp_path: Path) -> Iterator[Index]:
    with Index(tmp_path / "index") as server:
        yield server


@pytest.fixture
def parts(tmp_path: Path) -> dict[str, publish.Part]:
    """Return the parts of a release without datasets; nothing is built."""
    datasets = {suite: tmp_path / suite for suite in publish.GENERATE}
    release = publish.release("somebody", tmp_path / "out", datasets, [])
    return {name: replace(part, build=()) for name, part in release.items()}


# --- plan ---


def test_commands_of_the_plan_and_of_the_list_are_valid(capsys: pytest.CaptureFixture[str]) -> None:
    publish.main(["--plan"])
    lines = [shlex.split(line) for line in capsys.readouterr().out.splitlines() if line.startswith("    ")]
    typed = [[*filter(lambda word: not word.startswith(publish.TOKENS), words)] for words in lines]
    assert {words[0] for words in typed} == {"memobench", "lerobot", "python", "pip", "hf", "git"}
    for words in typed:
        if words[0] not in ("hf", "git"):
            check(words)


@pytest.mark.parametrize("guest", GUESTS, ids=lambda guest: guest.slug)
def test_commands_of_the_invitations_are_valid(guest: Guest, tmp_path: Path) -> None:
    page = tmp_path / "invitation.md"
    page.write_text(invitation(guest, "somebody", "lerobot_policy_memobench==0.2.0"))
    typed = [*commands(page)]
    evaluations = [words[2:] for words in typed if words[:2] == ["lerobot", "eval"]]
    assert (len(typed), len(evaluations)) == (7 + guest.on_libero, 3 + guest.on_libero)
    for words in typed:
        check(words)
    for line in evaluations:  # with the checks before a simulation: of dialect, images, variants, pauses
        assert plan_line(line).policy.label == guest.slug


# --- refusals ---


def test_an_upload_needs_tokens_commits_and_every_part(
    parts: dict[str, publish.Part], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "ROOT", tmp_path)
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / "new.txt").touch()
    monkeypatch.setenv("TWINE_PASSWORD", "x")
    monkeypatch.delenv("HF_TOKEN", raising=False)
    with pytest.raises(SystemExit) as refused:
        publish.refuse(parts)
    for reason in ("found no HF_TOKEN in", "?? new.txt", f"strict: {tmp_path}/strict holds no dataset", "published: "):
        assert reason in str(refused.value)
    monkeypatch.setenv("HF_TOKEN", "x")
    (tmp_path / "new.txt").unlink()
    publish.refuse({"weights": parts["weights"]})


def test_weights_of_a_row_of_the_board_are_required(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "ROOT", tmp_path)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "model.safetensors").write_bytes(b"weights")
    shipped = shipped_policies()
    rows = {"scripted": None, "known": {"files": checkpoint_files(shipped["memobench_strict"])}}
    rows["from the hub"] = {"files": {"model.safetensors": "1" * 64}, "revision": "2" * 40}
    for row, checkpoint in {**rows, "lost": {"files": checkpoint_files(mine)}}.items():
        (tmp_path / "results/board" / row).mkdir(parents=True)
        (tmp_path / "results/board" / row / "evaluation.json").write_text(json.dumps({"checkpoint": checkpoint}))
    found, absent = publish.weights_of_rows([])
    assert (found, absent.endswith("rows lost")) == (shipped, True)
    assert publish.weights_of_rows([mine]) == ({**shipped, "lost": mine}, "")


def test_a_finished_upload_is_not_left_to_do(parts: dict[str, publish.Part]) -> None:
    assert "- Upload." in publish.left(parts, "somebody")
    assert "- Upload." not in publish.left(parts, "somebody", uploaded=True)


# --- uploads ---


def test_uploads_to_a_hub_are_resumed(parts: dict[str, publish.Part], hub: Hub, index: Index, tmp_path: Path) -> None:
    out, environment = tmp_path / "out", publish.local(hub, index, tmp_path)
    page = out / "site" / "index.html"
    page.parent.mkdir(parents=True)
    page.write_text("page")
    publish.publish({name: parts[name] for name in ("weights", "site", "envhub")}, out, "somebody", environment)
    assert hub.kinds == {
        **{f"somebody/{name}": "models" for name in ("memobench_strict", "memobench_strict_memoryless", "memobench")},
        "somebody/memobench-docs": "spaces",
    }
    for name, folder in shipped_policies().items():
        assert hub.repos[f"somebody/{name}"] == {path.name: path.read_bytes() for path in folder.iterdir()}
    assert hub.repos["somebody/memobench-docs"] == {"index.html": b"page", "README.md": publish.SPACE.encode()}
    assert b'make_env("somebody/memobench"' in hub.repos["somebody/memobench"]["README.md"]

    hub.requests.clear()
    publish.publish({"weights": parts["weights"]}, out, "somebody", environment)
    assert any("/commit/" in request for request in hub.requests)
    assert not any(request.startswith("PUT /lfs/") for request in hub.requests), "unchanged weights are not sent again"


def write_wheel(folder: Path, text: str) -> Path:
    """Write a wheel of this project's name and version that holds one file."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"{publish.NAME}-{publish.VERSION}"
    with zipfile.ZipFile(folder / f"{stem}-py3-none-any.whl", "w") as archive:
        archive.writestr("one.py", text)
        head = f"Metadata-Version: 2.4\nName: {publish.NAME}\nVersion: {publish.VERSION}\n"
        archive.writestr(f"{stem}.dist-info/METADATA", head)
        archive.writestr(f"{stem}.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{stem}.dist-info/RECORD", "")
    return folder / f"{stem}-py3-none-any.whl"


def test_another_wheel_of_a_version_is_refused(
    parts: dict[str, publish.Part], hub: Hub, index: Index, tmp_path: Path
) -> None:
    out, environment = tmp_path / "out", publish.local(hub, index, tmp_path)
    wheel = write_wheel(out / "dist", "first")
    upload, _, sdist = parts["wheel"].upload[0].rpartition(" ")
    assert sdist.endswith(".tar.gz")
    alone = {"wheel": publish.Part(upload=(upload,))}
    publish.publish(alone, out, "somebody", environment)
    there = tmp_path / "index/simple" / publish.NAME.replace("_", "-") / wheel.name
    assert there.read_bytes() == wheel.read_bytes()
    publish.publish(alone, out, "somebody", environment)
    write_wheel(out / "dist", "second")
    with pytest.raises(SystemExit, match="the index has another"):
        publish.publish(alone, out, "somebody", environment)


@pytest.mark.slow
@pytest.mark.timeout(6000)
def test_wheel_is_installed_by_name_and_evaluates(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """In an empty environment: the expert, and the shipped policy from the local hub."""
    environment = publish.programs()
    reached = ["python", "-m", "pip", "download", "-q", "--no-deps", "-d"]
    if shutil.which("uv", path=environment["PATH"]) is None:
        pytest.skip("uv is neither in .uv nor on the PATH")
    if subprocess.run([*reached, str(tmp_path), "termcolor"], env=environment).returncode:
        pytest.skip("pip cannot reach a package index")
    publish.main(["--only", "weights", "wheel", "install", "--out", str(tmp_path), "--user", "somebody"])
    printed = capfd.readouterr().out
    assert "policy=memobench_expert" in printed
    assert "policy=somebody/memobench_strict" in printed
