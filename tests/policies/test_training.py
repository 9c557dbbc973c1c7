"""Training: schedule and loss, ranks, the curve, and the frames that are drawn and count."""

from __future__ import annotations

import json
import logging
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.scripts.lerobot_train import train
from PIL import Image
from safetensors import safe_open

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import training
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.mechanism import SUBGOAL, SUBGOALS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.sampler import execution_starts
from lerobot_memobench.policies.memobench_mem.training import (
    NUMBERS,
    PICTURE,
    WINDOW,
    TrainingCurve,
    counted_actions,
    mean_losses,
    means_over_ranks,
)
from lerobot_memobench.run.training import trained_on
from tests.support import rank_case
from tests.support.fork_server import ForkServer
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import CHUNK, batch_of, losses_in_training, made_for_training, small_config
from tests.support.synthetic_dataset import make_dataset


def _config(root: Path, output: Path, steps: int, save_freq: int, **fields: Any) -> TrainPipelineConfig:
    return TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(root)),
        policy=MemobenchMemConfig(device="cpu", push_to_hub=False, **fields),
        output_dir=output,
        steps=steps,
        batch_size=8,
        num_workers=0,
        log_freq=max(1, steps // 5),
        save_freq=save_freq,
    )


def _updates(checkpoint: Path) -> int:
    with safe_open(checkpoint / "pretrained_model" / "training_weights.safetensors", framework="pt") as file:
        return int(file.metadata()["updates"])


def _logged(caplog: pytest.LogCaptureFixture, name: str) -> list[float]:
    # The text, written when it was logged: the records hold the tracker, which has been reset since.
    lines = [line for line in caplog.text.splitlines() if "smpl:" in line]
    return [float(match[1]) for line in lines if (match := re.search(rf"\b{name}:(-?[\d.]+)", line))]


