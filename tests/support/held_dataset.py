"""A small dataset of the simulator with held frames, for tests of training."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lerobot_memobench.datasets.write import write_dataset
from tests.support.short_demonstrations import drawn_steps, with_images

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
LENGTHS, PROMPTS, HOLDS = (24, 20), (4, 0), (((4, 9), (14, 17), (22, 24)), ((0, 1), (5, 12)))
STRETCHES = ((9, 14), (17, 22), (25, 29), (36, 44))
"""Frames between the holds, by their global indices: first, and the one after the last."""
HELD = np.zeros(sum(LENGTHS), bool)
for _episode, _holds in enumerate(HOLDS):
    for _start, _end in _holds:
        HELD[sum(LENGTHS[:_episode]) + np.arange(_start, _end)] = True


def make_held_dataset(root: Path, images: bool = False) -> Path:
    """Write two episodes of drawn actions, the first one with a prompt, that are held at `HOLDS`."""
    made = (
        drawn_steps(TASK, seed, length, prompt, holds=holds)
        for seed, (length, prompt, holds) in enumerate(zip(LENGTHS, PROMPTS, HOLDS, strict=True))
    )
    return write_dataset((with_images(demo, 32) if images else demo for demo in made), root)
