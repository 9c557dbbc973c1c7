"""A card is data: what a stranger may have written into it leads nowhere, and what we write into it is repeated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash
from lerobot_memobench.perception.weights import SHIPPED
from lerobot_memobench.protocol import IDLE_STEPS
from lerobot_memobench.run import rerun
from lerobot_memobench.run.card import checkpoint_files, new_card, tree_hash, with_episodes, write_card
from lerobot_memobench.run.machine import run_facts
from lerobot_memobench.run.plan import plan_line
from lerobot_memobench.run.rerun import (
    allowed_settings,
    asked_of,
    check_policy,
    differences_here,
    plan_of_card,
    repeatable_card,
)
from lerobot_memobench.run.settings import EvaluationSettings, settings_of_flags

STOVE, DRAWER = "turn_on_the_stove_and_turn_it_off", "check_the_top_drawer_of_the_cabinet"
COUNTING = "turn_the_stove_on_and_off_a_given_number_of_times"
RECORD = {"task": STOVE, "memory_type": "temporal", "episode": 0, "seed": 7, "success": True, "checkpoints": []}


@pytest.fixture(autouse=True, scope="module")
def in_folder(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An empty folder, and no look through all that is installed."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("run.arguments", "run.rerun", "run.settings"):
            patch.setattr(f"lerobot_memobench.{module}.register_plugins", lambda: None)
        patch.chdir(tmp_path_factory.mktemp("here"))
        Path("tasks").mkdir()
        make_checkpoint(Path("checkpoint"))
        yield


def make_checkpoint(folder: Path, kind: str = "memobench_random") -> None:
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"type": kind, "device": "cpu"}))
    (folder / "model.safetensors").write_bytes(b"weights")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).write_text(json.dumps({"name": name, "steps": []}))


def card(settings: Any, **changes: Any) -> dict[str, Any]:
    asked = {"tasks": [STOVE], "episodes": 1}
    parts: dict[str, Any] = {"protocol": asked, "policy": {}, "checkpoint": None, "trained_on": None}
    runs = [run_facts(["lerobot", "eval"], 1)]
    return (
        with_episodes(new_card(**{**parts, "task_files": {}, "settings": settings, "runs": runs}), [RECORD]) | changes
    )


def earlier(flags: Any, **changes: Any) -> dict[str, Any]:
    """A card of an earlier version, with LeRobot's flags."""
    found = card({}, **changes)
    del found["settings"]
    return {**found, "format": 1, "flags": flags}


def settings_in(flags: list[str]) -> dict[str, Any]:
    return settings_of_flags(flags).portable


def allowed(flags: list[str], server: str | None = None) -> EvaluationSettings:
    return allowed_settings(settings_of_flags(flags), server)


BENCHMARK = ["--env.type=memobench", f"--env.tasks={STOVE}", "--policy.type=memobench_random"]
HOSTILE = {
    "env.type": ["--env.type=aloha"],
    "env.type ": ["--env.type=hub", "--env.type=memobench"],
    "env.hub_path": ["--env.hub_path=stranger/env"],
    "env.discover_packages_path": ["--env.discover_packages_path=antigravity"],
    "policy.discover_packages_path": ["--policy.discover_packages_path=antigravity"],
    "anything.discover_packages_path": ["--anything.discover_packages_path=antigravity"],
    "discover_packages_path": ["--discover_packages_path=antigravity"],
    "trust_remote_code": ["--trust_remote_code=true"],
    "policy.trust_remote_code": ["--policy.trust_remote_code=true"],
    "policy.push_to_hub": ["--policy.push_to_hub=true"],
    "policy.path": ["--policy.path=stranger/policy"],
    "policy.path ": ["--policy.path=http://stranger/a b"],
    "policy.path  ": ["--policy.path=~nobody/at/all"],
    "policy.path   ": ["--policy.path=" + "a" * 5000],
    "policy.pretrained_path": ["--policy.pretrained_path=stranger/policy"],
    "policy.base_weights": ["--policy.type=memobench_mem", "--policy.base_weights=stranger/weights"],
    "policy.text_encoder": ["--policy.type=memobench_mem", "--policy.text_encoder=stranger/words"],
    "policy.tokenizer_name": ["--policy.type=memobench_mem", "--policy.tokenizer_name=123"],
    "policy.vlm_model_name": ["--policy.type=smolvla", "--policy.vlm_model_name=stranger/vlm"],
    "policy.vision_backbone": ["--policy.type=act", "--policy.vision_backbone=resnet18"],
    "policy.repo_id": ["--policy.repo_id=stranger/policy"],
    "policy.device": ["--policy.device=cpu;x"],
    "policy.device ": ["--policy.device=cuda:64"],
    "env.horizon": ["--env.horizon=1000000"],
    "episodes": ["--eval.n_episodes=1000000000"],
    "batch_size": ["--eval.batch_size=5000"],
    "policy.seed": ["--policy.seed=!!python/object/apply:os.system [x]"],
    "policy.down_dims": ["--policy.type=diffusion", '--policy.down_dims=[16,"x"]'],
    "policy.down_dims ": ["--policy.type=diffusion", "--policy.down_dims=" + "[" * 9999],
    "policy.host": ["--policy.type=memobench_remote", "--policy.host=10.0.0.5"],
    "policy.servers": ["--policy.type=memobench_remote", "--policy.servers=127.0.0.1:1,stranger.example:80"],
    "policy.host ": ["--policy.type=memobench_remote", "--policy.host=127.0.0.1@stranger.example"],
    "env.log_dir ": ["--env.log_dir=none"],
    "config_path ": ["--config_path=none"],
    "policy.discover_packages_path ": ["--policy.discover_packages_path=none"],
    "eval.n_episodes": ["--eval.n_episodes=many"],
    "output_dir": ["--output_dir=/tmp/elsewhere"],
    "env.log_dir": ["--env.log_dir=/tmp/elsewhere"],
    "env.task_dir": ["--env.task_dir=/no/such/folder"],
    "env.tasks": ["--env.tasks=../../elsewhere"],
    "env.features": ["--env.features={}"],
    "config_path": ["--config_path=/tmp/settings.yaml"],
    "rename_map": ['--rename_map={"a": 1}'],
    "env": ["--env=/tmp/env.yaml"],
    "policy": ["--policy=/tmp/policy.yaml"],
    "trust_remote": ["--trust_remote=true"],
}


