"""Tests that no state of a LeRobot policy leaks between rows, episodes or instances; without a simulator.

    POLICY_FACTORY=package.module:function python -m pytest examples/leak_test.py

The function returns the policy, or the policy and a function that returns the observation of one row, drawn from a
generator (by default random numbers in the shapes of ``config.input_features``). Without ``POLICY_FACTORY`` the tests
run on small instances of LeRobot's act and diffusion. The file imports nothing of this project: copy it into your own
tests, and add your factory to `FACTORIES`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

LENGTH = 24
"""Control steps of an episode; several action chunks of a policy with few actions per chunk."""
SHARE, LEAST = 1e-3, 1e-6
"""Actions are equal if they differ by less than this share of the effect of an observation, or by this number."""

Frame = Mapping[str, Any]
Observe = Callable[[torch.Generator], Frame]
Factory = Callable[[], Any]


class EqualNoise(TorchFunctionMode):
    """Make random tensors equal at every call, and along every axis but the last: rows then draw the same noise."""

    DRAWS = (torch.randn, torch.randn_like, torch.normal, torch.rand, torch.rand_like, Tensor.normal_, Tensor.uniform_)

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call a function of torch, and replace the values that it drew."""
        found = function(*args, **(kwargs or {}))
        if function in self.DRAWS:
            width = found.shape[-1] if found.dim() else 1
            found.copy_(torch.rand(width, generator=torch.Generator().manual_seed(width)).to(found))
        return found


def check(passed: bool, problem: str) -> None:
    """Raise an AssertionError for a problem, under ``python -O`` too."""
    if not passed:
        raise AssertionError(problem)


class Subject:
    """A policy and episodes of random observations.

    Attributes:
        episodes: three sequences of `LENGTH` observations. alone: actions (`LENGTH`, A) of the first.
        effect: largest change of an action if all observations are those of another episode.
    """

    def __init__(self, make: Factory) -> None:
        torch.manual_seed(0)
        made = make()
        self.policy, observe = made if isinstance(made, tuple) else (made, drawn_from(made.config.input_features))
        self.policy.eval()
        generators = [torch.Generator().manual_seed(seed) for seed in range(3)]
        self.episodes = [[observe(generator) for _ in range(LENGTH)] for generator in generators]
        self.alone = self.roll([self.episodes[0]])[:, 0]
        self.effect = float((self.roll([self.episodes[1]])[:, 0] - self.alone).abs().max())
        check(self.effect > 0, "the actions do not depend on the observations; draw weights that are not zero")

    def roll(self, episodes: Sequence[Sequence[Frame]], policy: Any = None, between: Any = None) -> Tensor:
        """Reset the policy and return its actions (steps, rows, A) on episodes of equal length, one row each.

        Args:
            policy: by default the subject's. between: called after each step.
        """
        policy = policy or self.policy
        policy.reset()
        return torch.stack([self._acted(policy, frames, between) for frames in zip(*episodes, strict=True)])

    @staticmethod
    def _acted(policy: Any, frames: Sequence[Frame], between: Any = None) -> Tensor:
        batch = {
            key: torch.stack([frame[key] for frame in frames])
            if isinstance(value, Tensor)
            else [frame[key] for frame in frames]
            for key, value in frames[0].items()
        }
        with EqualNoise(), torch.inference_mode():
            action = policy.select_action(batch).to("cpu", torch.float32).clone()
        if between is not None:
            between()
        return action

    def changed(self, other: Tensor, one: Tensor | None = None) -> int | None:
        """Return the first step at which actions (steps, A) differ, by default from `alone`; None: at none."""
        differs = ((other - (self.alone if one is None else one)).abs() > max(SHARE * self.effect, LEAST)).any(dim=-1)
        return int(differs.nonzero()[0]) if differs.any() else None

    def showing(self, step: int) -> Tensor:
        """Return the actions of the first episode if one observation is replaced by that of the second."""
        frames = [*self.episodes[0]]
        frames[step] = self.episodes[1][step]
        return self.roll([frames])[:, 0]


def drawn_from(features: Mapping[str, Any]) -> Observe:
    """Return a function that draws an observation in the shapes of the input features, values in [0, 1]."""
    return lambda generator: {
        name: torch.rand(tuple(feature.shape), generator=generator) for name, feature in features.items()
    }


