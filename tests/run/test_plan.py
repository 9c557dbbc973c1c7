"""From a command line, a file or a card to a plan: complete, typed, and checked before anything runs."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

import draccus
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.configs.train import TrainPipelineConfig

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import shipped_policies
from lerobot_memobench.run.arguments import read_arguments, split_arguments
from lerobot_memobench.run.plan import (
    EvaluationPlan,
    Grid,
    PlannedTask,
    RunOptions,
    Shard,
    plan_line,
    policy_config,
    take_run_options,
)
from lerobot_memobench.run.shards import plan_shards, slurm_of
from lerobot_memobench.sim import robot

STOVE, DRAWER = "turn_on_the_stove_and_turn_it_off", "check_the_top_drawer_of_the_cabinet"
LINE = ["env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4", "policy=memobench_random"]
WITHOUT_POLICY = LINE[:3]


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for module in ("arguments", "settings"):
        monkeypatch.setattr(f"lerobot_memobench.run.{module}.register_plugins", lambda: None)


def test_a_plan_is_complete_and_never_changes() -> None:
    plan = plan_line([*LINE, "output_dir=out", "batch_size=2", "shard=2/3"])
    assert plan.output == plan.log == Path("out/shard-2-of-3")
    assert (plan.seed, plan.batch, plan.options.shard) == (7, 2, Shard(2, 3))
    assert plan.command == ("lerobot", "eval", *LINE, "output_dir=out", "batch_size=2", "shard=2/3")
    assert plan.policy.type == "memobench_random"
    assert [task.name for task in plan.grid.tasks] == [STOVE, DRAWER]
    assert (plan.grid.runs, plan.grid.batch, plan.grid.first) == (4, 2, 0)
    assert "out" not in json.dumps(plan.settings.portable)
    assert not any(Path().iterdir())  # planning writes nothing
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan.output = Path("elsewhere")  # type: ignore[misc]


def facts(plan: EvaluationPlan) -> dict[str, Any]:
    """Everything about a plan by one name each."""
    run = {"seed": plan.seed, "batch": plan.batch, "episodes": plan.grid.runs, "first": plan.grid.first}
    policy = {"policy": plan.policy.type, "n_action_steps": getattr(plan.policy, "n_action_steps", None)}
    use = {"use_async_envs": plan.settings.use_async_envs, "rename_map": plan.settings.rename_map}
    return {**plan.environment.gym_kwargs, **run, **policy, **use, "path": plan.policy_path}


OBJECT_POLICY = ["policy=memobench_small", "device=cpu"]
RENAMED = '{"observation.images.image": "observation.images.top"}'
PLANNED: list[tuple[list[str], dict[str, Any]]] = [
    ([], {"policy": "memobench_expert", "expert_action": True, "seed": 7, "seed_base": 7, "prompt_in": "steps"}),
    (["policy=memobench_blind"], {"blind_action": True, "expert_action": False}),
    (["policy=memobench_random"], {"expert_action": False, "prompt_in": "reset", "episodes": 4}),
    (["policy=act"], {"prompt_in": "reset"}),
    (["policy=act", "prompt_in=steps"], {"prompt_in": "steps"}),
    (["policy=memobench_mem"], {"prompt_in": "steps"}),
    (["seed=20000"], {"seed": 20_000, "seed_base": 20_000, "first": 0}),
    (["seed=20000", "env.seed_base=19990"], {"seed": 20_000, "seed_base": 19_990, "first": 10}),
    (["split=validation"], {"seed": 20_000}),
    (["--seed=1", "seed=2", "seed=3"], {"seed": 3}),
    (["protocol=upstream"], {"demonstration_prompt": False, "horizon": 990}),
    (["suite=strict", "tasks=3"], {"referent": "drawn"}),
    (["horizon=5", "pause_steps=3", "speed=0.5"], {"horizon": 5, "pause_steps": 3, "speed": 0.5}),
    (["demonstration_prompt=false", "env.oracle_memory=true"], {"demonstration_prompt": False, "oracle_memory": True}),
    (["replan=5"], {"replan_steps": 5}),
    ([*OBJECT_POLICY, "replan=2"], {"replan_steps": 2, "n_action_steps": 2}),
    ([*OBJECT_POLICY, "policy.n_action_steps=3"], {"replan_steps": 3}),
    ([], {"videos": 10}),
    (["videos=0"], {"videos": 0}),
    (["env.videos=-1"], {"videos": -1}),
    (["obs_type=environment_state_agent_pos"], {"videos": 0}),
    ([f"rename_map={RENAMED}"], {"rename_map": {"observation.images.image": "observation.images.top"}}),
    # Policies that observe objects run in one process on a CPU, ten at once.
    (OBJECT_POLICY, {"obs_type": "environment_state_agent_pos", "batch": 4, "use_async_envs": False, "videos": 0}),
    ([*OBJECT_POLICY, "episodes=50"], {"batch": 10, "use_async_envs": False}),
    ([*OBJECT_POLICY, "episodes=11"], {"batch": 10}),
    ([*OBJECT_POLICY, "batch_size=3"], {"batch": 3, "use_async_envs": None}),
    ([*OBJECT_POLICY, "eval.use_async_envs=true", "episodes=9"], {"batch": 9, "use_async_envs": True}),
    ([*OBJECT_POLICY, "obs_type=both", "episodes=9"], {"batch": 9, "use_async_envs": None}),
    (["episodes=9"], {"batch": 9, "use_async_envs": None}),
    (["episodes=50", "--eval.batch_size=0"], {"batch": 10}),
    (["shard=1/2", "output_dir=out", *OBJECT_POLICY], {"batch": 1}),
]


@pytest.mark.parametrize(("words", "found"), PLANNED, ids=[" ".join(words) or "none" for words, _ in PLANNED])
def test_words_become_typed_settings_and_defaults_are_the_benchmarks(
    words: list[str], found: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lerobot_memobench.run.plan.cores", lambda: 16)
    plan = plan_line([*WITHOUT_POLICY, *words])
    assert {name: facts(plan)[name] for name in found} == found
    # The settings on a card make the same plan again.
    again = plan_line(
        [*plan.settings.words, *(word for word in words if word.startswith(("split", "shard", "output")))]
    )
    assert facts(again) == facts(plan)


BAD: list[tuple[list[str], str]] = [
    (["episodes=many"], "episodes=many: expected a whole number"),
    (["episodes=0"], "found episodes=0"),
    (["batch_size=-1"], "found batch_size=-1"),
    (["resume=true"], "output_dir=<folder>"),
    (["env.fps=30"], "fps"),
    (["env.task=object"], "env.tasks"),
    (["env.max_parallel_tasks=4"], "no setting 'env.max_parallel_tasks'"),
    (["eval.recording=true"], "no setting 'eval.recording'"),
    (["env.render_every=5"], "render_every"),
    (["horizn=5"], "did you mean 'horizon'"),
    (["referent=rnd"], "'random'"),
    (["tasks=stove"], "'stove'"),
    (["tasks="], "among the tasks"),
    (["policy=memobnch_mem"], "memobench_mem"),
    (["split=sealed2"], "split is 'sealed2'"),
    (["seed=100007"], "test-sealed"),
    (["split=paper", "episodes=51"], "at most 50 episodes"),
    (["suite=strict", "tasks=all", "evidence=true", "episodes=6"], "at least episodes=12"),
    (["policy=memobench_random", "memory_reads=true"], "does not tell"),
    (["policy=diffusion", "policy.down_dims=[1"], "a value of policy. cannot be read"),
    (["policy=memobench_small", "obs_type=pixels_agent_pos"], "lacks inputs of the policy"),
    (["policy.discover_packages_path=not_here"], "not_here"),
]


@pytest.mark.parametrize(("words", "said"), BAD, ids=[" ".join(words) for words, _ in BAD])
def test_bad_words_are_refused_in_a_sentence_before_anything_is_written(words: list[str], said: str) -> None:
    with pytest.raises(MemobenchError) as caught:
        plan_line([*WITHOUT_POLICY, *words])
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not any(Path().iterdir())


OBJECTS = "environment_state_agent_pos"


def checkpoint(folder: Path, *seen: str) -> str:
    """A checkpoint of LeRobot's act as far as planning looks at one."""
    inputs = {
        "pictures": {"observation.images.image": {"type": "VISUAL", "shape": [3, 256, 256]}},
        "objects": {"observation.environment_state": {"type": "ENV", "shape": [208]}},
    }
    features = {key: value for name in seen for key, value in inputs[name].items()}
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"type": "act", "input_features": features}))
    (folder / "model.safetensors").touch()
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).write_text(json.dumps({"steps": []}))
    return f"policy={folder}"


