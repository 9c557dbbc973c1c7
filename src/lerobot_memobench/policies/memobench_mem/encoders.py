"""Encoders of images: present images to prefix tokens, remembered images to the input of a memory."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from einops import reduce
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor, nn
from torch.nn.functional import interpolate, rms_norm

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.visual_encoder import GRID, POOLED, SIDE, WIDTH, VisualEncoder, area_averaged
from lerobot_memobench.policies.compatibility import hint
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MEMORY_GRID

if TYPE_CHECKING:
    from transformers.models.paligemma.modeling_paligemma import PaliGemmaMultiModalProjector

TOKEN_SCALE = 8.0
"""Factor of the tokens that trained encoders add to the prefix; with 1 they learned more slowly."""
PrefixParts = tuple[list[Tensor], list[Tensor]]
"""Present observations: parts (B, ...), and their masks: (B,) for a whole part, or (B, n) per token."""


class ObservationEncoder(ABC):
    """Encoder of present and remembered observations, in training and in rollouts."""

    memory_input: str  # name of the observation that is remembered
    dim: int  # D, width of the memory's input tokens
    tokens_per_frame: int  # P, their number per frame
    grid: int  # side of the square of an image's tokens; 0 if tokens have no place in an image

    @property
    @abstractmethod
    def key(self) -> str:
        """Identity of the stored tokens: with equal keys, equal frames have equal tokens."""

    @abstractmethod
    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return the stored tokens (n, P, D') of some rows of an observation, without trained weights."""

    def observed(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return a training batch with simulated errors of the sensors."""
        return batch

    @abstractmethod
    def present(self, batch: Mapping[str, Tensor]) -> PrefixParts:
        """Return the parts of a batch of present observations."""

    @abstractmethod
    def prefix(self, observed: Tensor) -> Tensor:
        """Return the prefix tokens (B, n, d_vlm) of one part (B, ...)."""

    def pool(self) -> nn.Module:
        """Return a new module that maps stored frames (N, P', D') to the memory's input tokens (N, P, D)."""
        return nn.Identity()


VISION_SEED = 20_250_705  # of an image tower without given weights


def seed_parameters(module: nn.Module, seed: int) -> None:
    """Draw a module's weights from a fixed seed, equal on every machine: matrices ~ N(0, 1/fan_in), biases 0, norms 1.

    An image tower without given weights gets these, so that cached features match policies built later.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in sorted(module.named_parameters()):
            if parameter.is_meta:
                continue
            if parameter.ndim == 1:
                parameter.fill_(0.0 if name.endswith("bias") else 1.0)
            else:
                parameter.copy_(torch.randn(parameter.shape, generator=generator) / parameter[0].numel() ** 0.5)


def fingerprint(modules: dict[str, nn.Module]) -> str:
    """Return a short hash of names, shapes and values of the modules' parameters."""
    digest = hashlib.blake2b(digest_size=12)
    for prefix, module in sorted(modules.items()):
        for name, parameter in sorted(module.named_parameters()):
            digest.update(f"{prefix}.{name}{tuple(parameter.shape)}".encode())
            digest.update(parameter.detach().to("cpu", torch.float32).contiguous().numpy().tobytes())
    return digest.hexdigest()


# -- thumbnails -------------------------------------------------------------------------------------------------------


THUMBNAIL = 64
"""Side of a thumbnail, pixels."""
THUMBNAILS = f"grey-{THUMBNAIL}x{THUMBNAIL}"
"""Identity of thumbnails in feature caches."""
LUMA = (0.299, 0.587, 0.114)  # of ITU-R BT.601


@torch.no_grad()
def thumbnails(images: Tensor) -> Tensor:
    """Return grey copies (N, 1, THUMBNAIL^2) of images (N, 3, H, W); 0 ... 255, which bfloat16 holds exactly."""
    grey = (images.to(torch.float32) * images.new_tensor(LUMA, dtype=torch.float32)[:, None, None]).sum(dim=1)
    small = interpolate(grey.unsqueeze(1), (THUMBNAIL, THUMBNAIL), mode="area")
    return (255 * small).round().clamp(0, 255).flatten(2).to(torch.bfloat16)


# -- pi0.5's image tower ----------------------------------------------------------------------------------------------


class ImageTowerEncoder(ObservationEncoder):
    """pi0.5's frozen image tower, and the projection of its tokens to the language model's width.

    ``resolution`` is the height and width of the tower's images; ``camera`` is remembered, as tokens or ``thumbnails``;
    ``cameras`` are of the present.
    """

    tokens_per_frame = MEMORY_GRID**2
    grid = MEMORY_GRID

    def __init__(
        self,
        tower: nn.Module,
        projector: PaliGemmaMultiModalProjector,
        resolution: tuple[int, int],
        camera: str,
        cameras: Sequence[str] = (),
        thumbnails: bool = False,
    ) -> None:
        self.tower, self.projector, self.resolution = tower, projector, resolution
        self.cameras, self.memory_input, self.thumbnails = list(cameras), camera, thumbnails
        self.dim: int = projector.linear.out_features

    @cached_property
    def key(self) -> str:
        weights = fingerprint({"vision_tower": self.tower, "multi_modal_projector": self.projector})
        return f"{weights}-{self.resolution[0]}x{self.resolution[1]}-mean{self.tokens_per_frame}"

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        images = batch[self.memory_input][list(rows)]
        return thumbnails(images) if self.thumbnails else self(images)

    def present(self, batch: Mapping[str, Tensor]) -> PrefixParts:
        """Return the tower's images of all cameras; black ones, masked, for cameras that the batch lacks."""
        images = [self._resized(batch[camera]) for camera in self.cameras if camera in batch]
        if not images:
            raise MemobenchError(f"The observation has no image; {hint('image', batch)}")
        missing = len(self.cameras) - len(images)
        rows, blank = len(images[0]), torch.full_like(images[0], -1.0)
        masks = [torch.full((rows,), real) for real in [True] * len(images) + [False] * missing]
        return [*images, *[blank] * missing], masks

    def _resized(self, images: Tensor) -> Tensor:
        """Return images (N, 3, H, W) in [0, 1] as those of the tower, in [-1, 1]."""
        images = images.to(next(self.tower.parameters()).device, torch.float32)
        if tuple(images.shape[-2:]) != tuple(self.resolution):
            images = resize_with_pad_torch(images, *self.resolution)
        return images * 2.0 - 1.0

    @torch.no_grad()
    def __call__(self, images: Tensor) -> Tensor:
        """Encode images (N, 3, H, W) float in [0, 1] to (N, 16, D) bfloat16 on the tower's device."""
        images = self._resized(images)
        # With mixed precision, tokens of a rollout would differ from cached tokens.
        with torch.autocast(images.device.type, enabled=False):
            tokens = self.prefix(images)
        side, block = MEMORY_GRID, round(tokens.shape[1] ** 0.5) // MEMORY_GRID
        pooled = reduce(tokens, "n (gy by gx bx) d -> n (gy gx) d", "mean", gy=side, gx=side, by=block, bx=block)
        return pooled.to(torch.bfloat16)

    def prefix(self, observed: Tensor) -> Tensor:
        """Return all patch tokens (B, g*g, D) of images (B, 3, H, W) in [-1, 1]; the tower computes in float32."""
        return self.projector(self.tower(observed.to(torch.float32)).last_hidden_state).to(observed.dtype)


# -- visual encoder ---------------------------------------------------------------------------------------------------


ENCODED = "observation.encoded."
"""Prefix of the names of encoded images in training samples."""


def encoded_key(camera: str) -> str:
    """Return the name in a training sample of the tokens (B, 64, WIDTH) of a camera's image."""
    return ENCODED + camera.removeprefix(f"{OBS_IMAGES}.")


class PixelPool(nn.Module):
    """Project the pooled tokens of a remembered image to the policy's width, at unit size as in `ObjectPool`."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.project = nn.Linear(WIDTH, width)

    def forward(self, frames: Tensor) -> Tensor:
        tokens = self.project(frames.to(self.project.weight.dtype))
        return rms_norm(tokens, tokens.shape[-1:], eps=1e-6)


class VisualTokenEncoder(nn.Module, ObservationEncoder):
    """Encode the present images of all ``cameras`` by the frozen visual encoder, folded.

    ``camera`` is remembered, as pooled tokens or ``thumbnails``; ``width`` is that of the policy's tokens.
    """

    tokens_per_frame = POOLED**2
    grid = POOLED

    def __init__(
        self, tower: VisualEncoder, cameras: Sequence[str], camera: str, width: int, thumbnails: bool = False
    ) -> None:
        super().__init__()
        self._tower = (tower,)  # the tuple hides it from torch, because the model registers it elsewhere
        self.cameras, self.memory_input, self.dim = list(cameras), camera, width
        self.thumbnails = thumbnails
        self.project = nn.Linear(WIDTH, width)

    @property
    def tower(self) -> VisualEncoder:
        return self._tower[0]

    @cached_property
    def _weights(self) -> str:
        return f"{fingerprint({'visual_encoder': self.tower})}-{SIDE}x{SIDE}"

    @property
    def key(self) -> str:
        return f"{self._weights}-tokens{self.tokens_per_frame}"

    @property
    def present_key(self) -> str:
        """Identity of the tokens of present images."""
        return f"{self._weights}-tokens{GRID**2}"

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Return the tokens (N, 64, WIDTH) bfloat16 of images (N, 3, H, W) in [0, 1]."""
        device = self.tower.grid_position.device
        with torch.autocast(device.type, enabled=False):  # mixed precision would differ from the cache
            tokens: Tensor = self.tower(area_averaged(images.to(device)))
        return tokens.to(torch.bfloat16)

    @torch.no_grad()
    def pooled(self, tokens: Tensor) -> Tensor:
        """Return pooled tokens (N, 16, WIDTH) bfloat16 of the tokens of `encode`."""
        tower = self.tower
        with torch.autocast(tower.grid_position.device.type, enabled=False):
            return tower.pooled(tokens.to(tower.grid_position.device, torch.float32)).to(torch.bfloat16)

    def present(self, batch: Mapping[str, Tensor]) -> PrefixParts:
        """Return each camera's tokens (B, 64, WIDTH): those in the batch, or encoded from its images."""
        parts = [self._tokens(batch, camera) for camera in self.cameras]
        return parts, [torch.ones(len(part), dtype=torch.bool) for part in parts]

    def _tokens(self, batch: Mapping[str, Tensor], camera: str) -> Tensor:
        if encoded_key(camera) in batch:
            return batch[encoded_key(camera)]
        if camera not in batch:
            raise MemobenchError(f"The observation has no '{camera}', which this policy reads; {hint(camera, batch)}")
        return self.encode(batch[camera])

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        if self.thumbnails:
            return thumbnails(batch[self.memory_input][list(rows)])
        chosen = {
            key: batch[key][list(rows)] for key in (encoded_key(self.memory_input), self.memory_input) if key in batch
        }
        return self.pooled(self._tokens(chosen, self.memory_input))

    def prefix(self, observed: Tensor) -> Tensor:
        tokens: Tensor = self.project(observed.to(self.project.weight.dtype))
        return tokens * TOKEN_SCALE

    def pool(self) -> nn.Module:
        return PixelPool(self.dim)