@pytest.fixture
def logs(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> pytest.LogCaptureFixture:
    # LeRobot replaces the root logger's handlers, and with them pytest's.
    monkeypatch.setattr("lerobot.scripts.lerobot_train.init_logging", lambda **_: None)
    caplog.set_level(logging.INFO)
    return caplog


def test_training_saves_and_goes_on(
    dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logs: pytest.LogCaptureFixture
) -> None:
    train(
        _config(dataset_root, tmp_path / "run", steps=4, save_freq=2, align="framewise", chunk_size=8, n_action_steps=8)
    )
    assert len(_logged(logs, "loss")) == len(_logged(logs, "align_top1")) == 4
    checkpoints = tmp_path / "run" / "checkpoints"
    assert (_updates(checkpoints / "000002"), _updates(checkpoints / "000004")) == (2, 4)
    config_path = checkpoints / "000002" / "pretrained_model" / "train_config.json"
    monkeypatch.setattr(sys, "argv", ["lerobot-train", f"--config_path={config_path}", "--resume=true", "--steps=3"])
    train()  # type: ignore[call-arg]
    assert _updates(checkpoints / "000003") == 3


@pytest.mark.slow
def test_the_loss_of_held_out_episodes_lies_beside_the_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logs: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(training, "WINDOW", 2)
    config = _config(make_dataset(tmp_path / "two", repeats=2), tmp_path / "run", 4, 4, chunk_size=8)
    config.dataset.eval_split, config.eval_steps = 0.5, 2
    with trained_on(None):
        train(config)
    numbers = json.loads((tmp_path / "run/checkpoints/000004/pretrained_model" / training.NUMBERS).read_text())
    lerobots = [float(loss) for loss in re.findall(r"eval_loss=([\d.]+)", logs.text)]
    assert [look["updates"] for look in numbers["held_out"]] == [2, 4]
    assert [look["action_loss"] for look in numbers["held_out"]] == pytest.approx(lerobots, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("align", ["none", "semantic", "contrastive", "framewise"])
def test_loss_falls(dataset_root: Path, tmp_path: Path, logs: pytest.LogCaptureFixture, align: str) -> None:
    train(_config(dataset_root, tmp_path / "run", steps=50, save_freq=50, align=align))
    losses = _logged(logs, "action_loss")
    assert len(losses) == 5
    assert losses[-1] < 0.6 * losses[0]
    if align != "none":
        aligned = _logged(logs, "align_loss")
        assert aligned[-1] < 0.8 * aligned[0]
        assert all(norm > 0 for norm in _logged(logs, "align_grad_norm"))


# -- objectives of actions --------------------------------------------------------------------------------------------

REGRESSION: dict[str, Any] = {"perception": "objects", "size": "small", "objective": "regression", "n_action_steps": 3}
INDICES = [*range(8, 38, 3)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, dict[str, Any], list[float]]:
    """A policy after some updates on one batch, that batch, and how the loss fell."""
    root = make_object_dataset(tmp_path_factory.mktemp("objects") / "data")
    policy, before, _, dataset = made_for_training(root, **REGRESSION, ema_decay=0.0)
    batch = before(batch_of(dataset, INDICES))
    losses = losses_in_training(policy, batch)
    return policy.eval(), batch, losses


def planned(policy: Any, batch: dict[str, Any]) -> torch.Tensor:
    with torch.no_grad():
        policy.read_memory(batch)
        rows = len(batch["action"])
        return policy.model.sample_actions(
            *policy._preprocess_images(batch),
            batch["observation.language.tokens"],
            batch["observation.language.attention_mask"],
            noise=policy._noise([*range(rows)]),
        )[:, :, : policy._action_dim]


def test_the_loss_is_the_plans_error(trained: tuple[Any, dict[str, Any], list[float]]) -> None:
    policy, batch, losses = trained
    assert losses[-1] < 0.5 * losses[0]
    plans = planned(policy, batch)
    with torch.no_grad():
        _, logged = policy.forward(batch)
    error = (plans - batch["action"]).abs()[~batch["action_is_pad"]]
    error = error + error.square()
    assert logged["action_loss"] == pytest.approx(error.mean().item(), abs=2e-3)  # below 0.001 the error bends
    assert logged["loss_per_dim"] == pytest.approx(error.mean(dim=0).tolist(), abs=2e-3)


def test_nothing_is_drawn(trained: tuple[Any, dict[str, Any], list[float]]) -> None:
    policy, batch, _ = trained
    torch.manual_seed(1)
    one, first = planned(policy, batch), policy.forward(batch)[0]
    torch.manual_seed(2)
    assert torch.equal(one, planned(policy, batch))
    assert torch.equal(first, policy.forward(batch)[0])
    assert policy.config.num_inference_steps == 1


def test_what_guides_denoising_is_refused() -> None:
    from lerobot.policies.rtc.configuration_rtc import RTCConfig

    with pytest.raises(MemobenchError, match="objective=flow_matching"):
        MemobenchMemConfig(device="cpu", objective="regression", rtc_config=RTCConfig())
    with pytest.raises(MemobenchError, match="objective=<one of flow_matching, regression>"):
        MemobenchMemConfig(device="cpu", objective="l2")


# -- ranks ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ranks(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("ranks")
    forks = ForkServer([rank_case.__name__])
    code = "from pathlib import Path; from tests.support.rank_case import run_rank; run_rank({}, Path({!r}))"
    running = [forks.start(code.format(rank, str(folder)), folder / f"{rank}.txt") for rank in range(2)]
    assert [fork.wait() for fork in running] == [0, 0], [file.read_text() for file in folder.glob("*.txt")]
    forks.close()
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(rank_case.CASES)), ids=lambda n: f"{n}-{rank_case.CASES[n][0]}")
def test_two_ranks_are_one_batch(ranks: Any, number: int) -> None:
    joint = rank_case.step(*rank_case.CASES[number], slice(None))
    first, second = (rank[number] for rank in ranks)
    close = {"rtol": 1e-5, "atol": 1e-6}
    torch.testing.assert_close((first["loss"] + second["loss"]) / 2, joint["loss"], **close)
    assert first["top1"] == second["top1"] == joint["top1"]
    for name in joint.keys() - {"loss", "top1"}:
        torch.testing.assert_close(first[name], joint[name], **close)
        torch.testing.assert_close(second[name], joint[name], **close)
    if rank_case.CASES[number][0] == "contrastive":
        torch.testing.assert_close(first["loss"], joint["loss"], **close)
        assert "alignment.log_temperature" in joint