# --- LeRobot's policies, small ---


def make_act() -> Any:
    """Return a small ACT without images."""
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    small = {"dim_model": 16, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
    return ACTPolicy(ACTConfig(**_features(), **small, chunk_size=6, n_action_steps=4, latent_dim=4, device="cpu"))


def make_diffusion() -> Any:
    """Return a small Diffusion Policy without images, which reads two observations."""
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    small = {"down_dims": (8, 16), "n_groups": 4, "diffusion_step_embed_dim": 8, "num_train_timesteps": 4}
    return DiffusionPolicy(DiffusionConfig(**_features(), **small, horizon=8, n_action_steps=4, device="cpu"))


def _features() -> dict[str, Any]:
    from lerobot.configs import FeatureType, PolicyFeature

    state, other = PolicyFeature(FeatureType.STATE, (8,)), PolicyFeature(FeatureType.ENV, (6,))
    inputs = {"observation.state": state, "observation.environment_state": other}
    return {"input_features": inputs, "output_features": {"action": PolicyFeature(FeatureType.ACTION, (7,))}}


def factories() -> dict[str, Factory]:
    """Return the factory that ``POLICY_FACTORY`` names, else those of this file."""
    named = os.environ.get("POLICY_FACTORY")
    if named is None:
        return FACTORIES
    module, _, function = named.partition(":")
    return {named: getattr(import_module(module), function)}


FACTORIES: dict[str, Factory] = {"act": make_act, "diffusion": make_diffusion}

# --- the tests ---


@pytest.fixture(scope="module", params=factories())
def make(request: pytest.FixtureRequest) -> Factory:
    """Return the factory of a policy."""
    return factories()[request.param]


@pytest.fixture(scope="module")
def subject(make: Factory) -> Subject:
    """Return a policy with its episodes."""
    return Subject(make)


def test_reset_clears_the_state(subject: Subject) -> None:
    """Check that an episode is the same after any other, whose last chunk was not finished."""
    one, two, three = subject.episodes
    for before in ([two[:3]], [two[:10]], [three, two, one]):
        subject.roll(before)
        step = subject.changed(subject.roll([one])[:, 0])
        check(step is None, f"step {step} differs after another episode: clear histories and action queues in reset()")


def test_rows_are_independent(subject: Subject) -> None:
    """Check that a row acts alike alone and with other rows, in any place of the batch."""
    one, two, three = subject.episodes
    for place, batch in ((0, [one, two]), (1, [two, one, three]), (2, [three, two, one])):
        step = subject.changed(subject.roll(batch)[:, place])
        check(step is None, f"step {step} differs with other rows in the batch: keep a history for each row")


def test_history_holds_the_frames_under_action_chunks(subject: Subject) -> None:
    """Check that a policy that remembers frames also remembers those at which it did not plan."""
    change = [(subject.showing(step) - subject.alone).abs().amax(dim=-1) for step in range(LENGTH)]
    threshold = max(SHARE * subject.effect, LEAST)
    plans = [step for step in range(LENGTH) if change[step][step] > threshold]
    following = {step: next((plan for plan in plans if plan > step), None) for step in range(LENGTH)}
    kept = {step for step, plan in following.items() if plan is not None and change[step][plan:].max() > threshold}
    between = [step for step, plan in following.items() if plan is not None and step not in plans]
    if not kept or not between:
        pytest.skip("it remembers no frame, or plans at every step")
    check(
        bool(kept & {*between}), "only frames at which it plans are remembered: observe also while actions are queued"
    )


def test_instances_share_no_state(make: Factory, subject: Subject) -> None:
    """Check that a second instance, such as that of a parallel task, does not change the first."""
    torch.manual_seed(0)
    made = make()
    other = made[0] if isinstance(made, tuple) else made
    other.eval()
    other.reset()
    frames = iter(subject.episodes[1])
    found = subject.roll([subject.episodes[0]], between=lambda: subject._acted(other, [next(frames)]))[:, 0]
    step = subject.changed(found)
    check(step is None, f"step {step} differs while another instance acts: keep no state in the class or module")
