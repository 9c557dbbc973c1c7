"""A card is data: what a stranger may have written into it leads nowhere, and what we write into it is repeated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lerobot.configs.default import EvalConfig

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash
from lerobot_memobench.perception.weights import SHIPPED
from lerobot_memobench.protocol import IDLE_STEPS
from lerobot_memobench.run import rerun
from lerobot_memobench.run.arguments import field_types, without_none
from lerobot_memobench.run.card import checkpoint_files, new_card, tree_hash, with_episodes, write_card
from lerobot_memobench.run.machine import run_facts
from lerobot_memobench.run.plan import plan_line
from lerobot_memobench.run.rerun import allowed_flags, check_policy, differences_here, plan_of_card, repeatable_card

STOVE, DRAWER = "turn_on_the_stove_and_turn_it_off", "check_the_top_drawer_of_the_cabinet"
COUNTING = "turn_the_stove_on_and_off_a_given_number_of_times"
RECORD = {"task": STOVE, "memory_type": "temporal", "episode": 0, "seed": 7, "success": True, "checkpoints": []}


@pytest.fixture(autouse=True, scope="module")
def in_folder(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An empty folder, and no look through all that is installed."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("run.arguments", "run.rerun"):
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


def card(flags: Any, **changes: Any) -> dict[str, Any]:
    asked = {"tasks": [STOVE], "episodes": 1}
    parts: dict[str, Any] = {"protocol": asked, "policy": {}, "checkpoint": None, "trained_on": None}
    runs = [run_facts(["lerobot", "eval"], 1)]
    return with_episodes(new_card(**{**parts, "task_files": {}, "flags": [], "runs": runs}), [RECORD]) | {
        "flags": flags,
        **changes,
    }


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
    "eval.n_episodes ": ["--eval.n_episodes=1000000000"],
    "eval.batch_size": ["--eval.batch_size=5000"],
    "policy.seed": ["--policy.seed=!!python/object/apply:os.system [x]"],
    "policy.down_dims": ["--policy.type=diffusion", '--policy.down_dims=[16,"x"]'],
    "policy.down_dims ": ["--policy.type=diffusion", "--policy.down_dims=" + "[" * 9999],
    "policy.host": ["--policy.type=memobench_remote", "--policy.host=10.0.0.5"],
    "policy.servers": ["--policy.type=memobench_remote", "--policy.servers=127.0.0.1:1,stranger.example:80"],
    "policy.host ": ["--policy.type=memobench_remote", "--policy.host=127.0.0.1@stranger.example"],
    "eval.recording_repo_id": ["--eval.recording=true", "--eval.recording_repo_id=stranger/data"],
    "eval.recording_repo_id ": ["--eval.recording_repo_id=none"],
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
    Path("card.json").write_text(json.dumps(card([*BENCHMARK, *HOSTILE[named]])))
    assert main(["rerun", "card.json", "--out", "again"]) == 2
    said = capsys.readouterr().err
    assert named.strip() in said
    assert said.count("\n") == 1
    assert not Path("again").exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--env.tasks=all"], "does not say env.type=memobench"),
        ([*BENCHMARK, "--policy.type=stranger"], "there is no policy 'stranger'"),
        ([*BENCHMARK, "shards=64"], "'shards=64' is not --key=value"),
        ([*BENCHMARK, "--trust_remote_code", "true"], "'--trust_remote_code' is not --key=value"),
        ([*BENCHMARK, "-h"], "'-h' is not --key=value"),
        ([*BENCHMARK, 7], r"found flags\[3\] = 7"),
        ("--env.type=memobench", "found flags = '--env.type=memobench'"),
        (None, "found flags = None"),
    ],
)
def test_what_is_no_flag_of_ours(flags: Any, said: str) -> None:
    Path("card.json").write_text(json.dumps(card(flags)))
    with pytest.raises(MemobenchError, match=said):
        repeatable_card(Path("card.json"))


@pytest.mark.parametrize("label", [":", "=", "a: b: c"])
def test_a_text_need_be_no_yaml(label: str) -> None:
    plan: Any = plan_line(["env=memobench", "policy=memobench_remote", f"policy.label={label}"])
    assert plan.policy.label == label
    with pytest.raises(MemobenchError, match=r"a value of policy\. cannot be read"):
        plan_line(["env=memobench", "policy=diffusion", "policy.down_dims=[1"])


def test_a_checkpoint_that_the_card_does_not_identify_is_refused() -> None:
    Path("card.json").write_text(json.dumps(card([*BENCHMARK[:2], "--policy.path=checkpoint"], checkpoint=None)))
    with pytest.raises(MemobenchError, match="is not the one that was evaluated"):
        check_policy(repeatable_card(Path("card.json")))


def test_other_eyes_than_those_on_the_card_are_refused() -> None:
    detector = "--policy.detector=package"
    assert detector in allowed_flags([*BENCHMARK[:2], "--policy.type=memobench_mem", detector])
    told = card([*BENCHMARK[:2], "--policy.path=checkpoint"])
    settings = {"perception": "objects", "detector": "package"}
    told["policy"] |= {"sha256": tree_hash(checkpoint_files(Path("checkpoint"))), "settings": settings}
    check_policy(told | {"policy": told["policy"] | {"detector_sha256": file_hash(SHIPPED)}})
    for sha256 in ({"detector_sha256": "0" * 64}, {}):
        with pytest.raises(MemobenchError, match="detector package is not the one that was used"):
            check_policy(told | {"policy": told["policy"] | sha256})


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--eval.n_episodes=2"], "other tasks or episodes"),
        (["--eval.n_episodes=1", f"--env.tasks={STOVE},{DRAWER}"], "other tasks or episodes"),
        (["--eval.n_episodes=1", "--env.horizon=12000", "--env.pause_steps=1000"], "control steps"),
        (["--eval.n_episodes=1"], "does not name success, steps and checkpoints"),
    ],
)
def test_a_card_runs_no_more_than_its_episodes(flags: list[str], said: str) -> None:
    write_card(Path(), card([*BENCHMARK, *flags]))
    with pytest.raises(MemobenchError, match=said):
        rerun.repeat(Path("card.json"), None, None, lambda plan: pytest.fail("it was run"), print)


def test_a_card_says_where_opengl_drew_its_pictures() -> None:
    plain = card(BENCHMARK)
    (run,) = plain["runs"]
    assert differences_here({"runs": [run, {**run, "gl": {"GL backend": "none, drawn on the CPU"}}]}) == []
    (note,) = differences_here({"runs": [{**run, "gl": {"GL backend": "egl", "GL renderer": "llvmpipe"}}]})
    assert "used GL backend egl (here none, drawn on the CPU)" in note


def test_a_repetition_records_nothing() -> None:
    assert allowed_flags([*BENCHMARK, "--eval.recording=true"]) == allowed_flags(BENCHMARK)


@pytest.mark.parametrize("told", [{}, {"idle": 1200}])
def test_a_strict_card_is_repeated_only_where_the_robot_idles_as_long(told: dict[str, int]) -> None:
    flags = ["--env.type=memobench", "--policy.type=memobench_random", "--env.suite=strict"]
    asked = {"tasks": [COUNTING], "episodes": 1, "suite": "strict", **told}
    write_card(Path(), card(flags, protocol=asked))
    idled = f"idle={told.get('idle', 0)}, and this version idle={IDLE_STEPS}.*repeat it with that version"
    with pytest.raises(MemobenchError, match=idled):
        rerun.repeat(Path("card.json"), None, None, lambda plan: pytest.fail("it was run"), print)


def test_a_repository_is_its_copy_in_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun, "local_folder", lambda path: Path("checkpoint") if path == "user/name" else None)
    assert f"--policy.path={Path('checkpoint').absolute()}" in allowed_flags(
        [*BENCHMARK[:2], "--policy.path=user/name"]
    )


def test_the_user_names_the_server() -> None:
    flags = ["--env.type=memobench", "--policy.type=memobench_remote", "--policy.host=10.0.0.5", "--policy.port=8000"]
    assert allowed_flags(flags, "gpu1:9000")[1:] == ["--policy.type=memobench_remote", "--policy.servers=gpu1:9000"]
    assert allowed_flags([*flags[:2], "--policy.host=127.0.0.1"])[2] == "--policy.host=127.0.0.1"
    with pytest.raises(MemobenchError, match="for a policy that runs in a server"):
        allowed_flags(BENCHMARK, "gpu1:9000")


REFUSED = {
    MemobenchEnvConfig: {"log_dir", "features", "features_map"},
    EvalConfig: {"recording_repo_id", "recording_private"},
}


@pytest.mark.parametrize(("section", "config"), [("env", MemobenchEnvConfig), ("eval", EvalConfig)])
def test_every_setting_is_allowed_or_refused_on_purpose(section: str, config: type) -> None:
    refused = set()
    for name, kind in field_types(config).items():
        value = {bool: "true", int: "1", float: "1"}.get(without_none(kind), "tasks")
        try:
            allowed_flags([*BENCHMARK, f"--{section}.{name}={value}"])
        except MemobenchError:
            refused.add(name)
    assert refused == REFUSED[config]


def test_a_section_may_be_nothing_and_a_mapping_is_no_number() -> None:
    flags = ["--env.type=memobench", "--policy.type=memobench_mem", "--policy.rtc_config=null"]
    assert allowed_flags(flags)[2] == "--policy.rtc_config=null"
    for name in ("features", "features_map"):
        with pytest.raises(MemobenchError, match=f"the card sets env.{name}"):
            allowed_flags([*BENCHMARK, f"--env.{name}=5"])


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
    "env.render_every": st.just("1"),
    "env.videos": COUNT,
    "env.oracle_memory": BOOLEAN,
    "pause_steps": COUNT,
    "speed": st.sampled_from(["1", "0.5", "0.33"]),
    "evidence": st.just("false"),
    "eval.use_async_envs": BOOLEAN,
    "job_name": st.sampled_from(["mine", "run 7"]),
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
        "policy.memory_frames": COUNT,
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
    write_card(Path(), card(plan.portable_flags, shard=shard))
    again = plan_of_card(repeatable_card(Path("card.json")), Path("out"))
    assert sorted(again.portable_flags) == sorted(plan.portable_flags)
    assert (again.options, again.policy, again.environment) == (plan.options, plan.policy, plan.environment)
    assert (again.seed, again.batch, again.grid) == (plan.seed, plan.batch, plan.grid)
