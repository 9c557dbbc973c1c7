"""From the words of a command line to a plan: complete, and unchanged by what is left of it."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path

import pytest

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.arguments import flag_value
from lerobot_memobench.run.card import card_of
from lerobot_memobench.run.plan import Shard, plan_line
from lerobot_memobench.run.run import remainder
from lerobot_memobench.run.shards import executor_options, plan_shards

STOVE, DRAWER = "turn_on_the_stove_and_turn_it_off", "check_the_top_drawer_of_the_cabinet"
LINE = ["env=memobench", f"tasks={STOVE},{DRAWER}", "episodes=4", "policy=memobench_random"]


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lerobot_memobench.run.arguments.register_plugins", lambda: None)


def test_a_plan_says_everything() -> None:
    plan = plan_line([*LINE, "output_dir=out", "batch_size=2", "shard=2/3"])
    assert plan.output == plan.log == Path("out/shard-2-of-3")
    assert (plan.seed, plan.batch, plan.orders.shard) == (7, 2, Shard(2, 3))
    assert plan.command == ("lerobot", "eval", *LINE, "output_dir=out", "batch_size=2", "shard=2/3")
    assert isinstance(plan.environment, MemobenchEnvConfig)
    assert plan.policy is not None
    assert plan.policy.type == "memobench_random"
    assert plan.grid is not None
    assert [place.task.name for place in plan.grid.places] == [STOVE, DRAWER]
    assert (plan.grid.runs, plan.grid.batch, plan.grid.first) == (4, 2, 0)
    assert flag_value(plan.lerobot_flags, "output_dir") == "out/shard-2-of-3"
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
    assert plan.environment.protocol["prompt_in"] == found


@pytest.mark.parametrize("policy", [["policy=memobench_mem"], ["policy=remote", "policy.dialect=robomme"]])
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
    assert plan.environment.protocol["obs_type"] == shown
    other = OBJECTS if shown != OBJECTS else "pixels_agent_pos"
    with pytest.raises(MemobenchError, match=rf"env.obs_type is {other}, which lacks inputs of the policy"):
        plan_line([*line, f"obs_type={other}"])


def test_objects_alone_need_nothing_to_draw_with(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless films are asked for."""
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    plan = plan_line([*LINE, f"obs_type={OBJECTS}"])
    assert flag_value(plan.lerobot_flags, "env.videos") == "0"
    assert card_of(plan)["runs"][0]["gl"] == {}
    for words in (
        [],
        ["obs_type=both"],
        [f"obs_type={OBJECTS}", "videos=1"],
        [f"obs_type={OBJECTS}", "env.videos=-1"],
    ):
        with pytest.raises(MemobenchError, match="MUJOCO_GL"):
            plan_line([*LINE, *words])


def test_going_on_keeps_the_earlier_batch_size() -> None:
    Path("out").mkdir()
    card = {"protocol": {}, "runs": [{"batch_size": 4}]}
    Path("out/card.json").write_text(json.dumps(card))
    assert plan_line([*LINE, "output_dir=out", "resume=true"]).batch == 4
    assert plan_line([*LINE, "output_dir=out", "resume=true", "batch_size=2"]).batch == 2
    assert plan_line([*LINE, "output_dir=new", "shards=2"]).batch == 1


def test_ten_episodes_are_filmed_unless_another_number_is_given() -> None:
    for words, videos in (([], 10), (["videos=0"], 0), (["env.videos=3"], 3)):
        environment = plan_line([*LINE, *words]).environment
        assert environment is not None
        assert environment.videos == videos


def test_what_is_left_is_a_plan_of_its_own() -> None:
    plan = plan_line([*LINE, "output_dir=out", "resume=true"])
    before = dataclasses.replace(plan)
    record = {"task": STOVE, "memory_type": "temporal", "episode": 0, "success": True, "checkpoints": []}
    EpisodeLog("out").append(record)
    assert plan.grid is not None
    drawer = plan.grid.places[1]
    left = remainder(plan, {drawer.key: [(0, 4)]})
    assert left.output == Path("out/continued-1")
    assert left.log == Path("out")
    assert flag_value(left.lerobot_flags, "env.tasks") == DRAWER
    assert flag_value(left.lerobot_flags, "env.resume") == "true"
    assert plan == before
    assert remainder(plan, None) is plan


def test_going_on_needs_a_folder() -> None:
    with pytest.raises(MemobenchError, match="output_dir=<folder>"):
        plan_line([*LINE, "resume=true"])


@pytest.mark.parametrize("here", [False, True], ids=["without a GPU", "with one"])
def test_the_device_is_decided_where_the_episodes_are_run(here: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not on the login node that hands the parts to Slurm; each part decides on its own machine."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: here)
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)
    slurm = ["shards=2", "executor=slurm", "executor_option=partition=a", "executor_option=time=1:00"]
    for parts in (slurm, ["shards=2"]):
        (job, _) = plan_shards(plan_line([*LINE, "output_dir=out", *parts]), ("-m", "part"), print)
        assert not any("policy.device" in word for word in job.words)
        assert (job.beside == 2) is (parts != slurm)  # a node of its own, or this one
    assert plan_line([*LINE, "shard=1/2", "output_dir=out"]).settings.get("policy.device") == (None if here else "cpu")
    (job, _) = plan_shards(plan_line([*LINE, "output_dir=out", "device=cuda", *slurm]), ("-m", "part"), print)
    assert "--policy.device=cuda" in job.words  # what a user says stays


def test_a_login_node_needs_no_gl_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    slurm = ["executor=slurm", "executor_option=partition=a", "executor_option=time=1:00"]
    assert plan_line([*LINE, "output_dir=out", "shards=2", *slurm]).draws
    with pytest.raises(MemobenchError, match="libegl1"):
        plan_line([*LINE, "output_dir=out", "shards=2"])


@pytest.mark.parametrize(
    ("parameters", "words", "needs"),
    [
        (900_000, [], (2, 4, 0)),
        (3_500_000_000, [], (2, 18, 1)),  # 14 GB of weights, twice, beside 8 GB
        (900_000, ["device=cuda"], (2, 4, 1)),
        (3_500_000_000, ["device=cpu"], (2, 18, 0)),
    ],
)
def test_a_part_on_slurm_asks_for_what_its_policy_needs(
    parameters: int, words: list[str], needs: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lerobot_memobench.run.shards.parameters_of", lambda path: parameters)
    slurm = ["executor=slurm", "executor_option=partition=a", "executor_option=time=1:00"]
    line = [*LINE[:3], "policy=memobench_small", "obs_type=environment_state_agent_pos", *words]
    options = executor_options(plan_line([*line, "output_dir=out", "shards=2", *slurm]))
    assert (options["cpus_per_task"], options["mem_per_cpu_gb"], options["gpus_per_task"]) == needs


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
    assert (again.log, again.orders.resume) == (plan.log, True)
