"""Pixels: pictures through pi0.5's frozen image tower; a remembered one is pooled to 4 x 4 tokens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import torch
from einops import reduce
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.dimensions import GRID
from lerobot_memobench.policies.memobench_mem.perception.frozen import fingerprint
from lerobot_memobench.policies.memobench_mem.perception.perception import Perception


def pool_tokens(tokens: Tensor) -> Tensor:
    """Mean-pool the patch tokens of square images (N, g*g, D) to (N, 16, D); g is a multiple of 4 (16 at full size)."""
    patches = tokens.shape[1]
    side = round(patches**0.5)
    if side * side != patches or side % GRID:
        raise ValueError(f"cannot pool {patches} tokens to a {GRID}x{GRID} grid")
    return reduce(tokens, "n (gy by gx bx) d -> n (gy gx) d", "mean", gy=GRID, gx=GRID, by=side // GRID)


class PixelPerception(Perception):
    """The image tower, and the projection of its tokens to the language model's width.

    Args:
        resolution: height and width of the pictures that the tower sees, pixels.
        camera: whose pictures are remembered.
    """

    tokens_per_frame = GRID**2
    grid = GRID
    pictures = True

    def __init__(self, tower: nn.Module, projector: nn.Module, resolution: tuple[int, int], camera: str) -> None:
        self.tower, self.projector, self.resolution = tower, projector, resolution
        self.remembers = camera
        self.dim: int = projector.linear.out_features

    @cached_property
    def key(self) -> str:
        """Identity of the tokens this makes: weights, input size and pooling."""
        weights = fingerprint({"vision_tower": self.tower, "multi_modal_projector": self.projector})
        return f"{weights}-{self.resolution[0]}x{self.resolution[1]}-mean{self.tokens_per_frame}"

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return the tokens (n, 16, D) of some rows' pictures."""
        return self(batch[self.remembers][list(rows)])

    @torch.no_grad()
    def __call__(self, images: Tensor) -> Tensor:
        """Encode pictures (N, 3, H, W) float in [0, 1] to (N, 16, D) bfloat16 on the tower's device."""
        device = next(self.tower.parameters()).device
        images = images.to(device, torch.float32)
        if tuple(images.shape[-2:]) != tuple(self.resolution):
            images = resize_with_pad_torch(images, *self.resolution)
        # Mixed precision would make rollout tokens differ from cached ones.
        with torch.autocast(device.type, enabled=False):
            return pool_tokens(self.prefix(images * 2.0 - 1.0)).to(torch.bfloat16)

    def prefix(self, observed: Tensor) -> Tensor:
        """Return all patch tokens (B, g*g, D) of pictures (B, 3, H, W) in [-1, 1], in the pictures' precision.

        The tower computes in float32 whatever the rest of the model does.
        """
        return self.projector(self.tower(observed.to(torch.float32)).last_hidden_state).to(observed.dtype)
