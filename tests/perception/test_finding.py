"""Targets and finding undo one another: heads that said what they should are read off as what was there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_memobench.perception.finding import found
from lerobot_memobench.perception.labels import projected
from lerobot_memobench.perception.second_look import SecondLook
from lerobot_memobench.perception.targets import loss, targets
from lerobot_memobench.perception.tower import GRID
from lerobot_memobench.perception.training import CELLS
from lerobot_memobench.sim.scene import TABLE_TOP
from tests.support.made_up import HEIGHT, SLOPE, laid_out, made_up, perfect

KINDS, SIDE = 3, 2 * GRID


@pytest.mark.parametrize("cells", CELLS.values(), ids=CELLS)
def test_what_was_there_is_found(cells: tuple[int, int, int]) -> None:
    rows, (grid, _, coarse) = made_up(6), cells
    for row, things in zip(rows, found(perfect(targets(rows, KINDS, *cells), grid * coarse)), strict=True):
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
    said = perfect(targets(made_up(2), KINDS, GRID), SIDE)
    doubt = torch.tensor([0.16, 0.01, 0.02]).log()[:, None, None].expand(2, KINDS, 3, SIDE, SIDE)
    assert not found(said)[0]["doubt"].any()
    for things in found(replace(said, doubt=laid_out(doubt))):
        assert things["doubt"] == pytest.approx(np.tile([0.01, 0.01, 0.02], (KINDS, 1)), rel=1e-4)


def test_a_second_look_says_which_finds_are_right() -> None:
    said = perfect(targets(made_up(2), KINDS, GRID), SIDE)
    logits = torch.tensor([-4.0, 0.0, 2.0])

    def sure(picture: torch.Tensor, _: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
        return torch.where(said.heat[picture, :, row, column] > 0, logits, -9.0)

    for things in found(replace(said, sure=sure)):
        assert things["kind"].tolist() == [2, 1], "the surest first, and one not"
        assert things["score"] == pytest.approx(torch.sigmoid(logits[[2, 1]]).numpy())


def test_a_second_look_is_at_what_is_around_a_find() -> None:
    """Elsewhere it says of a place what it said of it, nothing far from it matters, and its square's edge does."""
    torch.manual_seed(0)
    look, side = SecondLook(6, 5, KINDS), 16
    maps = {"fine": torch.rand(side, side, 6), "close": torch.rand(2 * side, 2 * side, 5)}
    maps["heat"] = torch.rand(side, side, KINDS)

    def said(row: int, column: int, **changed: torch.Tensor) -> torch.Tensor:
        seen = {**maps, **changed}
        close, heat = (seen[name].permute(2, 0, 1)[None] for name in ("close", "heat"))
        cells = (torch.tensor([value]) for value in (0, 1, row, column))
        return look(seen["fine"].flatten(0, 1)[None], close, heat)(*cells)

    first = said(7, 8)
    assert first.shape == (1, KINDS)
    moved = {name: values.roll((4, -4) if name == "close" else (2, -2), (0, 1)) for name, values in maps.items()}
    assert torch.allclose(said(9, 6, **moved), first, atol=1e-6)
    for name, row, column, reach in (("fine", 7, 8, 2), ("close", 14, 16, 6), ("heat", 7, 8, 1)):
        far = torch.full_like(maps[name], 9.0)
        near = (slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1))
        far[near] = maps[name][near]
        assert torch.allclose(said(7, 8, **{name: far}), first, atol=1e-6)
        far[row - reach, column + reach] = 9.0
        assert not torch.allclose(said(7, 8, **{name: far}), first, atol=1e-3)


def test_saying_so_costs_nothing_and_anything_else_does() -> None:
    wanted = targets(made_up(3), KINDS, GRID)
    right = perfect(wanted, SIDE)
    assert all(float(value) < 1e-3 for value in loss(right, wanted).values())
    wrong = {
        "heat": replace(right, heat=-right.heat),
        "place": replace(right, geometry=lambda *cells: right.geometry(*cells) + torch.eye(8)[0]),
        "rest": replace(right, geometry=lambda *cells: right.geometry(*cells) + torch.eye(8)[2]),
        "mask": replace(right, mask=right.mask.flip(1)),
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


def test_an_origin_outside_the_picture_is_told() -> None:
    """Of a stove or a pan the wrist's camera shows a corner; what was asked for then had once ended at a quarter."""
    rows = made_up(4)
    rows["things"]["position"][:, :, 0] += 0.8 * 2 * HEIGHT * SLOPE
    for row, things in zip(rows, found(perfect(targets(rows, KINDS, GRID), SIDE)), strict=True):
        true = row["things"][things["kind"]]["position"].astype(float)
        assert np.allclose(things["place"], projected(true, row)[0], atol=1e-5)
