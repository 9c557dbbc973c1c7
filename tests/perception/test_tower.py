"""The tower: its sizes, what folding and the file leave as it was, and that pooled tokens know their place."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.heads import Said
from lerobot_memobench.perception.kinds import kinds
from lerobot_memobench.perception.neck import FINER, Neck
from lerobot_memobench.perception.tower import GRID, POOLED, SIDE, WIDTH, Block, Tower, shrunk
from lerobot_memobench.perception.weights import PACKAGE, READINGS, SHIPPED, Eyes, eyes_file, load_eyes, save_eyes
from lerobot_memobench.perception.whitening import whiten
from tests.support.made_up import everywhere

LARGEST, MOST = 6_000_000, 3_000_000
"""Bytes of the file, and weights of the tower."""


@pytest.fixture(autouse=True)
def same_weights() -> None:
    """Let weights and pictures be drawn alike each time."""
    torch.manual_seed(0)


def trained_a_little(tower: Tower) -> Tower:
    """Give batch normalisation something to remember."""
    tower.train()
    for _ in range(3):
        tower(torch.rand(4, 3, SIDE, SIDE))
    return tower.eval()


def all_said(readings: dict[str, Said]) -> list[Tensor]:
    """Return all that is said but doubts, as it is now: geometry is only worked out when it is asked for."""
    assert set(readings) == set(READINGS)
    return [
        values
        for said in readings.values()
        for values in (said.heat, said.mask, everywhere(said.geometry, (*said.heat.shape[:2], said.side)))
    ]


def test_sizes(tmp_path: Path) -> None:
    eyes = Eyes(Tower(), kinds())
    assert sum(weights.numel() for weights in eyes.tower.parameters()) <= MOST
    tokens = eyes.tower.eval()(torch.rand(2, 3, SIDE, SIDE))
    assert tokens.shape == (2, GRID**2, WIDTH)
    assert eyes.tower.pooled(tokens).shape == (2, POOLED**2, WIDTH)
    save_eyes(eyes, tmp_path / "eyes.safetensors")
    assert (tmp_path / "eyes.safetensors").stat().st_size <= LARGEST


@torch.no_grad()
def test_folding_leaves_tokens_as_they_were(small_tower: Callable[[], Tower]) -> None:
    tower, images = trained_a_little(small_tower()), torch.rand(2, 3, SIDE, SIDE)
    before = tower(images)
    tower.fold()
    assert torch.allclose(tower(images), before, atol=1e-5)
    assert not any("norm" in name for name in tower.state_dict())


@torch.no_grad()
def test_eyes_come_back_from_their_file(small_tower: Callable[[], Tower], tmp_path: Path) -> None:
    eyes, images = Eyes(trained_a_little(small_tower()), ("cork", "cap")), torch.rand(2, 3, SIDE, SIDE)
    before = all_said(eyes.eval()(images))
    save_eyes(eyes, tmp_path / "eyes.safetensors")
    back = load_eyes(tmp_path / "eyes.safetensors")
    assert back.kinds == ("cork", "cap")
    assert all(map(partial(torch.allclose, atol=0.05), all_said(back(images)), before))
    for name, value in eyes.state_dict().items():
        kept, rounding = back.state_dict()[name], 2**-8 * value.abs()
        if name.startswith(("heads.", "pooled_heads.")) and value.ndim > 1:
            rounding = value.abs().amax(dim=1, keepdim=True) / 253
        assert ((kept - value).abs() <= rounding + 1e-9).all(), name


@torch.no_grad()
def test_white_tokens_say_what_the_others_said(small_tower: Callable[[], Tower], tmp_path: Path) -> None:
    eyes, images = Eyes(trained_a_little(small_tower()), ("cork", "cap")).eval(), torch.rand(24, 3, SIDE, SIDE)
    before = all_said(eyes(images))
    whiten(eyes, images.split(10))
    assert all(map(partial(torch.allclose, atol=1e-3), all_said(eyes(images)), before))
    save_eyes(eyes, tmp_path / "eyes.safetensors")
    kept = load_eyes(tmp_path / "eyes.safetensors")
    for tower, rounding in ((eyes.tower, 1e-3), (kept.tower, 0.1)):  # the file's bfloat16 moves means
        for tokens in (tower(images), tower.pooled(tower(images))):
            rows = tokens.flatten(0, 1)
            variances = torch.linalg.eigvalsh(torch.cov(rows.T))
            assert rows.mean(dim=0).abs().max() < rounding
            assert variances.max() < 1.2
            assert variances[-3:].min() > 0.8


def test_the_packages_eyes_have_a_name() -> None:
    assert eyes_file(PACKAGE) == eyes_file(Path(PACKAGE)) == SHIPPED  # the command line makes paths of names


def test_other_files_are_no_eyes(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="there is no file"):
        load_eyes(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("eyes")
    with pytest.raises(MemobenchError, match="holds no eyes"):
        load_eyes(tmp_path / "text.safetensors")
    save_file({"weight": torch.zeros(2)}, tmp_path / "other.safetensors")
    with pytest.raises(MemobenchError, match="holds no eyes"):
        load_eyes(tmp_path / "other.safetensors")


def test_pictures_of_any_size_are_averaged_over_areas() -> None:
    images = torch.randint(0, 256, (1, 3, 2 * SIDE, 2 * SIDE), dtype=torch.uint8)
    by_hand = images.float().reshape(1, 3, SIDE, 2, SIDE, 2).mean(dim=(3, 5))
    assert torch.allclose(shrunk(images), by_hand)
    assert shrunk(by_hand) is by_hand


def test_a_pooled_token_is_of_its_own_four(small_tower: Callable[[], Tower]) -> None:
    tower = small_tower()
    tokens = torch.rand(1, GRID**2, tower.width, requires_grad=True)
    tower.pooled(tokens)[0, POOLED + 2].sum().backward()  # second row, third column
    assert tokens.grad is not None
    used = tokens.grad[0].abs().sum(dim=1).reshape(GRID, GRID) > 0
    assert used.nonzero().tolist() == [[2, 4], [2, 5], [3, 4], [3, 5]]
    parts = tower.pool.weight.reshape(tower.width, 4, tower.width)
    assert not torch.allclose(parts[:, 0], parts[:, 1])  # what is where in it is kept


def test_the_neck_knows_which_token_a_cell_lies_in(small_tower: Callable[[], Tower]) -> None:
    tower = small_tower()
    neck = Neck(tower).eval()
    for block in (module for module in neck.modules() if isinstance(module, Block)):
        for convolution in (block.first, block.second):
            torch.nn.init.zeros_(convolution.weigh.weight)  # it would look at the cells beside, too
    tokens = torch.rand(1, GRID**2, tower.width, requires_grad=True)
    _, maps = tower.looked(torch.rand(1, 3, SIDE, SIDE))
    maps = [one.detach().requires_grad_() for one in maps]
    cells = neck(tokens, maps).unflatten(1, (FINER * GRID, FINER * GRID))
    assert cells.shape[-1] == neck.width
    cells[0, 6, 11].sum().backward()
    assert tokens.grad is not None
    assert tokens.grad[0].any(dim=1).nonzero().flatten().tolist() == [1 * GRID + 2]
    used = [None if one.grad is None else one.grad[0].any(dim=0).nonzero().tolist() for one in maps]
    assert used == [None, None, [[6, 11]], [[3, 5]]], "the maps of the last stages, each the cell that it lies in"
    assert not torch.allclose(cells[0, 4, 8], cells[0, 4, 9]), "what is where in a token's square is told apart"
