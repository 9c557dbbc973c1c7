"""The command ``lerobot``: the calls that it makes, and the cost of a mistake."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any
from urllib.error import URLError

import lerobot.scripts.lerobot_eval
import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.commands.command_line import OPTIONS, SHORT_FORMS, parse_words
from lerobot_memobench.constants import CLOCK
from lerobot_memobench.datasets.layout import DEFAULT_REPO_ID
from lerobot_memobench.envs.episode_log import EpisodeLog, line_of
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import check_checkpoint, checkpoint_folder
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.rollouts.plan import EvaluationPlan
from lerobot_memobench.training.command import with_last_checkpoint
from tests.support import logs
from tests.support.fake_loop import STOVE, FakeLoop


class Called:
    """A call that is not made: of LeRobot's main function, of its trainer's process, or of the training loop."""

    def __init__(self) -> None:
        self.flags: list[str] | None = None
        self.config: Any = None
        self.action: Callable[[], Any] = lambda: 0

    def __call__(self, config: Any = None) -> Any:
        self.flags, self.config = sys.argv[1:], config
        return self.action()

    def value(self, key: str) -> Any:
        return attrgetter(key)(self.config)


@pytest.fixture
def theirs(monkeypatch: pytest.MonkeyPatch, fake_loop: FakeLoop) -> Called:
    called = Called()
    monkeypatch.setattr(lerobot.scripts.lerobot_eval, "main", called)
    return called


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch, fake_loop: FakeLoop) -> Called:
    called = Called()
    package = "lerobot_memobench.training"
    monkeypatch.setattr(f"{package}.trainer.run_lerobot", called)
    monkeypatch.setattr(f"{package}.trainer.prepare", lambda config, *_: config)
    monkeypatch.setattr(f"{package}.loop.train", called)
    monkeypatch.setattr(f"{package}.command.cores", lambda: 8)
    return called


def refused(words: list[str], called: Called | FakeLoop, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that is refused: one line, status 2; without a call of LeRobot or a new file."""
    before = sorted(Path().rglob("*"))
    assert main(words) == 2
    assert not (called.flags if isinstance(called, Called) else called.plans)
    assert sorted(Path().rglob("*")) == before
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("lerobot: ")
    assert err.count("\n") == 1
    return err


# --- the command ---


def test_commands_are_listed_and_near_names_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "dataset-viz" in capsys.readouterr().out
    assert main(["evl", "env=memobench"]) == 2
    assert "'eval'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["eval", "train"])
def test_help_explains_every_short_form(
    command: str, theirs: Called, training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help"]) == 0
    assert (theirs if command == "eval" else training).flags is None  # LeRobot's import takes ten seconds
    text = capsys.readouterr().out
    explained = {word for line in text.splitlines() if "=" in line for word in line.strip().split(", ")}
    of_env = {f"{word}=" for word, full in SHORT_FORMS[command].items() if full[0].startswith("env.")}
    words = {f"{word}=" for word in (*SHORT_FORMS[command], *OPTIONS[command], "policy")}
    assert words - (of_env - {"tasks=", "obs_type="} if command == "train" else set()) <= explained
    assert not any(len(line) > 106 for line in text.splitlines())


# --- eval ---


def test_an_evaluation_writes_and_prints_its_report(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    surplus = line_of(logs.record(STOVE, 3))
    fake_loop.before = lambda plan: EpisodeLog(plan.log).append(surplus)  # as plain lerobot-eval does
    assert main(["eval", "env=memobench", f"tasks={STOVE}", "episodes=2", "output_dir=out"]) == 0
    average = json.loads(Path("out/report.json").read_text())["average"]
    assert (average["SR"], average["n"]) == (50.0, 2)
    assert Path("out/report.md").is_file()
    out = capsys.readouterr().out
    assert out.startswith("evaluating memobench_expert on 1 task, 2 episodes each, into out\n")
    assert STOVE in out


def test_other_environments_are_lerobots(theirs: Called, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "env=pusht", "policy=diffusion"]) == 0
    assert theirs.flags == ["--env.type=pusht", "--policy.type=diffusion"]
    assert main(["eval", "env=memobench", "--help"]) == 0
    assert theirs.flags == ["--help", "--env.type=memobench"]
    theirs.flags = None
    capsys.readouterr()
    for words in (["policy=act"], ["env=pusht", "policy=act", "resume=true"]):
        assert "env=memobench" in refused(["eval", *words], theirs, capsys)


def test_errors_in_a_run(fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str]) -> None:
    """A mistake found late is one line, an error of the code a traceback; finished episodes stay."""
    finished = False

    def fail(plan: EvaluationPlan) -> None:
        (plan.output / "videos").mkdir(parents=True)
        if finished:
            EpisodeLog(plan.log).append(line_of(logs.record(STOVE)))
        try:
            raise MemobenchError("the scene\nis wrong")
        except MemobenchError as error:
            raise RuntimeError("worker died") from error

    fake_loop.before = fail
    assert main(["eval", "env=memobench", "output_dir=out"]) == 2
    assert capsys.readouterr().err == "lerobot: the scene is wrong\n"
    assert not Path("out").exists()
    finished = True
    assert main(["eval", "env=memobench", "output_dir=out"]) == 2
    assert "memobench report out" in capsys.readouterr().err
    assert list(Path("out/episodes").iterdir())
    fake_loop.before = lambda plan: 1 / 0
    with pytest.raises(ZeroDivisionError):
        main(["eval", "env=memobench"])
    Path("file").write_text("")
    fake_loop.plans.clear()
    capsys.readouterr()
    assert "is a file" in refused(["eval", "env=memobench", "output_dir=file"], fake_loop, capsys)


