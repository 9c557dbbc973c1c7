"""The benchmark in vla-evaluation-harness gives the same episodes as `lerobot eval`, bit for bit."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import vla_eval
import yaml
from vla_eval.config import EvalConfig
from vla_eval.registry import resolve_import_string
from vla_eval.specs import check_specs

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.constants import EXECUTION, NO_CLOCK
from lerobot_memobench.envs import episode as episodes
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import report_values, summary_of
from lerobot_memobench.vla_eval import MEMOBench
from tests.support.policy_server import free_port
from tests.support.vla_eval_server import DigestServer

ROOT = Path(__file__).parents[2]
PROMPTED = "put_the_butter_into_the_bowl_from_the_prompt_video"
UNPROMPTED = "turn_on_the_stove_and_turn_it_off"
HIGHLIGHT = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
METRICS = {"success": "SR", "MSR": "MSR", "MUR": "MUR", "MCR": "MCR"}
"""The harness's name of a metric -> our report's."""
Steps = dict[tuple[str, int], list[tuple[list[float], str, bool]]]
"""Task and seed -> per execution step the action, a hash of the scene after it, and success."""


@contextmanager
def recorded(monkeypatch: pytest.MonkeyPatch) -> Iterator[Steps]:
    """Record the execution steps of environments in this process."""
    found: Steps = {}
    step = MemobenchEnv.step

    def noted(env: MemobenchEnv, action: Any) -> Any:
        acting = env.episode.phase == EXECUTION
        result = step(env, action)
        if acting:
            row = ([float(each) for each in action], env.scene_hash(), result[4]["is_success"])
            found.setdefault((env.task, env.episode.seed), []).append(row)
        return result

    with monkeypatch.context() as patched:
        patched.setattr(MemobenchEnv, "step", noted)
        yield found


def by_harness(url: str, episodes: int = 1, **params: Any) -> dict[str, Any]:
    """Run the benchmark by vla-evaluation-harness's own runner; return its result."""
    benchmark = {
        "benchmark": "lerobot_memobench.vla_eval:MEMOBench",
        "episodes_per_task": episodes,
        "params": {"seed": 7, **params},
    }
    (result,) = vla_eval.run(
        {"server": {"url": url, "timeout": 120}, "benchmarks": [benchmark]}, docker=False, no_save=True
    )
    return result


def by_lerobot(out: Path, *words: str, episodes: int = 1) -> None:
    settings = (f"episodes={episodes}", "eval.use_async_envs=false", f"output_dir={out}")
    assert main(["eval", "env=memobench", *settings, *words]) == 0


def log_of(folder: Path) -> list[dict[str, Any]]:
    """Return the log without time, policy and run."""
    own = {"wall_s", "policy", "run"}
    return [{key: value for key, value in record.items() if key not in own} for record in read_episodes(folder)]


