"""The HTML report: data of the page, its videos, and its files."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shutil
import sys
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.envs.video import OPERATION_COLOURS, VideoRecorder
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.html import (
    find_videos,
    frame_count,
    inline_json,
    page,
    page_data,
    task_source,
    write_html,
)
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.tasks.catalogue import get_task
from tests.support import logs
from tests.support.logs import write_log

STOVE = "turn_on_the_stove_and_turn_it_off"


def record(task: str = STOVE, episode: int = 0, *, success: bool = True, **changes: Any) -> dict[str, Any]:
    """A rollout of the stove's task (S, U): both checkpoints in order, or only the second one, too early."""
    marks = [("S", 6, 6), ("U", 12, 12)] if success else [("S", None, None), ("U", 9, None)]
    own = {
        "variant": 0,
        "replan_steps": None,
        "prompt_steps": 0,
        "steps": 12 if success else 20,
        "success": success,
        "failure": None if success else "storage_failure",
        "scene_hash": "0123456789abcdef",
    }
    return logs.record(task, episode, marks, **own | changes)


def evaluation(folder: Path, records: list[dict[str, Any]]) -> Path:
    write_log(folder, records)
    return folder


def film(path: Path, frames: int) -> Path:
    """A video of ``frames`` frames, the last one held for a second as the environment does it."""
    strip = VideoRecorder(path)
    for _ in range(frames):
        strip.add(np.zeros((32, 48, 3), np.uint8))
    strip.finish()
    return path


