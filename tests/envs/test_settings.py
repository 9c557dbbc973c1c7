"""Settings have the same accepted values everywhere; a folder's file contains one protocol."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_policy_config

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.lerobot import help_of
from lerobot_memobench.constants import EVALUATION_SEED, HOLD_MEAN, HORIZON, UPSTREAM_HORIZON
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.evaluation_file import (
    EVALUATION_FILE,
    FORMAT,
    Acting,
    check_facts,
    facts_of,
    has_evaluation,
    read_evaluation,
    write_facts,
)
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.settings import GOALS, HOLD, NOT_COMPARED, SCENE_HASHES, SETTINGS, EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import ALLOWED
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import STRICT

STOVE = "turn_on_the_stove_and_turn_it_off"
TAKERS: dict[str, Callable[..., object]] = {
    "settings": lambda **asked: EnvSettings().changed(**asked),
    "configuration": lambda **asked: MemobenchEnvConfig(**asked),
    "environment": lambda **asked: MemobenchEnv(STOVE, **asked),
    "episode": lambda **asked: Episode(get_task(STOVE), **asked),
}
BAD: dict[str, tuple[Any, ...]] = {
    "suite": ("strikt",),
    "rules": ("papers",),
    "seed_base": (-1,),
    "obs_type": ("state",),
    "referent": ("randon", "drawn"),
    "demonstration_prompt": ("yes",),
    "horizon": (0, "60", True),
    "replan_steps": (0,),
    "render": ("ultra",),
    "oracle_memory": (1,),
    "pause_steps": (-1,),
    "speed": (0.0, 1e-320, 0.7, 2.0, float("nan"), "0.5"),
    "corrupt": ("erase",),
    "interference": (-1, 1.5),
    "evidence": (True,),  # not with the published referent
    "videos": (-2,),
}


@pytest.mark.parametrize("taker", TAKERS)
def test_bad_values_and_unknown_names_are_refused_everywhere(taker: str) -> None:
    for name, values in BAD.items():
        if (name, taker) in (("suite", "environment"), ("render", "episode")):
            continue  # the task determines the suite; an episode accepts other render settings
        for value in values:
            with pytest.raises(MemobenchError, match=name) as caught:
                TAKERS[taker](**{name: value})
            assert "\n" not in str(caught.value)
    if taker != "configuration":
        with pytest.raises(MemobenchError, match="'horizon'"):
            TAKERS[taker](horizn=5)


def test_every_setting_reaches_configuration_environment_and_protocol() -> None:
    fields = {each.name: each for each in dataclasses.fields(EnvSettings)}
    assert all(each.metadata["meaning"] for each in fields.values())
    assert set(SETTINGS) == {*fields} - set(NOT_COMPARED)
    assert [name for name in fields if f"{name}=" not in help_of("eval")] == []
    assert {*SETTINGS} - {*ALLOWED} == {"suite"}
    config = MemobenchEnvConfig(horizon=5, pause_steps=3, videos=2)
    assert config.gym_kwargs == dataclasses.asdict(config.settings)
    assert (config.horizon, config.pause_steps, config.videos) == (5, 3, 2)
    assert set(config.settings.protocol_block) == {*SETTINGS, SCENE_HASHES}
    env = MemobenchEnv(STOVE, config.settings, speed=0.5)
    assert env.settings == config.settings.changed(speed=0.5, prompt_in="steps")
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.settings.horizon = 7  # type: ignore[misc]


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ({"suite": STRICT, "referent": "fixed"}, {"referent": "drawn", HOLD: HOLD_MEAN, GOALS: 4}),
        ({"rules": "upstream"}, {"demonstration_prompt": False, "horizon": UPSTREAM_HORIZON}),
        ({"rules": "upstream", "horizon": 5}, {"horizon": 5}),
        ({}, {"horizon": HORIZON, "seed_base": EVALUATION_SEED}),
    ],
)
def test_suite_and_protocol_determine_other_settings(asked: dict[str, Any], found: dict[str, Any]) -> None:
    block = EnvSettings(**asked).protocol_block
    assert {name: block[name] for name in found} == found
    assert vars(MemobenchEnvConfig(**asked)).items() >= {k: v for k, v in found.items() if k in SETTINGS}.items()


def test_upstream_protocol_has_no_controls() -> None:
    controls = ({"suite": STRICT}, {"referent": "random"}, {"oracle_memory": True}, {"pause_steps": 3}, {"speed": 0.5})
    for asked in (*controls, {"evidence": True}):
        with pytest.raises(MemobenchError, match="rules=upstream"):
            EnvSettings(rules="upstream", **asked)


@pytest.mark.parametrize(
    ("policy", "prompt_in", "replan"),
    [
        (None, "steps", None),
        (type("P", (), {"n_action_steps": 4}), "reset", 4),
        (type("P", (), {"reads_prompt": True, "n_obs_steps": 2}), "steps", None),
    ],
)
def test_policy_determines_prompt_and_replanning(policy: Any, prompt_in: str, replan: int | None) -> None:
    settings = MemobenchEnvConfig().settings_for(policy)
    assert (settings.prompt_in, settings.replan_steps) == (prompt_in, replan)
    assert settings.window_steps == getattr(policy, "n_obs_steps", 1)
    named = MemobenchEnvConfig(prompt_in="steps", replan_steps=8).settings_for(policy)
    assert (named.prompt_in, named.replan_steps) == ("steps", 8)


@pytest.mark.parametrize("declared", [1, 399, 401])
def test_plans_longer_than_declared_are_refused(declared: int) -> None:
    """A plan of 400 actions, declared as 1, carried the past over home: 10 of 12 ordering episodes, ceiling 25 %."""
    with pytest.raises(MemobenchError, match=f"env.replan_steps is {declared}, but the policy executes 400 actions"):
        MemobenchEnvConfig(replan_steps=declared).settings_for(SimpleNamespace(n_action_steps=400))


PLANS = {
    **dict.fromkeys(["evo1", "pi0", "pi05", "pi0_fast", "smolvla", "memobench_mem"], (50, 1)),
    **dict.fromkeys(["fastwam", "wall_x", "xvla"], (32, 1)),
    **{
        "act": (100, 1),
        "eo1": (8, 1),
        "groot": (40, 1),
        "lingbot_va": (16, 1),
        "molmoact2": (30, 1),
        "vla_jepa": (7, 1),
    },
    **{"diffusion": (32, 2), "multi_task_dit": (24, 2), "tdmpc": (2, 1), "vqbet": (5, 5), "memobench_remote": (5, 1)},
    **dict.fromkeys(["gaussian_actor", "memobench_expert", "memobench_blind", "memobench_random"], (None, 1)),
}
"""Policy -> executed actions and observed steps of a plan under default settings, read in LeRobot 0.6.1: lengths of the
queues that `select_action` fills. None: it plans at every step."""


KNOWN = [name for name, each in PreTrainedConfig.get_known_choices().items() if each.__module__.startswith("lerobot")]


@pytest.mark.parametrize("policy", sorted({*KNOWN, *PLANS}))
def test_plans_of_all_policies(policy: str) -> None:
    own = {"vlm_config": {}} if policy == "eo1" else {}  # by default it reads the hub
    settings = MemobenchEnvConfig(suite=STRICT).settings_for(make_policy_config(policy, device="cpu", **own))
    assert (settings.replan_steps, settings.window_steps) == PLANS[policy]


def test_groot_executes_what_its_base_model_decodes(tmp_path: Path) -> None:
    """LeRobot's policy shortens 40 actions to 8 for NVIDIA's LIBERO model; a hold must end with those plans."""
    action = {"action": {"delta_indices": [*range(16)]}}
    processor = {"processor_kwargs": {"modality_configs": {"libero_sim": action}}}
    (tmp_path / "processor_config.json").write_text(json.dumps(processor))
    groot = make_policy_config("groot", device="cpu", base_model_path=str(tmp_path), embodiment_tag="libero_sim")
    assert MemobenchEnvConfig(suite=STRICT).settings_for(groot).replan_steps == 8


def test_strict_tasks_need_a_known_plan() -> None:
    """A server of vla-evaluation-harness queues its own plan, and a script opens environments without a policy."""
    queueing = make_policy_config("memobench_remote", dialect="vla_eval", device="cpu")
    for policy in (queueing, None):
        with pytest.raises(MemobenchError, match=r"set env\.replan_steps"):
            MemobenchEnvConfig(suite=STRICT).settings_for(policy)
        assert MemobenchEnvConfig(suite=STRICT, replan_steps=8).settings_for(policy).replan_steps == 8
        assert MemobenchEnvConfig().settings_for(policy).replan_steps == (None if policy is None else 1)


def test_averaged_plans_count_as_observed_steps() -> None:
    """ACT's temporal ensemble carries a plan over `chunk_size` steps, so a hold must be longer."""
    for coefficient, window in ((0.01, 100), (None, 1)):
        act = {"n_obs_steps": 1, "chunk_size": 100, "n_action_steps": 1, "temporal_ensemble_coeff": coefficient}
        assert MemobenchEnvConfig().settings_for(SimpleNamespace(**act)).window_steps == window