def test_what_a_curve_keeps_is_of_all_ranks(ranks: Any) -> None:
    assert [rank[-1] for rank in ranks] == [{"loss": 1.5, "per_dim": [0]}, {"loss": 1.5, "per_dim": [1]}]
    assert means_over_ranks({"loss": 2.0}) == {"loss": 2.0}


# -- curve ------------------------------------------------------------------------------------------------------------


def test_points_are_means_and_go_on(tmp_path: Path) -> None:
    curve = TrainingCurve()
    curve.save(tmp_path)
    assert not list(tmp_path.iterdir())
    for update in range(2 * WINDOW + 3):
        more = {"align_top1": 0.5, "align_loss": 1.0} if update % 2 else {}
        curve.note({"loss": update + 1.0, "action_loss": float(update), "loss_per_dim": [1.0, 2.0], **more})
    curve.save(tmp_path)
    means = [(WINDOW - 1) / 2, WINDOW + (WINDOW - 1) / 2]
    assert [point["action_loss"] for point in curve.points] == pytest.approx(means)
    assert curve.points[0]["align_top1"] == 0.5
    assert Image.open(tmp_path / PICTURE).width > 500
    again = TrainingCurve.read(tmp_path)
    assert again.points == curve.points
    for _ in range(WINDOW):
        again.note({"action_loss": 7.0})
    assert [point["action_loss"] for point in again.points] == pytest.approx([*means, 7.0])
    assert (tmp_path / NUMBERS).is_file()
    assert TrainingCurve.read(tmp_path / "elsewhere").points == []


def test_looks_at_held_out_episodes_lie_between_updates(tmp_path: Path) -> None:
    curve = TrainingCurve()
    for loss in (1.0, 3.0):
        curve.note_held_out({"action_loss": loss, "loss": 9.0})
    for _ in range(WINDOW + 4):
        curve.note({"action_loss": 0.5})
    curve.note_held_out({"action_loss": 0.25})
    curve.save(tmp_path)
    assert curve.held_out == [
        {"updates": 0, "action_loss": 2.0},
        {"updates": WINDOW + 4, "action_loss": 0.25},
    ]
    assert TrainingCurve.read(tmp_path).held_out == curve.held_out


def test_a_loss_that_is_measured_is_that_of_what_a_checkpoint_holds(tmp_path: Path) -> None:
    """`eval_loss` of lerobot-train, beside rollouts of the averaged weights."""
    policy, before, after, dataset = made_for_training(
        make_object_dataset(tmp_path / "data"), perception="objects", size="small", align="semantic"
    )
    batch = before(batch_of(dataset, [10, 30, 50]))
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-2)
    for _ in range(3):
        policy.train().forward(batch)[0].backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    for part in (policy, before, after):
        part.save_pretrained(tmp_path / "checkpoint")
    acting = MemobenchMemPolicy.from_pretrained(tmp_path / "checkpoint")
    with torch.no_grad():
        measured, held = (one.eval().forward(batch)[0].item() for one in (policy, acting))
    assert measured == held
    trained = policy.eval().forward(batch)[0]
    trained.backward()  # gradients are of the weights that learn
    assert abs(trained.item() - measured) > 1e-3
    assert policy.curve.held_out == []


@pytest.mark.parametrize("memory", ["subgoal", "keyframes"])
def test_a_loss_that_is_measured_follows_the_memorys_own_choice(tmp_path: Path, memory: str) -> None:
    policy, before, _, dataset = made_for_training(
        make_object_dataset(tmp_path / "data"), memory=memory, memory_frames=32, perception="objects", size="small"
    )
    if memory == "keyframes":
        policy.model.fusion.open_gate()  # so that actions depend on what it reads
    batch = before(batch_of(dataset, [10, 30, 50]))
    others = {name: (batch[name] + 1) % len(policy.config.subgoal_texts) for name in (SUBGOAL, SUBGOALS)}
    with torch.no_grad():
        for learns in (True, False):
            mine, other = (policy.train(learns).forward(one)[1] for one in (batch, {**batch, **others}))
            assert (mine["action_loss"] == other["action_loss"]) is not learns
            own = [name for name in mine if name.startswith("memory_")]
            assert own
            assert any(mine[name] != other[name] for name in own), "it is measured by the labels all the same"