@pytest.mark.parametrize("named", HOSTILE)
def test_a_hostile_card_is_refused_naming_the_setting(named: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("card.json").write_text(json.dumps(earlier([*BENCHMARK, *HOSTILE[named]])))
    assert main(["rerun", "card.json", "--out", "again"]) == 2
    said = capsys.readouterr().err
    assert named.strip() in said
    assert said.count("\n") == 1
    assert not Path("again").exists()


RANDOM = {"env": {"tasks": STOVE}, "policy": {"type": "memobench_random"}}
HOSTILE_SETTINGS: dict[str, dict[str, Any]] = {
    "env": {"env": ["tasks"]},
    "env.tasks": {"env": {"tasks": "../../elsewhere"}},
    "env.tasks ": {"env": {"tasks": ["all"]}},
    "env.task_dir": {"env": {"task_dir": "/no/such/folder"}},
    "env.log_dir": {"env": {"log_dir": "elsewhere"}},
    "env.features": {"env": {"features": {}}},
    "env.horizon": {"env": {"horizon": 1_000_000}},
    "horizon": {"env": {"horizon": "60"}},
    "render": {"env": {"render": "/elsewhere"}},
    "policy": {"policy": "memobench_random"},
    "policy.path": {"policy": {"path": "stranger/policy"}},
    "policy.seed": {"policy": {"type": "memobench_random", "seed": 3}},
    "policy.seed ": {"policy": {"type": "memobench_random", "seed": "many"}},
    "policy.repo_id": {"policy": {"type": "act", "repo_id": "stranger/policy"}},
    "policy.discover_packages_path": {"policy": {"type": "act", "discover_packages_path": "antigravity"}},
    "seed": {"seed": "7"},
    "episodes": {"episodes": 1_000_000_000},
    "episodes ": {"episodes": True},
    "batch_size": {"batch_size": 5000},
    "use_async_envs": {"use_async_envs": 1},
    "rename_map": {"rename_map": {"a": 1}},
    "output_dir": {"output_dir": "elsewhere"},
    "settings": {"anything": 1},
    "settings ": {"trust_remote_code": True},
}


@pytest.mark.parametrize("named", HOSTILE_SETTINGS)
def test_a_hostile_setting_is_refused_by_name(named: str) -> None:
    Path("evaluation.json").write_text(json.dumps(card({**RANDOM, **HOSTILE_SETTINGS[named]})))
    with pytest.raises(MemobenchError, match=named.strip().replace(".", r"\.")) as caught:
        repeatable_card(Path("evaluation.json"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--env.tasks=all"], "does not say --env.type=memobench"),
        ([*BENCHMARK, "--policy.type=stranger"], "there is no policy 'stranger'"),
        ([*BENCHMARK, "shards=64"], "no list of --key=value"),
        ([*BENCHMARK, "--trust_remote_code", "true"], "no list of --key=value"),
        ([*BENCHMARK, 7], r"found flags\[3\] = 7"),
        ("--env.type=memobench", "found flags = '--env.type=memobench'"),
    ],
)
def test_a_card_of_an_earlier_version_holds_flags_of_the_benchmark(flags: Any, said: str) -> None:
    Path("card.json").write_text(json.dumps(earlier(flags)))
    with pytest.raises(MemobenchError, match=said):
        repeatable_card(Path("card.json"))


def test_flags_of_earlier_versions_without_an_effect_are_left_out() -> None:
    old = ["--eval.recording=true", "--env.render_every=1", f"--env.task={STOVE}", "--job_name=a"]
    found = asked_of(earlier([BENCHMARK[0], BENCHMARK[2], *old]))
    assert found == settings_of_flags(BENCHMARK)


@pytest.mark.parametrize("label", [":", "=", "a: b: c"])
def test_a_text_need_be_no_yaml(label: str) -> None:
    plan: Any = plan_line(["env=memobench", "policy=memobench_remote", f"policy.label={label}"])
    assert plan.policy.label == label
    with pytest.raises(MemobenchError, match=r"a value of policy\. cannot be read"):
        plan_line(["env=memobench", "policy=diffusion", "policy.down_dims=[1"])


def test_a_checkpoint_that_the_card_does_not_identify_is_refused() -> None:
    settings = settings_in([*BENCHMARK[:2], "--policy.path=checkpoint"])
    write_card(Path(), card(settings, checkpoint=None))
    with pytest.raises(MemobenchError, match="is not the one that was evaluated"):
        check_policy(repeatable_card(Path("evaluation.json")))


def test_other_eyes_than_those_on_the_card_are_refused() -> None:
    flags = [*BENCHMARK[:2], "--policy.type=memobench_mem", "--policy.detector=package"]
    assert allowed(flags).policy["detector"] == "package"
    asked = allowed([*BENCHMARK[:2], "--policy.path=checkpoint"])
    told = {**card({}), "asked": asked}
    settings = {"perception": "objects", "detector": "package"}
    told["policy"] |= {"sha256": tree_hash(checkpoint_files(Path("checkpoint"))), "settings": settings}
    check_policy(told | {"policy": told["policy"] | {"detector_sha256": file_hash(SHIPPED)}})
    for sha256 in ({"detector_sha256": "0" * 64}, {}):
        with pytest.raises(MemobenchError, match="detector package is not the one that was used"):
            check_policy(told | {"policy": told["policy"] | sha256})


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--eval.n_episodes=2"], "2 episodes of 1 tasks, and its protocol names 1 of 1"),
        (["--eval.n_episodes=1", f"--env.tasks={STOVE},{DRAWER}"], "1 episodes of 2 tasks"),
        (["--eval.n_episodes=1", "--env.horizon=12000", "--env.pause_steps=1000"], "control steps"),
        (["--eval.n_episodes=1"], "does not name success, steps and checkpoints"),
    ],
)
def test_a_card_runs_no_more_than_its_episodes(flags: list[str], said: str) -> None:
    write_card(Path(), card(settings_in([*BENCHMARK, *flags])))
    with pytest.raises(MemobenchError, match=said):
        rerun.repeat(Path(), None, None, lambda plan: pytest.fail("it was run"), print)


