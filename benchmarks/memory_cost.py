"""Measure the cost of each memory mechanism: parameters, time per update and decision, stored bytes, tokens read.

    python benchmarks/memory_cost.py [--memory frames bank …] [--steps 1200] [--repeats 9]

Size small, with privileged objects, is measured on one thread, the mechanisms in turns. An update has 12 episodes x 6
samples with histories of up to ``--steps`` control steps. A decision is a chunk of 6 control steps (writes, read and
plan) one minute into an episode. Size pi05, with images, is counted without allocating pi0.5's weights. Bytes
are those of one environment after 1, 5 and 20 minutes. Prints two Markdown tables; times are CPU milliseconds.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_ENV_STATE
from object_update import random_slots
from policies import config, observation, updates
from random_weights import materialise
from torch import Tensor
from turns import medians

from lerobot_memobench.constants import CONTROL_HZ, OBS_PHASE, OBS_STEP
from lerobot_memobench.io import in_words
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import THUMBNAIL
from lerobot_memobench.policies.memobench_mem.memory import NONE, find_mechanism, mechanism_names
from lerobot_memobench.policies.memobench_mem.memory.mechanism import CHOICES, MemoryMechanism, Query
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE, frame_row
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep
from lerobot_memobench.policies.memobench_mem.texts import texts_of
from lerobot_memobench.sim.object_layout import SIZE
from lerobot_memobench.training.loop import keep_freed_memory

EPISODES, SAMPLES = 12, 6
MINUTE, MINUTES = 60 * CONTROL_HZ, (1, 5, 20)
SUBGOALS = {"a task": ["close it", "open it", "put it there"]}


def main() -> None:
    """Measure, count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--memory", nargs="+", default=[NONE, *mechanism_names()])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does
    small = {name: settings_of(name, "small") for name in args.memory}
    learning = {name: updater(settings, args.steps) for name, settings in small.items()}
    update = medians(learning, args.repeats, warm_up=2)
    learning.clear()
    acting = {name: Actor(settings) for name, settings in small.items()}
    turn = medians({name: actor.turn for name, actor in acting.items()}, args.repeats, warm_up=2)
    print(f"`size=small`, objects, measured; updates read histories of up to {args.steps:,} control steps.\n")
    print_table(
        ["update, ms", "decision, ms"],
        {
            name: [
                *costs(small[name], actor.policy.model),
                f"{1e3 * update[name]:.0f}",
                f"{1e3 * turn[name] / actor.decisions:.1f}",
                *actor.memory_size(),
            ]
            for name, actor in acting.items()
        },
    )
    print("\n`size=pi05`, pixels, counted.\n")
    print_table([], {name: full_size(settings_of(name, "pi05")) for name in args.memory})


def settings_of(name: str, size: str) -> MemobenchMemConfig:
    """Return a policy's configuration: with objects at size small, else with images."""
    objects: dict[str, Any] = {"perception": "objects"}
    settings = config(size, device="cpu", memory=name, **(objects if size == "small" else {}))
    settings.subgoals = SUBGOALS if settings.privileged_memory else {}
    if settings.uses_objects:
        settings.input_features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (SIZE,))
    return settings


def costs(settings: MemobenchMemConfig, model: MemoryPI05) -> tuple[str, str]:
    """Return the stride and the parameters of memory and fusion, million."""
    names = model.memory_names()
    count = sum(parameter.numel() for name, parameter in model.named_parameters() if name in names)
    return "–" if settings.memory == NONE else str(settings.memory_stride), f"{count / 1e6:.2f}"


# -- an update --------------------------------------------------------------------------------------------------------