# -- frames that are drawn and count ----------------------------------------------------------------------------------

EXECUTION = [*range(40), *range(48, 94)]  # the second episode, from 40 on, has eight prompt frames


def test_execution_starts() -> None:
    phase = np.array([1, 1, 0, 0, 1, 0, 0])
    assert execution_starts(np.array([0, 2, 5, 7]), phase).tolist() == [0, 4, 7]


def test_lerobot_train_draws_every_execution_frame_once_and_no_prompt(
    dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []
    forward = MemobenchMemPolicy.forward

    def spied(self: MemobenchMemPolicy, batch: dict[str, torch.Tensor]) -> object:
        drawn.extend(batch["index"].tolist())
        assert batch["phase"].all()
        return forward(self, batch)

    monkeypatch.setattr(MemobenchMemPolicy, "forward", spied)
    train(
        TrainPipelineConfig(
            dataset=DatasetConfig(repo_id="memobench/synthetic", root=str(dataset_root)),
            policy=small_config(memory_frames=2),
            output_dir=tmp_path / "run",
            steps=2,
            batch_size=len(EXECUTION) // 2,
            num_workers=0,
            save_checkpoint=False,
        )
    )
    assert sorted(drawn) == EXECUTION
    assert drawn != sorted(drawn)


def test_the_sampler_begins_where_the_configuration_says(dataset_root: Path) -> None:
    policy, _, _, dataset = made_for_training(dataset_root)
    ranges = [list(dataset.meta.episodes[f"dataset_{end}_index"]) for end in ("from", "to")]

    def drawn(drop: int, **options: bool) -> list[int]:
        return list(EpisodeAwareSampler(*ranges, drop_n_last_frames=drop, **options))

    asked = policy.config.drop_n_last_frames
    assert drawn(asked) == EXECUTION
    assert drawn(asked, shuffle=True) == drawn(asked, shuffle=True)
    # Other policies draw as ever; so does a configuration that is made for no dataset.
    assert drawn(0) == list(range(94))
    assert drawn(3) == [*range(37), *range(40, 60), *range(63, 91)]
    assert small_config().drop_n_last_frames == 0
    assert ranges[0] == [0, 40, 63]


def test_padded_actions_do_not_count(dataset_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame 38 is the last but one of its episode: of its chunk two actions are real."""
    policy, before, _, dataset = made_for_training(dataset_root)
    batch = before(batch_of(dataset, [38, 5]))
    losses = torch.ones(2, CHUNK, policy.config.max_action_dim)
    losses[0, 2:] = 1000.0
    losses[0, :2] = 5.0
    monkeypatch.setattr(policy.model, "forward", lambda *_: losses)
    _, logged = policy.forward(batch)
    assert logged["action_loss"] == pytest.approx((2 * 5.0 + CHUNK * 1.0) / (2 + CHUNK))
    assert logged["loss_per_dim"] == pytest.approx([logged["action_loss"]] * 7)
    per_sample, _ = policy.forward(batch, reduction="none")
    assert per_sample.mean().item() == pytest.approx(logged["action_loss"])


def test_mean_losses_without_padding_is_the_mean() -> None:
    losses = torch.rand(4, 5, 3)
    found = mean_losses(losses, counted_actions({}, losses))
    torch.testing.assert_close(found.mean, losses.mean())
    torch.testing.assert_close(found.per_sample, losses.mean(dim=(1, 2)))
    nothing = mean_losses(losses, torch.zeros(4, 5))
    assert nothing.mean == 0
    assert nothing.per_sample.tolist() == [0] * 4
