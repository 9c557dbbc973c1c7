"""Making the memory cache of a dataset with the frozen towers of a policy (``memobench cache``)."""

from __future__ import annotations

from pathlib import Path

import torch

from lerobot_memobench.datasets.memory_cache import Progress, build_memory_cache
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.text import make_text_encoder
from lerobot_memobench.policies.memobench_mem.weights import load_exactly, read_weights

_VISION_PREFIX = "paligemma_with_expert.paligemma.model."


def load_frame_encoder(config: MemobenchMemConfig, weights: str | Path | None = None):  # type: ignore[no-untyped-def]
    """The frozen image tower of ``config``'s size alone, without the rest of the model, as a ``FrameEncoder``.

    Args:
        weights: folder or repository of a pi0.5 or memobench_mem checkpoint; None takes ``config.base_weights``, or
            the fixed-seed tower when there are none.

    Raises:
        MemobenchError: the weights cannot be read or do not fit.
    """
    from lerobot_memobench.policies.memobench_mem.backbone import (
        VISION_SEED,
        FrameEncoder,
        SizedPaliGemmaWithExpert,
        seed_parameters,
    )

    with torch.device("meta"):
        model = SizedPaliGemmaWithExpert(config.dimensions, config).paligemma.model
    towers = type(model.vision_tower)(model.config.vision_config), type(model.multi_modal_projector)(model.config)
    tower, projector = (part.to(torch.float32).eval().requires_grad_(False) for part in towers)
    for part, name in ((tower, "vision_tower."), (projector, "multi_modal_projector.")):
        source = weights or config.base_weights
        if source is None:
            seed_parameters(part, VISION_SEED)
        else:
            load_exactly(part, read_weights(source, _VISION_PREFIX + name), source, optional=set())
        part.to(config.device)
    return FrameEncoder(tower, projector, config.image_size)


def cache_dataset(
    root: Path,
    config: MemobenchMemConfig,
    *,
    weights: str | Path | None = None,
    batch_size: int = 64,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Make (or finish) the cache that ``config`` reads beside the dataset at ``root``.

    Args:
        config: a policy configuration, for example ``MemobenchMemConfig(size="tiny", memory_stride=1)``.
        weights: checkpoint whose image tower is used, see :func:`load_frame_encoder`.
        workers: threads that decode videos ahead of the tower; by the cores of the machine when None.
        progress: called with (episodes done, episodes in all).

    Returns:
        The cache's folder, ``<root>/memory_cache/<size>-stride<n>``.
    """
    assert config.text_encoder is not None  # set by the configuration
    texts = make_text_encoder(config.text_encoder, config.dimensions.text_dim, str(config.device))
    return build_memory_cache(
        root,
        config.cache_name,
        load_frame_encoder(config, weights),
        texts,
        camera=config.memory_camera,
        stride=config.memory_stride,
        batch_size=batch_size,
        workers=workers,
        progress=progress,
    )