class Recorded:
    """Random stored frames of episodes of ``length`` steps, with the interface of `FrameLookup`.

    Args:
        stride: steps between stored frames.
    """

    texts, encoded = SUBGOALS["a task"], {}

    def __init__(self, length: int, stride: int) -> None:
        self.length, self.stride, self.count = length, stride, -(-length // stride)
        self.episodes, self.phase = np.arange(EPISODES + 1) * length, np.ones(EPISODES * length)
        self.stored = stored_objects(EPISODES * self.count)

    def locate(self, index: int) -> tuple[int, int]:
        """Return episode and frame of a global index."""
        return divmod(index, self.length)

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Return stored frames of an episode, by slot."""
        return self.stored[torch.tensor(slots) + episode * self.count]

    def changes(self, episode: int) -> np.ndarray:
        """Return the slots whose stored frames differ from those before: all, because they are random."""
        return np.arange(self.count)

    def text_rows(self, level: str) -> np.ndarray:
        """Return the index of each frame's text."""
        return np.arange(len(self.phase)) * len(self.texts) // self.length % len(self.texts)


def stored_objects(count: int) -> Tensor:
    """Return random frames (count, 1, D') in the format of the cache."""
    return frame_row(random_slots(count), torch.randn(count, 8), torch.ones(count))


def updater(settings: MemobenchMemConfig, steps: int) -> Callable[[], None]:
    """Return a function that makes one update, on samples from the last two thirds of the episodes."""
    torch.manual_seed(0)
    rows = EPISODES * SAMPLES
    samples = torch.randint(steps // 3, steps, (EPISODES, SAMPLES)) + torch.arange(EPISODES)[:, None] * steps
    lookup: Any = Recorded(steps, settings.memory_stride or 1)
    history = GatherMemoryProcessorStep(config=settings).gather(lookup, samples.flatten().tolist())
    actions = {ACTION: torch.rand(rows, settings.chunk_size, 7)}
    policy = MemobenchMemPolicy(settings)
    return updates(policy, policy_inputs(settings, rows) | actions | history)


def policy_inputs(settings: MemobenchMemConfig, rows: int) -> dict[str, Tensor]:
    """Return preprocessed random observations of objects."""
    without_images = {key: value for key, value in observation(settings, rows).items() if "images" not in key}
    objects = {OBS_ENV_STATE: random_slots(rows), OBS_RAW_STATE: torch.randn(rows, 8)}
    return without_images | objects | choices(settings, rows)


def choices(settings: MemobenchMemConfig, rows: int) -> dict[str, Tensor]:
    """Return the mask of allowed subgoals, for a memory that selects a subgoal: all are allowed."""
    texts = len(texts_of(settings.subgoals or {}))
    return {CHOICES: torch.ones(rows, texts, dtype=torch.bool)} if texts else {}


# -- a rollout --------------------------------------------------------------------------------------------------------


class Actor:
    """A policy one minute into an episode."""

    def __init__(self, settings: MemobenchMemConfig) -> None:
        torch.manual_seed(0)
        self.policy, self.step = MemobenchMemPolicy(settings).eval(), 0
        self.batch = policy_inputs(settings, 1) | {OBS_PHASE: torch.ones(1, 1)}
        self.steps = math.lcm(settings.n_action_steps, settings.memory_stride or 1)
        self.decisions = self.steps // settings.n_action_steps
        while self.step < MINUTE or self.step % self.steps:
            self._tick()
            self.policy.observe(self.batch)

    def _tick(self) -> None:
        self.batch[OBS_STEP] = torch.full((1, 1), float(self.step))
        self.batch[OBS_RAW_STATE] = torch.randn(1, 8)  # no frame and no plan is repeated
        self.step += 1

    def turn(self) -> None:
        """Act until a step both writes a frame and plans a chunk again."""
        for _ in range(self.steps):
            self._tick()
            self.policy.select_action(self.batch)

    @torch.no_grad()
    def memory_size(self) -> tuple[str, str]:
        """Return stored bytes and tokens read after 1, 5 and 20 minutes."""
        memory, stride = self.policy.model.memory, self.policy.config.memory_stride
        if memory is None or stride is None:
            return "0", "0"
        frames, state, query = stored_objects(64).split(1), memory.init(1), random_query(self.policy.config, memory)
        sizes, tokens = [], []
        for step in range(0, MINUTES[-1] * MINUTE + 1, stride):
            state = memory.observe(state, frames[step % 64], torch.tensor([step]), query._replace(tokens=None))
            if any(step <= minutes * MINUTE < step + stride for minutes in MINUTES):
                sizes.append(in_words(bytes_of(state)))
                tokens.append(str(int(memory.read(state, query).mask.sum())))
        return joined(sizes), joined(tokens)


def random_query(settings: MemobenchMemConfig, memory: MemoryMechanism) -> Query:
    """Return a query with a random current frame."""
    spec = memory.spec
    return Query(torch.randn(1, spec.tokens, spec.dim), choices(settings, 1).get(CHOICES))


def bytes_of(state: Any) -> int:
    """Return the bytes of all tensors in a state."""
    if isinstance(state, Tensor):
        return state.nbytes
    if isinstance(state, Mapping):
        return sum(map(bytes_of, state.values()))
    if isinstance(state, list | tuple):
        return sum(map(bytes_of, state))
    return bytes_of(vars(state)) if hasattr(state, "__dict__") else 0


# -- full size --------------------------------------------------------------------------------------------------------


@torch.no_grad()
def full_size(settings: MemobenchMemConfig) -> list[str]:
    """Count the parameters, bytes and tokens of a full-size policy from one written frame.

    A state of tensors has a constant size; a list of frames grows up to the mechanism's capacity.
    """
    with torch.device("meta"):
        model = MemoryPI05(settings)
    if model.memory is None or settings.memory_stride is None:
        return [*costs(settings, model), "0", "0"]
    memory = model.memory
    materialise(memory, torch.device("cpu"), seed=0)
    tokens = THUMBNAIL**2 if find_mechanism(settings.memory or "").asks_motion else None
    shape = (1, memory.spec.tokens, memory.spec.dim) if tokens is None else (1, 1, tokens)
    query = random_query(settings, memory)
    frame = torch.zeros(shape, dtype=torch.bfloat16)
    state = memory.observe(memory.init(1), frame, torch.tensor([0]), query._replace(tokens=None))
    counts = [min(minutes * MINUTE // settings.memory_stride + 1, memory.capacity) for minutes in MINUTES]
    sizes = [bytes_of(state) * (1 if isinstance(state, Mapping) else count) for count in counts]
    read = str(memory.read(state, query).mask.shape[1])
    return [*costs(settings, model), joined([in_words(size) for size in sizes]), read]


# -- tables -----------------------------------------------------------------------------------------------------------


def joined(values: list[str]) -> str:
    """Return all values as text, or a single value if they are equal."""
    return values[0] if len(set(values)) == 1 else ", ".join(values)


def print_table(measured: list[str], rows: Mapping[str, list[str]]) -> None:
    """Print a Markdown table with a row per memory."""
    head = ["`policy.memory`", "stride", "parameters, million", *measured, "bytes held", "tokens read"]
    for line in (head, ["---"] * len(head), *([f"`{name}`", *cells] for name, cells in rows.items())):
        print(f"| {' | '.join(line)} |")


if __name__ == "__main__":
    main()
