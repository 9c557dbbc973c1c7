"""Hold every constant of the benchmark, once: time, seeds, pictures, vectors (paper, section 5.1)."""

from __future__ import annotations

# -- time

CONTROL_HZ = 20
"""Control steps, and therefore frames, per second."""
HORIZON = 1200
"""Control steps of an execution before an episode is cut off."""
PROTOCOLS = BY_PAPER, UPSTREAM = ("paper", "upstream")
"""Whose evaluation it is: the paper's text, or the script that its authors published (`envs.settings`)."""
UPSTREAM_HORIZON = 990
"""Control steps of an execution there: LIBERO's simulator ends after 1,000, of which 10 are the stabilisation's."""
UPSTREAM_EVALUATIONS = 2
"""Evaluations of the goal per control step there: for the reward, and for the end of the episode."""
PROMPT_HORIZON = 1500
"""Control steps after which a demonstration prompt ends, whatever it still had to show. Hiding two things takes some
750; with one of them grasped at the fifth try more than 1000."""
IDLE_STEPS = 1800
"""Control steps that the robot idles at most before the execution of a strict task: the seed draws how many, uniformly
from 0 on. So a policy that counts its calls cannot conclude from the count what has been done."""
PROMPT, EXECUTION = 0, 1
"""Values of ``phase``: a demonstration prompt plays or the robot idles, and actions have no effect; the policy acts."""
OBS_PHASE, OBS_STEP = CLOCK = ("observation.phase", "observation.step")
"""A policy's names for an episode's phase and for the control steps since it began. A dataset has columns of these
names: both are float32, (B,) in a batch, and raw, in training as in a rollout."""
NO_CLOCK, ENDED = -1, -2
"""Values of ``step`` in the execution of a strict task: it runs, it has ended. A policy that could read a clock would
need no memory: it would begin each event at a time that names it."""

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
"""What the seeds of scenes are for. The paper's were looked at between trainings: for what is developed here, they are
validation too. The sealed ones are looked at once per release (`memobench test-sealed`)."""
GUARDED = (SEALED, PAPER, VALIDATION)
"""Splits of which no demonstration is made: policies are chosen or measured on them."""
EVALUATION_SEED, EVALUATION_EPISODES = SPLITS[PAPER].start, len(SPLITS[PAPER])
"""Episode i of an evaluation has the scene of seed 7 + i, unless another split is asked for; 50 episodes of a task."""
EVIDENCE_EPISODES = 36
"""Episodes of each task where each scene is run with each variant: whole scenes, for 2, 3, 6, 9 or 12 variants."""
DEMONSTRATION_SEED, VALIDATION_SEED = SPLITS["demonstrations"].start, SPLITS[VALIDATION].start
"""Demonstration i of a task has the scene of seed 10,000 + i; settings are chosen on seeds from 20,000 on."""
UNSEEDED = (1_000_000_000, 2_000_000_000)
"""Between these lie the seeds of episodes for which nobody named one, far above all others."""

# -- pictures

CAMERAS = {"image": "agentview", "wrist_image": "wrist"}
"""Name in observations and datasets (``observation.images.<name>``) → camera of the simulator."""
IMAGE_SIZE = 256
"""Height and width of a picture, pixels."""

# -- vectors

ACTION_DIM = 7
"""End-effector displacement (6; ±5 cm, ±0.5 rad per unit), gripper (−1 opens, 1 closes)."""
PROPRIO_DIM = 8
"""End-effector position (3, m), axis-angle (3, rad), fingers (2, m)."""

# -- software

PUBLISHED_MUJOCO = "3.9.0"
"""MuJoCo of the published figures. Under others scenes start and move slightly otherwise."""
