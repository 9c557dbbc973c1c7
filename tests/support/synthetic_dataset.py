"""Small LeRobotDatasets with this project's columns: moving squares, and objects as slots with or without images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.constants import CLOCK, EXECUTION, PROMPT
from lerobot_memobench.datasets.episodes import DemonstrationRecord, goals_of
from lerobot_memobench.datasets.layout import EPISODE_INFO, OBJECTS, PRIVILEGED
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH

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
STRING = {"dtype": "string", "shape": (1,), "names": None}


def numbers(count: int) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (count,), "names": None}


def create(root: Path, cameras: tuple[str, ...], **features: Any) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    camera = {"dtype": "video", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    texts = ("subgoal.intermediate", "subgoal.fine", "subgoal.coarse", "oracle_memory")
    return LeRobotDataset.create(
        "memobench/synthetic",
        fps=20,
        root=root,
        use_videos=bool(cameras),
        features={
            **dict.fromkeys(cameras, camera),
            "observation.state": numbers(8),
            "action": numbers(7),
            **{name: numbers(1) for name in CLOCK},
            **dict.fromkeys(texts, STRING),
            **features,
        },
    )


def clock_at(t: int, prompt: int) -> dict[str, np.ndarray]:
    """Return phase and step of frame t, by the columns' names."""
    values = (PROMPT, t) if t < prompt else (EXECUTION, t - prompt)
    return {name: np.array([value], np.float32) for name, value in zip(CLOCK, values, strict=True)}


def make_dataset(root: Path, lengths: tuple[int, int, int] = LENGTHS) -> Path:
    """Write three short episodes of moving coloured squares."""
    dataset, rng = create(root, CAMERAS), np.random.default_rng(0)
    for length, prompt, subgoals, task in zip(lengths, PROMPTS, SUBGOALS, TASKS, strict=True):
        colour = rng.integers(60, 255, 3)
        drift = rng.normal(size=7)
        for t in range(length):
            frame = np.full((SIZE, SIZE, 3), 30, np.uint8)
            corner = 2 + (t * (SIZE - 16)) // length
            frame[corner : corner + 12, corner : corner + 12] = colour
            k = min(t * len(subgoals) // length, len(subgoals) - 1)
            dataset.add_frame(
                {
                    **dict(zip(CAMERAS, (frame, frame[::-1].copy()), strict=True)),
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


# --- another robot's ---


def drawn_frame(rng: np.random.Generator, cameras: Mapping[str, tuple[int, int]], **vectors: int) -> dict[str, Any]:
    """Return random images of cameras (name -> height and width) and vectors (name -> length)."""
    drawn = {name: rng.integers(0, 255, (*size, 3), np.uint8) for name, size in cameras.items()}
    return drawn | {name: rng.normal(size=count).astype(np.float32) for name, count in vectors.items()}


def write_robot(
    root: Path,
    cameras: Mapping[str, tuple[int, int]],
    state: int,
    action: int,
    fps: int = 30,
    episodes: int = 1,
    **texts: str,
) -> Path:
    """Write episodes of 8 frames with names of another package; images are PNG in the tables."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    image = {"dtype": "image", "names": ["height", "width", "channels"]}
    vectors = {"observation.state": state, "action": action}
    dataset = LeRobotDataset.create(
        "somebody/robot",
        fps=fps,
        root=root,
        use_videos=False,
        features={
            **{name: numbers(count) for name, count in vectors.items()},
            **{name: {**image, "shape": (*size, 3)} for name, size in cameras.items()},
            **dict.fromkeys(texts, STRING),
        },
    )
    rng = np.random.default_rng(0)
    for _ in range(episodes):
        for _ in range(8):
            dataset.add_frame(drawn_frame(rng, cameras, **vectors) | texts | {"task": "fold the towel"})
        dataset.save_episode()
    dataset.finalize()
    return root


OBJECT_PROMPTS = (6, 8, 0)
OBJECT_TASKS = ("put the butter into the bowl", "open the drawer", "put the butter into the bowl")
BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
NAMES = (BUTTER, "put_the_milk_picked_up_in_the_prompt_video_on_the_plate", BUTTER)


def slots_at(rng: np.random.Generator, places: np.ndarray, lit: int | None = None) -> np.ndarray:
    """Slots (SLOTS * WIDTH,) of things of classes 3, 4, ... at places (n, 3), the ``lit``-th one highlighted."""
    found = np.zeros((SLOTS, WIDTH), np.float32)
    for row, place in enumerate(places):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2]
        found[row] = [1, 3 + row, *place, *axes.T.ravel(), 0.1 * row, float(row == lit)]
    return found.reshape(-1)


def state_at(hand: np.ndarray) -> np.ndarray:
    """State (8,) of a hand at a place (3,), looking down."""
    return np.array([*hand, 3.1, 0.05, 0.1, 0.03, -0.03], np.float32)


def record_of(name: str, seed: int, prompt: int, goals: int | None = None) -> str:
    return DemonstrationRecord(
        task_name=name,
        memory_type="object",
        family="",
        operations="S",
        seed=seed,
        referent="random",
        variant=0,
        success=True,
        exec_start_index=prompt,
        key_frames=[-1],
        goals=goals_of(name) if goals is None else goals,
        scene_hash="",
        fixture_poses={},
        digest="",
        world="libero",
        stand_ins=[],
    ).model_dump_json(exclude_none=True)


def make_object_dataset(root: Path, images: bool = False, records: bool = False, goals: int | None = None) -> Path:
    """Write episodes in which the hand moves to the one of three things that was lit in the prompt.

    With ``records`` each names one of two tasks, whose goals have the version ``goals``; None: the present one.
    """
    objects, cameras = (PRIVILEGED, CAMERAS[:1]) if images else (OBJECTS, ())
    more = {objects: numbers(SLOTS * WIDTH)} | ({EPISODE_INFO: STRING} if records else {})
    dataset, rng = create(root, cameras, **more), np.random.default_rng(0)
    for number, (length, prompt, task, name) in enumerate(
        zip(LENGTHS, OBJECT_PROMPTS, OBJECT_TASKS, NAMES, strict=True)
    ):
        places = np.array([0.0, 0.0, 0.9]) + rng.uniform(-0.2, 0.2, (3, 3))
        hand, lit = np.array([0.0, 0.0, 1.1]), int(rng.integers(3))
        for t in range(length):
            way = np.clip((places[lit] - hand) / 0.05, -1, 1) if t >= prompt else np.zeros(3)
            frame = {
                "observation.state": state_at(hand),
                objects: slots_at(rng, places, lit if t < prompt else None),
                "action": np.array([*way, 0, 0, 0, 1 if t % 2 else -1], np.float32) * (t >= prompt),
                **clock_at(t, prompt),
                "subgoal.intermediate": f"reach thing {lit}" if t >= prompt else "",
                "subgoal.fine": f"reach thing {lit} at {places[lit][0]:.1f}",
                "subgoal.coarse": "reach",
                "oracle_memory": f"thing {lit} was lit",
                "task": task,
                **{camera: np.full((SIZE, SIZE, 3), t, np.uint8) for camera in cameras},
            }
            if records:
                frame[EPISODE_INFO] = "" if t else record_of(name, 10_000 + number, prompt, goals)
            dataset.add_frame(frame)
            hand = hand + 0.01 * way
        dataset.save_episode()
    dataset.finalize()
    return root


assert STARTS["highlighted"] == WIDTH - 1  # as slots_at writes them
