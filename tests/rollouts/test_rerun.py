"""A card is data: a stranger's card stays on this machine, and our own cards are repeated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.constants import SCENE_HASH_VERSION
from lerobot_memobench.envs.episode_log import log_text, read_lines, write_episodes
from lerobot_memobench.envs.evaluation_file import read_evaluation, write_evaluation
from lerobot_memobench.envs.settings import SCENE_HASHES
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash
from lerobot_memobench.perception.detector import SHIPPED
from lerobot_memobench.policies.checkpoint import checkpoint_files, tree_hash
from lerobot_memobench.rollouts import rerun
from lerobot_memobench.rollouts.plan import EvaluationSettings, card_settings, plan_line
from lerobot_memobench.rollouts.rerun import (
    allowed_settings,
    check_policy,
    differences_here,
    read_repeatable,
)
from tests.support import logs
from tests.support.fake_loop import DRAWER, STOVE, FakeLoop, make_checkpoint

COUNTING = "turn_the_stove_on_and_off_a_given_number_of_times"
ONE = {"tasks": [STOVE], "episodes": 1}
RECORD = {"task": STOVE, "memory_type": "temporal", "episode": 0, "seed": 7, "success": True, "checkpoints": []}


@pytest.fixture(autouse=True, scope="module")
def in_folder(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An empty folder, and no search of all installed packages."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lerobot_memobench.commands.command_line.register_plugins", lambda: None)
        patch.chdir(tmp_path_factory.mktemp("here"))
        make_checkpoint(Path("checkpoint"))
        yield


def card(settings: Any, **changes: Any) -> dict[str, Any]:
    return logs.card(**{"protocol": ONE, "settings": settings} | changes)


def allowed(server: str | None = None, **settings: Any) -> EvaluationSettings:
    return allowed_settings(card_settings(card(settings)), server)


RANDOM = {"env": {"tasks": STOVE}, "policy": {"type": "memobench_random"}}


def policy(kind: str, **settings: Any) -> dict[str, Any]:
    return {"policy": {"type": kind, **settings}}


HOSTILE: list[tuple[str, dict[str, Any]]] = [
    ("env", {"env": ["tasks"]}),
    ("env.tasks", {"env": {"tasks": "../../elsewhere"}}),
    ("env.task_dir", {"env": {"task_dir": "/no/such/folder"}}),
    ("env.log_dir", {"env": {"log_dir": "elsewhere"}}),
    ("env.horizon", {"env": {"horizon": 1_000_000}}),
    ("policy", {"policy": "memobench_random"}),
    ("policy.path", {"policy": {"path": "stranger/policy"}}),
    ("policy.path", {"policy": {"path": "a" * 5000}}),
    ("policy.seed", policy("memobench_random", seed=[3])),
    ("policy.down_dims", policy("diffusion", down_dims=[16, "x"])),
    ("policy.seed", policy("memobench_random", seed="!!python/object/apply:os.system [x]")),
    ("policy.discover_packages_path", policy("act", discover_packages_path="antigravity")),
    ("policy.trust_remote_code", policy("memobench_random", trust_remote_code="true")),
    ("policy.push_to_hub", policy("memobench_random", push_to_hub="true")),
    ("policy.seed", policy("memobench_random", seed=True)),
    ("policy.repo_id", policy("act", repo_id="stranger/policy")),
    ("policy.base_weights", policy("memobench_mem", base_weights="stranger/weights")),
    ("policy.vision_backbone", policy("act", vision_backbone="resnet18")),
    ("policy.device", policy("act", device="cpu;x")),
    ("policy.device", policy("act", device="cuda:64")),
    ("policy.host", policy("memobench_remote", host="10.0.0.5")),
    ("policy.host", policy("memobench_remote", host="127.0.0.1@stranger.example")),
    ("policy.servers", policy("memobench_remote", servers="127.0.0.1:1,stranger.example:80")),
    ("stranger", policy("stranger")),
    ("episodes", {"episodes": 1_000}),
    ("batch_size", {"batch_size": 5000}),
    ("rename_map", {"rename_map": {"a": "b c"}}),
    ("output_dir", {"output_dir": "elsewhere"}),
]


@pytest.mark.parametrize(("named", "changes"), HOSTILE)
def test_hostile_settings_are_refused_by_name(named: str, changes: dict[str, Any]) -> None:
    write_evaluation(Path(), card({**RANDOM, **changes}))
    with pytest.raises(MemobenchError, match=named.replace(".", r"\.")) as caught:
        read_repeatable(Path("evaluation.json"))
    assert "\n" not in str(caught.value)


def test_the_device_of_a_card_may_be_missing_here(monkeypatch: pytest.MonkeyPatch) -> None:
    for there in (True, False):
        monkeypatch.setattr("lerobot_memobench.rollouts.rerun.has_device", lambda device, there=there: there)
        asked = allowed(env={"tasks": STOVE}, policy={"type": "memobench_random", "device": "cuda"})
        assert ("device" in asked.policy) == there


def test_a_card_names_only_a_server_of_this_machine() -> None:
    remote = policy("memobench_remote", host="10.0.0.5", port="8000")
    assert allowed("gpu1:9000", **remote).policy == {"type": "memobench_remote", "servers": "gpu1:9000"}
    assert allowed(**policy("memobench_remote", host="127.0.0.1")).policy["host"] == "127.0.0.1"
    with pytest.raises(MemobenchError, match="--server"):
        allowed("gpu1:9000", **RANDOM)


def test_checkpoint_and_detector_are_those_on_the_card(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun, "local_folder", lambda path: Path("checkpoint") if path == "user/name" else None)
    asked = allowed(policy={"path": "user/name"})
    assert asked.policy["path"] == str(Path("checkpoint").absolute())
    facts = {"sha256": tree_hash(checkpoint_files(Path("checkpoint")))}
    seeing = {"settings": {"perception": "objects", "detector": "package"}, "detector_sha256": file_hash(SHIPPED)}
    for known in (facts, facts | seeing):
        check_policy({"policy": known}, asked.policy["path"])
    for other, named in (
        ({}, "checkpoint"),
        (facts | {"sha256": "0" * 64}, "checkpoint"),
        (facts | seeing | {"detector_sha256": "0" * 64}, "detector package"),
        (facts | {"settings": seeing["settings"]}, "detector package"),
    ):
        with pytest.raises(MemobenchError, match=named):
            check_policy({"policy": other}, asked.policy["path"])


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"env": {"tasks": f"{STOVE},{DRAWER}"}}, "1 episodes of 2 tasks"),
        ({"env": {"tasks": STOVE, "horizon": 12_000, "pause_steps": 1000}}, "control steps"),
        ({}, "log lacks"),
    ],
)
def test_a_card_runs_no_more_than_its_episodes(settings: dict[str, Any], named: str) -> None:
    write_evaluation(Path(), card({**RANDOM, **settings}))
    write_episodes(Path(), [RECORD])
    with pytest.raises(MemobenchError, match=named):
        rerun.repeat(Path(), None, None, lambda plan: pytest.fail("it was run"), print)


@pytest.mark.parametrize("difficulty", ["standard", "extreme"])
def test_a_strict_card_may_be_held_as_long_as_the_protocol_says(difficulty: str) -> None:
    line = ["env=memobench", "suite=strict", f"difficulty={difficulty}", "replan=50", "pause_steps=100"]
    plan = plan_line([*line, f"tasks={COUNTING}", "episodes=1", "policy=memobench_random"])
    episodes = [{**RECORD, "task": COUNTING, "steps": 1}]
    rerun.check_extent(card({}, protocol={"tasks": [COUNTING], "episodes": 1}), episodes, plan)


@pytest.mark.parametrize("hold", [0, 1200])
def test_a_strict_card_of_another_version_is_refused(hold: int) -> None:
    asked = {"tasks": [COUNTING], "episodes": 1, "suite": "strict", "hold": hold}
    write_evaluation(Path(), card({**RANDOM, "env": {"tasks": COUNTING}}, protocol=asked))
    with pytest.raises(MemobenchError, match=f"another version .*hold: {hold} and"):
        rerun.repeat(Path(), None, None, lambda plan: pytest.fail("it was run"), print)


def test_other_versions_are_noted() -> None:
    (run,) = card(RANDOM)["runs"]
    assert differences_here({"runs": [run]}) == []
    (note,) = differences_here({"runs": [{**run, "versions": run["versions"] | {"mujoco": "0.1"}}]})
    assert "mujoco 0.1 (here " in note


# --- our own cards ---

COMMAND = ["eval", "env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4", "batch_size=2", "output_dir=out"]


def test_a_card_is_repeated_by_the_command(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_checkpoint(Path("checkpoint"))
    assert lerobot([*COMMAND, "seed=9", "horizon=600", f"policy={folder}"]) == 0
    assert main(["rerun", "out/evaluation.json", "--out", "again"]) == 0
    assert "repeated: 8 episodes" in capsys.readouterr().out
    assert fake_loop.plans[1].settings.portable == fake_loop.plans[0].settings.portable
    fake_loop.changed = {"steps": 5}
    assert main(["rerun", "out", "--out", "changed"]) == 1
    assert f"{DRAWER}, episode 0: steps" in capsys.readouterr().out.replace("\n", " ")
    save_file({"weight": np.ones(1, np.float32)}, folder / "model.safetensors")
    assert main(["rerun", "out", "--out", "other"]) == 2
    (folder / "config.json").unlink()
    assert main(["rerun", "out", "--out", "other"]) == 2
    assert "policy.path" in capsys.readouterr().err
    assert not Path("other").exists()


def test_a_part_is_repeated_as_a_part(fake_loop: FakeLoop) -> None:
    assert lerobot([*COMMAND, "shard=2/2"]) == 0
    fake_loop.ran.clear()
    assert main(["rerun", "out/shard-2-of-2/evaluation.json", "--out", "again"]) == 0
    assert fake_loop.ran == [(DRAWER, k) for k in range(4)]


CHANGES = {
    "only the first": (2, lambda lines: lines[:1]),
    "an episode more": (2, lambda lines: [*lines, {**lines[-1], "episode": 9, "seed": 16}]),
    "other outcome": (1, lambda lines: [{**lines[0], "success": not lines[0]["success"]}, *lines[1:]]),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_episode_of_a_log_is_compared(fake_loop: FakeLoop, change: str, capsys: Any) -> None:
    status, changed = CHANGES[change]
    assert lerobot(COMMAND) == 0
    write_evaluation(Path("kept"), read_evaluation(Path("out")))
    write_episodes(Path("kept"), changed(read_lines(Path("out"))))
    capsys.readouterr()
    assert main(["rerun", "kept/evaluation.json", "--out", "again"]) == status
    assert "\nrepeated: " not in capsys.readouterr().out
    assert Path("again").exists() == (status == 1), "an incomplete evaluation is not run"


# --- rows of the board ---

BOARD = Path(__file__).parents[2] / "results" / "board"
ROWS = sorted(file.parent.name for file in BOARD.glob("*/evaluation.json"))
OTHERWISE = "the versions hash scenes differently"


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_a_kept_rollout_of_each_row_is_repeated(row: str, tmp_path: Path) -> None:
    """Its first rollout alone."""
    card, (first, *_) = read_evaluation(BOARD / row), read_lines(BOARD / row)
    if (version := card["protocol"][SCENE_HASHES]) != SCENE_HASH_VERSION:
        pytest.xfail(f"{row}: {OTHERWISE} ({SCENE_HASHES} {version}); run it anew by scripts/renew_row.py")
    task = first["task"]
    protocol = card["protocol"] | {"tasks": [task], "episodes": 1}
    settings = card["settings"] | {"env": card["settings"]["env"] | {"tasks": task}}
    write_evaluation(tmp_path, card | {"protocol": protocol, "settings": settings})
    write_episodes(tmp_path, [first])
    assert main(["rerun", str(tmp_path), "--out", str(tmp_path / "again")]) == 0


TWO_EPISODES = ["eval", "env=memobench", f"tasks={STOVE}", "episodes=2", "policy=memobench_random"]


@pytest.mark.parametrize("other", [False, True])
def test_scenes_of_another_version_are_not_compared_by_hash(
    fake_loop: FakeLoop, other: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """By rerun, compare, merge and a resumed evaluation."""
    for out in ("before", "now"):
        assert lerobot([*TWO_EPISODES, f"output_dir={out}"]) == 0
    file = Path("before/evaluation.json")
    card = json.loads(file.read_text())
    assert card["protocol"][SCENE_HASHES] == SCENE_HASH_VERSION
    card["protocol"][SCENE_HASHES] -= other
    file.write_text(json.dumps(card))
    lines = [{**line, "scene_hash": "other"} for line in read_lines(Path("before"))]
    Path("before/episodes.jsonl").write_text(log_text(lines))
    for worker in Path("before/episodes").iterdir():
        worker.unlink()

    def said(*words: str) -> tuple[int, bool, str]:
        capsys.readouterr()
        status = (lerobot if words[0] == "eval" else main)(words)
        text = " ".join("".join(capsys.readouterr()).split())
        return status, OTHERWISE in text, text

    assert said("rerun", "before", "--out", "again")[:2] == (int(not other), other)
    assert said("compare", "before", "now", "--permutations", "100")[:2] == (0 if other else 2, other)
    assert said("merge", "both", "before", "now")[0] == 2
    assert not Path("both").exists()
    status, _, text = said(*TWO_EPISODES[:3], "episodes=3", TWO_EPISODES[-1], "output_dir=before", "resume=true")
    assert (status, SCENE_HASHES in text) == (2 if other else 0, other), text