@pytest.mark.parametrize(
    ("seen", "shown"),
    [(("pictures",), "pixels_agent_pos"), (("objects",), OBJECTS), (("objects", "pictures"), "both")],
)
def test_a_checkpoint_gets_the_inputs_it_was_trained_on(seen: tuple[str, ...], shown: str, tmp_path: Path) -> None:
    line = [*WITHOUT_POLICY, checkpoint(tmp_path / "act", *seen)]
    assert plan_line(line).environment.obs_type == shown
    other = OBJECTS if shown != OBJECTS else "pixels_agent_pos"
    with pytest.raises(MemobenchError, match=rf"obs_type is {other}, which lacks inputs of the policy"):
        plan_line([*line, f"obs_type={other}"])


@pytest.mark.parametrize("name", ["evaluation.json", "card.json"])
def test_going_on_keeps_the_earlier_batch_size(name: str) -> None:
    Path("out").mkdir()
    Path("out", name).write_text(json.dumps({"protocol": {}, "runs": [{"batch_size": 4}]}))
    assert plan_line([*LINE, "output_dir=out", "resume=true"]).batch == 4
    assert plan_line([*LINE, "output_dir=out", "resume=true", "batch_size=2"]).batch == 2
    assert plan_line([*LINE, "output_dir=new", "shards=2"]).batch == 1


