"""Losses beside a checkpoint: means of windows, a picture, and going on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from PIL import Image

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.training import NUMBERS, PICTURE, WINDOW, TrainingCurve
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import batch_of, made_for_training


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
