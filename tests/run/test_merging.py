"""Parts become one evaluation, or the reason why they are none is named."""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, read_episodes
from lerobot_memobench.envs.evaluation_file import read_evaluation, write_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.records import read_protocol
from lerobot_memobench.run.card import new_card, policy_facts, write_card
from lerobot_memobench.run.machine import run_facts
from lerobot_memobench.run.merging import merge, merge_and_report, part_folders
from tests.support.logs import SETTINGS


def part(folder: Path, episodes: list[int], task: str = "a", settings: Any = SETTINGS, **changes: Any) -> Path:
    """Write a part: its log with protocol, its films, its card."""
    log = EpisodeLog(folder, settings and partial(write_protocol, folder, settings))
    for k in episodes:
        log.append(
            {
                "task": task,
                "memory_type": "temporal",
                "episode": k,
                "seed": 7 + k,
                "referent": "fixed",
                "success": True,
                "steps": 100 + k,
                "checkpoints": [{"operation": "S", "first_step": 3, "ordered_step": 3}],
                "scene_hash": f"{k}",
                "wall_s": 1.0,
                **changes,
            }
        )
        film = folder / "videos" / f"{task}.{k}.mp4"
        film.parent.mkdir(exist_ok=True)
        film.write_text(f"film {k}")
        reads = folder / "memory_reads" / f"{task}.{k}.json.gz"
        reads.parent.mkdir(exist_ok=True)
        reads.write_text(f"reads {k}")
    return folder


def with_card(folder: Path, shard: str, policy: str = "act", task_hash: str = "1") -> Path:
    card = new_card(
        protocol={**SETTINGS, "tasks": ["a"], "episodes": 4},
        policy=policy_facts({"type": policy}, 7),
        checkpoint=None,
        trained_on=None,
        task_files={"a": task_hash},
        settings={"env": {"tasks": "a"}},
        runs=[run_facts(["lerobot", "eval", f"shard={shard}"], 1)],
        shard=shard,
    )
    write_card(folder, card)
    return folder


def test_logs_films_protocol_and_card_are_joined(tmp_path: Path) -> None:
    parts = [with_card(part(tmp_path / f"p{k}", [k, k + 2]), f"{k + 1}/2") for k in range(2)]
    out = tmp_path / "out"
    assert merge(out, parts) == []
    assert [record["episode"] for record in read_episodes(out)] == [0, 1, 2, 3]
    assert read_protocol(out) == {**SETTINGS, "tasks": ["a"], "episodes": 4, "policy": policy_facts({"type": "act"}, 7)}
    assert sorted(path.name for path in (out / "videos").iterdir()) == [f"a.{k}.mp4" for k in range(4)]
    assert os.path.samefile(out / "videos" / "a.2.mp4", tmp_path / "p0" / "videos" / "a.2.mp4")
    assert [(out / "memory_reads" / f"a.{k}.json.gz").read_text() for k in range(4)] == [f"reads {k}" for k in range(4)]
    card = read_evaluation(out)
    assert len(card["episodes"]) == 4
    assert [run["command"][-1] for run in card["runs"]] == ["shard=1/2", "shard=2/2"]
    assert card["shard"] is None
    # Once more, and with a part that came later.
    before = (out / "evaluation.json").read_bytes(), (out / "episodes.jsonl").read_bytes()
    assert merge(out, parts) == []
    assert before == ((out / "evaluation.json").read_bytes(), (out / "episodes.jsonl").read_bytes())
    settings = {**SETTINGS, "policy": {"type": "act", "identity": "act 1"}}
    assert merge(out, [part(tmp_path / "later", [0], task="b", settings=settings)]) == []
    assert len(read_episodes(out)) == 5
    assert set(read_evaluation(out)) == {"format", "protocol"}  # a card would say nothing of the part without one


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    only = with_card(part(tmp_path / "p", [0, 2]), "1/2")
    assert merge(tmp_path / "out", [only]) == [("a", 1), ("a", 3)]


def test_the_same_episode_twice_counts_once(tmp_path: Path) -> None:
    parts = [part(tmp_path / "x", [0, 1]), part(tmp_path / "y", [1, 2], wall_s=77.0)]
    assert merge(tmp_path / "out", parts) == []
    assert [record["episode"] for record in read_episodes(tmp_path / "out")] == [0, 1, 2]
    assert set(read_evaluation(tmp_path / "out")) == {"format", "protocol"}  # parts without cards: no policy is known


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"success": False}, "episode 1: success is True in .*x and False in .*y"),
        ({"scene_hash": "other"}, "scene_hash is 1 in .*x and other in .*y"),
        ({"checkpoints": [{"operation": "S", "first_step": 4, "ordered_step": 4}]}, "first_step of checkpoint 1"),
    ],
)
def test_contradicting_parts_are_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    parts = [part(tmp_path / "x", [0, 1]), part(tmp_path / "y", [1, 2], **changes)]
    with pytest.raises(MemobenchError, match=words):
        merge(tmp_path / "out", parts)
    assert not (tmp_path / "out").exists()


