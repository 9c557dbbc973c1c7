"""Training without prompt frames: what is relied on in LeRobot, and which frames it then draws and looks back to."""

from __future__ import annotations

import inspect
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from lerobot.configs.default import DatasetConfig, PeftConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
from lerobot.datasets import factory as dataset_factory
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.scripts import lerobot_train
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch.utils.data import default_collate

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.conformance.streams import write_streams
from lerobot_memobench.datasets import execution_frames
from lerobot_memobench.datasets.feature_cache.frames import frame_reader, read_frame_table
from lerobot_memobench.datasets.validate import validate
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.run.training import trained_on

LENGTHS, PROMPTS = (40, 23, 31), (0, 8, 0)
START = LENGTHS[0] + PROMPTS[1]
"""First execution frame of the one episode that has a prompt."""
PROMPT_FRAMES = set(range(LENGTHS[0], START))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.support.synthetic_dataset import make_dataset

    return make_dataset(tmp_path_factory.mktemp("data") / "synthetic")


# --- what is relied on: where one of these fails, LeRobot's training is another one ---

# In its module: LeRobot's main has split `train`.
CALLS = {
    (lerobot_train, "make_train_eval_datasets(cfg)"): "opens the datasets by it, looked up in its module",
    (lerobot_train, 'dataset.meta.episodes["dataset_from_index"]'): "draws within these bounds",
    (lerobot_train, "episode_indices_to_use=dataset.episodes"): "draws from the episodes that are opened",
    (StreamingLeRobotDataset.__iter__, "safe_shard(self.hf_dataset, idx"): "streams the frames that are found there",
    (StreamingLeRobotDataset._get_delta_frames, "dataset_iterator.peek_back"): "looks back in that stream alone",
    (lerobot_train, 'eval_dataset.hf_dataset.data.column("task_index")'): "looks there for held-out tasks",
    (PreTrainedPolicy._validate_peft_config, "if not self.config.pretrained_path"): "refuses adapters without weights",
    (PreTrainedPolicy._build_peft_config, "_get_default_peft_targets()"): "refuses adapters of no module",
    (dataset_factory.make_train_eval_datasets, "return full_dataset, None"): "returns two datasets, or one and None",
}


@pytest.mark.parametrize(("function", "call"), CALLS, ids=lambda part: getattr(part, "__name__", part))
def test_lerobot_does_what_is_relied_on(function: Any, call: str) -> None:
    assert call in inspect.getsource(function), (
        f"{function.__name__} holds no {call!r} any more; it was relied on that it {CALLS[function, call]}. Look at "
        "src/lerobot_memobench/run/training.py"
    )


def test_another_lerobot_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.8.0")
    before = lerobot_train.make_train_eval_datasets
    with (
        pytest.raises(MemobenchError, match=r"lerobot 0\.8\.0 .* steers the training of lerobot.*<0\.8"),
        trained_on(False),
    ):
        pass
    assert lerobot_train.make_train_eval_datasets is before


# --- what it is made to do ---


def opened(root: Path, policy: Any, prompt_frames: bool | None = None, **settings: Any) -> tuple[Any, Any]:
    """Return the datasets that LeRobot's training would work on."""
    config = TrainPipelineConfig(DatasetConfig("memobench/synthetic", root=str(root), **settings), policy=policy)
    with trained_on(prompt_frames):
        return lerobot_train.make_train_eval_datasets(config)  # type: ignore[no-any-return]