# --- the file ---


def test_folder_keeps_one_protocol_and_one_policy(tmp_path: Path) -> None:
    settings, acting = EnvSettings(horizon=5), Acting({"type": "act", "identity": "act 1"}, "pixels")
    facts = facts_of(settings, acting)
    check_facts(tmp_path / "new", facts)
    write_facts(tmp_path, facts)
    before = (tmp_path / EVALUATION_FILE).read_bytes()
    write_facts(tmp_path, facts)
    assert (tmp_path / EVALUATION_FILE).read_bytes() == before
    assert read_evaluation(tmp_path) == facts
    assert facts["protocol"] == {**settings.protocol_block, "inputs": "pixels"}
    check_facts(tmp_path, facts_of(settings, Acting()))  # what is unknown is no difference
    for other, named in (
        (facts_of(EnvSettings(horizon=6), acting), r"another protocol .*horizon: 5 and 6"),
        (
            {**facts, "protocol": facts["protocol"] | {SCENE_HASHES: 1}},
            r"another protocol .*scene_hash_version: 2 and 1",
        ),
        (facts_of(settings, Acting({"identity": "b"})), "another policy"),
    ):
        with pytest.raises(MemobenchError, match=named):
            write_facts(tmp_path, other)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "JSON"),
        ('{"format": 3, "protocol": {"horizon": -3}, "policy": {}}', "horizon"),
        ('{"format": 3, "protocol": {"suite": null}, "policy": {}}', "suite"),
        ('{"format": 2, "protocol": {}, "policy": {}}', "format"),
    ],
)
def test_damaged_and_other_files_are_named(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / EVALUATION_FILE).write_text(text)
    with pytest.raises(MemobenchError, match=rf"evaluation\.json.*{named}") as caught:
        read_evaluation(tmp_path)
    assert "\n" not in str(caught.value)


