"""From a command line to a plan: complete, typed, and unchanged by what is left of it."""

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
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.configuration_baselines import MemobenchBlindConfig, MemobenchRandomConfig
from lerobot_memobench.policies.checkpoint import shipped_policies
from lerobot_memobench.run.arguments import LerobotArguments, read_arguments, split_arguments
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


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lerobot_memobench.run.arguments.register_plugins", lambda: None)


def test_a_plan_says_everything() -> None:
    plan = plan_line([*LINE, "output_dir=out", "batch_size=2", "shard=2/3"])
    assert plan.output == plan.log == Path("out/shard-2-of-3")
    assert (plan.seed, plan.batch, plan.options.shard) == (7, 2, Shard(2, 3))
    assert plan.command == ("lerobot", "eval", *LINE, "output_dir=out", "batch_size=2", "shard=2/3")
    assert isinstance(plan.environment, MemobenchEnvConfig)
    assert plan.policy is not None
    assert plan.policy.type == "memobench_random"
    assert plan.grid is not None
    assert [task.name for task in plan.grid.tasks] == [STOVE, DRAWER]
    assert (plan.grid.runs, plan.grid.batch, plan.grid.first) == (4, 2, 0)
    assert not any("out" in flag for flag in plan.portable_flags)
    assert not any(Path().iterdir())  # planning writes nothing


@pytest.mark.parametrize(
    ("words", "base"), [([], 7), (["seed=20000"], 20_000), (["seed=20000", "env.seed_base=19990"], 19_990)]
)
def test_episodes_are_counted_from_the_first_seed(words: list[str], base: int) -> None:
    plan = plan_line([*LINE, *words])
    assert plan.environment is not None
    assert plan.grid is not None
    assert plan.environment.seed_base == base
    assert plan.grid.first == plan.seed - base


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["policy=act"], "reset"),
        (["policy=memobench_random"], "reset"),
        (["policy=memobench_mem"], "steps"),
        ([], "steps"),
        (["policy=act", "prompt_in=steps"], "steps"),
    ],
)
def test_the_prompt_plays_where_the_policy_can_take_it(words: list[str], found: str) -> None:
    plan = plan_line([*LINE[:-1], *words])
    assert "--env.prompt_in=" + found in plan.portable_flags
    assert plan.environment is not None
    assert plan.environment.agreed_settings["prompt_in"] == found


def test_the_authors_evaluation_is_planned_by_one_word() -> None:
    plan = plan_line([*LINE, "protocol=upstream"])
    agreed = plan.environment.agreed_settings
    assert (agreed["protocol"], agreed["world"], agreed["horizon"]) == ("upstream", "memobench", 990)
    assert agreed["demonstration_prompt"] is False


@pytest.mark.parametrize("policy", [["policy=memobench_mem"], ["policy=memobench_remote", "policy.dialect=robomme"]])
def test_repeated_pictures_are_refused_for_policies_that_remember(policy: list[str]) -> None:
    with pytest.raises(MemobenchError, match=r"env.render_every is 5; leave env.render_every at 1"):
        plan_line(["env=memobench", f"tasks={STOVE}", *policy, "env.render_every=5"])
    assert plan_line([*LINE, "env.render_every=5"]).grid is not None


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
def test_a_checkpoint_is_shown_what_it_was_trained_on(seen: tuple[str, ...], shown: str, tmp_path: Path) -> None:
    line = [*LINE[:-1], checkpoint(tmp_path / "act", *seen)]
    plan = plan_line(line)
    assert plan.environment is not None
    assert plan.environment.agreed_settings["obs_type"] == shown
    other = OBJECTS if shown != OBJECTS else "pixels_agent_pos"
    with pytest.raises(MemobenchError, match=rf"env.obs_type is {other}, which lacks inputs of the policy"):
        plan_line([*line, f"obs_type={other}"])


def test_going_on_keeps_the_earlier_batch_size() -> None:
    Path("out").mkdir()
    card = {"protocol": {}, "runs": [{"batch_size": 4}]}
    Path("out/card.json").write_text(json.dumps(card))
    assert plan_line([*LINE, "output_dir=out", "resume=true"]).batch == 4
    assert plan_line([*LINE, "output_dir=out", "resume=true", "batch_size=2"]).batch == 2
    assert plan_line([*LINE, "output_dir=new", "shards=2"]).batch == 1


def test_a_number_of_episodes_that_is_none() -> None:
    with pytest.raises(MemobenchError, match="found episodes=many and seed=7; expected whole numbers"):
        plan_line(["env=memobench", "--eval.n_episodes=many"])


def test_evidence_is_asked_for_in_whole_scenes() -> None:
    plan = plan_line(["env=memobench", "tasks=object", "referent=random", "evidence=true"])
    assert plan.grid.runs == 36
    assert all(plan.grid.runs % variants == 0 for variants in (2, 3, 6, 9, 12))
    assert plan_line(["env=memobench", "tasks=object", "referent=random", "evidence=true", "episodes=9"]).grid.runs == 9


def test_evidence_of_less_than_a_scene_is_refused() -> None:
    line = ["env=memobench", "suite=strict", "evidence=true"]
    with pytest.raises(MemobenchError, match=r"has 12: with episodes=6 no scene .* at least episodes=12"):
        plan_line([*line, "episodes=6"])
    assert plan_line([*line, "episodes=12"]).grid.runs == 12
    assert plan_line(["env=memobench", "suite=strict", "episodes=1"]).grid.runs == 1


