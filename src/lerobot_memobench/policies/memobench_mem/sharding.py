"""Training in shards (FSDP): each process keeps a part of every weight, of its AdamW state and of its average.

LeRobot 0.6.1 shards through accelerate, by torch's ``FullyShardedDataParallel``: launch a training with ``accelerate
launch --use_fsdp``. The policy then says by itself how it is sharded. Units, which are whole on a GPU only while they
are computed with, are the transformers' MLPs, two thirds of what learns. A layer is no unit: pi0.5 calls its parts
and never the layer. What is frozen stays whole in each process.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import GATHER_SHARDS, PREPARE, hooked_for
from lerobot_memobench.policies.memobench_mem.average import WeightAverage

UNIT = "GemmaMLP"
"""Name of the class of modules that are sharded each by itself."""


def shard_plugin() -> Any | None:
    """Return accelerate's settings of FSDP; None where this process does not train in shards."""
    from accelerate.state import AcceleratorState, is_initialized
    from accelerate.utils import DistributedType

    if not is_initialized() or AcceleratorState().distributed_type is not DistributedType.FSDP:
        return None
    return AcceleratorState().fsdp_plugin


def prepare_shards(policy: Any) -> None:
    """Say how a policy is sharded, and shard its average with it, where this process trains in shards.

    Args:
        policy: a `MemobenchMemPolicy` that is about to be trained.

    Raises:
        MemobenchError: FSDP was asked for in a way that does not go together with this policy.
    """
    plugin = shard_plugin()
    if plugin is None:
        return
    _check(plugin, policy)
    from torch.distributed.fsdp import MixedPrecision
    from torch.distributed.fsdp.wrap import transformer_auto_wrap_policy

    policy.precision.settle()
    plugin.use_orig_params = True
    plugin.auto_wrap_policy, plugin.transformer_cls_names_to_wrap = transformer_auto_wrap_policy, [UNIT]
    plugin.ignored_modules = [
        module
        for module in policy.modules()
        if any(True for _ in module.parameters()) and not any(one.requires_grad for one in module.parameters())
    ]
    if policy.config.dtype == "bfloat16":
        # As in one process: weights are rounded for each pass, and what they are given and summed up is not.
        # accelerate's own would round actions, gradients and the frequencies of positions too.
        plugin.mixed_precision_policy = MixedPrecision(
            param_dtype=torch.bfloat16, reduce_dtype=torch.float32, cast_root_forward_inputs=False
        )
    found = weakref.ref(policy)  # a hook lives as long as the policy, and must not keep it alive
    hooked_for(policy, PREPARE, functools.partial(_preparing, found))
    hooked_for(policy, GATHER_SHARDS, functools.partial(_gathering, found))


def _check(plugin: Any, policy: Any) -> None:
    if plugin.fsdp_version != 1:
        raise MemobenchError(
            "this LeRobot gathers a checkpoint's shards by FSDP 1, and --fsdp_version=2 was asked for; leave it out"
        )
    if policy.config.push_to_hub:
        raise MemobenchError(
            "policy.push_to_hub=true would send the weights at the end of training and not their average, where "
            "training is in shards; use policy.push_to_hub=false, and upload the last checkpoint afterwards"
        )


def check_adapters() -> None:
    """Refuse adapters where this process trains in shards.

    Raises:
        MemobenchError: it does.
    """
    if shard_plugin() is not None:
        raise MemobenchError(
            "adapters (peft) were asked for beside FSDP, and what adapters train has room on each GPU; leave "
            "--use_fsdp out"
        )


class ShardedAverage(WeightAverage):
    """Average of this process's shards of the weights; each update moves it without a word to other processes.

    Attributes:
        gathered: trained weights, whole, from their gathering until they are saved; in the first process alone.
    """

    whole = False

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        super().__init__(parameters, decay)
        self.gathered: dict[str, Tensor] = {}

    @contextmanager
    def applied(self, dtypes: Mapping[nn.Parameter, torch.dtype] | None = None) -> Iterator[None]:
        """Let the shards hold the average inside the block; by copies, for FSDP keeps the storage of its parameters."""
        trained = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}
        self._fill(self.average)
        try:
            yield
        finally:
            self._fill(trained)

    @torch.no_grad()
    def _fill(self, values: Mapping[str, Tensor]) -> None:
        for name, parameter in self.parameters.items():
            parameter.copy_(values[name])

    def take_over(self, begun: WeightAverage, sharded: nn.Module) -> None:
        """Go on with a whole average, that of a checkpoint; every process comes by.

        Args:
            sharded: FSDP's module around the policy.
        """
        from torch.distributed.fsdp import FullyShardedDataParallel

        self.counts = dict(begun.counts)
        trained = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}
        with FullyShardedDataParallel.summon_full_params(sharded, writeback=True):
            self._fill(begun.average)
        self.average = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}
        self._fill(trained)

    def state(self) -> tuple[dict[str, Tensor], dict[str, str]]:
        """Return what `WeightAverage.state` does, of the weights that were gathered; they are let go."""
        tensors = {f"weights.{name}": self.gathered[name].contiguous() for name in self.parameters}
        self.gathered = {}
        return tensors, self._metadata()


def _preparing(found: weakref.ref[Any], theirs: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap accelerate's ``prepare``: when it has sharded the policy, its average is sharded in the same way."""

    @functools.wraps(theirs)
    def run(accelerator: Any, *given: Any, **named: Any) -> Any:
        prepared = theirs(accelerator, *given, **named)
        policy = found()
        for before, after in zip(given, prepared if isinstance(prepared, tuple) else (prepared,), strict=True):
            if policy is not None and before is policy and policy.averages:
                begun = policy.average
                policy.average = average = ShardedAverage(policy.trained_parameters(), policy.config.ema_decay)
                if begun is not None:
                    average.take_over(begun, after)
        return prepared

    return run


def _gathering(found: weakref.ref[Any], theirs: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap LeRobot's gathering of a checkpoint's weights: those of the model are the average, as in one process."""

    @functools.wraps(theirs)
    def run(model: Any, optimizer: Any) -> Any:
        weights, state = theirs(model, optimizer)
        policy = found()
        average = None if policy is None else policy.average
        if isinstance(average, ShardedAverage):
            average.gathered = {name: weights[name] for name in average.parameters if name in weights}
            with average.applied():
                weights = _whole_weights(model)
        return weights, state

    return run


def _whole_weights(model: nn.Module) -> dict[str, Tensor]:
    """Return the whole weights of a sharded model in main memory, in the first process; none in the others."""
    from torch.distributed.fsdp import FullStateDictConfig, FullyShardedDataParallel, StateDictType

    wanted = FullStateDictConfig(offload_to_cpu=True, rank0_only=True)
    with FullyShardedDataParallel.state_dict_type(model, StateDictType.FULL_STATE_DICT, wanted):
        return dict(model.state_dict())
