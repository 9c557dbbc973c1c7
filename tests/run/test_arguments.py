"""A command line becomes LeRobot's flags; what is unknown is named with what is near."""

from __future__ import annotations

import json
import os
from pathlib import Path

import lerobot.scripts.lerobot_eval
import lerobot.scripts.lerobot_train
import pytest
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.arguments import (
    LerobotArguments,
    check_task_names,
    checked_value,
    flag_value,
    read_arguments,
    recipe_file,
    recipes,
    split_arguments,
    translate,
    whole_number,
    without_flags,
)
from lerobot_memobench.run.lerobot_commands import config_class, lerobot_commands, load_command


def test_a_line_is_taken_apart() -> None:
    given = split_arguments(["env=memobench", "--policy.type", "act", "-v", "--seed=3", "tasks=a=b", "--resume"])
    assert given.pairs == [("env", "memobench"), ("tasks", "a=b")]
    assert given.flags == ["--policy.type=act", "-v", "--seed=3", "--resume"]
    assert not given.wants_help


@pytest.mark.parametrize("word", ["memobench", "=x", "", "a b=c", "=="])
def test_a_word_that_is_neither_is_refused(word: str) -> None:
    with pytest.raises(MemobenchError, match="expected key=value"):
        split_arguments(["env=memobench", word])


def test_flags_are_found() -> None:
    flags = ["--a.b=1", "--c=2", "--d", "--a.b=3", "--ab=4"]
    assert flag_value(flags, "a.b") == "3"
    assert flag_value(flags, "d") is None
    assert LerobotArguments(tuple(flags)).has("d")
    assert not LerobotArguments(tuple(flags)).has("a")
    assert without_flags(flags, "a.b", "d") == ["--c=2", "--ab=4"]


def test_numbers() -> None:
    assert [whole_number(text) for text in ("7", "-1", "null", None)] == [7, -1, None, None]


def evaluated(*words: str) -> list[str]:
    return list(translate("eval", split_arguments(words), EvalPipelineConfig, {}).flags)


def trained(*words: str) -> list[str]:
    return list(translate("train", split_arguments(words), TrainPipelineConfig, {}).flags)


def test_the_commands_of_the_readme() -> None:
    assert evaluated("env=memobench") == ["--env.type=memobench"]
    assert trained("policy=memobench_mem", "align=contrastive") == [
        "--policy.type=memobench_mem",
        "--policy.align=contrastive",
    ]


def test_short_forms_of_train() -> None:
    flags = trained("policy=act", "dataset=user/name", "steps=50", "batch_size=4", "seed=1")
    assert flags == [
        "--policy.type=act",
        "--dataset.repo_id=user/name",
        "--steps=50",
        "--batch_size=4",
        "--seed=1",
    ]


def test_dotted_keys_and_untouched_flags() -> None:
    flags = evaluated(
        "--env.type=memobench", "--policy.type", "act", "eval.use_async_envs=false", "policy.chunk_size=10"
    )
    assert flags == [
        "--env.type=memobench",
        "--policy.type=act",
        "--eval.use_async_envs=false",
        "--policy.chunk_size=10",
    ]


def test_an_optimizer_is_chosen_like_a_policy() -> None:
    flags = ["--optimizer.type=adam", "--optimizer.lr=1e-3"]
    assert trained("policy=act", "optimizer=adam", "optimizer.lr=1e-3")[1:] == flags
    assert trained("policy=act", "optimizer.type=adam", "optimizer.lr=1e-3")[1:] == flags
    with pytest.raises(MemobenchError, match=r"needs optimizer="):
        trained("policy=act", "optimizer.lr=1e-3")


def test_a_type_of_a_package_that_lerobot_will_look_for_is_left_to_it() -> None:
    flags = ["--policy.type=mine", "--policy.discover_packages_path=my_package"]
    assert trained(*flags, "steps=1") == [*flags, "--steps=1"]


def test_a_visual_encoder_has_a_short_form() -> None:
    assert trained("policy=memobench_mem", "visual_encoder=package")[1:] == ["--policy.visual_encoder=package"]


def test_the_order_of_words_does_not_matter() -> None:
    assert "--policy.align=semantic" in trained("align=semantic", "policy=memobench_mem")


def test_none_is_a_word_for_text_and_nothing_for_numbers() -> None:
    assert trained("policy=memobench_mem", "align=none")[1:] == ["--policy.align=none"]
    assert trained("policy=act", "seed=None", "job_name=null")[1:] == ["--seed=null", "--job_name=null"]


