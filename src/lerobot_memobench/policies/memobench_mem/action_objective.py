"""How actions are learned: by flow matching, as in pi0.5, or by regression, through the same passes of the same model.

Flow matching learns the velocity ``noise - actions`` at every time between the two, and a plan follows it from drawn
noise. Regression asks at one place only, zero noise at time 1: the velocity there is minus the actions, and one Euler
step ends at them.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

FLOW_MATCHING, REGRESSION = "flow_matching", "regression"
OBJECTIVES = (FLOW_MATCHING, REGRESSION)
_SMOOTH = 1e-6
"""Square of the error below which the absolute error bends into its square: 0.001 of an action's deviation."""


def noise_and_time(objective: str, model: Any, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Return where a batch of actions (B, T, A) is learned: noise (B, T, A) and time (B,)."""
    if objective == REGRESSION:
        return torch.zeros_like(actions), actions.new_ones(actions.shape[0])
    return (
        model.sample_noise(actions.shape, actions.device),
        model.sample_time(actions.shape[0], actions.device),
    )


def losses_of(objective: str, squared: Tensor) -> Tensor:
    """Return losses (B, T, A) of squared errors of the velocity: themselves, and for regression absolute errors with
    them.

    Absolute errors make actions exact, and squared ones are what a memory is learned by: to have chosen another of
    three bowls is a large error at few moments. After 800 updates 20 of 20 bowls were right by both, 15 by squared
    ones, one by absolute ones.
    """
    return squared + (squared + _SMOOTH).sqrt() if objective == REGRESSION else squared
