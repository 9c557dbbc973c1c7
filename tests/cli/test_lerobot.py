"""The command ``lerobot``: what LeRobot's own commands are called with, and what a mistake costs."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.error import URLError

import lerobot.scripts.lerobot_eval
import lerobot.scripts.lerobot_train
import numpy as np
import pytest
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy_config
from safetensors.numpy import save_file

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.datasets.lerobot_format.layout import DEFAULT_REPO_ID
from lerobot_memobench.envs.command_line import overrides
from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import check_checkpoint, folder_with_checkpoint
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.protocol import CLOCK
from lerobot_memobench.run.arguments import (
    OPTIONS,
    SHORT_FORMS,
    flag_value,
    split_arguments,
)
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.training.resume import resumed

TASK = "turn_on_the_stove_and_turn_it_off"


class Called:
    """Stands for LeRobot's main function and remembers how it was called."""

    def __init__(self, module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        self.flags: list[str] | None = None
        self.program = ""
        self.action: Callable[[list[str]], Any] = lambda flags: None

        def fake() -> Any:
            self.program, *self.flags = sys.argv
            return self.action(self.flags)

        fake.__module__ = module.__name__
        monkeypatch.setattr(module, "main", fake)

    def value(self, key: str) -> str | None:
        assert self.flags is not None
        return flag_value(self.flags, key)


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def evaluation(fake_loop: Any) -> Any:
    return fake_loop


@pytest.fixture
def theirs(monkeypatch: pytest.MonkeyPatch, in_folder: Path) -> Called:
    return Called(lerobot.scripts.lerobot_eval, monkeypatch)


class CalledTraining(Called):
    """Stands for the loop of memory policies, and for the process of LeRobot's trainer."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.flags: list[str] | None = None
        self.action: Callable[[list[str]], Any] = lambda flags: 0
        package = "lerobot_memobench.training"
        monkeypatch.setattr(f"{package}.command.run_lerobot", self)
        monkeypatch.setattr(f"{package}.view.viewed", lambda arguments, *_: arguments)
        monkeypatch.setattr(f"{package}.configuration.read_training", lambda flags: flags)
        monkeypatch.setattr(f"{package}.loop.train", self)

    def __call__(self, flags: Any) -> Any:
        self.flags = [*flags]
        return self.action(self.flags)


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch, in_folder: Path) -> Called:
    return CalledTraining(monkeypatch)


def log_episodes(folder: Path, count: int) -> None:
    """Write what environments would have logged."""
    log = EpisodeLog(folder)
    for k in range(count):
        log.append(
            {
                "task": TASK,
                "memory_type": "temporal",
                "episode": k,
                "seed": 7 + k,
                "success": True,
                "checkpoints": [{"operation": "S", "first_step": 1, "ordered_step": 1}],
            }
        )


def checkpoint(folder: Path, statistics: tuple[str, ...] = ("observation.state.mean", "action.mean")) -> Path:
    """Write what matters of a checkpoint of LeRobot's."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"type": "act", "device": "cpu"}))
    save_file({"w": np.zeros(1)}, folder / "model.safetensors")
    save_file({name: np.zeros(1) for name in (*statistics, "other.mean")}, folder / "stats.safetensors")
    config = {
        "features": {
            "observation.state": {"type": "STATE", "shape": [8]},
            "observation.images.image": {"type": "VISUAL", "shape": [3, 256, 256]},
            "action": {"type": "ACTION", "shape": [7]},
        },
        "norm_map": {"STATE": "MEAN_STD", "ACTION": "MEAN_STD", "VISUAL": "IDENTITY"},
    }
    for name in ("policy_preprocessor", "policy_postprocessor"):
        prefix = "un" if "post" in name else ""
        step = {
            "registry_name": prefix + "normalizer_processor",
            "config": config,
            "state_file": "stats.safetensors",
        }
        (folder / f"{name}.json").write_text(json.dumps({"name": name, "steps": [step]}))
    return folder


# --- LeRobot's commands ---


def test_without_a_command_it_tells_which_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "dataset-viz" in capsys.readouterr().out


def test_an_unknown_command_names_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evl", "env=memobench"]) == 2
    assert capsys.readouterr().err.startswith("lerobot: there is no command 'evl', did you mean 'eval'")


# --- eval ---


def test_the_report_is_written_and_printed(evaluation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "env=memobench", f"tasks={TASK}", "episodes=2", "output_dir=out"]) == 0
    assert json.loads(Path("out/report.json").read_text())["average"]["SR"] == 50.0
    assert Path("out/report.md").is_file()
    assert len(Path("out/episodes.jsonl").read_text().splitlines()) == 2
    out = capsys.readouterr().out
    assert TASK in out
    assert out.startswith("evaluating memobench_expert on 1 task, 2 episodes each, into out\n")