def test_a_checkpoint_folder_is_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"type": "act"}))
    assert evaluated("env=memobench", f"policy={folder}")[1] == f"--policy.path={folder}"
    assert evaluated("env=memobench", f"policy={tmp_path / 'run'}")[1] == f"--policy.path={folder}"
    monkeypatch.chdir(tmp_path / "run" / "checkpoints" / "last")
    flags = evaluated("env=memobench", "policy=pretrained_model", "policy.chunk_size=3")
    assert flags[1:] == ["--policy.path=pretrained_model", "--policy.chunk_size=3"]


def test_a_name_with_a_slash_is_a_repository() -> None:
    assert evaluated("env=memobench", "policy=lerobot/pi05_base")[1] == "--policy.path=lerobot/pi05_base"


@pytest.mark.parametrize("holds_checkpoint", [True, False])
def test_a_known_type_is_the_type_and_a_folder_is_a_path(
    holds_checkpoint: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "act").mkdir()
    if holds_checkpoint:
        (tmp_path / "act" / "config.json").write_text(json.dumps({"type": "diffusion"}))
    monkeypatch.chdir(tmp_path)
    assert evaluated("env=memobench", "policy=act", "policy.chunk_size=3")[1] == "--policy.type=act"
    notes = [record.getMessage() for record in caplog.records]
    told = "policy=act is the policy type; the checkpoint in the folder of that name is policy=./act"
    assert notes == [told] * holds_checkpoint
    if holds_checkpoint:
        assert evaluated("env=memobench", "policy=./act")[1] == "--policy.path=act"


def test_a_recipe_is_the_recipe_and_a_file_is_a_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "train_paper").write_text("steps: 1")
    monkeypatch.chdir(tmp_path)
    assert recipe_file("train_paper") == recipes()["train_paper"]
    assert "the file of that name is config=./train_paper" in caplog.text
    assert recipe_file("./train_paper") == Path("train_paper")


def test_a_dataset_folder_is_a_root(tmp_path: Path) -> None:
    folder = tmp_path / "demos"
    folder.mkdir()
    assert trained("policy=act", f"dataset={folder}")[1:] == [
        "--dataset.repo_id=local/demos",
        f"--dataset.root={folder}",
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env=memobensh"], "there is no env 'memobensh', did you mean 'memobench'"),
        (["env=memobench", "policy=memobench_men"], "'memobench_mem'"),
        (["env=memobench", "episode=3"], "no setting 'episode', did you mean 'episodes'"),
        (["env=memobench", "env.horizn=3"], "'env.horizon'"),
        (["env=memobench", "policy=act", "policy.chunksize=3"], "'policy.chunk_size'"),
        (["env=memobench", "--policy.type=atc"], "there is no policy 'atc', did you mean 'act'"),
        (["env=memobench", "episodes=many"], "episodes=many: expected a whole number"),
        (["env=memobench", "env.demonstration_prompt=perhaps"], "expected true or false"),
        (["env=memobench", "policy=act", "policy.dropout=x"], "expected a number"),
        (["env=memobench", "policy=act", "align=semantic"], "ACTConfig"),
        (["env=memobench", "align=semantic"], "name one with policy="),
        (["policy=act", "env.horizon=3"], "needs env="),
        (["env=memobench", "policy="], "policy= is empty"),
        (["env=memobench", "policy=./nowhere"], "does not exist"),
        (["env=memobench", "policy=/a/b/c"], "does not exist"),
    ],
)
def test_what_is_unknown_is_named_with_what_is_near(words: list[str], message: str) -> None:
    with pytest.raises(MemobenchError) as caught:
        evaluated(*words)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_that_is_no_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"no checkpoint \(no config.json\)"):
        evaluated("env=memobench", f"policy={tmp_path}")


@pytest.mark.parametrize("name", ["./nowhere", "nowhere", "/a/b", "a/b/c"])
def test_a_dataset_that_can_only_be_a_folder_must_be_there(name: str) -> None:
    with pytest.raises(MemobenchError, match="no such folder"):
        trained("policy=act", f"dataset={name}")


def test_a_config_file_may_hold_the_choices() -> None:
    file = {"policy": {"type": "memobench_mem"}, "env": {"type": "memobench"}}
    settings = translate("train", split_arguments(["align=semantic", "env.horizon=3"]), TrainPipelineConfig, file)
    assert list(settings.flags) == ["--policy.align=semantic", "--env.horizon=3"]


