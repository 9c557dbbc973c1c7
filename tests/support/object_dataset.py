"""A small LeRobotDataset of objects seen as slots, with or without images, for tests of policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.constants import CLOCK
from lerobot_memobench.datasets.episodes import DemonstrationRecord, goals_of
from lerobot_memobench.datasets.layout import EPISODE_INFO, OBJECTS, PRIVILEGED
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from tests.support.synthetic_dataset import clock_at

LENGTHS, PROMPTS = (40, 23, 31), (6, 8, 0)
TASKS = ("put the butter into the bowl", "open the drawer", "put the butter into the bowl")
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
    """Return the record of an episode, as `memobench generate` writes it."""
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


def make_object_dataset(
    root: Path,
    seed: int = 0,
    images: bool = False,
    repeats: int = 1,
    records: bool = False,
    goals: int | None = None,
) -> Path:
    """Write episodes in which the hand moves to the one of three things that was lit in the prompt.

    With ``repeats`` each of the three kinds of episodes has that many; with ``records`` each names one of two
    tasks, whose goals have the version ``goals``; None: the present one.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    objects = PRIVILEGED if images else OBJECTS
    number: dict[str, Any] = {"dtype": "float32", "names": None}
    string = {"dtype": "string", "shape": (1,), "names": None}
    camera = {"dtype": "video", "shape": (48, 48, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        "memobench/objects",
        fps=20,
        root=root,
        use_videos=images,
        features={
            **({"observation.images.image": camera} if images else {}),
            "observation.state": number | {"shape": (8,)},
            objects: number | {"shape": (SLOTS * WIDTH,)},
            "action": number | {"shape": (7,)},
            **{name: {"dtype": "float32", "shape": (1,), "names": None} for name in CLOCK},
            **dict.fromkeys(("subgoal.intermediate", "subgoal.fine", "subgoal.coarse", "oracle_memory"), string),
            **({EPISODE_INFO: string} if records else {}),
        },
    )
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in zip(LENGTHS, PROMPTS, TASKS, NAMES, strict=True) for _ in range(repeats)]
    for number, (length, prompt, task, name) in enumerate(kinds):
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
            }
            if records:
                frame[EPISODE_INFO] = "" if t else record_of(name, 10_000 + number, prompt, goals)
            if images:
                frame["observation.images.image"] = np.full((48, 48, 3), t, np.uint8)
            dataset.add_frame(frame)
            hand = hand + 0.01 * way
        dataset.save_episode()
    dataset.finalize()
    return root


assert STARTS["highlighted"] == WIDTH - 1  # as slots_at writes them
