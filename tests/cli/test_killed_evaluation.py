"""An evaluation killed twenty times and gone on with ends as one that nobody disturbed."""

from __future__ import annotations

import hashlib
import json
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import pytest

from lerobot_memobench.envs.episode_log import has_log, read_episodes
from tests.support.fork_server import Fork, ForkServer

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3 * 3600)]

TASKS = "turn_on_the_stove_and_turn_it_off,check_the_top_drawer_of_the_cabinet"
KILLS = 20
COMMON = ["env=memobench", "env.render=fast", "env.videos=-1", "batch_size=2"]
COMMON += ["eval.use_async_envs=false"]  # rows in one process: workers would start for longer than an episode lasts

#: Within the horizon the expert reaches the stove's first checkpoint in some episodes. The random policy draws from a
#: generator of its own; what it drew shows in the films.
EXPERT = [f"tasks={TASKS}", "episodes=6", "horizon=70", "env.render_every=10"]
RANDOM = [f"tasks={TASKS}", "policy=memobench_random", "episodes=6", "horizon=40"]
#: Each scene with each variant, and a pause within 120 steps.
PACED = ["policy=memobench_random", "evidence=true", "referent=random", "episodes=6", "horizon=130", "pause_steps=10"]
PACED += ["tasks=put_the_butter_into_the_bowl_from_the_prompt_video", "demonstration_prompt=false"]

IMPORTED = ("lerobot.scripts.lerobot_eval", "lerobot_memobench.envs.memobench_env")
IMPORTED += ("lerobot_memobench.datasets.generation", "lerobot_memobench.cli.lerobot")


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    """Starting Python and importing LeRobot takes longer than an episode."""
    forks = ForkServer(IMPORTED)
    yield forks
    forks.close()


def start(server: ForkServer, out: Path, settings: list[str], resume: bool = True) -> Fork:
    words = ["eval", *COMMON, *settings, f"output_dir={out}", *(["resume=true"] if resume else [])]
    code = f"from lerobot_memobench.cli.lerobot import main; raise SystemExit(main({words!r}))"
    return server.start(code, out.with_suffix(".txt"))


def episodes_in(out: Path) -> int:
    return len(read_episodes(out)) if has_log(out) else 0


def kill_sometime(process: Fork, out: Path, rng: random.Random, run_s: float) -> bool:
    """Kill a run at a random moment; return whether there still was one.

    A third of the kills fall anywhere in the time that an undisturbed run takes, the others soon after an episode has
    ended, where the writing is.
    """
    before = episodes_in(out)
    if rng.random() < 1 / 3:
        deadline = time.monotonic() + rng.uniform(0, run_s)
    else:
        while process.poll() is None and episodes_in(out) == before:
            time.sleep(0.01)
        deadline = time.monotonic() + rng.choice([0, rng.uniform(0, 0.1), rng.uniform(0, run_s / 4)])
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    if process.poll() is not None:
        return False
    return process.kill()


def comparable(out: Path) -> list[dict[str, Any]]:
    problems: list[str] = []
    records = read_episodes(out, problems)
    assert not problems
    return [{key: value for key, value in record.items() if key not in ("wall_s", "run")} for record in records]


def film_hashes(out: Path) -> dict[str, str]:
    """VideoRecorder -> hash of its frames."""
    found = {}
    for path in sorted((out / "videos").glob("*.mp4")):
        digest = hashlib.sha256()
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                digest.update(frame.to_ndarray(format="rgb24").tobytes())
        found[path.name] = digest.hexdigest()
    return found


@pytest.mark.parametrize("settings", [EXPERT, RANDOM, PACED], ids=["expert", "random", "evidence and pauses"])
def test_killed_and_gone_on_with(server: ForkServer, tmp_path: Path, settings: list[str]) -> None:
    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    began = time.monotonic()
    assert start(server, undisturbed, settings, resume=False).wait() == 0
    run_s = time.monotonic() - began
    reference = comparable(undisturbed)
    assert settings is not PACED or all(each["paused_steps"] and "variants" in each for each in reference)

    rng = random.Random(f"{settings}")
    kills, history = 0, []
    while kills < KILLS:
        process = start(server, killed, settings)
        if not kill_sometime(process, killed, rng, run_s):
            assert process.wait() == 0
            assert len(comparable(killed)) == len(reference)
            # All was done: take some episodes away, as if the disk had been lost at an earlier kill.
            forget(killed, rng.sample(range(len(reference)), len(reference) // 2))
            continue
        kills += 1
        history.append(episodes_in(killed))
        print(kills, history[-1], flush=True)
    assert start(server, killed, settings).wait() == 0

    print(f"{kills} kills of runs that take {run_s:.0f} s; episodes in the log after each: {history}")
    assert comparable(killed) == reference
    assert film_hashes(killed) == film_hashes(undisturbed)
    report = json.loads((killed / "report.json").read_text())
    assert report == json.loads((undisturbed / "report.json").read_text())
    assert (
        json.loads((killed / "evaluation.json").read_text())["episodes"]
        == json.loads((undisturbed / "evaluation.json").read_text())["episodes"]
    )
    assert not [path for path in killed.rglob("*") if path.name.endswith(".part")]


def forget(out: Path, numbers: list[int]) -> None:
    """Take episodes out of a log."""
    records = read_episodes(out)
    kept = [record for number, record in enumerate(records) if number not in numbers]
    for file in (out / "episodes").glob("*.jsonl"):
        file.unlink()
    (out / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in kept))
    for record in (records[number] for number in numbers):
        (out / "videos" / f"{record['task']}.{record['episode']}.mp4").unlink()
