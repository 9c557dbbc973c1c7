"""Encode images as 8 x 8 tokens, and these as 4 x 4 pooled tokens that keep the positions of objects."""

from __future__ import annotations

from typing import Self

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu
from torch.nn.utils.fusion import fuse_conv_bn_eval

from lerobot_memobench.errors import MemobenchError

SIDE = 256  # side of the encoder's images, pixels: the benchmark's own
GRID, POOLED = 8, 4  # sides of the squares of tokens
WIDTH = 192  # dimension of a token
WIDTHS, BLOCKS = (16, 24, 48, 96, WIDTH), (0, 0, 2, 3, 1)
"""Channels of each stage, which halves the image, and its residual blocks."""


def area_averaged(images: Tensor) -> Tensor:
    """Return square images (N, 3, H, H) at the encoder's size, float (N, 3, SIDE, SIDE), by area averaging."""
    height, width = images.shape[-2:]
    if height != width:
        raise MemobenchError(
            f"found images of {height} x {width} pixels, and the visual encoder and the detector read square ones; "
            "set observation_height and observation_width to one number"
        )
    images = images.to(torch.float32)
    return images if images.shape[-1] == SIDE else interpolate(images, (SIDE, SIDE), mode="area")


class ConvNorm(nn.Module):
    """A 3 x 3 convolution with batch normalisation, which `fold_norms` folds into it."""

    def __init__(self, channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out_channels, 3, stride, 1, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, channels, H, W) to (N, out_channels, H / stride, W / stride)."""
        return self.norm(self.conv(x))


class ResidualBlock(nn.Module):
    """Two convolutions with a skip connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.second = ConvNorm(channels, channels), ConvNorm(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, channels, H, W) to the same shape."""
        return relu(x + self.second(relu(self.first(x))))


class VisualEncoder(nn.Module):
    """A small convolutional network to tokens: stages of ``widths`` channels, with ``blocks`` residual blocks each."""

    def __init__(self, widths: tuple[int, ...] = WIDTHS, blocks: tuple[int, ...] = BLOCKS) -> None:
        super().__init__()
        self.widths, self.blocks, self.width = widths, blocks, widths[-1]
        self.stages = nn.ModuleList(
            nn.Sequential(ConvNorm(before, width, stride=2), nn.ReLU(), *(ResidualBlock(width) for _ in range(count)))
            for before, width, count in zip((3, *widths[:-1]), widths, blocks, strict=True)
        )
        self.grid_position = nn.Parameter(torch.zeros(widths[-1], GRID, GRID))
        self.decorrelate: nn.Module = nn.Identity()
        self.pool = nn.Linear(widths[-1] * (GRID // POOLED) ** 2, widths[-1])

    def forward(self, images: Tensor) -> Tensor:
        """Return the tokens (N, 64, width) of images (N, 3, SIDE, SIDE) in [0, 1], row by row."""
        return self.tokens_and_maps(images)[0]

    def tokens_and_maps(self, images: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return the tokens, and the feature maps (N, channels, H, W) of the stages before the last, finest first."""
        x = (images * 2 - 1).contiguous(memory_format=torch.channels_last)
        maps = []
        for stage in self.stages[:-1]:
            x = stage(x)
            maps.append(x)
        tokens = rearrange(self.stages[-1](x) + self.grid_position, "n d y x -> n (y x) d")
        return self.decorrelate(tokens), maps

    def pooled(self, tokens: Tensor) -> Tensor:
        """Pool 64 tokens to 16 (N, 16, width): one per square of four, by a linear map that knows their order."""
        near = rearrange(tokens, "n (y b x a) d -> n (y x) (b a d)", b=2, a=2, y=POOLED, x=POOLED)
        return self.pool(near)

    def fold(self) -> Self:
        """Fold batch normalisation into the convolutions, and add the linear map that whitens tokens, as identity.

        Outputs in evaluation mode do not change. A folded encoder, as in a detector's file, is not trained further.
        """
        fold_norms(self)
        if isinstance(self.decorrelate, nn.Identity):
            self.decorrelate = nn.Linear(self.width, self.width)
            nn.init.eye_(self.decorrelate.weight)
            nn.init.zeros_(self.decorrelate.bias)
        return self


def fold_norms(module: nn.Module) -> None:
    """Fold all batch normalisation of a module into its convolutions."""
    for part in module.modules():
        if isinstance(part, ConvNorm) and isinstance(part.norm, nn.BatchNorm2d):
            part.conv = fuse_conv_bn_eval(part.conv.eval(), part.norm.eval())
            part.norm = nn.Identity()
