"""From a command line or a file to a plan: complete, typed, and checked before anything runs."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.constants import SPLITS
from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import shipped_policies
from lerobot_memobench.rollouts.card import card_of
from lerobot_memobench.rollouts.plan import (
    EvaluationPlan,
    Grid,
    Shard,
    plan_line,
)
from lerobot_memobench.rollouts.rerun import plan_of_evaluation, read_repeatable
from lerobot_memobench.sim import files
from tests.support.fake_loop import DRAWER, STOVE, make_checkpoint

BARE = ["env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4"]
LINE = [*BARE, "policy=memobench_random"]
OBJECTS = "environment_state_agent_pos"


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lerobot_memobench.commands.command_line.register_plugins", lambda: None)


def test_a_plan_is_complete_and_never_changes() -> None:
    line = [*LINE, "output_dir=out", "batch_size=2", "shard=2/3"]
    plan = plan_line(line)
    assert plan.output == plan.log == Path("out/shard-2-of-3")
    assert (plan.seed, plan.batch, plan.options.shard) == (7, 2, Shard(2, 3))
    assert plan.command == ("lerobot", "eval", *line)
    assert [task.name for task in plan.grid.tasks] == [STOVE, DRAWER]
    assert (plan.grid.runs, plan.grid.batch, plan.grid.first) == (4, 2, 0)
    assert "out" not in json.dumps(plan.settings.portable)
    assert not any(Path().iterdir())  # planning writes no file
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan.output = Path("elsewhere")  # type: ignore[misc]


def facts(plan: EvaluationPlan) -> dict[str, Any]:
    """Everything about a plan by one name each."""
    run = {"seed": plan.seed, "batch": plan.batch, "episodes": plan.grid.runs, "first": plan.grid.first}
    policy = {"policy": plan.policy.type, "n_action_steps": getattr(plan.policy, "n_action_steps", None)}
    use = {"use_async_envs": plan.settings.use_async_envs, "rename_map": plan.settings.rename_map}
    return {**plan.environment.gym_kwargs, **run, **policy, **use, "path": plan.policy_path}


SMALL = ["policy=memobench_strict", "device=cpu"]
RENAMED = '{"observation.images.image": "observation.images.top"}'
PLANNED: list[tuple[list[str], dict[str, Any]]] = [
    (
        [],
        {"policy": "memobench_expert", "expert_action": True, "seed": 7, "seed_base": 7}
        | {"prompt_in": "steps", "videos": 10, "batch": 4, "use_async_envs": None},
    ),
    (["policy=memobench_blind"], {"blind_action": True, "expert_action": False}),
    (["policy=memobench_random"], {"expert_action": False, "prompt_in": "reset", "episodes": 4}),
    (["policy=memobench_mem"], {"prompt_in": "steps"}),
    (["seed=20000", "env.seed_base=19990"], {"seed": 20_000, "seed_base": 19_990, "first": 10}),
    (["suite=strict", "tasks=3"], {"referent": "drawn"}),
    (["replan=5"], {"replan_steps": 5}),
    ([*SMALL, "replan=2"], {"replan_steps": 2, "n_action_steps": 2}),
    ([*SMALL, "policy.n_action_steps=3"], {"replan_steps": 3}),
    (["env.videos=-1", f"obs_type={OBJECTS}"], {"videos": -1}),
    ([f"obs_type={OBJECTS}"], {"videos": 0}),
    ([f"rename_map={RENAMED}"], {"rename_map": json.loads(RENAMED)}),
    # Policies that observe objects run in one process on a CPU, ten at once.
    (SMALL, {"obs_type": OBJECTS, "batch": 4, "use_async_envs": False, "videos": 0}),
    ([*SMALL, "episodes=11"], {"batch": 10, "use_async_envs": False}),
    ([*SMALL, "batch_size=3"], {"batch": 3, "use_async_envs": None}),
    (["episodes=50", "--eval.batch_size=0"], {"batch": 10}),
    (["shard=1/2", "output_dir=out", *SMALL], {"batch": 1}),
    (["policy=memobench_remote", "host=127.0.0.1", "policy.label=a (é)"], {"policy": "memobench_remote"}),
    (["policy=diffusion", "policy.down_dims=[16,32,64]", "policy.do_mask_loss_for_padding=true"], {"batch": 4}),
]


@pytest.mark.parametrize(("words", "found"), PLANNED, ids=[" ".join(words) or "none" for words, _ in PLANNED])
def test_settings_are_typed_and_completed(
    words: list[str], found: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lerobot_memobench.rollouts.plan.cores", lambda: 16)
    plan = plan_line([*BARE, *words])
    assert {name: facts(plan)[name] for name in found} == found
    # The card of the plan makes it again.
    write_evaluation(Path("card"), card_of(plan))
    again = plan_of_evaluation(*read_repeatable(Path("card")), Path("out"))
    assert (facts(again), again.grid, again.options.shard) == (facts(plan), plan.grid, plan.options.shard)


@pytest.mark.parametrize("words", [SMALL, [*SMALL, "episodes=11"], [*SMALL, "batch_size=3"], []], ids=" ".join)
def test_a_resumed_evaluation_keeps_batch_and_processes(words: list[str]) -> None:
    line = [*BARE, *words, "output_dir=out"]
    plan = plan_line(line)
    write_evaluation(plan.log, card_of(plan))
    again = plan_line([*line, "resume=true"])
    assert (again.batch, again.settings.use_async_envs) == (plan.batch, plan.settings.use_async_envs)


CHECKPOINT = shipped_policies()["memobench_strict"]
BAD: list[tuple[list[str], str]] = [
    (["episodes=many"], "a whole number"),
    (["episodes=0"], "episodes=0"),
    (["batch_size=-1"], "batch_size=-1"),
    (["policy=diffusion", "policy.down_dims=[1"], "policy.down_dims=[1 cannot be read"),
    (["resume=true"], "output_dir="),
    ([f"policy={CHECKPOINT}", f"output_dir={CHECKPOINT}"], "is also the policy; name another folder"),
    (["env.fps=30"], "fps"),
    (["env.render_every=5"], "render_every"),
    (["suite=strict", f"tasks={STOVE}"], "task of the published suite"),
    (["tasks="], "among the tasks"),
    (["seed=100007"], "test-sealed"),
    (["split=validation", "seed=7"], "split=validation"),
    (["split=sealed", "episodes=51"], "at most 50 episodes"),
    (["suite=strict", "tasks=all", "evidence=true", "episodes=6"], "at least episodes=12"),
    (["policy=memobench_random", "memory_reads=true"], "memory_reads"),
    (["policy=act", "prompt_in=steps", "corrupt=delete", "tasks=object"], "corrupt_memory(how, rows)"),
    (["policy=memobench_strict_memoryless", "corrupt=noise", "tasks=object"], "memobench_mem has none"),
    (["policy=memobench_strict", "corrupt=swap", "tasks=object", "episodes=11"], "batch of one episode"),
    (["policy=memobench_strict", "corrupt=delete", "tasks=temporal"], "set corrupt_step="),
    (["policy=memobench_strict", "obs_type=pixels_agent_pos"], "lacks inputs of the policy"),
    (["policy.discover_packages_path=not_here"], "not_here"),
    (["shard=0/4"], "shard=0/4"),
    (["policy=memobench_strict", "device=cuda:99"], "cuda:99"),
    (["--policy.path=outputs/none"], "outputs/none does not exist"),
    (["shard=a/b"], "shard=a/b"),
    (["workers=3"], "shards=8"),
    (["shard=1/4"], "without output_dir=; name the folder that all parts share"),
    (["shards=2", "output_dir=out", "env.log_dir=elsewhere"], "log_dir=elsewhere of an evaluation in parts"),
    (["shard=1/2", "shards=2"], "shards=2"),
]


@pytest.mark.parametrize(("words", "named"), BAD, ids=[" ".join(words) for words, _ in BAD])
def test_bad_settings_are_refused_before_anything_is_written(words: list[str], named: str) -> None:
    with pytest.raises(MemobenchError) as caught:
        plan_line([*BARE, *words])
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not any(Path().iterdir())


def test_without_the_assets_nothing_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "find_assets", lambda: (None, ""))
    with pytest.raises(MemobenchError, match="LIBERO's assets"):
        plan_line([*LINE, "output_dir=out"])


FEATURES = {
    "images": {"observation.images.wrist_image": {"type": "VISUAL", "shape": [3, 256, 256]}},
    "objects": {"observation.environment_state": {"type": "ENV", "shape": [208]}},
}


@pytest.mark.parametrize(
    ("seen", "shown"), [(("images",), "pixels_agent_pos"), (("objects",), OBJECTS), (("objects", "images"), "both")]
)
def test_a_checkpoint_gets_the_inputs_it_was_trained_on(seen: tuple[str, ...], shown: str) -> None:
    features = {key: value for name in seen for key, value in FEATURES[name].items()}
    path = make_checkpoint(Path("act").absolute(), "act", input_features=features)
    plan = plan_line([*BARE, "policy=./act"])
    assert plan.environment.obs_type == shown
    assert plan.settings.portable["policy"]["path"] == str(path)
    other = OBJECTS if shown != OBJECTS else "pixels_agent_pos"
    with pytest.raises(MemobenchError, match="lacks inputs of the policy"):
        plan_line([*BARE, "policy=./act", f"obs_type={other}"])
    shipped = shipped_policies()["memobench_strict"]
    assert plan_line([*BARE, f"policy={shipped}"]).settings.portable["policy"]["path"] == "memobench_strict"


def test_a_split_decides_the_scenes() -> None:
    for name in ("paper", "validation", "sealed"):
        plan = plan_line([*LINE, f"split={name}", "episodes=3"])
        assert (list(plan.seeds), plan.split) == (list(SPLITS[name][:3]), name)
    assert plan_line(["env=memobench"]).seeds == SPLITS["paper"] == range(7, 57)
    assert plan_line([*LINE, "seed=500"]).split is None


def test_scenes_of_evidence_are_counted_once() -> None:
    line = ["env=memobench", "tasks=object", "referent=random", "evidence=true"]
    assert plan_line(line).grid.runs == 36
    line.append("env.seed_base=30000")
    assert plan_line([*line, "seed=30000"]).seeds == range(30_000, 30_018)
    # Of two variants and of nine: episode 12 is of scene 6 and of scene 1.
    assert plan_line([*line, "seed=30012", "episodes=9"]).seeds == range(30_001, 30_011)
    butter = ["env=memobench", "tasks=put_the_butter_into_the_bowl_from_the_prompt_video", *line[2:4], "split=sealed"]
    assert plan_line([*butter, "episodes=150"]).seeds == SPLITS["sealed"]
    with pytest.raises(MemobenchError, match="100057"):
        plan_line([*butter, "episodes=151"])


@pytest.mark.parametrize("split", ["paper", "sealed"])
def test_strict_evidence_is_of_all_tasks(split: str) -> None:
    """A ranked row of the board is one command; a task with one variant runs each of its scenes once."""
    plan = plan_line(["env=memobench", "suite=strict", "evidence=true", f"split={split}"])
    assert (len(plan.grid.tasks), plan.grid.runs, plan.seeds) == (30, 36, SPLITS[split][:36])
    assert all(plan.grid.runs % variants == 0 for variants in plan.variants.values()), "whole scenes"
    assert {*plan.variants.values()} == {1, 2, 3, 6, 9, 12}


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["shard=2/4", "output_dir=out"], ["shard=2/4", "resume=true", "output_dir=out"]),
        (["--output_dir", "my out", "resume=false"], ["resume=true", "output_dir=my out"]),
    ],
)
def test_the_command_that_resumes(words: list[str], found: list[str]) -> None:
    plan = plan_line([*LINE, *words])
    assert shlex.split(plan.resuming_command) == ["lerobot", "eval", *LINE, *found]
    again = plan_line(shlex.split(plan.resuming_command)[2:])
    assert (again.log, again.options.resume) == (plan.log, True)


def test_a_configuration_file_is_overridden_by_the_line() -> None:
    path = shipped_policies()["memobench_strict"]
    for text, words, found in (
        ("policy: memobench_blind", [LINE[0]], {"policy": "memobench_blind", "blind_action": True}),
        ("policy: {type: memobench_blind}", [LINE[0], "policy=memobench_random"], {"policy": "memobench_random"}),
        (f"policy: {{path: {path}}}\nenv: {{type: memobench, obs_type: both}}", ["replan=2"], {"replan_steps": 2}),
        (
            "seed: 9\nenv: {type: memobench, horizon: 30, videos: 0, tasks: 9}\neval: {n_episodes: 3, batch_size: 3}",
            ["horizon=40", "--eval.n_episodes=2"],
            {"seed": 9, "batch": 3, "episodes": 2, "horizon": 40, "videos": 0},
        ),
    ):
        Path("eval.yaml").write_text(text)
        for flag in ("config_path=eval.yaml", "--config_path=eval.yaml"):
            plan = plan_line([flag, *words])
            assert {name: facts(plan)[name] for name in found} == found
    for text, named in (
        ("env: memobench\nsede: 1", "'sede'"),
        ("env: memobench\neval: 3", "eval=3"),
        ("env: memobench\npolicy: {type: memobench_random, null: 3}", "'policy.None'"),
        ("env: {type: memobench, null: 3}", "None"),
    ):
        Path("eval.yaml").write_text(text)
        with pytest.raises(MemobenchError, match=named):
            plan_line(["config_path=eval.yaml"])


def test_a_policy_of_another_package_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine_of_test").mkdir()
    (tmp_path / "mine_of_test" / "__init__.py").write_text(
        "from dataclasses import dataclass\n"
        "from lerobot_memobench.policies.baselines import MemobenchRandomConfig\n"
        "from lerobot.configs import PreTrainedConfig\n"
        "@PreTrainedConfig.register_subclass('mine_of_test')\n@dataclass\n"
        "class Mine(MemobenchRandomConfig):\n    spread: float = 1.0\n    label: str = ''\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    words = ["--policy.type=mine_of_test", "--policy.discover_packages_path=mine_of_test", "policy.spread=0.5"]
    plan: Any = plan_line([*BARE, *words, "policy.label=a: b: c", "output_dir=2026-11-28"])
    assert (plan.policy.type, plan.policy.spread, plan.policy.label) == ("mine_of_test", 0.5, "a: b: c")
    assert plan.output == Path("2026-11-28")


# --- options and batches ---


def grid(tasks: str = "ab", runs: int = 10, batch: int = 4, first: int = 0) -> Grid:
    return Grid(tuple(map(Path, tasks)), runs, batch, first)


@given(
    tasks=st.integers(1, 5), runs=st.integers(1, 60), batch=st.integers(1, 70), count=st.integers(1, 12), data=st.data()
)
def test_parts_make_up_the_whole(tasks: int, runs: int, batch: int, count: int, data: st.DataObject) -> None:
    whole = grid("abcde"[:tasks], runs, min(batch, runs))
    parts = [whole.cells(Shard(k, count)) for k in range(1, count + 1)]
    assert [cell for part in parts for cell in part] == whole.cells()
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    episodes = [episode for part in parts for cell in part for episode in whole.episodes(cell)]
    assert episodes == [(name, k) for name in "abcde"[:tasks] for k in range(runs)]
    done = data.draw(st.sets(st.sampled_from(episodes)))
    run = {
        episode
        for number in range(1, count + 1)
        for cell in whole.missing(done, Shard(number, count))
        for episode in whole.episodes(cell)
    }
    assert run | done == set(episodes)