def test_scenes_of_evidence_are_whole_and_counted_from_episode_0() -> None:
    line = ["env=memobench", "tasks=object", "referent=random", "evidence=true"]
    assert plan_line(line).grid.runs == 36
    assert plan_line([*line, "episodes=9"]).grid.runs == 9
    line.append("env.seed_base=30000")
    assert plan_line([*line, "seed=30000"]).seeds == range(30_000, 30_018)
    # Of two variants and of nine: episode 12 is of scene 6 and of scene 1.
    assert plan_line([*line, "seed=30012", "episodes=9"]).seeds == range(30_001, 30_011)


def test_paths_on_a_card_are_absolute_and_the_packages_policies_go_by_name(tmp_path: Path) -> None:
    checkpoint(tmp_path / "act", "objects")
    plan = plan_line([*WITHOUT_POLICY, "policy=./act"])
    assert plan.settings.portable["policy"]["path"] == str(tmp_path / "act")
    assert f"--policy.path={tmp_path / 'act'}" in plan.settings.words
    path = shipped_policies()["memobench_small"]
    assert plan_line([*WITHOUT_POLICY, f"policy={path}"]).settings.portable["policy"]["path"] == "memobench_small"


@pytest.mark.parametrize("here", [False, True], ids=["without a GPU", "with one"])
def test_the_device_is_decided_where_the_episodes_are_run(here: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not on the login node that hands the parts to Slurm; each part decides on its own machine."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: here)
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)
    slurm = ["shards=2", "slurm=--partition=a"]
    for parts in (slurm, ["shards=2"]):
        (job, _) = plan_shards(plan_line([*LINE, "output_dir=out", *parts]), ("-m", "part"), print)
        assert not any("policy.device" in word for word in job.arguments)
        assert (job.beside == 2) is (parts != slurm)  # a node of its own, or this one
    assert plan_line([*LINE, "shard=1/2", "output_dir=out"]).settings.policy.get("device") == (None if here else "cpu")
    (job, _) = plan_shards(plan_line([*LINE, "output_dir=out", "device=cuda", *slurm]), ("-m", "part"), print)
    assert "--policy.device=cuda" in job.arguments  # what a user says stays


def test_without_the_arm_nothing_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot, "ROBOSUITE", "1.4.2")
    with pytest.raises(MemobenchError, match=r"found robosuite 1\.4\.1; run: pip install --no-deps robosuite"):
        plan_line([*LINE, "output_dir=out"])


