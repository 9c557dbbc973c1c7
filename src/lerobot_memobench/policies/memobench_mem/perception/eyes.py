"""Eyes: pictures through the tower of `lerobot_memobench.perception`, which learns no more; its tokens do.

All tokens of a present picture enter the prefix; of a remembered one the pooled ones are kept. In a training sample the
tokens stand in the pictures' place, see `seen_pictures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor, nn
from torch.nn.functional import rms_norm

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.tower import GRID, POOLED, SIDE, WIDTH, Tower, shrunk
from lerobot_memobench.policies.memobench_mem.perception.frozen import fingerprint
from lerobot_memobench.policies.memobench_mem.perception.objects import LOUD
from lerobot_memobench.policies.memobench_mem.perception.perception import Perception, Seen
from lerobot_memobench.policies.memobench_mem.perception.pooled_memory import PooledMemory
from lerobot_memobench.policies.shown import cure

SEEN = "observation.seen."
"""What the names of pictures' tokens in training samples begin with."""


def seen_key(camera: str) -> str:
    """Return the name in a training sample of the tokens (B, 64, WIDTH) of a camera's picture."""
    return SEEN + camera.removeprefix(f"{OBS_IMAGES}.")


class PicturePool(nn.Module):
    """The pooled tokens of a remembered picture at the policy's width, of unit size as those of `FramePool`."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.project = nn.Linear(WIDTH, width)

    def forward(self, frames: Tensor) -> Tensor:
        """Return tokens (N, 16, width) of pooled ones (N, 16, WIDTH)."""
        made = self.project(frames.to(self.project.weight.dtype))
        return rms_norm(made, made.shape[-1:], eps=1e-6)


class EyePerception(nn.Module, Perception):
    """The tokens of all cameras' present pictures; pooled ones of one camera's are remembered.

    Args:
        tower: without batch normalisation. It is the model's own part, as image towers are, and not registered here.
        cameras: whose pictures are seen now. camera: whose are remembered. width: of the policy's tokens.
    """

    tokens_per_frame = POOLED**2
    grid = POOLED
    pictures = True

    def __init__(self, tower: Tower, cameras: Sequence[str], camera: str, width: int) -> None:
        super().__init__()
        self._tower = (tower,)
        self.cameras, self.remembers, self.dim = list(cameras), camera, width
        self.project = nn.Linear(WIDTH, width)

    @property
    def tower(self) -> Tower:
        """What pictures are seen through."""
        return self._tower[0]

    @cached_property
    def _sight(self) -> str:
        return f"{fingerprint({'eyes': self.tower})}-{SIDE}x{SIDE}"

    @property
    def key(self) -> str:
        """Identity of the pooled tokens: weights, and size of the pictures."""
        return f"{self._sight}-eyes{self.tokens_per_frame}"

    @property
    def present_key(self) -> str:
        """Identity of the tokens of present pictures."""
        return f"{self._sight}-eyes{GRID**2}"

    @torch.no_grad()
    def look(self, pictures: Tensor) -> Tensor:
        """Return the tokens (N, 64, WIDTH) bfloat16 of pictures (N, 3, H, W) in [0, 1]."""
        device = self.tower.place.device
        with torch.autocast(device.type, enabled=False):  # mixed precision would see otherwise than the cache did
            seen: Tensor = self.tower(shrunk(pictures.to(device)))
        return seen.to(torch.bfloat16)

    @torch.no_grad()
    def pooled(self, tokens: Tensor) -> Tensor:
        """Return what is remembered, (N, 16, WIDTH) bfloat16, of what `look` returns."""
        tower = self.tower
        with torch.autocast(tower.place.device.type, enabled=False):
            return tower.pooled(tokens.to(tower.place.device, torch.float32)).to(torch.bfloat16)

    def present(self, batch: Mapping[str, Tensor]) -> Seen:
        """Return each camera's tokens (B, 64, WIDTH), all of them real: those that the batch has, or of its pictures.

        Raises:
            MemobenchError: it has neither of a camera.
        """
        parts = [self._seen(batch, camera) for camera in self.cameras]
        return parts, [torch.ones(len(part), dtype=torch.bool) for part in parts]

    def _seen(self, batch: Mapping[str, Tensor], camera: str) -> Tensor:
        if seen_key(camera) in batch:
            return batch[seen_key(camera)]
        if camera not in batch:
            raise MemobenchError(f"The observation has no '{camera}', which this policy sees; {cure(camera, batch)}")
        return self.look(batch[camera])

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return the pooled tokens (n, 16, WIDTH) of some rows' pictures."""
        return self.pooled(self.look(batch[self.remembers][list(rows)]))

    def prefix(self, observed: Tensor) -> Tensor:
        """Return prefix tokens (B, 64, d_vlm) of a camera's tokens."""
        made: Tensor = self.project(observed.to(self.project.weight.dtype))
        return made * LOUD

    def memory(self, encoder: nn.Module) -> nn.Module:
        """Return the encoder behind a projection of each frame's tokens."""
        return PooledMemory(PicturePool(self.dim), encoder)