def test_a_card_says_where_opengl_drew_its_pictures() -> None:
    plain = card(RANDOM)
    (run,) = plain["runs"]
    assert differences_here({"runs": [run, {**run, "gl": {"GL backend": "none, drawn on the CPU"}}]}) == []
    (note,) = differences_here({"runs": [{**run, "gl": {"GL backend": "egl", "GL renderer": "llvmpipe"}}]})
    assert "used GL backend egl (here none, drawn on the CPU)" in note


@pytest.mark.parametrize("told", [{}, {"idle": 1200}])
def test_a_strict_card_is_repeated_only_where_the_robot_idles_as_long(told: dict[str, int]) -> None:
    flags = ["--env.type=memobench", "--policy.type=memobench_random", "--env.suite=strict"]
    asked = {"tasks": [COUNTING], "episodes": 1, "suite": "strict", **told}
    write_card(Path(), card(settings_in(flags), protocol=asked))
    idled = f"idle={told.get('idle', 0)}, and this version idle={IDLE_STEPS}.*repeat it with that version"
    with pytest.raises(MemobenchError, match=idled):
        rerun.repeat(Path(), None, None, lambda plan: pytest.fail("it was run"), print)


def test_a_repository_is_its_copy_in_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun, "local_folder", lambda path: Path("checkpoint") if path == "user/name" else None)
    found = allowed([*BENCHMARK[:2], "--policy.path=user/name"])
    assert found.policy_path == str(Path("checkpoint").absolute())