def test_harness_and_lerobot_run_the_same_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server derives its actions from every bit that it receives, including the prompt."""
    monkeypatch.setattr(episodes, "PROMPT_HORIZON", 7)
    server = DigestServer(steps=3)
    with vla_eval.serve_background(server) as handle:
        with recorded(monkeypatch) as theirs:
            params = {"tasks": [PROMPTED], "horizon": 5, "history_every": 3}
            result = by_harness(handle.url, episodes=2, **params, log_dir=str(tmp_path / "log"), label="digest")
        heard, server.heard = server.heard, []
        with recorded(monkeypatch) as ours:
            words = ("policy=memobench_remote", "dialect=vla_eval", f"port={handle.port}", "batch_size=2")
            tasks = (f"tasks={PROMPTED}", "horizon=5", "policy.history_every=3")
            by_lerobot(tmp_path / "run", *words, *tasks, episodes=2)
    assert set(theirs) == {(PROMPTED, 7), (PROMPTED, 8)}
    assert [len(steps) for steps in theirs.values()] == [5, 5]
    assert len({str(steps) for steps in theirs.values()}) == 2
    assert ours == theirs
    assert sorted(len(obs.get("video_history", ())) for _, _, obs in heard) == [0, 0, 3, 3]
    assert len(server.heard) == len(heard) == 4
    assert log_of(tmp_path / "log") == log_of(tmp_path / "run")
    values = report_values(summary_of(read_episodes(tmp_path / "log")))
    (task,) = result["tasks"]
    row = values["tasks"][task["task"]]
    assert row["n"] == task["num_episodes"] == 2
    for name, metric in METRICS.items():
        value = task.get(f"mean_{name}")
        assert row[metric] == (None if value is None else 100 * value)


@pytest.fixture
def benchmarks() -> Iterator[Callable[..., MEMOBench]]:
    """Return a function that makes benchmarks; they are closed after the test."""
    made = []

    def make(*tasks: Any, **params: Any) -> MEMOBench:
        made.append(MEMOBench(*tasks, **params))
        made[-1]._recorder = vla_eval.recording.NullEpisodeRecorder()
        return made[-1]

    yield make
    for benchmark in made:
        benchmark.cleanup()


def played(benchmark: MEMOBench, number: int = 0, expert: bool = False) -> tuple[dict[str, Any], dict[str, Any]]:
    """Play an episode as the harness does; return the first observation and the result."""
    task = benchmark.get_tasks()[0] | {"episode_idx": number}
    first = benchmark.make_obs(benchmark.reset(task), task)
    running = benchmark._running()
    running.need_observation(False)
    while True:
        last = benchmark.step({"actions": running.episode.expert_action() if expert else np.zeros(7)})
        if benchmark.check_done(last):
            return first, benchmark.get_step_result(last)


Make = Callable[..., MEMOBench]


def test_frames_at_rest_after_a_prompt_are_not_sent(benchmarks: Make) -> None:
    first, _ = played(benchmarks(HIGHLIGHT, suite="strict", replan_steps=1, horizon=1, seed=20_000))
    assert first["step"].tolist() == [NO_CLOCK]
    assert len(first["video_history"]) == len(first["state_history"]) == 66, "the highlight only"
    assert not np.array_equal(first["video_history"][30], first["images"]["agentview"])


def test_contents_of_observations_and_specs(benchmarks: Make) -> None:
    less = benchmarks(UNPROMPTED, horizon=1, send_state=False, convention="libero")
    plain = benchmarks(UNPROMPTED, horizon=1)
    assert less.get_tasks() == [{"name": UNPROMPTED, "suite": "temporal"}]
    (first, _), (whole, _) = played(less), played(plain)
    assert set(first) == {"images", "task_description", "step"}
    assert set(whole) == {"images", "task_description", "states", "step"}
    assert whole["step"].tolist() == [0]
    assert list(whole["images"]) == ["agentview", "wrist"]
    for camera in whole["images"]:
        assert np.array_equal(first["images"][camera], whole["images"][camera][:, ::-1])
    sizes, names = {"observation_height": 96, "observation_width": 64}, {"agentview_image": "camera1"}
    other = benchmarks(UNPROMPTED, horizon=1, convention="libero", camera_name_mapping=names, robot_state=True, **sizes)
    asked, _ = played(other)
    assert {name: image.shape for name, image in asked["images"].items()} == {
        "agentview": (96, 64, 3),
        "wrist": (96, 64, 3),
    }
    assert np.allclose(asked["robot_state"]["eef"]["pos"], asked["states"][:3])
    declared = plain.get_observation_spec()
    assert check_specs(plain.get_action_spec(), plain.get_action_spec(), declared, declared) == []
    assert set(declared) == {"agentview", "wrist", "language", "state"}
    assert set(less.get_observation_spec()) == {"agentview", "wrist", "language"}
    assert list(benchmarks(UNPROMPTED, send_wrist_image=False).get_observation_spec()) == [
        "agentview",
        "language",
        "state",
    ]
    held = plain.get_hold_action({"actions": np.full((2, 7), 0.5)})["actions"]
    assert held.tolist() == [0] * 6 + [0.5]
    assert len(MEMOBench().get_tasks()) == 30
    assert {task["suite"] for task in MEMOBench("object", suite="strict", n_action_steps=8).get_tasks()} == {"object"}
    assert MEMOBench(horizon=9).get_metadata()["max_steps"] == 9


@pytest.mark.parametrize(
    ("params", "named"),
    [
        ({"history_every": 0}, "history_every"),
        ({"seed": 100_007}, "test-sealed"),
        ({"obs_type": "both"}, "send_state"),
        ({"suite": "strict"}, "set replan_steps"),
        ({"n_action_steps": 4, "replan_steps": 6}, "multiple of n_action_steps=4"),
    ],
)
def test_wrong_settings_are_named(params: dict[str, Any], named: str) -> None:
    with pytest.raises(MemobenchError, match=named):
        MEMOBench(**params)


def test_the_server_states_the_convention_of_its_policy(benchmarks: Make) -> None:
    """The harness hands it over as an argument, unless the configuration names it too."""
    server = DigestServer()
    server.get_observation_params = lambda: {"trained_convention": "libero"}  # type: ignore[method-assign]
    with vla_eval.serve_background(server) as handle:
        by_harness(handle.url, tasks=[UNPROMPTED], horizon=1)
        images = server.heard[0][2]["images"]
        with pytest.raises(MemobenchError, match="expects images of convention=libero, and found convention=upright"):
            by_harness(handle.url, tasks=[UNPROMPTED], horizon=1, convention="upright")
    first, _ = played(benchmarks(UNPROMPTED, horizon=1))
    assert all(np.array_equal(images[name], first["images"][name][:, ::-1]) for name in ("agentview", "wrist"))
    assert MEMOBench(trained_convention="upright").get_tasks()
    with pytest.raises(MemobenchError, match="did you mean 'libero'"):
        MEMOBench(trained_convention="liberu")


def configuration() -> dict[str, Any]:
    """Return the configuration in the guide."""
    text = (ROOT / "docs" / "guides" / "vla_eval.md").read_text()
    found = yaml.safe_load(text.split("```yaml\n")[1].split("```")[0])
    assert isinstance(found, dict)
    return found


def test_configuration_in_the_guide_is_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = EvalConfig.from_dict(configuration()["benchmarks"][0])
    assert len(resolve_import_string(config.benchmark)(**config.params).get_tasks()) == 30
    assert (config.episodes_per_task, config.params["seed"]) == (50, 7)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_trained_memory_policy_by_three_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With and without a prompt: by ``vla-eval run``, by ``dialect=vla_eval``, and in this process."""
    tasks, port = [PROMPTED, UNPROMPTED], free_port()
    script = [sys.executable, str(ROOT / "examples" / "vla_eval_server.py"), "memobench_strict"]
    server = subprocess.Popen([*script, "--detector", "package", "--port", str(port), "--device", "cpu"])
    try:
        words = (f"tasks={','.join(tasks)}", "batch_size=1")
        with recorded(monkeypatch) as asked:
            remote = ("policy=memobench_remote", "dialect=vla_eval", f"port={port}", "policy.connect_timeout=300")
            by_lerobot(tmp_path / "remote", *remote, *words)
        config = configuration()
        config["benchmarks"][0] |= {"episodes_per_task": 1}
        published = {"suite": "published", "replan_steps": 1, "tasks": tasks}  # the guide's are strict
        config["benchmarks"][0]["params"] |= {**published, "log_dir": str(tmp_path / "log")}
        config["output_dir"] = str(tmp_path / "results")
        (tmp_path / "memobench.yaml").write_text(yaml.safe_dump(config))
        command = [str(Path(sys.executable).with_name("vla-eval")), "run", "--no-docker", "-c", "memobench.yaml"]
        subprocess.run([*command, "--server-url", f"ws://127.0.0.1:{port}"], cwd=tmp_path, check=True)
    finally:
        server.kill()
        server.wait()
    with recorded(monkeypatch) as direct:
        by_lerobot(tmp_path / "direct", "policy=memobench_strict", "detector=package", *words)
    assert direct == asked
    logs = [log_of(tmp_path / name) for name in ("direct", "remote", "log")]
    for record in logs[0]:
        assert (record.pop("inputs"), record.pop("replan_steps")) == ("detections", 6)
    for record in (*logs[1], *logs[2]):
        assert (record.pop("inputs"), record.pop("replan_steps")) == ("pixels", 1)
    assert logs[0] == logs[1] == logs[2]
    for number, task in enumerate(tasks):
        (file,) = (tmp_path / "results/episodes/MEMOBench").glob(f"task{number:04d}_ep0000_*.jsonl")
        rows = [json.loads(line) for line in file.read_text().splitlines()]
        assert [row["action"] for row in rows] == [action for action, _, _ in direct[task, 7]]
