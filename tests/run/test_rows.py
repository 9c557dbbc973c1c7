"""Rows of the board are repeated, rollout by rollout, and evaluations of earlier versions without scene hashes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode_log import with_omitted
from lerobot_memobench.envs.settings import SCENE_HASHES
from lerobot_memobench.sim.scene_hash import SCENE_HASH_VERSION
from tests.support.fake_loop import STOVE, FakeLoop

BOARD = Path(__file__).parents[2] / "results" / "board"
ROWS = sorted(file.parent.name for file in BOARD.glob("*/evaluation.json"))
EARLIER = "an earlier version hashed scenes otherwise"


def first_rollout(card: dict[str, Any]) -> dict[str, Any]:
    """The card of an evaluation of its first rollout alone."""
    (episode, *_) = card["episodes"]
    task = episode["task"]
    found = card | {"task_files": {task: card["task_files"][task]}, "episodes": [episode]}
    found["protocol"] = card["protocol"] | {"tasks": [task], "episodes": 1}
    if "settings" in card:
        env = card["settings"]["env"] | {"tasks": task}
        return found | {"settings": card["settings"] | {"env": env, "episodes": 1}}
    others = [flag for flag in card["flags"] if not flag.startswith(("--env.tasks", "--eval.n_episodes"))]
    return found | {"flags": [*others, f"--env.tasks={task}", "--eval.n_episodes=1"]}


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_a_kept_rollout_of_each_row_is_repeated(row: str, tmp_path: Path) -> None:
    card = first_rollout(json.loads((BOARD / row / "evaluation.json").read_text()))
    if (version := with_omitted(card["protocol"])[SCENE_HASHES]) != SCENE_HASH_VERSION:
        pytest.xfail(f"{row}: {EARLIER} ({SCENE_HASHES} {version}); run it anew by scripts/renew_row.py")
    (tmp_path / "evaluation.json").write_text(json.dumps(card))
    assert main(["rerun", str(tmp_path), "--out", str(tmp_path / "again")]) == 0


COMMAND = ["eval", "env=memobench", f"tasks={STOVE}", "episodes=2", "policy=memobench_random"]


@pytest.mark.parametrize("earlier", [False, True])
def test_scenes_of_an_earlier_version_are_not_compared_by_hash(
    fake_loop: FakeLoop, earlier: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """By rerun, compare, merge and a resumed evaluation."""
    for out in ("before", "now"):
        assert lerobot([*COMMAND, f"output_dir={out}"]) == 0
    file = Path("before/evaluation.json")
    card = json.loads(file.read_text())
    assert card["protocol"][SCENE_HASHES] == SCENE_HASH_VERSION
    card["protocol"][SCENE_HASHES] -= earlier
    for line in (lines := [json.loads(each) for each in Path("before/episodes.jsonl").read_text().splitlines()]):
        line["scene_hash"] = "other"
    for episode in card["episodes"]:
        episode["scene_hash"] = "other"
    file.write_text(json.dumps(card))
    Path("before/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    for worker in Path("before/episodes").iterdir():
        worker.unlink()

    def said(*words: str) -> tuple[int, bool, str]:
        capsys.readouterr()
        status = (lerobot if words[0] == "eval" else main)(words)
        text = " ".join("".join(capsys.readouterr()).split())
        return status, EARLIER in text, text

    assert said("rerun", "before", "--out", "again")[:2] == (int(not earlier), earlier)
    assert said("compare", "before", "now", "--permutations", "100")[:2] == (0 if earlier else 2, earlier)
    assert said("merge", "both", "before", "now")[:2] == (2, earlier)
    assert not Path("both").exists()
    status, named, text = said(*COMMAND[:3], "episodes=3", COMMAND[-1], "output_dir=before", "resume=true")
    assert (status, named) == (2 if earlier else 0, earlier), text