def test_backbone_weights_that_cannot_be_fetched(
    fake_loop: FakeLoop, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """LeRobot's policies ask torch for them, and torch the network."""

    def no_network(*_: Any, **__: Any) -> None:
        raise URLError(OSError(-3, "Temporary failure in name resolution"))

    monkeypatch.setenv("TORCH_HOME", str(Path.cwd()))
    monkeypatch.setattr("torch.hub.urlopen", no_network)
    fake_loop.before = lambda plan: torch.hub.load_state_dict_from_url("https://weights.example/resnet18.pth")
    assert main(["eval", "env=memobench", "policy=act"]) == 2
    error = capsys.readouterr().err
    assert "name resolution" in error
    assert "policy.pretrained_backbone_weights=null" in error
    assert error.count("\n") == 1


# --- checkpoints ---


def checkpoint(folder: Path, statistics: tuple[str, ...] = ("observation.state.mean", "action.mean")) -> Path:
    """Write a checkpoint of LeRobot's act as far as it is checked."""
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
        step = {"registry_name": prefix + "normalizer_processor", "config": config, "state_file": "stats.safetensors"}
        (folder / f"{name}.json").write_text(json.dumps({"name": name, "steps": [step]}))
    return folder


def leave(folder: Path, outside: str = "../elsewhere.safetensors") -> None:
    path = folder / "policy_preprocessor.json"
    path.write_text(path.read_text().replace("stats.safetensors", outside))


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda folder: (folder / "stats.safetensors").unlink(), "statistics"),
        (lambda folder: (folder / "stats.safetensors").write_bytes(b"x"), "stats.safetensors"),
        (lambda folder: save_file({"action.mean": np.zeros(1)}, folder / "stats.safetensors"), "observation.state"),
        (lambda folder: (folder / "policy_preprocessor.json").unlink(), "policy_preprocessor.json"),
        (leave, "names no file"),
    ],
)
def test_a_damaged_checkpoint_is_refused(
    fake_loop: FakeLoop, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], Any], named: str
) -> None:
    spoil(checkpoint(Path("run")))
    assert named in refused(["eval", "env=memobench", "policy=run"], fake_loop, capsys)


def test_the_clock_needs_no_statistics(tmp_path: Path) -> None:
    """`lerobot-train` makes every column `observation.…` an input; phase and step are to stay raw."""
    folder = checkpoint(tmp_path / "run")
    for path in folder.glob("policy_*processor.json"):
        config = json.loads(path.read_text())
        config["steps"][0]["config"]["features"] |= {key: {"type": "STATE", "shape": [1]} for key in CLOCK}
        path.write_text(json.dumps(config))
    check_checkpoint(str(folder))


# --- train ---

EMPTY_DATASET = json.dumps({"codebase_version": "v3.0", "total_episodes": 0, "total_frames": 0, "features": {}})


def datasets(*names: str) -> None:
    for name in names:
        Path(name, "meta").mkdir(parents=True)
        Path(name, "meta", "info.json").write_text(EMPTY_DATASET)


def training_run(folder: Path, steps: int = 100, done: tuple[int, ...] = (40, 80), size: str = "tiny") -> Path:
    """Write a training run as far as it is checked; return the folder of its last checkpoint."""
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig

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


