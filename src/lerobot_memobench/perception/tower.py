"""The tower: pictures to 8 x 8 tokens, and those to 4 x 4 that still know where things are."""

from __future__ import annotations

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu
from torch.nn.utils.fusion import fuse_conv_bn_eval

SIDE = 256
"""Side of the pictures that the tower sees, pixels: the benchmark's own."""
GRID, POOLED = 8, 4
"""Sides of the squares of tokens."""
WIDTH = 192
"""Numbers of a token."""
WIDTHS, BLOCKS = (16, 24, 48, 96, WIDTH), (0, 0, 2, 3, 1)
"""Channels of each halving of the picture, and the residual blocks that follow it."""


def shrunk(images: Tensor) -> Tensor:
    """Return square pictures (N, 3, H, H) as the tower sees them, float (N, 3, SIDE, SIDE): areas averaged."""
    images = images.to(torch.float32)
    return images if images.shape[-1] == SIDE else interpolate(images, (SIDE, SIDE), mode="area")


class Convolution(nn.Module):
    """A 3 x 3 convolution with batch normalisation, which `fold` makes part of it."""

    def __init__(self, here: int, there: int, stride: int = 1) -> None:
        super().__init__()
        self.weigh = nn.Conv2d(here, there, 3, stride, 1, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(there)

    def forward(self, x: Tensor) -> Tensor:
        """(N, here, H, W) to (N, there, H / stride, W / stride)."""
        return self.norm(self.weigh(x))

    def fold(self) -> None:
        """Go on without normalisation; what comes out stays as it was in evaluation."""
        if isinstance(self.norm, nn.BatchNorm2d):
            self.weigh = fuse_conv_bn_eval(self.weigh.eval(), self.norm.eval())
            self.norm = nn.Identity()


class Block(nn.Module):
    """Two convolutions beside which the input is carried past."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = Convolution(width, width), Convolution(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(N, width, H, W) to the same."""
        return relu(x + self.second(relu(self.first(x))))


class Tower(nn.Module):
    """Pictures to tokens.

    Args:
        widths, blocks: of each stage; the last width is a token's.
        folded: without batch normalisation, as `weights` keeps it.
    """

    def __init__(
        self, widths: tuple[int, ...] = WIDTHS, blocks: tuple[int, ...] = BLOCKS, *, folded: bool = False
    ) -> None:
        super().__init__()
        self.widths, self.blocks = widths, blocks
        self.stages = nn.ModuleList(
            nn.Sequential(Convolution(here, there, stride=2), nn.ReLU(), *(Block(there) for _ in range(count)))
            for here, there, count in zip((3, *widths[:-1]), widths, blocks, strict=True)
        )
        self.place = nn.Parameter(torch.zeros(widths[-1], GRID, GRID))
        self.even: nn.Module = nn.Identity()
        self.pool = nn.Linear(widths[-1] * (GRID // POOLED) ** 2, widths[-1])
        if folded:
            self.fold()

    @property
    def width(self) -> int:
        """Numbers of a token."""
        return self.widths[-1]

    def forward(self, images: Tensor) -> Tensor:
        """Return the tokens (N, 64, width) of pictures (N, 3, SIDE, SIDE) in [0, 1], row by row."""
        return self.looked(images)[0]

    def looked(self, images: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return the tokens, and the maps of the stages before the last, (N, width, side, side), the finest first."""
        x = (images * 2 - 1).contiguous(memory_format=torch.channels_last)
        maps = []
        for stage in self.stages[:-1]:
            x = stage(x)
            maps.append(x)
        return self.even(rearrange(self.stages[-1](x) + self.place, "n d y x -> n (y x) d")), maps

    def pooled(self, tokens: Tensor) -> Tensor:
        """Return 16 tokens (N, 16, width) of 64: each of a square of four, which keeps what is where in it."""
        near = rearrange(tokens, "n (y b x a) d -> n (y x) (b a d)", b=2, a=2, y=POOLED, x=POOLED)
        return self.pool(near)

    def fold(self) -> None:
        """Make batch normalisation part of the convolutions, and room for `whitening`: no more for training."""
        fold(self)
        if isinstance(self.even, nn.Identity):
            self.even = nn.Linear(self.width, self.width)
            nn.init.eye_(self.even.weight)
            nn.init.zeros_(self.even.bias)


def fold(module: nn.Module) -> None:
    """Make all batch normalisation of a module part of its convolutions."""
    for part in module.modules():
        if isinstance(part, Convolution):
            part.fold()
