"""One table of settings for everything that takes them: the same values are accepted and refused everywhere."""

from __future__ import annotations

import dataclasses
import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.evaluation_file import (
    EARLIER_CARD,
    EARLIER_PROTOCOL,
    EVALUATION_FILE,
    check_protocol,
    protocol_of,
    read_evaluation,
    write_protocol,
)
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.settings import NOT_COMPARED, SETTINGS, EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import EVALUATION_SEED, HORIZON, UPSTREAM_HORIZON
from lerobot_memobench.tasks.catalogue import get_task

STOVE = "turn_on_the_stove_and_turn_it_off"

TAKERS: dict[str, Callable[..., object]] = {
    "settings": lambda **asked: EnvSettings().changed(**asked),
    "configuration": lambda **asked: MemobenchEnvConfig(**asked),
    "environment": lambda **asked: MemobenchEnv(STOVE, **asked),
    "episode": lambda **asked: Episode(get_task(STOVE), **asked),
}

BAD: list[tuple[str, Any]] = [
    ("suite", "strikt"),
    ("world", "robosuite"),
    ("protocol", "papers"),
    ("seed_base", -1),
    ("obs_type", "state"),
    ("referent", "randon"),
    ("referent", "drawn"),
    ("demonstration_prompt", "yes"),
    ("prompt_in", "rest"),
    ("horizon", 0),
    ("horizon", "60"),
    ("horizon", True),
    ("replan_steps", 0),
    ("render", "ultra"),
    ("oracle_memory", 1),
    ("pause_steps", -1),
    ("speed", 0.0),
    ("speed", 0.7),
    ("speed", 2.0),
    ("speed", float("nan")),
    ("speed", "0.5"),
    ("evidence", True),  # with the published referent alone there is nothing to choose from
    ("videos", -2),
]


@pytest.mark.parametrize("taker", TAKERS)
@pytest.mark.parametrize(("name", "value"), BAD, ids=[f"{name}={value}" for name, value in BAD])
def test_a_bad_value_is_refused_by_everything_that_takes_settings(taker: str, name: str, value: Any) -> None:
    if name == "suite" and taker == "environment":
        pytest.skip("an environment has the suite of its task")
    if (name, taker) == ("render", "episode"):
        pytest.skip("an episode takes size and quality of its frames")
    with pytest.raises(MemobenchError, match=name) as caught:
        TAKERS[taker](**{name: value})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("taker", ["settings", "environment", "episode"])
def test_an_unknown_setting_names_the_nearest(taker: str) -> None:
    with pytest.raises(MemobenchError, match=r"'horizn'.*'horizon'"):
        TAKERS[taker](horizn=5)


@pytest.mark.parametrize(("name", "value"), [("task", STOVE), ("fps", 30), ("task_dir", "somewhere")])
def test_a_field_of_lerobots_that_has_no_use_here_is_refused(name: str, value: Any) -> None:
    with pytest.raises(MemobenchError, match=name):
        MemobenchEnvConfig(tasks="object", **{name: value})


def test_bad_settings_leave_no_file_behind(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=STOVE):
        MemobenchEnvConfig(tasks="turn_on_the_stofe_and_turn_it_off", log_dir=str(tmp_path / "log")).create_envs(1)
    assert not (tmp_path / "log").exists()


def test_every_setting_has_a_meaning_and_reaches_configuration_environment_and_protocol() -> None:
    fields = {each.name: each for each in dataclasses.fields(EnvSettings)}
    assert all(each.metadata["meaning"] for each in fields.values())
    assert set(SETTINGS) == set(fields) - set(NOT_COMPARED)
    config = MemobenchEnvConfig(horizon=5, pause_steps=3, videos=2)
    assert config.gym_kwargs == dataclasses.asdict(config.settings)
    assert (config.horizon, config.pause_steps, config.videos) == (5, 3, 2)
    assert set(config.settings.protocol_block) == set(SETTINGS)
    env = MemobenchEnv(STOVE, config.settings, speed=0.5)
    assert env.settings == config.settings.changed(speed=0.5, prompt_in="steps")
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.settings.horizon = 7  # type: ignore[misc]


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ({"suite": "strict"}, {"referent": "drawn", "idle": 1800, "goals": 2}),
        ({"protocol": "upstream"}, {"demonstration_prompt": False, "horizon": UPSTREAM_HORIZON}),
        ({"protocol": "upstream", "horizon": 5}, {"horizon": 5}),
        ({}, {"horizon": HORIZON, "seed_base": EVALUATION_SEED, "world": "memobench"}),
    ],
)
def test_a_suite_and_a_protocol_decide_other_settings(asked: dict[str, Any], found: dict[str, Any]) -> None:
    block = EnvSettings(**asked).protocol_block
    assert {name: block[name] for name in found} == found
    assert vars(MemobenchEnvConfig(**asked)).items() >= {k: v for k, v in found.items() if k in SETTINGS}.items()


