"""Targets and finding undo one another: heads that said what they should are read off as what was there."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lerobot_memobench.eyes.finding import found
from lerobot_memobench.eyes.heads import GEOMETRY, Said
from lerobot_memobench.eyes.labels import projected
from lerobot_memobench.eyes.targets import LIT, Targets, loss, targets
from lerobot_memobench.eyes.tower import GRID, POOLED
from lerobot_memobench.sim.scene import TABLE_TOP

from .made_up import HEIGHT, made_up

KINDS = 3


def perfect(wanted: Targets) -> Said:
    """Return what heads say that have learned all there is to learn."""
    pictures, kinds, side, _ = wanted.heat.shape
    geometry = torch.zeros(pictures, kinds, len(GEOMETRY), side // 2, side // 2)
    picture, kind, row, column = wanted.cells.T
    said = wanted.geometry.nan_to_num()
    said[:, LIT] = torch.where(said[:, LIT] > 0.5, 10.0, -10.0)
    geometry[picture, kind, :, row, column] = said
    mask = 20 * torch.nn.functional.one_hot(wanted.mask, kinds + 1).float().permute(0, 3, 1, 2)
    return Said(torch.where(wanted.heat == 1, 10.0, -10.0), geometry, mask)


@pytest.mark.parametrize("grid", [GRID, POOLED])
def test_what_was_there_is_found(grid: int) -> None:
    rows = made_up(6)
    for row, things in zip(rows, found(perfect(targets(rows, KINDS, grid))), strict=True):
        assert sorted(things["kind"]) == list(range(KINDS))
        true = row["things"][things["kind"]]
        place, depth = projected(true["position"].astype(float), row)
        assert np.allclose(things["place"], place, atol=1e-5)
        assert np.allclose(things["depth"], HEIGHT, atol=1e-5)
        assert np.allclose(depth, HEIGHT, atol=1e-5)
        assert np.allclose(things["height"], true["position"][:, 2] - TABLE_TOP, atol=1e-5)
        jointed = ~np.isnan(true["joint"])
        assert np.allclose(things["joint"][jointed], true["joint"][jointed], atol=1e-6)
        assert np.allclose(things["turn"], true["turn"], atol=1e-5)
        assert ((things["lit"] > 0.5) == true["lit"]).all()


def test_doubts_are_of_the_picture_and_of_metres() -> None:
    said = perfect(targets(made_up(2), KINDS, GRID))
    doubt = torch.tensor([0.16, 0.01, 0.02]).log()[:, None, None].expand(2, KINDS, 3, 2 * GRID, 2 * GRID)
    assert not found(said)[0]["doubt"].any()
    for things in found(Said(said.heat, said.geometry, said.mask, doubt)):
        assert things["doubt"] == pytest.approx(np.tile([0.01, 0.01, 0.02], (KINDS, 1)), rel=1e-4)


def test_saying_so_costs_nothing_and_anything_else_does() -> None:
    wanted = targets(made_up(3), KINDS, GRID)
    right = perfect(wanted)
    assert all(float(value) < 1e-3 for value in loss(right, wanted).values())
    wrong = {
        "heat": Said(-right.heat, right.geometry, right.mask),
        "place": Said(right.heat, right.geometry + torch.eye(8)[0][:, None, None], right.mask),
        "rest": Said(right.heat, right.geometry + torch.eye(8)[2][:, None, None], right.mask),
        "mask": Said(right.heat, right.geometry, right.mask.flip(1)),
    }
    for name, said in wrong.items():
        costs = loss(said, wanted)
        assert [other for other, value in costs.items() if float(value) > 0.5] == [name]


def test_what_hardly_shows_is_not_taught() -> None:
    rows = made_up(1)
    rows["things"]["pixels"][:, 1] = 3
    wanted = targets(rows, KINDS, GRID)
    assert [bool((wanted.heat[0, kind] == 1).any()) for kind in range(KINDS)] == [True, False, True]
    assert set(wanted.cells[:, 1].tolist()) == {0, 2}


def test_of_two_of_a_kind_in_a_cell_the_nearer_is_asked_for() -> None:
    rows = made_up(1)
    rows["things"][0, 1] = rows["things"][0, 0]
    rows["things"]["anchor"][0, :2] = [(0.5, 0.53), (0.5, 0.58)]
    cells = targets(rows, KINDS, GRID).cells.tolist()
    assert len(cells) == len({tuple(cell) for cell in cells})