SMALL = ["policy=memobench_strict", "steps=1", "device=cpu"]
DEFAULTS: list[tuple[list[str], dict[str, Any]]] = [
    (
        ["policy=memobench_mem", "align=contrastive"],
        {"policy.type": "memobench_mem", "policy.align": "contrastive", "dataset.repo_id": DEFAULT_REPO_ID}
        | {"policy.push_to_hub": False, "num_workers": 4, "log_freq": 200},
    ),
    (["policy=act", "steps=50"], {"log_freq": 5}),
    (["policy=act", "dataset=mine"], {"dataset.repo_id": "local/mine", "dataset.root": "mine"}),
    (
        ["config_path=train.yaml", "align=semantic"],
        {"policy.align": "semantic", "dataset.repo_id": "a/b", "policy.push_to_hub": False, "steps": 100_000},
    ),
    # A memory that is not the checkpoint's has its own defaults.
    (SMALL, {"policy.memory_stride": 8}),
    ([*SMALL, "policy.memory=frames"], {"policy.memory_stride": 8}),
    ([*SMALL, "policy.memory=motion", "policy.memory_stride=2"], {"policy.memory_stride": 2}),
    ([*SMALL, "align=none", "policy.memory=none"], {"policy.memory_phase": False}),
]


@pytest.mark.parametrize(("words", "found"), DEFAULTS, ids=[" ".join(words) for words, _ in DEFAULTS])
def test_a_training_gets_the_benchmarks_defaults(
    training: Called, words: list[str], found: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    datasets("mine")
    Path("train.yaml").write_text("policy: {type: memobench_mem}\ndataset: {repo_id: a/b}\n")
    assert main(["train", *words]) == 0
    assert {key: training.value(key) for key in found} == found
    if "policy.memory=motion" in words:
        config = training.config.policy
        own = MemobenchMemConfig(device="cpu", size="small", perception="objects", memory="motion", memory_stride=2)
        assert (config.memory_fusion, config.memory_settings) == (own.memory_fusion, own.memory_settings)


def test_a_small_machine_has_few_loaders(training: Called, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_memobench.training.command.cores", lambda: 2)
    assert main(["train", "policy=act"]) == 0
    assert training.value("num_workers") == 2


def test_settings_that_differ_from_the_checkpoints_are_noted(
    training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", *SMALL]) == 0
    assert capsys.readouterr().err == ""
    assert main(["train", *SMALL, "policy.memory_stride=2", "policy.memory_settings={frames: 4}"]) == 0
    note = capsys.readouterr().err
    assert note.count("\n") == 1
    before, _, now = note.partition(" continues ")
    assert "memory_stride=8" in before
    assert "memory_stride=2" in now
    assert "'frames': 4" in now


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "policy=memobench_mem"),
        (["policy=memobench_mem", "align=contrastiv"], "contrastive"),
        (["policy=memobench_mem", "policy.memory=recurrent", "policy.memory_settings={length: 4}"], "'length'"),
        ([*SMALL, "align=none", "policy.memory=none", "policy.memory_phase=true"], "memory_phase=True"),
        (["policy=act", "dataset=stuff"], "meta/info.json"),
        (["resume=true"], "output_dir="),
        (["resume=true", "output_dir=empty"], "no complete checkpoint"),
        (["resume=true", "output_dir=run", "policy=act"], "policy=act"),
        (["resume=true", "output_dir=run", "align=semantic"], "align=none"),
        (["resume=true", "output_dir=run", "dataset=mine"], "dataset a/b"),
        (["resume=true", "output_dir=run", "episodes=[0, 1]"], "dataset.episodes=None"),
        (
            ["config_path=run/checkpoints/last/pretrained_model/train_config.json", "align=semantic", "--resume"],
            "align=none",
        ),
    ],
)
def test_a_training_that_cannot_be_run_is_refused(
    training: Called, capsys: pytest.CaptureFixture[str], words: list[str], named: str
) -> None:
    training_run(Path("run"))
    datasets("mine")
    Path("empty/checkpoints/000010").mkdir(parents=True)
    Path("recipe.yaml").write_text("steps: 100")
    Path("stuff").mkdir()
    assert named in refused(["train", *words], training, capsys)


RESUME = ["train", "output_dir=run", "resume=true"]