@pytest.mark.parametrize(
    "asked",
    [
        {"suite": "strict"},
        {"referent": "random"},
        {"oracle_memory": True},
        {"pause_steps": 3},
        {"speed": 0.5},
        {"referent": "random", "evidence": True},
    ],
)
def test_the_authors_evaluation_has_no_controls(asked: dict[str, Any]) -> None:
    with pytest.raises(MemobenchError, match="protocol=upstream"):
        EnvSettings(protocol="upstream", **asked)


@pytest.mark.parametrize(
    ("policy", "prompt_in", "replan"),
    [
        (None, "steps", None),
        (type("P", (), {"n_action_steps": 4}), "reset", 4),
        (type("P", (), {"reads_prompt": True}), "steps", None),
    ],
)
def test_settings_that_follow_from_the_policy(policy: Any, prompt_in: str, replan: int | None) -> None:
    settings = MemobenchEnvConfig().settings_for(policy)
    assert (settings.prompt_in, settings.replan_steps) == (prompt_in, replan)
    named = MemobenchEnvConfig(prompt_in="steps", replan_steps=2).settings_for(policy)
    assert (named.prompt_in, named.replan_steps) == ("steps", 2)


# --- the file ---


def test_the_protocol_of_a_folder_is_written_once_and_another_refused(tmp_path: Path) -> None:
    block = EnvSettings(horizon=5).protocol_block
    write_protocol(tmp_path, block)
    before = (tmp_path / EVALUATION_FILE).read_bytes()
    write_protocol(tmp_path, block)
    assert (tmp_path / EVALUATION_FILE).read_bytes() == before
    assert protocol_of(tmp_path) == block
    assert check_protocol(tmp_path, block)
    assert not check_protocol(tmp_path / "new", block)
    with pytest.raises(MemobenchError, match=r"another protocol .*horizon: 5 and 6"):
        write_protocol(tmp_path, {**block, "horizon": 6})
    write_protocol(tmp_path / "of_a_policy", {**block, "policy": {"identity": "a"}})
    with pytest.raises(MemobenchError, match="another policy"):
        write_protocol(tmp_path / "of_a_policy", {**block, "policy": {"identity": "b"}})


def test_files_of_earlier_versions_are_read_as_one(tmp_path: Path) -> None:
    card = {"protocol": {"tasks": ["a"], "episodes": 2, "horizon": 5}, "policy": {"type": "act"}}
    (tmp_path / EARLIER_CARD).write_text(json.dumps(card))
    (tmp_path / EARLIER_PROTOCOL).write_text(json.dumps({"horizon": 5, "render_every": 1, "prompt_in": "steps"}))
    found = read_evaluation(tmp_path)
    assert found["policy"] == {"type": "act"}
    assert found["protocol"] == {**card["protocol"], "render_every": 1, "prompt_in": "steps"}
    assert check_protocol(tmp_path, EnvSettings(horizon=5, prompt_in="steps").protocol_block)
    (tmp_path / EARLIER_PROTOCOL).write_text(json.dumps({"horizon": 5, "render_every": 8}))
    with pytest.raises(MemobenchError, match="render_every: 8 and 1"):
        check_protocol(tmp_path, EnvSettings(horizon=5).protocol_block)
    card_file = tmp_path / EARLIER_CARD
    card_file.with_name(f"{EARLIER_CARD}.gz").write_bytes(gzip.compress(card_file.read_bytes()))
    card_file.unlink()
    assert read_evaluation(card_file) == card
    write_protocol(tmp_path / "new", EnvSettings().protocol_block)
    assert read_evaluation(tmp_path / "new")["format"] == 2


@pytest.mark.parametrize("name", [EVALUATION_FILE, EARLIER_CARD, EARLIER_PROTOCOL])
@pytest.mark.parametrize(
    "text", ["", "[]", '{"protocol": 3, "horizon": "x"}', "\x00", '{"protocol": {"horizon": -3}, "horizon": []}']
)
def test_a_damaged_file_is_named(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(MemobenchError, match=name.replace(".", r"\.")) as caught:
        protocol_of(tmp_path)
    assert "\n" not in str(caught.value)


def test_an_absent_file_is_an_empty_one_unless_all_of_it_is_needed(tmp_path: Path) -> None:
    assert read_evaluation(tmp_path) == protocol_of(tmp_path) == protocol_of(tmp_path / "new") == {}
    with pytest.raises(MemobenchError, match="missing"):
        read_evaluation(tmp_path, whole=True)
    with pytest.raises(MemobenchError, match="missing"):
        read_evaluation(tmp_path / "no.json", whole=True)