@pytest.mark.parametrize(
    ("parameters", "words", "needs"),
    [
        (900_000, [], (2, 8, 0)),
        (3_500_000_000, [], (2, 36, 1)),  # 14 GB of weights, twice, beside 8 GB
        (900_000, ["device=cuda"], (2, 8, 1)),
        (3_500_000_000, ["device=cpu"], (2, 36, 0)),
    ],
)
def test_a_part_on_slurm_asks_for_what_its_policy_needs(
    parameters: int, words: list[str], needs: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lerobot_memobench.run.shards.parameters_of", lambda path: parameters)
    line = [*LINE[:3], "policy=memobench_small", "obs_type=environment_state_agent_pos", *words]
    slurm = slurm_of(plan_line([*line, "output_dir=out", "shards=2", "slurm=--partition=a"]))
    assert slurm is not None
    assert (slurm.needs.cores, slurm.needs.memory_gb, slurm.needs.gpus) == needs


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["shard=2/4", "output_dir=out"], ["shard=2/4", "resume=true", "output_dir=out"]),
        (["--output_dir", "my out", "resume=false"], ["resume=true", "output_dir=my out"]),
    ],
)
def test_the_command_that_goes_on(words: list[str], found: list[str]) -> None:
    plan = plan_line([*LINE, *words])
    assert shlex.split(plan.going_on) == ["lerobot", "eval", *LINE, *found]
    again = plan_line(shlex.split(plan.going_on)[2:])
    assert (again.log, again.options.resume) == (plan.log, True)


def test_settings_of_a_configuration_file_are_used_where_the_line_says_nothing() -> None:
    path = shipped_policies()["memobench_small"]
    for text, words, found in (
        ("policy: memobench_blind", [LINE[0]], {"policy": "memobench_blind", "blind_action": True}),
        ("policy: {type: memobench_blind}", [LINE[0], "policy=memobench_random"], {"policy": "memobench_random"}),
        (f"policy: {{path: {path}}}\nenv: {{type: memobench, obs_type: both}}", ["replan=2"], {"replan_steps": 2}),
        (
            "seed: 9\nenv: {type: memobench, horizon: 30, videos: 0, tasks: 9}\neval: {n_episodes: 3, batch_size: 3}",
            ["horizon=40"],
            {"seed": 9, "batch": 3, "episodes": 3, "horizon": 40, "videos": 0},
        ),
    ):
        Path("eval.yaml").write_text(text)
        for flag in ("config_path=eval.yaml", "--config_path=eval.yaml"):
            plan = plan_line([flag, *words])
            assert {name: facts(plan)[name] for name in found} == found
    for text, said in (("env: memobench\nsede: 1", "no setting 'sede'"), ("env: memobench\neval: 3", "eval=3")):
        Path("eval.yaml").write_text(text)
        with pytest.raises(MemobenchError, match=said):
            plan_line(["config_path=eval.yaml"])


@pytest.mark.parametrize(
    "words",
    [
        ["policy=memobench_random", "policy=memobench_blind"],
        ["policy=memobench_random", "--policy.type=memobench_blind"],
        ["policy=memobench_small", "policy=memobench_small_memoryless"],
        ["policy=memobench_small", "--policy.type=memobench_blind"],
        ["--policy.type=memobench_random", "--policy.type=memobench_blind"],
    ],
)
def test_a_policy_is_named_once(words: list[str]) -> None:
    """LeRobot ran the first, and the card told of the last."""
    with pytest.raises(MemobenchError, match="two answers to which policy is meant"):
        plan_line([*LINE[:3], *words])