def test_a_training_is_resumed_by_its_folder(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    training_run(Path("run"))
    again = ["train", "policy=memobench_mem", "dataset.repo_id=a/b", "output_dir=run", "steps=100", "resume=true"]
    free = ["save_freq=5", "num_workers=0", "device=cpu", "policy.n_action_steps=1", "align=none", "size=tiny"]
    for words in (again, [*again, *free], ["train", "output_dir=run", "--resume"]):
        training.flags = None
        assert main(words) == 0
        assert (training.value("checkpoint_path"), training.value("resume")) == (Path("run/checkpoints/last"), True)
        assert training.value("policy.size") == "tiny"
    assert capsys.readouterr().err == ""
    for stated in ("run/checkpoints/000040/pretrained_model/train_config.json", "somebody/repository"):
        for resume in ("resume=true", "--resume=True"):
            given = parse_words([f"config_path={stated}", resume])
            assert with_last_checkpoint(given) == given  # LeRobot's own form


@pytest.mark.parametrize("last", ["000040\n", None])
@pytest.mark.parametrize("lost", [None, "training_step.json", "optimizer_param_groups.json"])
def test_a_copied_run_has_no_link(training: Called, last: str | None, lost: str | None) -> None:
    """A copy has a file or no file in the place of the link `last`; a killed run has an incomplete checkpoint."""
    training_run(Path("run"), steps=200)
    link = Path("run/checkpoints/last")
    link.unlink()
    if last is not None:
        link.write_text(last)
    if lost is not None:
        Path("run/checkpoints/000080/training_state", lost).unlink()
    found = Path("run/checkpoints/000080" if last is lost is None else "run/checkpoints/000040") / "pretrained_model"
    if lost is None:
        for text in ("run", "run/checkpoints/last", "run/checkpoints/last/pretrained_model"):
            assert checkpoint_folder(text) == found
    assert main(RESUME) == 0
    assert training.value("checkpoint_path") == found.parent
    assert not link.exists(), "LeRobot makes it"


@pytest.mark.parametrize("text", [None, "my notes"])
def test_another_file_named_last_is_not_removed(
    text: str | None, training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = training_run(Path("run")).parent
    link = Path("run/checkpoints/last")
    link.unlink()
    if text is None:
        shutil.copytree(folder, link)
    else:
        link.write_text(text)
    assert str(link) in refused(RESUME, training, capsys)


def test_more_steps_are_noted_where_the_learning_rate_jumps(
    training: Called, capsys: pytest.CaptureFixture[str]
) -> None:
    """A cosine down to a fiftieth over 100 steps is stretched to 200 when 80 are done."""
    from lerobot.configs.train import TrainPipelineConfig

    folder = training_run(Path("run"), size="small")
    peak = TrainPipelineConfig.from_pretrained(folder).optimizer.lr
    rates = [peak * (1 - 0.98 * (1 - math.cos(math.pi * 80 / steps)) / 2) for steps in (100, 200)]
    assert main([*RESUME, "steps=200"]) == 0
    error = capsys.readouterr().err
    assert all(f"{rate:.2e}" in error for rate in rates)
    shutil.rmtree("run")
    training_run(Path("run"), done=(40, 100))  # a constant rate, and all steps done
    assert main([*RESUME, "steps=200"]) == 0
    assert capsys.readouterr().err == ""
    training.flags = None
    assert main(RESUME) == 0
    assert training.flags is None
    assert "steps=" in capsys.readouterr().err


def test_changed_settings_of_a_resumed_training_are_noted(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    training_run(Path("run"))
    assert main([*RESUME, "batch_size=8", "seed=1000", "optimizer.lr=1e-3"]) == 0  # as before
    assert "continues with" not in capsys.readouterr().err
    assert main([*RESUME, "batch_size=3", "seed=7", "dataset.use_imagenet_stats=false"]) == 0
    noted = " ".join(capsys.readouterr().err.split())
    for changed in ("seed=7 instead of 1000", "batch_size=3 instead of 8", "use_imagenet_stats=False instead of True"):
        assert changed in noted


def test_a_training_is_resumed_on_its_dataset(training: Called, capsys: pytest.CaptureFixture[str]) -> None:
    datasets("mine", "other")
    file = training_run(Path("run")) / "train_config.json"
    config = json.loads(file.read_text())
    config["dataset"] |= {"repo_id": "local/mine", "root": "mine", "episodes": [0, 1]}
    file.write_text(json.dumps(config))
    Path("link").symlink_to("mine")
    for same in ("dataset=mine", f"dataset={Path('mine').absolute()}", "dataset=link", "episodes=[0, 1]"):
        assert main([*RESUME, same]) == 0
    training.flags = None
    for changed in ("dataset=other", "--dataset.root=other"):
        assert "dataset mine" in refused([*RESUME, changed], training, capsys)
    shutil.rmtree("mine")
    assert "link it to mine" in refused([*RESUME, "dataset=other"], training, capsys)


def test_a_dataset_that_cannot_be_fetched(
    training: Called, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    training.action = lambda: LeRobotDatasetMetadata(training.value("dataset.repo_id"), root="none")
    assert main(["train", "policy=memobench_mem"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "memobench generate --tasks object" in error
