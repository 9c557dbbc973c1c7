"""What each memory mechanism costs, side by side: parameters, an update, a decision, bytes held, tokens read.

    python benchmarks/memory_cost.py [--memory frames bank …] [--steps 1200] [--repeats 9]

At size small, from privileged objects, all is measured, on one thread. An update is of 12 episodes x 6 samples, whose
histories are up to ``--steps`` control steps long. A decision is a chunk of 6 control steps: what is written meanwhile,
read, and planned, one minute into an episode. Mechanisms take turns; milliseconds are of the CPU. At size pi05, from
pixels, parameters, bytes and tokens are counted: weights are on the meta device, but for the memory's own, which are
not filled. Bytes are those of one row of a rollout after 1, 5 and 20 minutes. Prints two Markdown tables.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_ENV_STATE
from object_update import scene
from policies import config, observation, updates
from random_weights import materialise
from torch import Tensor
from turns import medians

from lerobot_memobench.io import in_words
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import THUMBNAIL
from lerobot_memobench.policies.memobench_mem.memory import NONE, find_mechanism, mechanism_names
from lerobot_memobench.policies.memobench_mem.memory.mechanism import CHOICES, MemoryMechanism, Query
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE, frame_row
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep
from lerobot_memobench.protocol import CONTROL_HZ, OBS_PHASE, OBS_STEP
from lerobot_memobench.sim.object_layout import SIZE
from lerobot_memobench.training.speed import keep_freed_memory

EPISODES, MOMENTS = 12, 6
MINUTE, MINUTES = 60 * CONTROL_HZ, (1, 5, 20)
SUBGOALS = {"a task": ["close it", "open it", "put it there"]}


def main() -> None:
    """Measure, count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--memory", nargs="+", default=[NONE, *mechanism_names()])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--repeats", type=int, default=9)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does
    small = {name: settings_of(name, "small") for name in asked.memory}
    learning = {name: updater(settings, asked.steps) for name, settings in small.items()}
    update = medians(learning, asked.repeats, warm_up=2)
    learning.clear()
    acting = {name: Actor(settings) for name, settings in small.items()}
    turn = medians({name: actor.turn for name, actor in acting.items()}, asked.repeats, warm_up=2)
    print(f"`size=small`, objects, measured; an update reads histories of up to {asked.steps:,} control steps.\n")
    print_table(
        ["update, ms", "decision, ms"],
        {
            name: [
                *costs(small[name], actor.policy.model),
                f"{1e3 * update[name]:.0f}",
                f"{1e3 * turn[name] / actor.decisions:.1f}",
                *actor.held(),
            ]
            for name, actor in acting.items()
        },
    )
    print("\n`size=pi05`, pixels, counted.\n")
    print_table([], {name: full_size(settings_of(name, "pi05")) for name in asked.memory})


def settings_of(name: str, size: str) -> MemobenchMemConfig:
    """Return the configuration of a policy with a memory: of objects at size small, else of pixels."""
    objects: dict[str, Any] = {"perception": "objects"}
    settings = config(size, device="cpu", memory=name, **(objects if size == "small" else {}))
    settings.subgoals = SUBGOALS if settings.privileged_memory else {}
    if settings.uses_objects:
        settings.input_features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (SIZE,))
    return settings


def costs(settings: MemobenchMemConfig, model: MemoryPI05) -> tuple[str, str]:
    """Return the stride, and how many parameters are the memory's and its fusion's."""
    names = model.memory_names()
    count = sum(parameter.numel() for name, parameter in model.named_parameters() if name in names)
    return "–" if settings.memory == NONE else str(settings.memory_stride), f"{count / 1e6:.2f}"


# -- an update --------------------------------------------------------------------------------------------------------