def test_other_protocols_are_refused(tmp_path: Path) -> None:
    parts = [part(tmp_path / "x", [0]), part(tmp_path / "y", [1], settings={**SETTINGS, "horizon": 600})]
    with pytest.raises(MemobenchError, match="horizon: 1200 and 600"):
        merge(tmp_path / "out", parts)


def test_other_policies_and_task_files_are_refused(tmp_path: Path) -> None:
    first = with_card(part(tmp_path / "x", [0]), "1/2")
    other = with_card(part(tmp_path / "y", [1]), "2/2", policy="diffusion")
    with pytest.raises(MemobenchError, match=r"policy\.type: act and diffusion"):
        merge(tmp_path / "out", [first, other])
    with_card(other, "2/2", task_hash="2")
    with pytest.raises(MemobenchError, match="other task files"):
        merge(tmp_path / "out", [first, other])
    assert not (tmp_path / "out").exists()


def test_logs_alone_are_enough(tmp_path: Path) -> None:
    parts = [part(tmp_path / name, [k], settings=None) for k, name in enumerate("xy")]
    assert merge(tmp_path / "out", parts) == []
    assert not (tmp_path / "out" / "protocol.json").exists()
    mixed = part(tmp_path / "z", [2], settings=None, referent="random")
    with pytest.raises(MemobenchError, match="referent: fixed and random"):
        merge(tmp_path / "out", [mixed])


def test_episodes_of_nobody_are_not_given_to_a_policy(tmp_path: Path) -> None:
    """Neither by a card, nor by a protocol, nor by the lines beside theirs."""
    known = {**SETTINGS, "policy": {"type": "act", "identity": "act 1"}}
    old, out = part(tmp_path / "old", [2], settings=None), tmp_path / "out"
    sources = (
        with_card(part(tmp_path / "card", [0]), "1/2"),
        part(tmp_path / "protocol", [0], settings=known),
        part(tmp_path / "lines", [0], policy="act 1"),
    )
    for source in sources:
        for order in ([source, old], [old, source]):
            with pytest.raises(MemobenchError, match=f"{old} does not say whose episodes it holds, and {source} does"):
                merge(out, order)
    partly = part(part(tmp_path / "partly", [0], policy="act 1"), [1])
    with pytest.raises(MemobenchError, match=r"partly does not say whose .*, and some of its lines do"):
        merge(out, [partly])
    other = part(tmp_path / "other", [3], policy="act 2")
    with pytest.raises(MemobenchError, match=r"lines holds episodes of act 1 and .*other ones of act 2"):
        merge(out, [sources[2], other])
    assert not out.exists()
    nobodys = merge_and_report(out, [old, part(tmp_path / "older", [4], settings=None)]).run
    assert nobodys.notes == [f"{out} does not say whose episodes it holds: no part of it did"]
    whole = merge_and_report(tmp_path / "whole", [sources[1]]).run
    assert whole.notes == []
    protocol = "published suite, referent fixed, seed 7, 1 episode of a; inputs: not recorded"
    assert headline([nobodys]).startswith("policy not recorded: published suite, referent fixed, seeds ")
    assert headline([whole]) == f"act 1: {protocol}"


def test_copies_where_there_are_no_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_link(*_: Any) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", no_link)
    merge(tmp_path / "out", [part(tmp_path / "x", [0])])
    assert (tmp_path / "out" / "videos" / "a.0.mp4").read_text() == "film 0"


def test_parts_are_found_in_their_evaluations_folder(tmp_path: Path) -> None:
    for k in (2, 1):
        part(tmp_path / f"shard-{k}-of-2", [k])
    (tmp_path / "shard-3-of-3").mkdir()
    assert [folder.name for folder in part_folders(tmp_path)] == ["shard-1-of-2", "shard-2-of-2"]
    with pytest.raises(MemobenchError, match="name the folders"):
        merge(tmp_path, [])


def test_json_of_the_joined_log_is_whole(tmp_path: Path) -> None:
    merge(tmp_path / "out", [part(tmp_path / "x", [0, 1])])
    lines = (tmp_path / "out" / "episodes.jsonl").read_text().splitlines()
    assert [json.loads(line)["episode"] for line in lines] == [0, 1]
    assert "written_at" not in json.loads(lines[0])
