"""Constants of the benchmark: time, seeds, images, vectors (paper, section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence

# -- time

CONTROL_HZ = 20
"""Control steps, and therefore frames, per second."""
HORIZON = 1200
"""Maximum number of control steps of an execution."""
RULES = BY_PAPER, UPSTREAM = ("paper", "upstream")
"""Values of the setting ``rules``: the evaluation of the paper's text, or of the authors' published script."""
UPSTREAM_HORIZON = 990
"""Maximum number of control steps of an execution in the script: LIBERO's limit of 1,000 minus 10 of stabilisation."""
UPSTREAM_EVALUATIONS = 2
"""Evaluations of the goal per control step in the script: one for the reward, one for the end of the episode."""
PROMPT_HORIZON = 1500
"""Maximum number of control steps of a demonstration prompt. Hiding two objects takes some 750, and more than 1000 if
one of them is grasped at the fifth attempt."""
HOLD_SHAPE, HOLD_MEAN, LONGEST_HOLD = 0.5, 600, 6000
"""Holds of strict tasks: at the start of the execution and at home after each event, actions have no effect for a
number of control steps that the seed draws. Holds after an event have a gamma distribution with this shape and mean,
cut at the longest hold. The first hold of a task without a prompt is uniform up to the longest one, because these tasks
ask for events that a clock could time; of a task with a prompt it has the gamma distribution too.
`research.necessity.clock` computes what a policy that knows the elapsed time alone can reach."""
MOST_HOLDS = 30
"""Number of drawn holds per episode; later ones have the shortest length. No task needs more than 10."""
PROMPT, EXECUTION = 0, 1
"""Values of ``phase``. In `PROMPT` the prompt plays, and actions have no effect."""
OBS_PHASE, OBS_STEP = CLOCK = ("observation.phase", "observation.step")
"""A policy's names of the phase and of the control steps since it began; also columns of a dataset. Both are float32,
(B,) in a batch, and not normalised."""
NO_CLOCK, ENDED = -1, -2
"""Values of ``step`` in the execution of a strict task: running, ended. With a clock a policy would need no memory: it
could start each event at a fixed time."""

# -- seeds

PAPER, VALIDATION, SEALED = "paper", "validation", "sealed"
SPLITS = {
    PAPER: range(7, 57),
    "demonstrations": range(10_000, 20_000),
    VALIDATION: range(20_000, 30_000),
    "detector": range(30_000, 40_000),
    "detector test": range(40_000, 60_000),
    SEALED: range(100_007, 100_057),
}
"""Seeds of scenes, by purpose. The paper's seeds were used between trainings, so for policies developed here they are
validation seeds too. The sealed ones are used once per release (`memobench test-sealed`)."""


def split_of(seeds: Sequence[int]) -> str | None:
    """Return the split that holds the first and the last of some seeds, None without one."""
    return next((name for name, split in SPLITS.items() if seeds[0] in split and seeds[-1] in split), None)


GUARDED = (SEALED, PAPER, VALIDATION)
"""Splits without demonstrations, because policies are selected or evaluated on them."""
EVALUATION_SEED, EVALUATION_EPISODES = SPLITS[PAPER].start, len(SPLITS[PAPER])
"""Episode i of an evaluation has the scene of seed 7 + i by default; 50 episodes per task."""
EVIDENCE_EPISODES = 36
"""Episodes per task of an evidence evaluation: a multiple of 2, 3, 6, 9 and 12 variants."""
DEMONSTRATION_SEED, VALIDATION_SEED = SPLITS["demonstrations"].start, SPLITS[VALIDATION].start
"""Demonstration i of a task has the scene of seed 10,000 + i; settings are selected on seeds from 20,000."""
UNSEEDED = (1_000_000_000, 2_000_000_000)
"""Range of the seeds of episodes that are reset without a seed, above all other seeds."""

WORLD, LIBERO = "world", "libero"
"""Field of demonstrations that names the source of the scenes, and its value."""
SCENE_HASH_VERSION = 2
"""Raise it with each change of a scene's hash: of `Simulation.scene_hash`, of states, or of rounding in the simulation.

1: release 0.2.0.
"""

# -- images

CAMERAS = {"image": "agentview", "wrist_image": "wrist"}
"""Name in observations and datasets (``observation.images.<name>``) → camera of the simulator."""
IMAGE_SIZE = 256
"""Height and width of an image, pixels."""

# -- vectors

ACTION_DIM = 7
"""End-effector displacement (6; ±5 cm, ±0.5 rad per unit), gripper (−1 opens, 1 closes)."""
PROPRIO_DIM = 8
"""End-effector position (3, m), axis-angle (3, rad), fingers (2, m)."""

# -- software

MEMORY_POLICY = "memobench_mem"
"""Type of the policy with a memory, as LeRobot registers it."""
PUBLISHED_MUJOCO = "3.9.0"
"""MuJoCo version of the published figures. Scenes start and move slightly differently in other versions."""