def test_a_command_without_a_configuration_takes_any_key() -> None:
    assert list(translate("dataset-viz", split_arguments(["repo-id=a/b"]), None, {}).flags) == ["--repo-id=a/b"]


def test_what_is_added_never_overrides() -> None:
    given = LerobotArguments(("--seed=3",))
    settings = given.default("seed", 7).default("env.expert_action", True)
    assert list(settings.flags) == ["--seed=3", "--env.expert_action=true"]
    assert list(given.flags) == ["--seed=3"]


def test_what_is_changed_replaces() -> None:
    assert list(LerobotArguments(("--seed=3", "--x=1")).changed("seed", 5).flags) == ["--x=1", "--seed=5"]


STRICT, PUBLISHED = "open_and_close_the_microwave_a_given_number_of_times", "open_and_close_the_microwave"


@pytest.mark.parametrize(
    "words",
    [
        ["env=memobench", "suite=strict"],
        ["env=memobench", "suite=strict", f"tasks={STRICT},spatial"],
        ["--env.type=memobench", "--env.suite=strict", f"--env.tasks={STRICT}"],
        ["env=memobench", f"tasks={PUBLISHED}"],
        ["env=memobench", "--config_path=settings.yaml", f"tasks={STRICT}"],
    ],
)
def test_tasks_of_the_suite_are_known(words: list[str]) -> None:
    check_task_names(split_arguments(words))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env=memobench", f"tasks={STRICT}"], "task of the strict suite; set suite=strict"),
        (["env=memobench", "suite=strict", f"tasks={PUBLISHED}"], "task of the published suite"),
        (["env=memobench", "suite=strikt"], "suite is 'strikt'; did you mean 'strict'"),
    ],
)
def test_others_are_refused_in_a_sentence(words: list[str], said: str) -> None:
    with pytest.raises(MemobenchError) as error:
        check_task_names(split_arguments(words))
    assert said in str(error.value)


def test_every_command_of_lerobot_is_there() -> None:
    assert {"train", "eval", "record", "dataset-viz", "edit-dataset", "info"} <= set(lerobot_commands())


def test_their_configurations_are_found() -> None:
    assert config_class(lerobot.scripts.lerobot_eval.main) is EvalPipelineConfig
    assert config_class(lerobot.scripts.lerobot_train.main) is TrainPipelineConfig


@pytest.mark.parametrize("chosen", [None, "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"])
def test_torch_waits_briefly_in_evaluations_unless_told_otherwise(
    chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {"HOME": "/nowhere"} | ({chosen: "ACTIVE"} if chosen else {})
    monkeypatch.setattr(os, "environ", dict(before))
    load_command("train")
    assert os.environ.get("GOMP_SPINCOUNT") == before.get("GOMP_SPINCOUNT")
    load_command("eval")
    assert os.environ.get("GOMP_SPINCOUNT") == (before.get("GOMP_SPINCOUNT") if chosen else "2000")
    assert os.environ.get("OMP_WAIT_POLICY") == before.get("OMP_WAIT_POLICY")


def test_a_mapping_is_handed_on_as_lerobot_reads_it_beside_a_checkpoint() -> None:
    assert checked_value("policy.memory_settings", dict[str, bool], "{content: false}") == '{"content": false}'


@pytest.mark.parametrize(
    ("key", "annotation"), [("demonstration_prompt", bool), ("horizon", int), ("resume", bool), ("lr", float)]
)
@pytest.mark.parametrize("text", ["null", "none", "~"])
def test_what_must_have_a_value_is_not_nothing(key: str, annotation: type, text: str) -> None:
    with pytest.raises(MemobenchError, match=f"{key}={text}: expected"):
        checked_value(key, annotation, text)
    assert checked_value(key, annotation | None, text) == "null"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env=memobench", "env.horizon.x=1"], "no setting 'env.horizon.x'"),
        (["env=memobench", "policy=act", "policy.type.x=1"], "no setting 'policy.type.x'"),
        (["env=memobench", "rename_map.a=b"], """say rename_map='{"a": …}'"""),
        (["env=memobench", "rename_map={"], "rename_map={: expected a mapping"),
        (["env=memobench", "rename_map=a"], "rename_map=a: expected a mapping"),
        (["env="], "env= is empty; expected a name"),
        (["env=memobench", "eval=3"], "eval=3: eval holds settings; expected one of them, such as eval.n_episodes="),
    ],
)
def test_sections_and_mappings_are_told(words: list[str], said: str) -> None:
    with pytest.raises(MemobenchError) as error:
        read_arguments("eval", split_arguments(words))
    assert said in str(error.value)