def content(text: str) -> dict[str, Any]:
    """The data inside a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


# --- data ---


def test_figures_are_those_of_the_report(tmp_path: Path) -> None:
    evaluation(tmp_path, [record(episode=k, success=k > 0, prompt_steps=5) for k in range(4)])
    run = page_data(read_runs([tmp_path]), [{0: "videos/a.mp4"}], task_source([STOVE]))["runs"][0]
    episode = run["episodes"][0]
    assert (episode["prompt"], episode["steps"], episode["outcome"]) == (5, 20, "storage_failure")
    assert (episode["checkpoints"], episode["video"]) == ([["S", None, None], ["U", 9, None]], "videos/a.mp4")
    rates = run["tasks"][STOVE]["rates"]
    assert rates["SR"] == [75.0, 30.1, 95.4, 4]  # Wilson, 3 of 4
    assert rates["MSR"][0] == 75.0
    assert rates["MUR"][0] == 100.0
    assert rates["MCR"] is None
    assert run["average"]["SR"] == run["memory_types"]["temporal"]["SR"] == rates["SR"]
    assert [rate[0] for rate in run["tasks"][STOVE]["prefix"]] == [75.0, 75.0]
    assert run["tasks"][STOVE]["outcomes"] == {
        "success": 3,
        "storage_failure": 1,
        "stale_memory": 0,
        "compression_collapse": 0,
        "reference_drift": 0,
        "execution_failure": 0,
    }
    protocol = f"published suite, referent fixed, seeds 7 to 10, 4 episodes of {STOVE}"
    assert run["headline"] == f"policy not recorded: {protocol}; inputs: not recorded, prompt in steps (observed)"
    assert run["facts"] == ["4 rollouts", "horizon 1200"]
    assert run["commands"] == []


def test_texts_are_the_tasks_own(tmp_path: Path) -> None:
    shutil.copytree(get_task(STOVE).folder, tmp_path / "tasks" / "my_task")
    assert task_source([], tmp_path / "tasks")["my_task"].language == get_task(STOVE).language
    other_version = record("turn_on_the_stove", checkpoints=record()["checkpoints"] * 2)
    evaluation(tmp_path, [record(), record("task_of_mine"), other_version])
    data = page_data(read_runs([tmp_path]), [{}], {**task_source([STOVE]), "turn_on_the_stove": get_task(STOVE)})
    assert data["tasks"]["turn_on_the_stove"]["variants"] == {}, "its texts are of another version"
    stove = data["tasks"][STOVE]
    assert stove["language"] == get_task(STOVE).language
    assert stove["variants"]["0"]["checkpoints"][1]["texts"] == list(get_task(STOVE).checkpoints[1].language)
    own = {"memory_type": "temporal", "id": None, "language": "task of mine", "variants": {}}
    assert data["tasks"]["task_of_mine"] == own
    assert data["operations"]["U"]["colour"] == "#{:02x}{:02x}{:02x}".format(*OPERATION_COLOURS["U"])


# --- page ---


def test_text_cannot_leave_the_data() -> None:
    nasty = {"a": "</script><script>alert(1)</script><!-- & \u2028 {{script}}"}
    text = inline_json(nasty)
    assert "<" not in text
    assert json.loads(text) == nasty
    data = {"version": "1", **nasty}
    whole = page(data, title="<b>&\"'")
    assert content(whole) == data
    assert "<title>&lt;b&gt;&amp;&quot;&#x27; · MEMOBench</title>" in whole


def test_only_the_pages_own_script_and_style_may_run() -> None:
    text = page({"version": "1"}, title="t")
    policy = unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])  # type: ignore[index]
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    for element, kind in ((r"<script>(.*)</script>", "script-src"), (r"<style>(.*?)</style>", "style-src")):
        body = re.search(element, text, re.DOTALL)[1]  # type: ignore[index]
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{kind} 'sha256-{digest}'" in policy
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text)


# --- videos ---


def test_a_film_belongs_to_the_rollout_that_is_as_long(tmp_path: Path) -> None:
    evaluation(tmp_path, [record(episode=0), record(episode=1), record(episode=2, prompt_steps=4)])
    videos = tmp_path / "videos"
    film(videos / f"{STOVE}.0.mp4", 13)  # a frame at the start and one per step
    film(videos / f"{STOVE}.1.mp4", 12)
    film(videos / f"{STOVE}.2.mp4", 17)
    torn = tmp_path / "torn.mp4"
    torn.write_bytes((videos / f"{STOVE}.0.mp4").read_bytes()[:200])
    assert (frame_count(torn), frame_count(videos / f"{STOVE}.0.mp4")) == (None, 33)
    (run,) = read_runs([tmp_path])
    found, notes = find_videos(tmp_path, run.records)
    assert found == {0: videos / f"{STOVE}.0.mp4", 2: videos / f"{STOVE}.2.mp4"}
    assert len(notes) == 1
    assert f"{STOVE}.1.mp4" in notes[0]


@pytest.mark.parametrize(
    "changes",
    [*({"task": name} for name in ("../outside", "/outside", "a\nb", "a/b")), {"referent": "x/../../../outside"}],
    ids=str,
)
def test_a_task_or_referent_that_is_a_path_leads_nowhere(tmp_path: Path, changes: dict[str, Any]) -> None:
    run = tmp_path / "run"
    evaluation(run, [{**record(), **changes}])
    film(run / "videos" / f"{STOVE}.0.mp4", 13)
    film(run / "outside.0.mp4", 13)
    (run / "videos" / "a").mkdir(parents=True)
    film(run / "videos" / "a" / "b.0.mp4", 13)
    assert write_html([run], tmp_path / "out").videos == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["index.html"]


# --- the folder ---


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = evaluation(tmp_path / "run", [record(episode=k) for k in range(2)])
    film(folder / "videos" / f"{STOVE}.0.mp4", 13)
    return folder


def test_the_folder_holds_page_and_videos(run: Path, tmp_path: Path) -> None:
    written = write_html([run], tmp_path / "out")
    assert (written.rollouts, written.videos) == (2, 1)
    video = tmp_path / "out" / "videos" / "run" / f"{STOVE}.0.mp4"
    assert video.samefile(run / "videos" / f"{STOVE}.0.mp4")  # a hard link costs no space
    episodes = content(written.page.read_text())["runs"][0]["episodes"]
    assert [episode["video"] for episode in episodes] == [f"videos/run/{STOVE}.0.mp4", None]
    assert not list((tmp_path / "out").rglob("*.part*"))


def test_videos_are_copied_where_links_are_not_possible(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError("another file system")

    monkeypatch.setattr(os, "link", refuse)
    write_html([run], tmp_path / "out")
    source, copy = run / "videos" / f"{STOVE}.0.mp4", tmp_path / "out" / "videos" / "run" / f"{STOVE}.0.mp4"
    assert copy.read_bytes() == source.read_bytes()
    assert not copy.samefile(source)
    before = copy.stat().st_ino
    write_html([run], tmp_path / "out")
    assert copy.stat().st_ino == before  # an existing copy stays


def test_an_earlier_report_is_replaced(run: Path, tmp_path: Path) -> None:
    write_html([run], tmp_path / "out")
    other = evaluation(tmp_path / "other", [record(episode=5)])
    write_html([other], tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["index.html"]
    assert (run / "videos" / f"{STOVE}.0.mp4").is_file()
    write_html([run], tmp_path / "out")
    (tmp_path / "out" / "videos" / "run" / "mine.txt").write_text("mine")
    write_html([other], tmp_path / "out")
    assert [path.name for path in (tmp_path / "out" / "videos").rglob("*.*")] == ["mine.txt"]


def test_videos_behind_links_stay(run: Path, tmp_path: Path) -> None:
    """A user may save room by links to the videos of an evaluation."""
    out = tmp_path / "out"
    write_html([run], out)
    shutil.rmtree(out / "videos" / "run")
    (out / "videos" / "run").symlink_to(run / "videos")
    kept = film(run / "videos" / "kept.mp4", 3)
    other = evaluation(tmp_path / "other", [record(episode=5)])
    before = {path: path.read_bytes() for path in (run / "videos").iterdir()}
    assert [note for note in write_html([other], out).notes if str(out / "videos" / "run") in note]
    with pytest.raises(MemobenchError, match=r"videos/run is a link to .*; remove the link"):
        write_html([run], out)
    shutil.rmtree(out / "videos")
    (out / "videos").symlink_to(run.parent)
    with pytest.raises(MemobenchError, match="out/videos is a link to "):
        write_html([other], out)
    assert {path: path.read_bytes() for path in (run / "videos").iterdir()} == before
    assert kept.is_file()


def test_an_unfinished_report_can_be_made_again(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules[write_html.__module__]
    place = module.place_videos  # type: ignore[attr-defined]

    def killed(*arguments: Any) -> None:
        place(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "place_videos", killed)
    with pytest.raises(KeyboardInterrupt):
        write_html([run], tmp_path / "out")
    monkeypatch.undo()
    assert "was not finished" in (tmp_path / "out" / "index.html").read_text()
    assert write_html([run], tmp_path / "out").videos == 1
    assert content((tmp_path / "out" / "index.html").read_text())["runs"]


def test_runs_of_like_names_keep_their_videos_apart(run: Path, tmp_path: Path) -> None:
    other = evaluation(tmp_path / "Run", [record(success=False, failure="unstable_physics", fault="it broke")])
    film(other / "videos" / f"{STOVE}.0.mp4", 21)
    data = content(write_html([run, other], tmp_path / "out").page.read_text())
    episodes = [run["episodes"][0] for run in data["runs"]]
    assert len({episode["video"].lower() for episode in episodes}) == 2
    assert all((tmp_path / "out" / episode["video"]).is_file() for episode in episodes)
    assert [(each["outcome"], each["fault"]) for each in episodes] == [
        ("success", None),
        ("unstable_physics", "it broke"),
    ]
    assert data["failures"][-1] == "unstable_physics"


@pytest.mark.parametrize("name", ["index.html", "notes.txt"])
def test_other_peoples_files_are_left_alone(run: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    with pytest.raises(MemobenchError, match="no earlier report"):
        write_html([run], tmp_path / "out")
    assert (tmp_path / "out" / name).read_text() == "mine"
    with pytest.raises(MemobenchError, match="is a file"):
        write_html([run], tmp_path / "out" / name)
