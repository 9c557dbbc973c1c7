"""What a memory takes of a GPU in training beside its weights, found by letting a sample through it on the CPU.

A memory is built with weights at random; one sample and then two are replayed; what autograd keeps of the second is
what each sample costs. So any mechanism is counted, another package's too. The tokens that its fusion adds are counted
on the meta device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from transformers.initialization import no_init_weights

from lerobot_memobench.envs.command_line import quiet
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.visual_encoder import WIDTH
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import THUMBNAIL
from lerobot_memobench.policies.memobench_mem.memory import NONE
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories, MemoryMechanism, MemoryTokens, Query
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05, make_memory
from lerobot_memobench.policies.memobench_mem.objects import HAND_DIM
from lerobot_memobench.protocol import HORIZON
from lerobot_memobench.sim.object_layout import SIZE

MIXED = 1.5
"""Bytes at most in mixed precision, of those in float32: a tensor may be kept in both."""


class UncountedError(MemobenchError):
    """A memory whose use of a GPU cannot be found."""


@dataclass(frozen=True)
class MemoryUse:
    """What a sample of a training batch costs.

    Attributes:
        kept: bytes from the memory's pass until the gradients come. prefix, suffix: tokens that the fusion adds there.
        stored: bytes of a frame in the feature cache.
    """

    kept: int = 0
    prefix: int = 0
    suffix: int = 0
    stored: int = 0


def memory_use(config: MemobenchMemConfig) -> MemoryUse:
    """Return what a policy's memory takes of each sample.

    Raises:
        UncountedError: a sample of random numbers does not go through it.
    """
    if config.memory == NONE:
        return MemoryUse()
    with torch.device("meta"), quiet():
        model = MemoryPI05(config)
    try:
        with torch.random.fork_rng(devices=[]):
            with no_init_weights():
                memory = make_memory(config, model.paligemma_with_expert.perception).train()
            sizes, tokens = zip(*(_replayed(config, memory, samples) for samples in (1, 2)), strict=True)
        prefix, suffix = _added(config, model, tokens[0])
    except Exception as error:  # a package's memory may want what only a real batch has
        raise UncountedError(
            f"what memory={config.memory} needs cannot be counted: a sample of random numbers does not go through it "
            f"({type(error).__name__}: {error}); try an update, or name another memory"
        ) from error
    loaded = len(memory.slots(HORIZON // config.memory_stride, config.memory_frames))
    stored = 2 * math.prod(_frame(config, memory))
    kept = (sizes[1] - sizes[0]) * (MIXED if config.dtype == "bfloat16" else 1)
    return MemoryUse(round(kept) + stored * loaded, prefix, suffix, stored)


def _frame(config: MemobenchMemConfig, memory: MemoryMechanism) -> tuple[int, int]:
    """Return the shape (P', D') of a stored frame."""
    if config.uses_objects:
        return 1, SIZE + HAND_DIM + 1
    if config.remembers_thumbnails:
        return 1, THUMBNAIL**2
    return memory.spec.tokens, WIDTH if config.uses_visual_encoder else memory.spec.dim


def _replayed(config: MemobenchMemConfig, memory: MemoryMechanism, samples: int) -> tuple[int, MemoryTokens]:
    """Return the bytes that autograd keeps of so many samples, weights among them, and what these read."""
    spec = memory.spec
    latest = memory.gradient_frames + min(memory.capacity, spec.frames) - 1  # earlier ones leave nothing that is kept
    length = len(memory.slots(latest, spec.frames))
    places = torch.arange(samples * length).unflatten(0, (samples, length))
    ahead = places[:, -1:].expand(-1, memory.ahead) if memory.ahead else None
    frames = torch.zeros(samples * length, *_frame(config, memory), dtype=torch.bfloat16)
    labels = torch.zeros(len(frames), dtype=torch.int64) if memory.privileged else None
    query = Query(
        memory.pool(frames[places[:, -1]]) if memory.asks_present else None,
        torch.ones(samples, len(spec.subgoals), dtype=torch.bool) if memory.privileged else None,
        None if labels is None else labels[:samples],
    )
    steps = (torch.arange(length) * spec.stride).repeat(samples)
    held = {storage.data_ptr(): storage for storage in [frames.untyped_storage()]}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        held.setdefault(storage.data_ptr(), storage)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        read = memory.replay(Histories(frames, steps, places, labels, ahead), query)
    return sum(storage.nbytes() for storage in held.values()) - frames.nbytes, read


@torch.no_grad()
def _added(config: MemobenchMemConfig, model: MemoryPI05, read: MemoryTokens) -> tuple[int, int]:
    """Return how many tokens a fusion adds to prefix and suffix, of what one sample reads; on the meta device."""
    fusion, dims = model.to("meta").fusion, config.dimensions
    assert fusion is not None

    def there(part: Any) -> Any:
        return None if part is None else part.to("meta")

    def tokens(count: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
        real = torch.ones(1, count, dtype=torch.bool, device="meta")
        return torch.empty(1, count, width, device="meta"), real, torch.zeros_like(real)

    query = None if read.query is None else Query(*map(there, read.query))
    each = read.each.to("meta", torch.float32)
    fusion.hand_over(MemoryTokens(each, there(read.mask), there(read.places), query=query))
    prefix, *_ = fusion.prefix(tokens(1, dims.vlm.width), 0 if config.state_token else None)
    condition = torch.empty(1, dims.expert.width, device="meta")
    suffix, *_ = fusion.suffix((*tokens(1, dims.expert.width), condition))
    return prefix.shape[1] - 1, suffix.shape[1] - 1