def test_scenes_of_evidence_are_counted_from_episode_0() -> None:
    line = ["env=memobench", "tasks=object", "referent=random", "evidence=true", "env.seed_base=30000"]
    assert plan_line([*line, "seed=30000"]).seeds == range(30_000, 30_018)
    # Of two variants and of nine: episode 12 is of scene 6 and of scene 1.
    assert plan_line([*line, "seed=30012", "episodes=9"]).seeds == range(30_001, 30_011)


def test_ten_episodes_are_filmed_unless_another_number_is_given_or_nothing_is_drawn() -> None:
    for words, videos in (([], 10), (["videos=0"], 0), (["env.videos=3"], 3), ([f"obs_type={OBJECTS}"], 0)):
        environment = plan_line([*LINE, *words]).environment
        assert environment is not None
        assert environment.videos == videos


def test_going_on_needs_a_folder() -> None:
    with pytest.raises(MemobenchError, match="output_dir=<folder>"):
        plan_line([*LINE, "resume=true"])


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
    assert plan_line([*LINE, "shard=1/2", "output_dir=out"]).arguments.get("policy.device") == (None if here else "cpu")
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


def test_a_policy_of_a_configuration_file_is_the_policy() -> None:
    for section in ("{type: memobench_blind}", "memobench_blind"):
        Path("eval.yaml").write_text(f"policy: {section}\n")
        plan = plan_line([LINE[0], "config_path=eval.yaml"])
        assert [flag for flag in plan.portable_flags if "action=" in flag] == ["--env.blind_action=true"]
        assert isinstance(plan.policy, MemobenchBlindConfig)
        plan = plan_line([LINE[0], "--config_path=eval.yaml", "policy=memobench_random"])
        assert isinstance(plan.policy, MemobenchRandomConfig)


def test_a_checkpoint_of_a_configuration_file_takes_settings() -> None:
    path = shipped_policies()["memobench_small"]
    Path("eval.yaml").write_text(f"policy: {{path: {path}}}\nenv: {{type: memobench, obs_type: both}}\n")
    plan = plan_line(["config_path=eval.yaml", "replan=2", "device=cpu"])
    assert plan.policy_path == str(path)
    assert plan.policy.n_action_steps == plan.environment.replan_steps == 2


def test_settings_of_a_configuration_file_stay() -> None:
    """The benchmark's defaults hid them: fifty episodes ran where the file said one."""
    Path("eval.yaml").write_text(
        "seed: 9\nenv: {type: memobench, horizon: 30, videos: 0, tasks: 9}\neval: {n_episodes: 3, batch_size: 3}\n"
    )
    plan = plan_line(["config_path=eval.yaml"])
    assert (plan.seed, plan.batch, plan.grid.runs) == (9, 3, 3)
    assert (plan.environment.horizon, plan.environment.videos) == (30, 0)
    plan = plan_line(["config_path=eval.yaml", "--seed=5", "episodes=2", "horizon=40"])
    assert (plan.seed, plan.grid.runs, plan.environment.horizon) == (5, 2, 40)
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


def test_of_a_setting_that_is_given_twice_the_last_counts() -> None:
    plan = plan_line([*LINE, "--seed=1", "seed=2", "seed=3"])
    assert plan.seed == 3
    assert [flag for flag in plan.portable_flags if flag.startswith("--seed=")] == ["--seed=3"]


@pytest.mark.parametrize("more", [[], ["shards=2", "output_dir=out"]])
def test_a_batch_of_no_episodes_is_refused(more: list[str]) -> None:
    with pytest.raises(MemobenchError, match="found batch_size=-1; expected how many episodes run at once"):
        plan_line([*LINE, "batch_size=-1", *more])


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
    assert plan.policy is not None
    assert (plan.policy.type, plan.policy.spread) == ("mine_of_test", 0.5)
    assert not any("action=" in flag for flag in plan.portable_flags)
    with pytest.raises(MemobenchError, match=r"policy\.discover_packages_path=not_here"):
        plan_line([*LINE[:3], "policy.discover_packages_path=not_here"])


# --- the plan itself ---


def evaluation(*flags: str) -> EvaluationPlan:
    return EvaluationPlan(
        LerobotArguments(flags),
        None,
        None,
        None,
        None,
        Path("out"),
        Path("log"),
        7,
        1,
        RunOptions(),
        ("lerobot", "eval"),
    )


def test_flags_are_complete_but_for_what_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("checkpoint").mkdir()
    asked = evaluation("--policy.path=checkpoint", "--seed=7", "--env.videos=-1")
    assert asked.portable_flags == ["--seed=7", "--env.videos=-1", f"--policy.path={tmp_path / 'checkpoint'}"]
    assert evaluation("--policy.path=user/name").portable_flags == ["--policy.path=user/name"]  # a repository stays one


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


def test_a_text_that_the_parser_would_open_as_a_file_is_refused() -> None:
    with pytest.raises(MemobenchError, match="job_name=include"):
        _ = read_arguments("train", split_arguments(["policy=act", "job_name=include x"])).for_parser


def test_a_plan_never_changes() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        evaluation().output = Path("elsewhere")  # type: ignore[misc]


# --- how it is run ---


def run_options(*given: str) -> RunOptions:
    return take_run_options(split_arguments(given))[0]


def test_run_options_are_taken_out_of_the_arguments() -> None:
    taken, rest = take_run_options(split_arguments(["env=memobench", "resume=true", "episodes=3", "shard=2/3"]))
    assert rest.pairs == [("env", "memobench"), ("episodes", "3")]
    assert (taken.resume, taken.shard, taken.any) == (True, Shard(2, 3), True)
    assert not run_options().any


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