def test_a_kind_of_observation_that_is_not_there_is_told(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = TrainPipelineConfig(DatasetConfig("memobench/synthetic", root=str(root)), policy=act())
    with trained_on(None, "environment_state_agent_pos"), pytest.raises(MemobenchError, match="but the dataset has"):
        lerobot_train.make_train_eval_datasets(config)
    assert main(["train", "policy=act", f"dataset={root}", "obs_type=environment"]) == 2
    assert "found obs_type=environment, did you mean 'environment_state_agent_pos'" in capsys.readouterr().err


def drawn(dataset: LeRobotDataset, last: int = 0) -> set[int]:
    """Return the frames that LeRobot's sampler draws."""
    bounds = dataset.meta.episodes
    sampler = EpisodeAwareSampler(
        bounds["dataset_from_index"],
        bounds["dataset_to_index"],
        episode_indices_to_use=dataset.episodes,
        drop_n_last_frames=last,
        shuffle=True,
        absolute_to_relative_idx=dataset.absolute_to_relative_idx,
    )
    return {dataset.hf_dataset[k]["index"].item() for k in sampler}


def act() -> ACTConfig:
    return ACTConfig(device="cpu", push_to_hub=False, chunk_size=4, n_action_steps=4)


def test_a_policy_without_phases_trains_on_execution_frames(root: Path) -> None:
    train, held_out = opened(root, act())
    assert held_out is None
    assert drawn(train) == set(range(sum(LENGTHS))) - PROMPT_FRAMES
    assert drawn(opened(root, act(), prompt_frames=True)[0]) == set(range(sum(LENGTHS)))
    assert drawn(opened(root, act(), episodes=[1])[0]) == set(range(START, sum(LENGTHS[:2])))


def test_a_policy_with_phases_is_left_alone_unless_asked(root: Path) -> None:
    policy = MemobenchMemConfig(device="cpu", push_to_hub=False)
    assert drawn(opened(root, policy)[0]) == set(range(sum(LENGTHS)))
    assert drawn(opened(root, policy, prompt_frames=False)[0]) == set(range(sum(LENGTHS))) - PROMPT_FRAMES


@pytest.mark.parametrize("remembers", [False, True])
@pytest.mark.parametrize("kind", [ACTConfig, DiffusionConfig])
def test_phase_and_step_are_no_inputs_and_reach_every_policy_as_they_are(
    root: Path, kind: Any, remembers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot would take them for two more states, and normalise them."""
    monkeypatch.setattr(kind, "reads_prompt", remembers, raising=False)
    policy = kind(device="cpu", push_to_hub=False)
    train, _ = opened(root, policy)
    assert set(policy.input_features) == {"observation.state", *(f"observation.images.{name}" for name in CAMERAS)}
    features = dataset_to_policy_features(train.meta.features)
    policy.output_features = {"action": features["action"]}
    before, _ = make_pre_post_processors(policy, dataset_stats=train.meta.stats)
    batch = before(default_collate([train[START + step] for step in (0, 3)]))
    assert "observation.step" in train.meta.stats, "LeRobot's own writer gives them statistics"
    assert batch["observation.phase"].reshape(2, -1)[:, -1].tolist() == [1, 1]
    assert batch["observation.step"].reshape(2, -1)[:, -1].tolist() == [0, 3]


def test_a_dataset_of_an_earlier_version_is_refused_in_one_sentence(root: Path, tmp_path: Path) -> None:
    """Its prompts would be trained on as if they were executions."""
    folder = Path(shutil.copytree(root, tmp_path / "earlier"))
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["phase"] = info["features"].pop("observation.phase") | {"dtype": "int64"}
    (folder / "meta/info.json").write_text(json.dumps(info))
    for path in (folder / "data").rglob("*.parquet"):
        table = pq.read_table(path).drop(["observation.step"])
        table = table.rename_columns({"observation.phase": "phase"}).replace_schema_metadata(None)
        place = table.column_names.index("phase")
        pq.write_table(table.set_column(place, "phase", table.column("phase").cast("int64")), path)
    del info["features"]["observation.step"]
    (folder / "meta/info.json").write_text(json.dumps(info))
    told = r"earlier was made by an earlier version: it has the column phase, and not .*generate or convert it again"
    with pytest.raises(MemobenchError, match=told):
        opened(folder, act())
    with pytest.raises(MemobenchError, match=told):
        read_frame_table(folder)
    with pytest.raises(MemobenchError, match=told):
        validate(folder)


def test_histories_do_not_reach_back_into_the_prompt(root: Path) -> None:
    train, _ = opened(root, DiffusionConfig(device="cpu", push_to_hub=False, n_obs_steps=3))
    whole = LeRobotDataset("memobench/synthetic", root=root)
    first = train[START]
    assert first["index"] == START
    assert first["observation.state_is_pad"].tolist() == [True, True, False]
    assert first["observation.images.image_is_pad"].tolist() == [True, True, False]
    for state in first["observation.state"]:
        assert state.tolist() == whole[START]["observation.state"].tolist()
    assert train[START + 2]["observation.state_is_pad"].tolist() == [False, False, False]


@pytest.mark.parametrize("settings", [{}, {"episodes": [1, 2]}, {"eval_split": 0.4}], ids=str)
@pytest.mark.parametrize("prompt_frames", [True, False])
def test_samples_out_of_memory_are_lerobots_without_its_pictures(
    settings: dict[str, Any], prompt_frames: bool, tmp_path: Path
) -> None:
    """Equal to the bit, of the same types, history and padding included; no video is opened."""
    root = write_streams(tmp_path / "streams", frames=9)
    policy = DiffusionConfig(device="cpu", push_to_hub=False, n_obs_steps=3)
    config = TrainPipelineConfig(DatasetConfig("memobench/streams", root=str(root), **settings), policy=policy)
    with trained_on(prompt_frames, "environment_state_agent_pos"):
        parts = [part for part in lerobot_train.make_train_eval_datasets(config) if part is not None]
    assert len(parts) == 1 + ("eval_split" in settings)
    assert "language_persistent" in parts[0].meta.features
    for part in parts:
        whole = getattr(part, "dataset", part)
        pictures = set(whole.meta.camera_keys)
        assert len(pictures) == 2
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("lerobot.datasets.dataset_reader.decode_video_frames", None)
            quick = [part[row] for row in range(len(part))]
        del whole.reader.get_item
        for row, found in enumerate(quick):
            expected = {name: value for name, value in part[row].items() if name not in pictures}
            assert set(found) == set(expected)
            for name, value in expected.items():
                same = torch.equal(value, found[name]) if isinstance(value, torch.Tensor) else value == found[name]
                assert same, name
                assert getattr(value, "dtype", type(value)) == getattr(found[name], "dtype", type(found[name])), name


def test_the_held_out_part_has_no_prompt_either(tmp_path: Path) -> None:
    from tests.support.synthetic_dataset import make_dataset

    train, held_out = opened(make_dataset(tmp_path / "two", repeats=2), act(), eval_split=0.5)
    assert {train[k]["observation.phase"].item() for k in range(0, LENGTHS[0])} == {1}
    assert len(held_out) == sum(LENGTHS) - PROMPTS[1]
    assert {
        held_out[k]["observation.phase"].item() for k in range(LENGTHS[0], LENGTHS[0] + LENGTHS[1] - PROMPTS[1])
    } == {1}
    tasks = held_out.hf_dataset.data.column("task_index").to_numpy()
    assert tasks.tolist() == [held_out.dataset.hf_dataset[k]["task_index"].item() for k in held_out.indices]


def test_a_policy_with_phases_is_tested_on_what_it_learns(tmp_path: Path) -> None:
    from tests.support.synthetic_dataset import make_dataset

    policy = MemobenchMemConfig(device="cpu", push_to_hub=False)
    train, held_out = opened(make_dataset(tmp_path / "two", repeats=2), policy, eval_split=0.5)
    assert len(drawn(train)) == sum(LENGTHS)
    assert len(held_out) == sum(LENGTHS) - PROMPTS[1]


def test_what_is_no_dataset_of_ours_stays_as_it_is(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution_frames, "COLUMNS", {"observation.phase", "nothing_of_ours"})
    assert drawn(opened(root, act())[0]) == set(range(sum(LENGTHS)))


def test_of_a_streamed_dataset_prompts_are_passed_over(root: Path) -> None:
    """Nor does a history reach into them; each frame is that of the dataset on disk."""
    acting = set(range(sum(LENGTHS))) - PROMPT_FRAMES
    train, held_out = opened(root, act(), streaming=True)
    assert held_out is None
    streamed = {int(frame["index"]): frame for frame in train}
    assert set(streamed) == acting
    train.delta_indices = {"observation.state": [-2, -1, 0]}
    train.delta_timestamps = {"observation.state": [-0.1, -0.05, 0.0]}
    (first,) = (frame for frame in train if frame["index"] == START)
    assert first["observation.state_is_pad"].tolist() == [True, True, False]
    assert (first["observation.state"] == streamed[START]["observation.state"]).all()
    on_disk, _ = opened(root, act())
    for key in ("observation.state", "action", "action_is_pad", "observation.phase"):
        assert np.asarray(streamed[START][key]).tolist() == np.asarray(on_disk[START][key]).tolist()
    assert {int(frame["index"]) for frame in opened(root, act(), True, streaming=True)[0]} == acting | PROMPT_FRAMES


def test_a_folder_may_be_named_as_a_pattern(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot looks for its tables as `glob` does."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = shutil.copytree(root, tmp_path / "obj [v2]*")
    for _ in range(2):
        train, _ = opened(folder, act())
        assert train[START]["observation.images.image"].shape[0] == 3
    with pytest.raises(MemobenchError, match=r"streaming=true.*\[v2\]"):
        opened(folder, act(), streaming=True)
    assert frame_reader(folder, "observation.images.image")(0, [0]).shape[0] == 1
    assert len(list((tmp_path / "cache").rglob("*"))) == 3, "one link"


def test_what_cannot_be_streamed_without_prompts_is_refused_in_one_sentence(root: Path) -> None:
    looks_back = DiffusionConfig(device="cpu", push_to_hub=False, n_obs_steps=2)
    for prompt_frames in (None, True):
        with pytest.raises(MemobenchError, match=r"diffusion.*observation\.phase.*dataset\.streaming=false"):
            opened(root, looks_back, prompt_frames, streaming=True)
    config = TrainPipelineConfig(DatasetConfig("a/b", root=str(root), streaming=True), policy=act(), num_workers=0)
    with trained_on(None), pytest.raises(MemobenchError, match="num_workers=0"):
        lerobot_train.make_train_eval_datasets(config)
    ours = MemobenchMemConfig(device="cpu", push_to_hub=False)
    with pytest.raises(MemobenchError, match=r"memobench_mem draws execution frames alone.*prompt_frames=false"):
        opened(root, ours, streaming=True)
    train, _ = opened(root, ours, prompt_frames=False, streaming=True)
    assert {int(frame["observation.phase"]) for frame in train} == {1}


@pytest.mark.parametrize(
    ("policy", "path", "targets", "told"),
    [
        (ACTConfig, None, "all-linear", "policy=act begins without any"),
        (MemobenchMemConfig, None, None, "policy=memobench_mem begins without any"),
        (ACTConfig, "somewhere", None, "peft.target_modules"),
        (ACTConfig, "somewhere", "all-linear", None),
        (MemobenchMemConfig, "somewhere", None, None),
    ],
)
def test_adapters_that_cannot_be_are_refused_before_a_dataset_is_opened(
    policy: Any, path: str | None, targets: str | None, told: str | None, root: Path
) -> None:
    whole = TrainPipelineConfig(
        DatasetConfig("a/b", root=str(root)),
        policy=policy(device="cpu", push_to_hub=False, pretrained_path=path),
        peft=PeftConfig(target_modules=targets),
    )
    with trained_on(None):
        if told is None:
            lerobot_train.make_train_eval_datasets(whole)
            return
        whole.dataset.root = "nowhere"
        with pytest.raises(MemobenchError, match=told):
            lerobot_train.make_train_eval_datasets(whole)


@pytest.mark.parametrize(
    ("section", "told"),
    [({"parallelism": {"is_sharded": True}}, "dp_shard would train"), ({"ema": {"enable": True}}, "policy.ema_decay")],
)
def test_what_lerobots_main_would_do_to_the_weights_is_refused(section: dict[str, Any], told: str, root: Path) -> None:
    config = TrainPipelineConfig(
        DatasetConfig("memobench/synthetic", root=str(root)), policy=MemobenchMemConfig(device="cpu", push_to_hub=False)
    )
    for name, fields in section.items():
        setattr(config, name, SimpleNamespace(**fields))
    with trained_on(None), pytest.raises(MemobenchError, match=told):
        lerobot_train.make_train_eval_datasets(config)


# --- by the commands ---

POLICY = {
    "type": "act",
    **{"device": "cpu", "push_to_hub": "false", "pretrained_backbone_weights": "null", "dim_model": "32"},
    **{"n_heads": "2", "dim_feedforward": "64", "n_encoder_layers": "1", "n_vae_encoder_layers": "1"},
    **{"chunk_size": "4", "n_action_steps": "4", "latent_dim": "8"},
}
WORDS = [*(f"policy.{key}={value}" for key, value in POLICY.items()), "steps=12", "batch_size=8", "num_workers=0"]


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Collect the frames of every batch that is trained on."""
    from lerobot.policies.act.modeling_act import ACTPolicy

    found: list[int] = []
    forward = ACTPolicy.forward

    def run(this: ACTPolicy, batch: Any, *args: Any, **options: Any) -> Any:
        found.extend(batch["index"].flatten().tolist())
        return forward(this, batch, *args, **options)

    monkeypatch.setattr(ACTPolicy, "forward", run)
    return found


@pytest.mark.parametrize(
    ("words", "prompts"), [([], False), pytest.param(["prompt_frames=true"], True, marks=pytest.mark.slow)]
)
def test_lerobot_train(words: list[str], prompts: bool, root: Path, tmp_path: Path, trained: list[int]) -> None:
    assert main(["train", *WORDS, *words, f"dataset={root}", f"output_dir={tmp_path / 'run'}"]) == 0
    assert len(trained) >= sum(LENGTHS) - PROMPTS[1]  # an epoch
    assert bool(PROMPT_FRAMES & set(trained)) is prompts


def test_an_unclear_choice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", *WORDS, "prompt_frames=some"]) == 2
    assert "prompt_frames=some: expected true or false" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["steps=0", "steps=-1", "batch_size=0", "num_workers=-1", "eval.n_episodes=0"])
@pytest.mark.parametrize("in_a_file", [False, True])
def test_a_number_that_is_too_small_is_refused(
    word: str, in_a_file: bool, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*WORDS, f"dataset={root}", word]
    if in_a_file:
        key, _, value = word.rpartition("=")
        content: Any = int(value)
        for part in reversed(key.split(".")):
            content = {part: content}
        (tmp_path / "recipe.yaml").write_text(yaml.safe_dump({"policy": {"type": "act"}, **content}))
        words = [f"config_path={tmp_path / 'recipe.yaml'}", f"dataset={root}"]
    assert main(["train", *words, f"output_dir={tmp_path / 'run'}"]) == 2
    assert f"lerobot: found {word}; expected at least " in capsys.readouterr().err


@pytest.mark.parametrize(("episodes", "named"), [([7], [7]), ([0, 3], [3]), ([], [])])
def test_episodes_that_are_not_there_are_refused(root: Path, episodes: list[int], named: list[int]) -> None:
    told = re.escape(f"found episodes={named}, and the dataset {root} has 3 episodes; name some of 0 to 2")
    with pytest.raises(MemobenchError, match=told):
        opened(root, act(), episodes=episodes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("streaming", "told"), [((), "8 frames"), (("--dataset.streaming=true", "--num_workers=1"), "the frames")]
)
def test_plain_lerobot_train_by_its_own_flag(root: Path, tmp_path: Path, streaming: tuple[str, ...], told: str) -> None:
    flags = [f"--{word}" for word in WORDS]
    run = subprocess.run(
        [
            *(sys.executable, "-c", "from lerobot.scripts.lerobot_train import main; main()", *flags),
            *("--dataset.repo_id=memobench/synthetic", f"--dataset.root={root}", f"--output_dir={tmp_path / 'run'}"),
            "--dataset.discover_packages_path=lerobot_memobench.run.without_prompts",
            *streaming,
        ],
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert f"{told} of prompts are left out of the 94 to train on" in run.stderr
