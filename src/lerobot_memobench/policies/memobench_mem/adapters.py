"""What `lerobot-train --peft…` trains of the policy: adapters in pi0.5, and whole what pi0.5 does not have."""

from __future__ import annotations

from collections.abc import Iterable

from torch import nn

_OWN = (
    *("model.memory", "model.memory_to_expert", "modulator", "alignment"),
    *("model.state_token", "model.instruction", "paligemma_with_expert.perception"),
)
"""Ends of the names of modules that a checkpoint of pi0.5 knows nothing of; they are small beside it."""


def trained_whole(policy: nn.Module, asked: Iterable[str] = ()) -> list[str]:
    """Return peft's ``modules_to_save``: those ``asked`` for, and memory and heads as far as the policy has them."""
    names = [name for name, _ in policy.named_modules()]
    own = [end for end in _OWN if any(name == end or name.endswith(f".{end}") for name in names)]
    return [*asked, *(end for end in own if end not in set(asked))]
