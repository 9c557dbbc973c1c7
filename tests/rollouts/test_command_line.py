"""A command line becomes LeRobot's settings; an unknown key or value is refused with the nearest known one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import draccus
import pytest
from lerobot.configs.train import TrainPipelineConfig

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.commands.command_line import (
    lerobot_commands,
    parse_words,
    read_words,
    recipe_file,
    recipes,
    value_of,
)
from lerobot_memobench.errors import MemobenchError


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lerobot_memobench.commands.command_line.register_plugins", lambda: None)


def values(command: str, *words: str) -> dict[str, Any]:
    return dict(read_words(command, parse_words(words)).words)


def test_a_line_is_split() -> None:
    found = parse_words(
        ["env=memobench", "--policy.type", "act", "--seed=3", "tasks=a=b", "--resume", "x=1", "--n", "-1", "--m", "-"]
    )
    assert found == {
        **{"env": "memobench", "policy.type": "act", "seed": "3", "tasks": "a=b", "resume": "true", "x": "1"},
        **{"n": "-1", "m": "-"},
    }
    assert parse_words(["-h"]) == {"help": "true"}
    for word in ("memobench", "=x", "", "a b=c", "==", "-v", "--"):
        with pytest.raises(MemobenchError, match="expected key=value"):
            parse_words(["env=memobench", word])


UNDERSTOOD: list[tuple[str, list[str], dict[str, Any]]] = [
    ("eval", ["env=memobench"], {"env.type": "memobench"}),
    ("train", ["policy=memobench_mem", "align=none"], {"policy.type": "memobench_mem", "policy.align": "none"}),
    ("train", ["align=semantic", "policy=memobench_mem"], {"policy.type": "memobench_mem", "policy.align": "semantic"}),
    ("train", ["policy=act", "seed=None", "job_name=null"], {"policy.type": "act", "seed": "None", "job_name": "null"}),
    ("train", ["policy=act", "dataset=user/name"], {"policy.type": "act", "dataset.repo_id": "user/name"}),
    ("train", ["policy=act", "dataset=data"], {"policy.type": "act", "dataset.repo_id": "local/data"}),
    ("train", ["optimizer=adam", "optimizer.lr=1e-3"], {"optimizer.type": "adam", "optimizer.lr": "1e-3"}),
    ("eval", ["--seed=1", "seed=2", "seed=3"], {"seed": "3"}),
    ("eval", ["policy=act", "policy=diffusion"], {"policy.type": "diffusion"}),
    ("eval", ["--policy.type=act", "policy=user/name"], {"policy.path": "user/name"}),
    ("eval", ["policy=run", "policy.chunk_size=3"], {"policy.path": "run/checkpoints/last/pretrained_model"}),
    ("eval", ["policy=run/checkpoints/last"], {"policy.path": "run/checkpoints/last/pretrained_model"}),
    ("eval", ["policy=./act"], {"policy.path": "act"}),
    ("eval", ["env=memobench", "replan=5"], {"env.type": "memobench", "env.replan_steps": 5}),
    ("train", ["config_path=file.yaml", "align=semantic"], {"policy.align": "semantic"}),
]


@pytest.mark.parametrize(("command", "words", "found"), UNDERSTOOD, ids=[" ".join(case[1]) for case in UNDERSTOOD])
def test_words_become_settings_of_lerobot(command: str, words: list[str], found: dict[str, Any]) -> None:
    for folder in (Path("run/checkpoints/last/pretrained_model"), Path("act")):
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(json.dumps({"type": "act"}))
    Path("data").mkdir()
    Path("file.yaml").write_text("policy: {type: memobench_mem}\nenv: {type: memobench}")
    result = values(command, *words)
    assert {key: text for key, text in result.items() if key not in ("dataset.root", "policy.chunk_size")} == found
    assert result.get("dataset.root", "data") == "data"


def test_other_commands_get_their_arguments_as_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[Any] = []
    monkeypatch.setattr("lerobot_memobench.cli.lerobot.call_lerobot", lambda *words: called.extend(words) or 0)
    assert main(["record", "--a", "-v", "b=c", "--policy.type=x"]) == 0
    assert called == ["record", ["--a", "-v", "--b=c", "--policy.type=x"]]
    assert {"train", "eval", "record", "dataset-viz"} <= set(lerobot_commands())


@pytest.mark.parametrize(
    ("command", "words", "named"),
    [
        ("eval", ["env=memobensh"], "'memobench'"),
        ("eval", ["env=memobench", "episode=3"], "'episodes'"),
        ("eval", ["env="], "env= is empty"),
        ("eval", ["env=memobench", "env.horizon.x=1"], "'env.horizon.x'"),
        ("eval", ["env=memobench", "policy=act", "policy.type.x=1"], "policy.type.x"),
        ("eval", ["env=memobench", "env.horizn=3"], "'env.horizon'"),
        ("eval", ["env=memobench", "--policy.type=atc"], "'act'"),
        ("eval", ["env=memobench", "episodes=many"], "episodes=many: expected a whole number"),
        ("eval", ["env=memobench", "env.demonstration_prompt=perhaps"], "true or false"),
        ("eval", ["env=memobench", "policy=act", "align=semantic"], "ACTConfig"),
        ("eval", ["env=memobench", "align=semantic"], "policy="),
        ("eval", ["env=memobench", "policy=./nowhere"], "does not exist"),
        ("eval", ["env=memobench", "rename_map.a.b=c"], """rename_map='{"a": …}'"""),
        ("eval", ["policy=act", "policy.discover_packages_path=not_here"], "not_here"),
        ("eval", ["--config_path=broken.yaml"], "neither YAML nor JSON"),
        ("eval", ["policy=act", "env.horizon=3"], "needs env="),
        ("eval", ["env=memobench", "policy=folder"], "no config.json"),
        ("eval", ["--config_path=x.yaml"], "x.yaml: there is no such file"),
        ("train", ["policy=act", "dataset=outputs/no"], "no such folder"),
        ("train", ["policy=act", "dataset=no"], "no such folder"),
    ],
)
def test_mistakes_name_the_nearest_setting(command: str, words: list[str], named: str) -> None:
    Path("folder").mkdir()
    Path("broken.yaml").write_text("a: {")
    with pytest.raises(MemobenchError) as caught:
        read_words(command, parse_words(words)).build()
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_recipes_go_by_name_and_files_by_path() -> None:
    Path("train_paper").write_text("steps: 1")
    assert recipe_file("train_paper") == recipes()["train_paper"]
    assert recipe_file("./train_paper") == Path("train_paper")
    for name in ("train_papr", "nowhere.yaml"):
        with pytest.raises(MemobenchError, match=name):
            recipe_file(name)


def test_settings_of_a_checkpoint_are_overridden() -> None:
    Path("act").mkdir()
    Path("act/config.json").write_text(json.dumps({"type": "act", "chunk_size": 30, "dim_model": 64}))
    policy: Any = read_words("eval", parse_words(["policy=./act", "policy.n_action_steps=3"])).build_field("policy")
    assert (policy.chunk_size, policy.dim_model, policy.n_action_steps) == (30, 64, 3)
    assert policy.pretrained_path == Path("act")


def test_a_value_may_be_null_only_where_the_type_allows() -> None:
    for annotation in (bool, int, float):
        for text in ("null", "none", "~"):
            with pytest.raises(MemobenchError, match=f"key={text}"):
                value_of("key", annotation, text)
            assert value_of("key", annotation | None, text) is None
    assert value_of("key", dict[str, bool], "{content: false}") == {"content": False}
    assert value_of("key", str | None, "none") == "none"
    assert value_of("key", list[int] | None, "[1, 2]") == [1, 2]


NAMES = ("run #2", "2026-11-28", "007", "on", "run: 2", "obj [v2]", "1e3", "NaN", "!x", "'a'", " x ", "é", "include x")


def test_names_reach_lerobot_as_they_are_typed() -> None:
    for name in NAMES:
        Path(name).mkdir()
        line = ["policy=memobench_strict", f"dataset={name}", f"output_dir={name}", f"policy.repo_id=user/{name}"]
        trained: Any = read_words("train", parse_words(line)).build()
        assert (trained.output_dir, Path(trained.dataset.root or "")) == (Path(name), Path(name))
        assert trained.dataset.repo_id == f"local/{name}"
        assert trained.policy.repo_id == f"user/{name}"
        written = json.dumps(draccus.encode(trained))  # LeRobot's trainer receives it as JSON
        assert json.dumps(draccus.encode(draccus.decode(TrainPipelineConfig, json.loads(written)))) == written