def test_the_user_names_the_server() -> None:
    flags = ["--env.type=memobench", "--policy.type=memobench_remote", "--policy.host=10.0.0.5", "--policy.port=8000"]
    assert allowed(flags, "gpu1:9000").policy == {"type": "memobench_remote", "servers": "gpu1:9000"}
    assert allowed([*flags[:2], "--policy.host=127.0.0.1"]).policy["host"] == "127.0.0.1"
    with pytest.raises(MemobenchError, match="for a policy that runs in a server"):
        allowed(BENCHMARK, "gpu1:9000")


def test_a_section_may_be_nothing() -> None:
    flags = ["--env.type=memobench", "--policy.type=memobench_mem", "--policy.rtc_config=null"]
    assert allowed(flags).policy["rtc_config"] == "null"


# --- what we write ---

BOOLEAN = st.sampled_from(["true", "false"])
COUNT = st.integers(1, 300).map(str)
OF_THE_RUN = {
    "tasks": st.sampled_from(["all", "object,spatial", STOVE, f"{STOVE},{DRAWER}"]),
    "episodes": COUNT,
    "batch_size": COUNT,
    "seed": st.integers(0, 99).map(str),
    "referent": st.sampled_from(["fixed", "random"]),
    "demonstration_prompt": BOOLEAN,
    "prompt_in": st.sampled_from(["auto", "steps", "reset"]),
    "horizon": COUNT,
    "obs_type": st.sampled_from(["pixels_agent_pos", "both"]),
    "env.render": st.sampled_from(["fast", "high"]),
    "env.videos": COUNT,
    "env.oracle_memory": BOOLEAN,
    "pause_steps": COUNT,
    "speed": st.sampled_from(["1", "0.5", "0.33"]),
    "evidence": st.just("false"),
    "eval.use_async_envs": BOOLEAN,
    "rename_map": st.just('{"observation.images.image": "observation.images.top"}'),
    "shard": st.sampled_from(["1/1", "2/3"]),
    "policy.device": st.just("cpu"),
}
OF_A_POLICY: dict[str, dict[str, st.SearchStrategy[str]]] = {
    "memobench_expert": {},
    "memobench_random": {"policy.seed": COUNT, "policy.smoothing": st.sampled_from(["0", "0.5", "1e-3"])},
    "checkpoint": {"policy.smoothing": st.just("0.25")},
    "memobench_mem": {
        "align": st.sampled_from(["none", "contrastive"]),
        "size": st.just("tiny"),
        "replan": st.integers(1, 50).map(str),
        "policy.memory_stride": COUNT,
        "policy.base_weights": st.just("null"),
        "policy.optimizer_betas": st.just("[0.9, 0.99]"),
    },
    "memobench_remote": {
        "host": st.sampled_from(["127.0.0.1", "localhost"]),
        "port": COUNT,
        "dialect": st.sampled_from(["openpi", "robomme", "vla_eval"]),
        "policy.label": st.text("abc ()é", max_size=20),
        "policy.gripper": st.sampled_from(["libero", "rlds"]),
        "policy.timeout": st.just("7.5"),
    },
    "act": {"policy.chunk_size": st.just("100"), "policy.pretrained_backbone_weights": st.just("null")},
    "diffusion": {"policy.down_dims": st.just("[16,32,64]"), "policy.do_mask_loss_for_padding": BOOLEAN},
}


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    policy = draw(st.sampled_from(list(OF_A_POLICY)))
    known = OF_THE_RUN | OF_A_POLICY[policy]
    keys = draw(st.lists(st.sampled_from(list(known)), unique=True))
    return ["env=memobench", f"policy={policy}", *(f"{key}={draw(known[key])}" for key in keys)]


@settings(max_examples=20, suppress_health_check=[HealthCheck.too_slow])
@given(command_lines())
def test_a_card_that_we_write_is_repeated(line: list[str]) -> None:
    plan = plan_line([*line, "output_dir=out"])
    shard = None if plan.options.shard is None else str(plan.options.shard)
    write_card(Path(), card(plan.settings.portable, shard=shard))
    again = plan_of_card(repeatable_card(Path()), Path("out"))
    assert again.settings.portable == plan.settings.portable
    assert (again.options, again.policy, again.environment) == (plan.options, plan.policy, plan.environment)
    assert (again.seed, again.batch, again.grid) == (plan.seed, plan.batch, plan.grid)
