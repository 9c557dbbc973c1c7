"""A small LeRobotDataset with this project's columns, for tests of caches, policies and studies."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lerobot_memobench.constants import CLOCK, EXECUTION, PROMPT

SIZE = 48  # pixels of the synthetic cameras
CAMERAS = ("observation.images.image", "observation.images.wrist_image")
LENGTHS = (40, 23, 31)
PROMPTS = (0, 8, 0)
SUBGOALS = (
    ("pick up the cream cheese", "put it in the basket"),
    ("open the top drawer", "put the bowl in the drawer", "close the top drawer"),
    ("pick up the cream cheese", "pick up the butter", "put both in the basket"),
)
TASKS = ("put the cream cheese in the basket", "put the bowl away", "fetch cream cheese and butter")


def clock_at(t: int, prompt: int) -> dict[str, np.ndarray]:
    """Return phase and step of frame t, by the columns' names."""
    values = (PROMPT, t) if t < prompt else (EXECUTION, t - prompt)
    return {name: np.array([value], np.float32) for name, value in zip(CLOCK, values, strict=True)}


def make_dataset(
    root: Path,
    seed: int = 0,
    repeats: int = 1,
    cameras: tuple[str, str] = CAMERAS,
    lengths: tuple[int, int, int] = LENGTHS,
) -> Path:
    """Write a LeRobotDataset with this project's columns: three short episodes of moving coloured squares.

    With ``repeats`` each of the three tasks has that many episodes, one task after the other.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    image = {"dtype": "video", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    string = {"dtype": "string", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create(
        "memobench/synthetic",
        fps=20,
        root=root,
        use_videos=True,
        features={
            **dict.fromkeys(cameras, image),
            "observation.state": {"dtype": "float32", "shape": (8,), "names": None},
            "action": {"dtype": "float32", "shape": (7,), "names": None},
            **{name: {"dtype": "float32", "shape": (1,), "names": None} for name in CLOCK},
            "subgoal.intermediate": string,
            "subgoal.fine": string,
            "subgoal.coarse": string,
            "oracle_memory": string,
        },
    )
    rng = np.random.default_rng(seed)
    kinds = list(zip(lengths, PROMPTS, SUBGOALS, TASKS, strict=True))
    for length, prompt, subgoals, task in [kind for kind in kinds for _ in range(repeats)]:
        colour = rng.integers(60, 255, 3)
        drift = rng.normal(size=7)
        for t in range(length):
            frame = np.full((SIZE, SIZE, 3), 30, np.uint8)
            corner = 2 + (t * (SIZE - 16)) // length
            frame[corner : corner + 12, corner : corner + 12] = colour
            k = min(t * len(subgoals) // length, len(subgoals) - 1)
            dataset.add_frame(
                {
                    **dict(zip(cameras, (frame, frame[::-1].copy()), strict=True)),
                    "observation.state": (np.sin(t / 5 + np.arange(8)) + 0.05 * rng.normal(size=8)).astype(np.float32),
                    "action": np.tanh(drift + np.sin(t / 5 + np.arange(7))).astype(np.float32),
                    **clock_at(t, prompt),
                    # Some frames carry no text: the cache then looks at the next that does.
                    "subgoal.intermediate": "" if t % 7 == 3 else subgoals[k],
                    "subgoal.fine": subgoals[k] + " at (0.1, 0.2)",
                    "subgoal.coarse": subgoals[k].split()[0] + " it",
                    "oracle_memory": "; ".join(subgoals[:k]),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root