def test_resuming_needs_the_whole_file(tmp_path: Path) -> None:
    assert not has_evaluation(tmp_path)
    for place in (tmp_path, tmp_path / "no.json"):
        with pytest.raises(MemobenchError, match="missing"):
            read_evaluation(place, whole=True)
    start = {"command": [], "batch_size": 1, "versions": {}, "git_commit": None, "machine": {}}
    parts = {"format": FORMAT, "protocol": {"tasks": [], "episodes": 0}, "policy": {}, "written": "", "settings": {}}
    others = {"checkpoint": None, "trained_on": None, "task_files": {}, "shard": None, "runs": [start]}
    whole = parts | others
    file = tmp_path / EVALUATION_FILE
    file.write_text(json.dumps(whole))
    assert read_evaluation(tmp_path, whole=True) == whole
    lacking = [{k: v for k, v in whole.items() if k != key} for key in others]
    lacking.append({**whole, "protocol": {"tasks": []}})
    for content in lacking:
        file.write_text(json.dumps(content))
        assert read_evaluation(tmp_path)
        with pytest.raises(MemobenchError, match="found no"):
            read_evaluation(tmp_path, whole=True)


def test_the_page_of_the_protocol_names_each_setting() -> None:
    page = (Path(__file__).parents[2] / "docs" / "benchmark" / "protocol.md").read_text()
    section = page[page.index("## Settings that must agree") : page.index("## Report at least")]
    assert {setting.name for setting in dataclasses.fields(EnvSettings)} - {*NOT_COMPARED} <= {*section.split("`")}