def test_surplus_episodes_are_not_reported(evaluation: Any) -> None:
    evaluation.before = lambda plan: log_episodes(plan.log, 4)
    assert main(["eval", "env=memobench", f"tasks={TASK}", "episodes=3", "output_dir=out"]) == 0
    assert json.loads(Path("out/report.json").read_text())["average"]["n"] == 3


def test_an_earlier_evaluation_is_not_mixed_in(evaluation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    log_episodes(Path("out"), 1)
    assert main(["eval", "env=memobench", "output_dir=out"]) == 2
    assert not evaluation.plans
    assert "already holds an evaluation" in capsys.readouterr().err


def test_an_environment_of_lerobots_own_gets_no_defaults(theirs: Called) -> None:
    assert main(["eval", "env=pusht", "policy=diffusion"]) == 0
    assert theirs.flags == ["--env.type=pusht", "--policy.type=diffusion"]


def test_help_is_passed_on(theirs: Called, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "env=memobench", "--help"]) == 0
    assert theirs.flags == ["--help", "--env.type=memobench"]
    assert "tasks=\n" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["eval", "train"])
def test_help_explains_every_short_form(
    command: str, theirs: Called, training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help"]) == 0
    assert (theirs if command == "eval" else training).flags == ["--help"]
    told = capsys.readouterr().out
    explained = {word for line in told.splitlines() if line.endswith("=") for word in line.strip().split(", ")}
    assert {f"{word}=" for word in (*SHORT_FORMS[command], *OPTIONS[command], "policy")} <= explained
    assert not any(len(line) > 106 for line in told.splitlines())


# --- train ---


def test_train_as_the_table_says(training: Called, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_memobench.training.command.cores", lambda: 8)
    assert main(["train", "policy=memobench_mem", "align=contrastive"]) == 0
    assert training.flags == [
        "--policy.type=memobench_mem",
        "--policy.align=contrastive",
        f"--dataset.repo_id={DEFAULT_REPO_ID}",
        "--policy.push_to_hub=false",
    ]


def test_few_cores_get_few_loaders(training: Called, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_memobench.training.command.cores", lambda: 2)
    assert main(["train", "policy=act"]) == 0
    assert training.value("num_workers") == "2"


def test_train_pushes_where_a_repository_is_named(training: Called) -> None:
    assert main(["train", "policy=act", "policy.repo_id=user/name"]) == 0
    assert training.value("policy.push_to_hub") is None


def test_a_short_training_shows_its_loss(training: Called) -> None:
    assert main(["train", "policy=act", "steps=50"]) == 0
    assert training.value("log_freq") == "5"


EMPTY_DATASET = json.dumps({"codebase_version": "v3.0", "total_episodes": 0, "total_frames": 0, "features": {}})


def test_train_on_a_folder(training: Called, in_folder: Path) -> None:
    (in_folder / "demos" / "meta").mkdir(parents=True)
    (in_folder / "demos" / "meta" / "info.json").write_text(EMPTY_DATASET)
    assert main(["train", "policy=act", "dataset=demos"]) == 0
    assert training.value("dataset.repo_id") == "local/demos"
    assert training.value("dataset.root") == "demos"


def test_a_config_file_brings_its_own(training: Called, in_folder: Path) -> None:
    Path("train.yaml").write_text("policy: {type: memobench_mem}\ndataset: {repo_id: a/b}\n")
    assert main(["train", "config_path=train.yaml", "align=semantic"]) == 0
    assert training.flags == ["--config_path=train.yaml", "--policy.align=semantic"]


# --- a training is gone on with ---


def training_run(folder: Path, steps: int = 100, done: tuple[int, ...] = (40, 80), size: str = "tiny") -> Path:
    """Write what matters of a training run of LeRobot's; return the folder of its last checkpoint."""
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig

    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

    policy = MemobenchMemConfig(size=size, warmup_fraction=0.1, device="cpu", push_to_hub=False)
    config = TrainPipelineConfig(dataset=DatasetConfig(repo_id="a/b"), policy=policy, steps=steps, output_dir=folder)
    config.optimizer, config.scheduler = policy.get_optimizer_preset(), policy.get_scheduler_preset()
    for step in done:
        place = folder / "checkpoints" / f"{step:06d}"
        (place / "pretrained_model").mkdir(parents=True)
        (place / "training_state").mkdir()
        (place / "training_state" / "training_step.json").write_text(json.dumps({"step": step}))
        (place / "training_state" / "optimizer_param_groups.json").write_text("[]")
        config.save_pretrained(place / "pretrained_model")
        policy.save_pretrained(place / "pretrained_model")
        (place.parent / "last").unlink(missing_ok=True)
        (place.parent / "last").symlink_to(place.name)
    return place / "pretrained_model"


def test_a_training_goes_on_by_its_folder(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    training_run(Path("run"))
    # The command that began it, and resume=true behind it.
    words = ["train", "policy=memobench_mem", "dataset.repo_id=a/b", "output_dir=run", "steps=100", "resume=true"]
    assert main(words) == 0
    assert training.flags == [
        "--config_path=run/checkpoints/last/pretrained_model/train_config.json",
        "--resume=true",
        "--dataset.repo_id=a/b",
        "--output_dir=run",
        "--steps=100",
    ]
    assert capsys.readouterr().err == ""
    training.flags = None
    assert main(["train", "output_dir=run", "--resume"]) == 0
    assert training.value("config_path") == "run/checkpoints/last/pretrained_model/train_config.json"
    assert training.value("resume") == "true"
    for stated in ("run/checkpoints/000040/pretrained_model/train_config.json", "somebody/repository"):
        for resume in ("resume=true", "--resume=True"):
            given = split_arguments([f"config_path={stated}", resume])
            assert resumed(given) == given  # LeRobot's own form


@pytest.mark.parametrize("missing", ["training_step.json", "optimizer_param_groups.json"])
def test_a_copy_of_a_run_has_no_link(training: Called, missing: str) -> None:
    folder = training_run(Path("run"), done=(40, 80, 120), steps=200)
    (Path("run") / "checkpoints" / "last").unlink()
    (folder.parent / "training_state" / missing).unlink()  # killed while it was saved
    assert main(["train", "output_dir=run", "resume=true"]) == 0
    assert training.value("config_path") == "run/checkpoints/000080/pretrained_model/train_config.json"


@pytest.mark.parametrize("last", ["000040\n", None])
def test_a_copy_has_a_file_or_nothing_for_the_link(training: Called, last: str | None) -> None:
    training_run(Path("run"))
    link = Path("run/checkpoints/last")
    link.unlink()
    if last is not None:
        link.write_text(last)
    found = Path("run/checkpoints/000040" if last else "run/checkpoints/000080") / "pretrained_model"
    for text in ("run", "run/checkpoints/last", "run/checkpoints/last/pretrained_model"):
        assert folder_with_checkpoint(text) == found
    assert main(["train", "output_dir=run", "resume=true"]) == 0
    assert training.value("config_path") == str(found / "train_config.json")
    assert not link.exists(), "LeRobot makes it"


@pytest.mark.parametrize("text", [None, "what I thought of it"])
def test_what_is_no_link_is_no_place_for_one(
    text: str | None, training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = training_run(Path("run")).parent
    link = Path("run/checkpoints/last")
    link.unlink()
    if text is None:
        shutil.copytree(folder, link)
    else:
        link.write_text(text)
    assert str(link) in refused(["train", "output_dir=run", "resume=true"], training, capsys)
    assert link.exists()


def test_a_jump_of_the_learning_rate_is_noted(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    """A cosine down to a fiftieth over 100 steps is stretched to 200 when 80 are done."""
    from lerobot.configs.train import TrainPipelineConfig

    folder = training_run(Path("run"), size="small")
    peak = TrainPipelineConfig.from_pretrained(folder).optimizer.lr

    def rate(step: int, steps: int) -> float:
        return peak * (1 - 0.98 * (1 - math.cos(math.pi * step / steps)) / 2)

    assert main(["train", "output_dir=run", "resume=true", "steps=200"]) == 0
    assert f"jumps from {rate(80, 100):.2e} to {rate(80, 200):.2e}" in capsys.readouterr().err
    shutil.rmtree("run")
    training_run(Path("run"))  # constant
    assert main(["train", "output_dir=run", "resume=true", "steps=200"]) == 0
    assert capsys.readouterr().err == ""


def test_a_training_that_is_over(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    training_run(Path("run"), done=(40, 100))
    assert main(["train", "output_dir=run", "resume=true"]) == 0
    assert training.flags is None
    assert "has made all of its 100 steps; ask for more by steps=" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["output_dir=nowhere"], "output_dir=nowhere does not exist, so there is nothing to go on with"),
        (["output_dir=empty"], "output_dir=empty holds no whole checkpoint"),
        ([], "resume=true needs the folder of the training to go on with: output_dir=<folder>"),
        (["output_dir=run", "policy=act"], "the training in run is of policy=memobench_mem, and policy=act was asked"),
        (["output_dir=run", "config=train_paper"], "config=train_paper is given beside resume=true"),
        (["output_dir=run", "--config_path=recipe.yaml"], "config_path=recipe.yaml is given beside resume=true"),
    ],
)
def test_nothing_to_go_on_with(
    training: Called, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    training_run(Path("run"))
    Path("empty/checkpoints/000010").mkdir(parents=True)
    Path("recipe.yaml").write_text("steps: 100")
    assert message in refused(["train", "resume=true", *words], training, capsys)


def test_a_training_goes_on_as_it_was_begun(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = training_run(Path("run"))
    words = ["train", "output_dir=run", "resume=true"]
    free = ["steps=100", "save_freq=5", "num_workers=0", "device=cpu", "log_freq=1", "policy.n_action_steps=1"]
    same = ["align=none", "size=tiny", "policy.push_to_hub=false"]
    assert main([*words, *free, *same, "--policy.memory_stride", "1"]) == 0
    assert capsys.readouterr().err == ""
    training.flags = None
    for changed, said in {
        "align=semantic": "begun with align=none, and goes on with nothing else than that: found semantic",
        "policy.optimizer_lr=1e-5": "leave optimizer_lr out, or train a new run from the checkpoint: policy=run/",
        "--policy.ema_decay=0": "begun with ema_decay=0.999",
    }.items():
        assert said in refused([*words, changed], training, capsys)
    lerobots = ["train", f"config_path={checkpoint}/train_config.json", "align=semantic", "--resume"]
    assert "begun with align=none" in refused(lerobots, training, capsys)


def test_a_training_goes_on_with_its_dataset(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("mine", "other"):
        Path(name, "meta").mkdir(parents=True)
        Path(name, "meta", "info.json").write_text(EMPTY_DATASET)
    file = training_run(Path("run")) / "train_config.json"
    words = ["train", "output_dir=run", "resume=true"]
    new_run = (
        "train a new run from the checkpoint: policy=run/checkpoints/last/pretrained_model output_dir=<new folder>"
    )
    for changed in ("dataset=other", "dataset=c/d", "--dataset.repo_id=c/d", "--dataset.root=other"):
        said = refused([*words, changed], training, capsys)
        assert "begun on the dataset a/b, and" in said
        assert new_run in said
    assert "begun with dataset.episodes=None" in refused([*words, "episodes=[0, 1]"], training, capsys)

    config = json.loads(file.read_text())
    config["dataset"] |= {"repo_id": "local/mine", "root": "mine", "episodes": [0, 1]}
    file.write_text(json.dumps(config))
    Path("link").symlink_to("mine")
    for same in ("dataset=mine", f"dataset={Path('mine').absolute()}", "dataset=link", "episodes=[0, 1]"):
        assert main([*words, same]) == 0
        training.flags = None
    for changed in ("dataset=other", "dataset=c/d", "--dataset.root=other"):
        assert "begun on the dataset mine, and" in refused([*words, changed], training, capsys)
    shutil.rmtree("mine")
    said = refused([*words, "dataset=other"], training, capsys)
    assert "if that is the same, put it or a link to it at mine; else leave that out" in said


def test_other_settings_than_a_checkpoint_was_trained_with_are_told_of(
    training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "policy=memobench_small", "steps=1"]
    assert main([*words, "device=cpu"]) == 0
    assert capsys.readouterr().err == ""
    assert main([*words, "policy.memory_stride=2", "policy.memory_settings={frames: 4}"]) == 0
    assert training.value("policy.memory_stride") == "2"
    note = capsys.readouterr().err
    assert note.count("\n") == 1
    assert "memory_stride=8" in note.partition(" now ")[0]
    assert "memory_stride=2" in note.partition(" now ")[2]
    assert "'frames': 4" in note.partition(" now ")[2]


def test_another_memory_than_a_checkpoints_has_its_own_defaults(training: Called) -> None:
    """Of the checkpoint's it would take the stride, the fusion and the settings."""
    words = ["train", "policy=memobench_small", "steps=1", "device=cpu"]
    named = ("memory_stride", "memory_fusion", "memory_phase")
    for more, told in (
        ([], [None] * 3),
        (["policy.memory=frames"], [None] * 3),
        (["policy.memory=bank", "policy.memory_settings={length: 4}"], ["null", "null", "false"]),
        (["policy.memory=motion", "policy.memory_stride=2"], ["2", "null", "false"]),
    ):
        assert main([*words, *more]) == 0
        assert [training.value(f"policy.{name}") for name in named] == told
        # What LeRobot makes of it.
        path = training.value("policy.path")
        found: Any = PreTrainedConfig.from_pretrained(str(path), cli_overrides=overrides("policy", training.flags))
        own = MemobenchMemConfig(device="cpu", size="small", perception="objects", memory=found.memory)
        assert found.memory_fusion == own.memory_fusion
        assert found.memory_stride == (2 if told[0] == "2" else own.memory_stride)
        assert found.memory_settings == own.memory_settings | ({"length": 4} if "bank" in found.memory else {})


def test_settings_of_a_checkpoint_that_nothing_reads_any_more_are_reset(
    training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "policy=memobench_small", "steps=1", "device=cpu", "align=none", "policy.memory=none"]
    assert main(words) == 0
    assert training.value("policy.memory_phase") == "false"
    assert main([*words, "policy.memory_phase=true"]) == 2
    assert "memory_phase=True" in capsys.readouterr().err


# --- mistakes: one sentence, status 2, LeRobot never called, nothing written ---


def refused(words: list[str], called: Any, capsys: pytest.CaptureFixture[str]) -> str:
    before = sorted(Path().rglob("*"))
    assert main(words) == 2
    assert not (called.flags if isinstance(called, Called) else called.plans)
    assert sorted(Path().rglob("*")) == before
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("lerobot: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


def test_an_unknown_alignment(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", "policy=memobench_mem", "align=contrastiv"]
    assert "contrastive" in refused(words, training, capsys)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["policy.memory=none", "policy.memory_settings={content: false}"], "only a memory reads it"),
        (["policy.memory=recurrent", "policy.memory_settings={length: 4, slots: 3}"], "'length'"),
    ],
)
def test_settings_of_another_memory(
    words: list[str], told: str, training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told in refused(["train", "policy=memobench_mem", *words], training, capsys)


def test_a_folder_that_is_no_dataset(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    Path("stuff").mkdir()
    for words in (["dataset=stuff"], ["--dataset.repo_id=local/stuff", "--dataset.root=stuff"]):
        assert "meta/info.json" in refused(["train", "policy=act", *words], training, capsys)


def test_a_dataset_folder_that_is_not_there(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    assert "memobench generate" in refused(["train", "policy=act", "dataset=nothing"], training, capsys)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: (folder / "stats.safetensors").unlink(), "lacks its normalisation statistics"),
        (lambda folder: (folder / "stats.safetensors").write_bytes(b"x"), "cannot be read"),
        (lambda folder: (folder / "policy_preprocessor.json").unlink(), "policy_preprocessor.json is missing"),
        (lambda folder: (folder / "policy_preprocessor.json").write_text("{"), "is not JSON"),
        (lambda folder: (folder / "model.safetensors").unlink(), "holds no weights"),
        (lambda folder: (folder / "config.json").write_text("{}"), "names no policy type"),
        (lambda folder: _name_statistics(folder, "../elsewhere.safetensors"), "which names no file"),
    ],
)
def test_a_checkpoint_that_is_not_whole(
    evaluation: Any, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], Any], message: str
) -> None:
    spoil(checkpoint(Path("run")))
    assert message in refused(["eval", "env=memobench", "policy=run"], evaluation, capsys)


def _name_statistics(folder: Path, name: str) -> None:
    path = folder / "policy_preprocessor.json"
    path.write_text(path.read_text().replace("stats.safetensors", name))


def test_a_checkpoint_without_statistics(evaluation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint(Path("run"), statistics=("action.mean",))
    assert "statistics for observation.state" in refused(["eval", "env=memobench", "policy=run"], evaluation, capsys)


def test_the_clock_has_no_statistics(in_folder: Path) -> None:
    """`lerobot-train` makes every column `observation.…` an input; these two are to stay raw."""
    folder = checkpoint(Path("run"))
    for path in folder.glob("policy_*processor.json"):
        told = json.loads(path.read_text())
        told["steps"][0]["config"]["features"] |= {key: {"type": "STATE", "shape": [1]} for key in CLOCK}
        path.write_text(json.dumps(told))
    check_checkpoint(str(folder))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["tasks=turn_on_the_stov"], TASK),
        (["tasks=,"], "among the tasks"),
        (["policy=memobnch_mem"], "memobench_mem"),
        (["referent=rnd"], "'random'"),
        (["env.render=ultra"], "render is 'ultra'"),
        (["horizon=many"], "horizon=many: expected a whole number"),
        (["horizn=5"], "'horizon'"),
        (["shard=3/2", "output_dir=out"], "i from 1 to n"),
        (["suite=strict", "world=libero"], "leave one of the two out"),
    ],
)
def test_a_bad_word_of_an_evaluation_is_one_sentence(
    evaluation: Any, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    assert said in refused(["eval", "env=memobench", *words], evaluation, capsys)
    assert not any(Path().iterdir())


def test_no_environment_and_no_policy(evaluation: Any, training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    assert "env=memobench" in refused(["eval", "policy=act"], evaluation, capsys)
    assert "policy=memobench_mem" in refused(["train"], training, capsys)


def test_an_output_that_is_a_file(evaluation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").write_text("")
    assert "is a file" in refused(["eval", "env=memobench", "output_dir=out"], evaluation, capsys)


# --- failures inside LeRobot ---


def test_an_error_from_inside_is_one_sentence_and_leaves_no_empty_folder(
    evaluation: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(plan: EvaluationPlan) -> None:
        (plan.output / "videos").mkdir(parents=True)
        try:
            raise MemobenchError("the scene\nis wrong")
        except MemobenchError as error:
            raise RuntimeError("worker died") from error

    evaluation.before = fail
    assert main(["eval", "env=memobench", "output_dir=out"]) == 2
    assert capsys.readouterr().err == "lerobot: the scene is wrong\n"
    assert not Path("out").exists()


def test_a_dataset_that_cannot_be_fetched_is_to_be_made_here(
    training: Called, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    training.action = lambda flags: LeRobotDatasetMetadata(flag_value(flags, "dataset.repo_id") or "", root="none")
    assert main(["train", "policy=memobench_mem"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "memobench generate --tasks object --episodes 5 --out outputs/demonstrations`, then dataset=" in told


def test_finished_episodes_of_a_failed_run_stay(evaluation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(plan: EvaluationPlan) -> None:
        log_episodes(plan.log, 1)
        raise MemobenchError("enough")

    evaluation.before = fail
    assert main(["eval", "env=memobench", "output_dir=out"]) == 2
    assert "memobench report out" in capsys.readouterr().err
    assert list(Path("out/episodes").iterdir())


def test_other_errors_keep_their_traceback(evaluation: Any) -> None:
    def fail(plan: EvaluationPlan) -> None:
        raise ZeroDivisionError

    evaluation.before = fail
    with pytest.raises(ZeroDivisionError):
        main(["eval", "env=memobench"])


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_weights_of_a_backbone_that_cannot_be_fetched_are_one_sentence(
    kind: str,
    evaluation: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """LeRobot's policies ask torch for them, and torch the network."""

    def no_network(*_: Any, **__: Any) -> None:
        raise URLError(OSError(-3, "Temporary failure in name resolution"))

    def make_policy(asked: object) -> None:
        policy = make_policy_config(kind, device="cpu", pretrained_backbone_weights="ResNet18_Weights.IMAGENET1K_V1")
        policy.use_group_norm = False  # of diffusion: it goes with random weights alone
        policy.input_features = {
            "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
            "observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 96, 96)),
        }
        policy.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
        get_policy_class(kind)(policy)

    monkeypatch.setenv("TORCH_HOME", str(Path.cwd()))
    monkeypatch.setattr("torch.hub.urlopen", no_network)
    evaluation.before = make_policy
    assert main(["eval", "env=memobench", f"policy={kind}"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("lerobot: the pretrained weights of a backbone are not on this machine")
    assert "name resolution" in told
    assert "policy.pretrained_backbone_weights=null begins with random ones" in told
    assert len(told.splitlines()) == 1


def test_the_trainers_exit_status_is_passed_on(training: Called) -> None:
    training.action = lambda flags: 3
    assert main(["train", "policy=act"]) == 3


# --- the installed program ---


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["eval", "env=memobench", "tasks=stove"], "found 'stove' among the tasks"),
        (["evaluate"], "did you mean 'eval'"),
        pytest.param(
            ["train", "policy=memobench_mem", "aling=semantic"], "did you mean 'align'", marks=pytest.mark.slow
        ),
    ],
)
def test_the_program_itself(tmp_path: Path, words: list[str], message: str) -> None:
    program = Path(sys.executable).with_name("lerobot")
    done = subprocess.run([program, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())
