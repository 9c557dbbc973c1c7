"""The result card: what identifies an evaluation, and whether two agree."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest

from lerobot_memobench.envs.episode import referent_of
from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.envs.evaluation_file import read_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import disagreement, outcome
from lerobot_memobench.run.card import (
    checkpoint_files,
    extended,
    first_variant_mismatch,
    joined_runs,
    new_card,
    policy_facts,
    training_facts,
    tree_hash,
    with_checkpoint,
    with_episodes,
    write_card,
)
from lerobot_memobench.run.machine import run_facts
from lerobot_memobench.run.merging import merge
from lerobot_memobench.run.rerun import repeat
from lerobot_memobench.run.run import resumed_card
from lerobot_memobench.tasks.catalogue import get_task
from tests.support import logs


def record(task: str = "a_task", episode: int = 0, **changes: Any) -> dict[str, Any]:
    own = {
        "variant": 0,
        "replan_steps": None,
        "prompt_steps": 0,
        "steps": 100,
        "scene_hash": "0123456789abcdef",
        "wall_s": 1.5,
    }
    return logs.record(task, episode, [("S", 3, 3), ("U", 9, 9)], **own | changes)


def card(**changes: Any) -> dict[str, Any]:
    parts: dict[str, Any] = {
        "protocol": {"tasks": ["a"], "episodes": 2, "seed_base": 7, "referent": "fixed", "horizon": 1200},
        "policy": policy_facts({"type": "act", "chunk_size": 50, "device": "cuda"}, 7),
        "checkpoint": None,
        "trained_on": None,
        "task_files": {"a": "1"},
        "settings": {"env": {"tasks": "a"}, "policy": {"type": "act"}, "episodes": 2},
        "runs": [run_facts(["lerobot", "eval"], 2)],
    }
    return new_card(**{**parts, **changes})


@pytest.mark.parametrize("missing", ["tasks", "episodes"])
def test_an_evaluation_goes_on_only_from_a_card_that_says_what_was_asked_for(tmp_path: Path, missing: str) -> None:
    EpisodeLog(tmp_path).append(record("a"))
    now = card()
    write_card(tmp_path, {**now, "protocol": {key: now["protocol"][key] for key in now["protocol"] if key != missing}})
    with pytest.raises(MemobenchError, match=f"evaluation.json: found no {missing} in protocol"):
        resumed_card(tmp_path, now, print)
    with pytest.raises(MemobenchError, match=f"evaluation.json: found no {missing} in protocol"):
        merge(tmp_path / "out", [tmp_path])


def test_a_card_is_read_back_as_it_was(tmp_path: Path) -> None:
    full = with_episodes(card(), [record("a", k) for k in range(3)])
    write_card(tmp_path, full)
    assert read_evaluation(tmp_path, whole=True) == json.loads(json.dumps(full))
    text = (tmp_path / "evaluation.json").read_text()
    assert sum('"scene_hash"' in line for line in text.splitlines()) == 3  # one episode a line
    write_card(tmp_path, card())
    assert read_evaluation(tmp_path)["episodes"] == []


def test_an_outcome_leaves_out_the_clock() -> None:
    assert outcome(record()) == {k: v for k, v in record().items() if k not in ("wall_s", "replan_steps")}


# --- hashes ---


def test_the_hash_of_a_checkpoint_is_that_of_sha256sum(tmp_path: Path) -> None:
    (tmp_path / "b.json").write_text("two")
    (tmp_path / "a.safetensors").write_text("one")
    (tmp_path / "train_config.json").write_text("no part of the policy")
    files = checkpoint_files(tmp_path)
    assert files["a.safetensors"] == hashlib.sha256(b"one").hexdigest()
    listing = subprocess.run(
        ["sha256sum", "a.safetensors", "b.json"], cwd=tmp_path, capture_output=True, check=True
    ).stdout
    assert tree_hash(files) == hashlib.sha256(listing).hexdigest()


def test_where_a_policy_runs_is_no_part_of_it() -> None:
    facts = policy_facts({"type": "act", "chunk_size": 50, "device": "cuda", "pretrained_path": "/somewhere"}, 7)
    assert facts == {"type": "act", "seed": 7, "settings": {"chunk_size": 50}}


def test_eyes_that_find_objects_are_part_of_a_policy(tmp_path: Path) -> None:
    file = tmp_path / "detector.safetensors"
    file.write_bytes(b"one")
    settings = {"type": "memobench_mem", "perception": "objects", "detector": str(file)}
    assert policy_facts(settings, 7)["detector_sha256"] == hashlib.sha256(b"one").hexdigest()
    assert "detector_sha256" not in policy_facts({**settings, "detector": None}, 7)
    pixels = {**settings, "perception": "pixels", "detector": None, "visual_encoder": str(file)}
    assert "detector_sha256" not in policy_facts(pixels, 7), "a checkpoint holds its encoder"
    file.unlink()
    with pytest.raises(MemobenchError, match="there is no file"):
        policy_facts(settings, 7)


def test_the_dataset_that_a_policy_was_trained_on(tmp_path: Path) -> None:
    assert training_facts(tmp_path) is None
    data = tmp_path / "data"
    (data / "meta").mkdir(parents=True)
    (data / "meta" / "info.json").write_text("{}")
    told = {"dataset": {"repo_id": "a/b", "root": str(data), "revision": "v1"}, "steps": 50}
    (tmp_path / "train_config.json").write_text(json.dumps(told))
    facts = training_facts(tmp_path)
    assert facts is not None
    assert (facts["repo_id"], facts["revision"], facts["steps"]) == ("a/b", "v1", 50)
    (data / "manifest.json").write_text("{}")
    changed = training_facts(tmp_path)
    assert changed is not None
    assert changed["sha256"] != facts["sha256"]
    told["dataset"]["root"] = 5000 * "a"
    (tmp_path / "train_config.json").write_text(json.dumps(told))
    elsewhere = training_facts(tmp_path)
    assert elsewhere is not None
    assert "sha256" not in elsewhere, "a name that no file system takes is one of a dataset that is not here"
    (tmp_path / "train_config.json").write_text("{}")
    assert training_facts(tmp_path) is None


def test_this_machine_is_described() -> None:
    facts = run_facts(["lerobot"], 3)
    assert {"python", "lerobot", "mujoco", "robosuite", "torch", "lerobot_policy_memobench"} <= set(facts["versions"])
    assert "not installed" not in facts["versions"].values()
    assert facts["machine"]["cpu"]
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True)
    if head.returncode == 0:
        assert facts["git_commit"].startswith(head.stdout.strip())


# --- several runs ---


def test_equal_runs_are_counted() -> None:
    a, b = {"command": ["x"], "batch_size": 1}, {"command": ["y"], "batch_size": 1}
    assert joined_runs([a, b, a, a]) == [{**a, "times": 3}, {**b, "times": 1}]
    assert joined_runs([{**a, "times": 3}, a]) == [{**a, "times": 4}]
    assert joined_runs([{**a, "times": 3}, a], again=False) == [{**a, "times": 3}]


def test_a_wider_evaluation() -> None:
    wide = card(protocol={"tasks": ["b"], "episodes": 5, "seed_base": 7}, task_files={"b": "2"})
    both = extended(card(), wide)
    assert (both["protocol"]["tasks"], both["protocol"]["episodes"]) == (["a", "b"], 5)
    assert both["protocol"]["horizon"] == 1200
    assert both["task_files"] == {"a": "1", "b": "2"}
    assert both["settings"] == {"env": {"tasks": "a,b"}, "policy": {"type": "act"}, "episodes": 5}
    assert both["runs"][0]["times"] == 2
    assert extended(card(shard="1/2"), card(shard="1/2"))["shard"] == "1/2"
    assert extended(card(shard="1/2"), card(shard="2/2"))["shard"] is None


# --- agreement ---


def test_records_agree_whatever_the_clock_says() -> None:
    assert disagreement(record(), record(wall_s=9.0)) is None
    assert disagreement(outcome(record()), record()) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"success": False}, "success is True on the card and False here"),
        ({"scene_hash": "x"}, "scene_hash is 0123456789abcdef on the card and x here"),
        ({"steps": 99}, "steps is 100 on the card and 99 here"),
        ({"seed": 9}, "seed is 7 on the card and 9 here"),
        ({"checkpoints": []}, "checkpoints is"),
        (
            {
                "checkpoints": [
                    {"operation": "S", "first_step": 3, "ordered_step": 3},
                    {"operation": "U", "first_step": 9, "ordered_step": 11},
                ]
            },
            "ordered_step of checkpoint 2 is 9 on the card and 11 here",
        ),
    ],
)
def test_the_first_disagreement_is_named(changes: dict[str, Any], words: str) -> None:
    found = disagreement(record(), record(**changes), "on the card", "here")
    assert found is not None
    assert found.startswith("a_task, episode 0: ")
    assert words in found


def test_a_card_of_an_earlier_version_is_widened_into_settings() -> None:
    old = {**card(), "format": 1, "flags": ["--env.type=memobench"]}
    del old["settings"]
    both = extended(old, card(protocol={"tasks": ["a"], "episodes": 5, "seed_base": 7}))
    assert (both["format"], both["settings"]["episodes"]) == (2, 5)
    assert "flags" not in both


# --- what is known of a model checkpoint before anything has been found ---

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def test_a_repository_is_known_once_it_has_been_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = tmp_path / "models--user--name" / "snapshots" / COMMIT
    snapshot.mkdir(parents=True)
    cached = lambda repo, name: str(snapshot / name) if (snapshot / name).exists() else None  # noqa: E731
    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", cached)
    card: dict[str, Any] = {"policy": {"type": "act"}, "checkpoint": None, "trained_on": None}
    assert with_checkpoint(card, None) == card
    assert with_checkpoint(card, "user/name") == card
    (snapshot / "config.json").write_text("{}")  # the configuration comes first, the weights when the policy is made
    assert with_checkpoint(card, "user/name") == card
    (snapshot / "model.safetensors").write_bytes(b"weights")
    found = with_checkpoint(card, "user/name")
    assert sorted(found["checkpoint"]["files"]) == ["config.json", "model.safetensors"]
    assert found["checkpoint"]["revision"] == COMMIT
    assert len(found["policy"]["sha256"]) == 64


def test_episodes_that_drew_their_variants_otherwise_are_neither_gone_on_with_nor_repeated(tmp_path: Path) -> None:
    bowl = "put_the_butter_into_the_bowl_from_the_prompt_video"
    here = {seed: referent_of(get_task(bowl), seed).variant_index for seed in (7, 8)}
    lines = [record(bowl, seed - 7, seed=seed, referent="random", variant=k) for seed, k in here.items()]
    assert first_variant_mismatch(lines) is None
    assert first_variant_mismatch([record("of_my_own", variant=5, referent="random", seed=7)]) is None
    assert first_variant_mismatch([record(bowl, variant=5, referent="random", seed=-7)]) is None, "no scene of ours"
    other = (here[8] + 1) % 3
    lines[1] = lines[1] | {"variant": other}
    told = f"{bowl}, episode 1: variant {other} there, {here[8]} by its seed here"
    for line in lines:
        EpisodeLog(tmp_path).append(line)
    write_card(tmp_path, with_episodes(card(), lines))
    with pytest.raises(MemobenchError, match=f"drew their variants otherwise .{told}.: an earlier version"):
        resumed_card(tmp_path, card(), print)
    with pytest.raises(MemobenchError, match=f"{told}.*repeat it with that version"):
        repeat(tmp_path, None, None, lambda plan: 0, print)
    for name, line in zip(("part", "old"), lines, strict=True):
        EpisodeLog(tmp_path / name).append(line)
    with pytest.raises(MemobenchError, match=r"old drew their variants otherwise than .*leave that folder out"):
        merge(tmp_path / "out", [tmp_path / "part", tmp_path / "old"])