class Recorded:
    """Random frames of episodes of ``length`` steps, looked up as a feature cache is.

    Args:
        stride: every how many steps one is stored.
    """

    texts = SUBGOALS["a task"]

    def __init__(self, length: int, stride: int) -> None:
        self.length, self.kept, self.meta = length, -(-length // stride), SimpleNamespace(stride=stride)
        self.episodes, self.phase = np.arange(EPISODES + 1) * length, np.ones(EPISODES * length)
        self.stored = stored_objects(EPISODES * self.kept)

    def locate(self, index: int) -> tuple[int, int]:
        """Return episode and frame of a global index."""
        return divmod(index, self.length)

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Return stored frames of an episode."""
        return self.stored[torch.tensor(slots) + episode * self.kept]

    def text_rows(self, level: str) -> np.ndarray:
        """Return which text each frame has."""
        return np.arange(len(self.phase)) * len(self.texts) // self.length % len(self.texts)


def stored_objects(count: int) -> Tensor:
    """Return frames (count, 1, D') of some things, as they are stored."""
    return frame_row(scene(count), torch.randn(count, 8), torch.ones(count))


def updater(settings: MemobenchMemConfig, steps: int) -> Callable[[], None]:
    """Return a function that makes one update on samples from the last two thirds of episodes."""
    torch.manual_seed(0)
    rows = EPISODES * MOMENTS
    moments = torch.randint(steps // 3, steps, (EPISODES, MOMENTS)) + torch.arange(EPISODES)[:, None] * steps
    cache: Any = Recorded(steps, settings.memory_stride or 1)
    looked_up = GatherMemoryProcessorStep(config=settings).gather(cache, moments.flatten().tolist())
    actions = {ACTION: torch.rand(rows, settings.chunk_size, 7)}
    policy = MemobenchMemPolicy(settings)
    return updates(policy, observed(settings, rows) | actions | looked_up)


def observed(settings: MemobenchMemConfig, rows: int) -> dict[str, Tensor]:
    """Return what the preprocessor makes of observations."""
    objects = {OBS_ENV_STATE: scene(rows), OBS_RAW_STATE: torch.randn(rows, 8)}
    return (
        {key: value for key, value in observation(settings, rows).items() if "images" not in key}
        | objects
        | choices(settings, rows)
    )


def choices(settings: MemobenchMemConfig, rows: int) -> dict[str, Tensor]:
    """Return that every subgoal is a task's, for a memory that chooses among them."""
    return {CHOICES: torch.ones(rows, len(settings.subgoal_texts), dtype=torch.bool)} if settings.subgoals else {}


# -- a rollout --------------------------------------------------------------------------------------------------------


class Actor:
    """A policy one minute into an episode."""

    def __init__(self, settings: MemobenchMemConfig) -> None:
        torch.manual_seed(0)
        self.policy, self.step = MemobenchMemPolicy(settings).eval(), 0
        self.batch = observed(settings, 1) | {OBS_PHASE: torch.ones(1, 1)}
        self.steps = math.lcm(settings.n_action_steps, settings.memory_stride or 1)
        self.decisions = self.steps // settings.n_action_steps
        while self.step < MINUTE or self.step % self.steps:
            self._tick()
            self.policy.observe(self.batch)

    def _tick(self) -> None:
        self.batch[OBS_STEP] = torch.full((1, 1), float(self.step))
        self.step += 1

    def turn(self) -> None:
        """Act until a frame is written and a chunk is planned at the same step again."""
        for _ in range(self.steps):
            self._tick()
            self.policy.select_action(self.batch)

    @torch.no_grad()
    def held(self) -> tuple[str, str]:
        """Return the bytes that are held and the tokens that are read on the way through twenty minutes."""
        memory, stride = self.policy.model.memory, self.policy.config.memory_stride
        if memory is None or stride is None:
            return "0", "0"
        frames, state, query = stored_objects(64).split(1), memory.init(1), present(self.policy.config, memory)
        sizes, tokens = [], []
        for step in range(0, MINUTES[-1] * MINUTE + 1, stride):
            state = memory.observe(state, frames[step % 64], torch.tensor([step]), query._replace(tokens=None))
            if any(step <= minutes * MINUTE < step + stride for minutes in MINUTES):
                sizes.append(in_words(bytes_of(state)))
                tokens.append(str(int(memory.read(state, query).mask.sum())))
        return told(sizes), told(tokens)


def present(settings: MemobenchMemConfig, memory: MemoryMechanism) -> Query:
    """Return a present for a memory to write and read by."""
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
    """Count what a row costs; its memory writes one frame, of random weights.

    A state of tensors has its size from the beginning on; a list grows by a frame up to the mechanism's capacity.
    """
    with torch.device("meta"):
        model = MemoryPI05(settings)
    if model.memory is None or settings.memory_stride is None:
        return [*costs(settings, model), "0", "0"]
    memory = model.memory
    materialise(memory, torch.device("cpu"), seed=0)
    tokens = THUMBNAIL**2 if find_mechanism(settings.memory or "").asks_motion else None
    shape = (1, memory.spec.tokens, memory.spec.dim) if tokens is None else (1, 1, tokens)
    query = present(settings, memory)
    frame = torch.zeros(shape, dtype=torch.bfloat16)
    state = memory.observe(memory.init(1), frame, torch.tensor([0]), query._replace(tokens=None))
    counts = [min(minutes * MINUTE // settings.memory_stride + 1, memory.capacity) for minutes in MINUTES]
    sizes = [bytes_of(state) * (1 if isinstance(state, Mapping) else count) for count in counts]
    read = str(memory.read(state, query).mask.shape[1])
    return [*costs(settings, model), told([in_words(size) for size in sizes]), read]


# -- words ------------------------------------------------------------------------------------------------------------


def told(values: list[str]) -> str:
    """Return a value that stays, or all of them."""
    return values[0] if len(set(values)) == 1 else ", ".join(values)


def print_table(measured: list[str], rows: Mapping[str, list[str]]) -> None:
    """Print a Markdown table of a row per memory."""
    head = ["`policy.memory`", "stride", "parameters, million", *measured, "bytes held", "tokens read"]
    for line in (head, ["---"] * len(head), *([f"`{name}`", *cells] for name, cells in rows.items())):
        print(f"| {' | '.join(line)} |")


if __name__ == "__main__":
    main()
