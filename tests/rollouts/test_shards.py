"""Parts of an evaluation: jobs, and merging them or naming the reason why not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.lerobot import SHARD_PROGRAM
from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.episode_log import EpisodeLog, line_of, read_episodes
from lerobot_memobench.envs.evaluation_file import read_evaluation, write_evaluation, write_facts
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import headline
from lerobot_memobench.rollouts.card import policy_facts, run_facts
from lerobot_memobench.rollouts.plan import plan_line
from lerobot_memobench.rollouts.shards import merge, merge_and_report, part_folders, plan_shards
from tests.support.fake_loop import DRAWER, STOVE, FakeLoop
from tests.support.logs import MISSING, SETTINGS, card, facts, record

COMMAND = ["eval", "env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4", "batch_size=2"]
LINE = [*COMMAND[1:], "policy=memobench_random", "output_dir=out"]


KNOWN = {"type": "act", "identity": "act 1"}

# --- merging ---


def part(
    folder: Path, episodes: list[int], task: str = "a", settings: Any = SETTINGS, policy: Any = None, **changes: Any
) -> Path:
    """Write a part: its file, log, videos and memory reads."""
    write_facts(folder, facts(settings, policy))
    log = EpisodeLog(folder)
    for k in episodes:
        own = {"steps": 100 + k, "scene_hash": f"{k}", "wall_s": 1.0}
        log.append(line_of(record(task, k, **own | changes)))
        for file in (f"videos/{task}.{k}.mp4", f"memory_reads/{task}.{k}.json.gz"):
            (folder / file).parent.mkdir(exist_ok=True)
            (folder / file).write_text(f"{file} of {k}")
    return folder


def with_card(folder: Path, shard: str, policy: str = "act", task_hash: str = "1") -> Path:
    content = card(
        {**SETTINGS, "tasks": ["a"], "episodes": 4},
        policy_facts({"type": policy}, 7),
        task_files={"a": task_hash},
        settings={"env": {"tasks": "a"}},
        runs=[run_facts(["lerobot", "eval", f"shard={shard}"], 1)],
        shard=shard,
    )
    write_evaluation(folder, content)
    return folder


def test_logs_videos_protocol_and_card_are_merged(tmp_path: Path) -> None:
    parts = [with_card(part(tmp_path / f"p{k}", [k, k + 2]), f"{k + 1}/2") for k in range(2)]
    out = tmp_path / "out"
    found = merge_and_report(tmp_path / "half", parts[:1])
    assert MISSING.format(2, 4, "a", 1) in str(found.missing).replace(", in part 1/2 of an evaluation", "")
    assert merge_and_report(out, parts).missing is None
    assert [record["episode"] for record in read_episodes(out)] == [0, 1, 2, 3]
    assert os.path.samefile(out / "videos" / "a.2.mp4", tmp_path / "p0" / "videos" / "a.2.mp4")
    assert sorted(path.name for path in (out / "memory_reads").iterdir()) == [f"a.{k}.json.gz" for k in range(4)]
    merged = read_evaluation(out)
    assert merged["protocol"] == {**SETTINGS, "tasks": ["a"], "episodes": 4}
    assert merged["policy"] == policy_facts({"type": "act"}, 7)
    assert [run["command"][-1] for run in merged["runs"]] == ["shard=1/2", "shard=2/2"]
    assert merged["shard"] is None
    # Once more, and with a part that came later and has no card.
    before = (out / "evaluation.json").read_bytes(), (out / "episodes.jsonl").read_bytes()
    merge(out, parts)
    assert before == ((out / "evaluation.json").read_bytes(), (out / "episodes.jsonl").read_bytes())
    merge(out, [part(tmp_path / "later", [0], task="b", policy=KNOWN)])
    assert len(read_episodes(out)) == 5
    assert set(read_evaluation(out)) == {"format", "protocol", "policy"}


def test_an_episode_in_two_parts_counts_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_link(*_: Any) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", no_link)
    parts = [part(tmp_path / "x", [0, 1]), part(tmp_path / "y", [1, 2], wall_s=77.0)]
    merge(tmp_path / "out", parts)
    assert [record["episode"] for record in read_episodes(tmp_path / "out")] == [0, 1, 2]
    assert (tmp_path / "out" / "videos" / "a.0.mp4").read_text() == "videos/a.0.mp4 of 0"  # copied


OTHERWISE = {"settings": {**SETTINGS, "horizon": 600}}


@pytest.mark.parametrize(
    ("x", "y", "named"),
    [
        ({}, {"success": False}, "success is True"),
        ({}, {"scene_hash": "other"}, "scene_hash"),
        ({}, {"checkpoints": [{"operation": "S", "first_step": 4, "ordered_step": 4}]}, "first_step of checkpoint 1"),
        ({}, OTHERWISE, "horizon: 1200 and 600"),
        ({"policy": KNOWN}, {"policy": {**KNOWN, "identity": "act 2"}}, "act 2"),
        ({"policy": KNOWN}, {}, "does not name the policy"),
        ({"card": "1/2"}, {}, "does not name the policy"),
        ({"card": "1/2"}, {"card": "2/2", "other": {"policy": "diffusion"}}, r"policy\.type: act and diffusion"),
        ({"card": "1/2"}, {"card": "2/2", "other": {"task_hash": "2"}}, "task files"),
    ],
)
def test_parts_that_disagree_are_refused(tmp_path: Path, x: dict[str, Any], y: dict[str, Any], named: str) -> None:
    folders = []
    for name, episodes, given in (("x", [0, 1], x), ("y", [1, 2], y)):
        fields = {key: value for key, value in given.items() if key not in ("card", "other")}
        folders.append(part(tmp_path / name, episodes, **fields))
        if "card" in given:
            with_card(folders[-1], given["card"], **given.get("other", {}))
    orders = [folders, folders[::-1]] if named == "does not name the policy" else [folders]
    for order in orders:
        with pytest.raises(MemobenchError, match=named):
            merge(tmp_path / "out", order)
    assert not (tmp_path / "out").exists()


def test_parts_without_a_policy_are_merged_with_a_note(tmp_path: Path) -> None:
    parts = [part(tmp_path / name, [k]) for k, name in enumerate("xy")]
    unnamed = merge_and_report(tmp_path / "out", parts)
    assert len(unnamed.notes) == 1
    assert headline([unnamed]).startswith("policy not recorded: ")
    named = merge_and_report(tmp_path / "named", [part(tmp_path / "z", [0], policy=KNOWN)])
    assert (named.notes, headline([named])[:6]) == ([], "act 1:")


def test_folders_of_parts_are_found_or_named(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    for number in (1, 2):
        assert lerobot([*COMMAND, f"output_dir=machine{number}", f"shard={number}/2"]) == 0
    folders = [f"machine{number}/shard-{number}-of-2" for number in (1, 2)]
    assert [str(folder) for folder in part_folders(Path("machine1"))] == folders[:1]
    assert memobench(["merge", "half", folders[0]]) == 1
    assert f"4 of 8 episodes, with all of 1 task, the first is {DRAWER}, episode 0" in capsys.readouterr().out
    assert memobench(["merge", "out", *folders]) == 0
    assert len(read_episodes(Path("out"))) == 8
    assert memobench(["merge", "empty"]) == 2


# --- jobs ---


@pytest.mark.parametrize("gpu", [False, True])
def test_parts_repeat_the_command_and_decide_the_device_where_they_run(
    fake_loop: FakeLoop, gpu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: gpu)
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)
    Path("eval.yaml").write_text("env: {horizon: 30}")
    words = ["memory_reads=true", "config_path=eval.yaml", "policy=memobench_strict", "workers=1"]
    whole = plan_line([*LINE, *words, "shards=2"])
    jobs = plan_shards(whole, ("program",), print)
    parts = [plan_line(job.arguments[1:]) for job in jobs]
    assert [str(part.options.shard) for part in parts] == ["1/2", "2/2"]
    for part_plan in parts:
        assert (part_plan.grid, part_plan.options.memory_reads, part_plan.options.resume) == (whole.grid, True, True)
        assert part_plan.environment.horizon == 30
        assert part_plan.settings.policy.get("device") == (None if gpu else "cpu")
    assert not any("device" in word for job in jobs for word in job.arguments)
    assert {job.at_once for job in jobs} == {1}
    here = plan_shards(plan_line([*LINE, "shards=2"]), (), print)
    assert {job.at_once for job in here} == {2}
    assert here[0].episodes | here[1].episodes == {(task, k) for task in (STOVE, DRAWER) for k in range(4)}
    assert not any("use_async_envs" in word for job in here for word in job.arguments)
    together = plan_line([*LINE, "policy=memobench_strict", "device=cpu", "batch_size=0", "shards=2"])
    for job in plan_shards(together, (), print):  # ten rows in one process, in parts too
        settings = plan_line(job.arguments[1:]).settings
        assert (settings.batch_size, settings.use_async_envs) == (together.batch, False)
    with pytest.raises(MemobenchError, match="4 batches"):
        plan_shards(plan_line([*LINE, "shards=9"]), (), print)


@pytest.mark.slow
def test_the_process_of_a_part_ends_with_its_parent(tmp_path: Path) -> None:
    words = ["eval", "env=memobench", f"tasks={STOVE}", "episodes=50", "output_dir=out", "shard=1/1", "batch_size=1"]
    process = subprocess.Popen([sys.executable, *SHARD_PROGRAM, *words], cwd=tmp_path, stdin=subprocess.PIPE)
    while not (tmp_path / "out" / "shard-1-of-1" / "evaluation.json").exists():
        assert process.poll() is None
    process.stdin.close()
    assert process.wait(60) == 1


@pytest.mark.slow
def test_a_failed_part_names_its_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["eval", "env=memobench", f"tasks={STOVE}", "episodes=1", f"output_dir={tmp_path / 'out'}", "shards=1"]
    assert lerobot([*words, "policy=memobench_remote", "host=127.0.0.1", "port=1", "policy.connect_timeout=0.1"]) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in ("part 1/1 ended with", "127.0.0.1:1", "resume=true"))