def test_a_policy_of_another_package_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine_of_test").mkdir()
    (tmp_path / "mine_of_test" / "__init__.py").write_text(
        "from dataclasses import dataclass\n"
        "from lerobot_memobench.policies.baselines.configuration_baselines import MemobenchRandomConfig\n"
        "from lerobot.configs import PreTrainedConfig\n"
        "@PreTrainedConfig.register_subclass('mine_of_test')\n@dataclass\n"
        "class Mine(MemobenchRandomConfig):\n    spread: float = 1.0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    words = ["--policy.type=mine_of_test", "--policy.discover_packages_path=mine_of_test", "policy.spread=0.5"]
    plan = plan_line([*LINE[:3], *words])
    assert (plan.policy.type, plan.policy.spread) == ("mine_of_test", 0.5)
    assert plan_line(plan.settings.words).policy.spread == 0.5  # a part finds the package as well


NAMES = ("run #2", "2026-11-28", "20261128", "007", "on", "run: 2", "obj [v2]", "1e3", "NaN", "!x", "'a'", " x ", "é")


@pytest.mark.parametrize("name", [*NAMES, "included", "include x"])
def test_a_name_arrives_as_it_is_typed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As LeRobot's commands parse it: by YAML, and the settings of a checkpoint's policy by JSON."""
    plan = plan_line([*LINE, f"output_dir={name}", f"env.log_dir={name}"])
    assert (plan.output, plan.log) == (Path(name), Path(name))
    Path(name).mkdir()
    line = ["policy=memobench_small", f"dataset={name}", f"output_dir={name}", f"policy.repo_id=user/{name}"]
    arguments = read_arguments("train", split_arguments(line))
    trained = draccus.parse(TrainPipelineConfig, args=[flag for flag in arguments.for_parser if "policy" not in flag])
    assert (trained.output_dir, Path(trained.dataset.root or "")) == (Path(name), Path(name))
    assert trained.dataset.repo_id == f"local/{name}"
    policy: Any = policy_config(arguments)
    assert policy.repo_id == f"user/{name}"


# --- how it is run ---


def run_options(*given: str) -> RunOptions:
    return take_run_options(split_arguments(given))[0]


def test_run_options_are_taken_out_of_the_arguments() -> None:
    taken, rest = take_run_options(split_arguments(["env=memobench", "resume=true", "episodes=3", "shard=2/3"]))
    assert rest.pairs == [("env", "memobench"), ("episodes", "3")]
    assert (taken.resume, taken.shard) == (True, Shard(2, 3))
    assert run_options() == RunOptions()


def test_parts_run_here_or_on_slurm() -> None:
    taken = run_options("shards=8", "workers=2", "slurm=--partition=gpu --mem=4G")
    assert (taken.shards, taken.workers, taken.slurm) == (8, 2, ("--partition=gpu", "--mem=4G"))
    assert run_options("shards=8").slurm is None


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("shard=0/4", "i from 1 to n"),
        ("shard=5/4", "i from 1 to n"),
        ("shard=2", "i from 1 to n"),
        ("shard=a/b", "i from 1 to n"),
        ("shard=-1/4", "i from 1 to n"),
        ("shards=0", "from 1 on"),
        ("shards=many", "from 1 on"),
        ("resume=yes", "true or false"),
        ("slurm=--partition=gpu", "shards=8"),
        ("workers=3", "shards=8"),
    ],
)
def test_run_options_that_cannot_be_obeyed(word: str, message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        run_options(word)


def test_one_part_or_all_of_them() -> None:
    with pytest.raises(MemobenchError, match="one part"):
        run_options("shard=1/2", "shards=2")


# --- which episodes are run, in which batches ---


def grid(tasks: str = "ab", runs: int = 10, batch: int = 4, first: int = 0) -> Grid:
    return Grid(tuple(PlannedTask("temporal", k, Path(name)) for k, name in enumerate(tasks)), runs, batch, first)


def test_batches_are_not_taken_apart() -> None:
    done = {("a", k) for k in range(10)} - {("a", 5)} | {("b", k) for k in range(4)}
    left = grid().missing(done)
    assert [(task.name, number) for task, number in left] == [("a", 1), ("b", 1), ("b", 2)]
    assert [grid().runs_of(number) for _, number in left] == [range(4, 8), range(4, 8), range(8, 10)]


def test_nothing_is_left_of_a_complete_evaluation() -> None:
    whole = {(name, k) for name in "ab" for k in range(10)}
    assert grid().missing(whole) == []
    assert grid().missing(whole | {("c", 0), ("a", 11)}) == []


def test_episodes_count_from_the_first() -> None:
    later = grid("a", runs=3, batch=2, first=5)
    assert [later.episodes(cell) for cell in later.cells()] == [[("a", 5), ("a", 6)], [("a", 7)]]


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


def test_parts_have_folders_that_sort() -> None:
    assert Shard.parse("3/12").folder == "shard-3-of-12"
