"""Make README's animation: the expert and two policies in the same scene, side by side.

    python scripts/memory_film.py            # docs/figures/memory.webp; minutes on one core

Evaluates all three on the first evaluation seeds, with a demonstration prompt whose referent depends on the seed, and
selects the first seed with different outcomes. Its actions are replayed in a scene rendered at quality high.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.observations import OBJECTS
from lerobot_memobench.envs.video import OPERATION_COLOURS
from lerobot_memobench.evaluation.tables import OPERATION_NAMES
from lerobot_memobench.io import draft_of
from lerobot_memobench.protocol import CONTROL_HZ, EXECUTION
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.tasks.catalogue import DEMO_TASK, get_task

TASK = DEMO_TASK
POLICIES = {
    "expert": (),
    "with memory": ("policy=memobench_small",),
    "without memory": ("policy=memobench_small_memoryless",),
}
"""Column title -> arguments of `lerobot eval` that select the policy."""
EPISODES, HORIZON = 6, 400
"""Evaluated seeds, and steps per episode."""
STRIDE, SPEED = 4, 2.0
"""Control steps per frame, and playback speed relative to real time."""
LAST_SECONDS = 2.0
"""Duration of the last frame."""
SIDE, MARGIN = 272, 6
"""Size of a scene and margin between scenes, pixels; three scenes are as wide as a README on GitHub."""
HEADER, TITLE, FOOTER = 48, 40, 42
"""Heights of the text rows, pixels."""
LARGE, MEDIUM = 25, 21
"""Font sizes; readable at half the width, on a phone."""
BACKGROUND, INK, FAINT = (24, 26, 30), (240, 240, 240), (165, 170, 180)
DEMONSTRATION, SOLVED, FAILED = (204, 121, 167), (0, 158, 115), (213, 94, 0)
QUALITY = 78
"""WebP quality; keeps the file below 2 MB without artefacts around text."""

Rollout = tuple[dict[str, Any], list[NDArray[np.float32]]]
"""Log record and actions of an episode."""


@dataclass(frozen=True)
class Frame:
    """Image and state of one episode at a step; ``reached`` has a value per memory checkpoint."""

    image: NDArray[np.uint8]
    phase: int
    clock: int
    reached: tuple[bool, ...]
    drifted: bool
    solved: bool


@contextmanager
def recorded_actions() -> Iterator[dict[int, list[NDArray[np.float32]]]]:
    """Record the executed actions of all episodes in this process, by seed."""
    actions: dict[int, list[NDArray[np.float32]]] = defaultdict(list)
    step = Episode.step

    def recording_step(episode: Episode, action: ArrayLike) -> None:
        executing = episode.phase == EXECUTION
        step(episode, action)
        if executing:
            actions[episode.seed].append(episode.applied_action)

    with mock.patch.object(Episode, "step", recording_step):
        yield actions


def evaluate(name: str, folder: Path) -> dict[int, Rollout]:
    """Evaluate one of `POLICIES` in this process; return log record and actions by seed."""
    from lerobot_memobench.run.plan import plan_line
    from lerobot_memobench.run.run import run_evaluation

    words = ["env=memobench", *POLICIES[name], f"tasks={TASK}", "referent=random", f"horizon={HORIZON}"]
    words += [f"obs_type={OBJECTS}", f"episodes={EPISODES}", "videos=0", f"output_dir={folder}"]
    plan = plan_line([*words, "batch_size=1", "eval.use_async_envs=false"])
    with recorded_actions() as actions:
        run_evaluation(plan, print, print)
    return {record["seed"]: (record, actions[record["seed"]]) for record in read_episodes(folder)}


def first_difference(rollouts: dict[str, dict[int, Rollout]]) -> int:
    """Return the first seed with different outcomes.

    Raises:
        SystemExit: the outcomes are equal on all seeds.
    """
    seeds = sorted(next(iter(rollouts.values())))
    for seed in seeds:
        if len({episodes[seed][0]["success"] for episodes in rollouts.values()}) > 1:
            return seed
    raise SystemExit(f"all outcomes are equal on seeds {seeds[0]} to {seeds[-1]}; increase EPISODES")


def replay(seed: int, record: dict[str, Any], actions: Sequence[NDArray[np.float32]]) -> list[Frame]:
    """Replay an evaluated episode until success, reference drift or its end.

    Raises:
        SystemExit: scene or outcome differ from the evaluation's.
    """
    render = RenderSettings(2 * SIDE, 2 * SIDE, "high")
    episode = Episode(get_task(TASK), referent="random", horizon=HORIZON, render=render)
    episode.reset(seed)
    frames, remaining = [frame_of(episode)], iter(actions)
    while not (episode.done or frames[-1].solved or frames[-1].drifted):
        start = episode.exec_start
        episode.step(next(remaining) if start is not None else np.zeros(7, np.float32))
        if episode.step_index % STRIDE == 0 or episode.done or start != episode.exec_start:
            frames.append(frame_of(episode))
    if episode.scene_hash != record["scene_hash"] or (episode.done and episode.success != record["success"]):
        raise SystemExit(f"the replay of seed {seed} differs from its evaluation")
    return frames


def frame_of(episode: Episode) -> Frame:
    """Render the current step."""
    reached = tuple(k < episode.progress.index for k in range(len(episode.task.checkpoints)))
    image = Image.fromarray(episode.sim.render()).resize((SIDE, SIDE), Image.Resampling.BOX)
    return Frame(np.asarray(image), episode.phase, episode.clock, reached, episode.drifted, episode.success)


def animation(columns: dict[str, list[Frame]]) -> Iterator[Image.Image]:
    """Yield the frames of the animation; a finished column repeats its last frame."""
    for k in range(max(map(len, columns.values()))):
        yield compose({name: frames[min(k, len(frames) - 1)] for name, frames in columns.items()})


def compose(columns: dict[str, Frame]) -> Image.Image:
    """Return a frame of the animation: instruction and time, then title, scene and checkpoints of each column."""
    task = get_task(TASK)
    picture = Image.new("RGB", (len(columns) * (SIDE + MARGIN) - MARGIN, HEADER + TITLE + SIDE + FOOTER), BACKGROUND)
    draw = ImageDraw.Draw(picture)
    large, medium = (ImageFont.load_default(size=size) for size in (LARGE, MEDIUM))
    phase = max(frame.phase for frame in columns.values())
    clock = max(frame.clock for frame in columns.values() if frame.phase == phase)
    label, colour = ("execution", FAINT) if phase == EXECUTION else ("demonstration", DEMONSTRATION)
    draw.text((8, HEADER // 2), f"“{task.language}”", fill=INK, font=medium, anchor="lm")
    draw.text((picture.width - 8, HEADER // 2), f"{label}  {clock / CONTROL_HZ:4.1f} s", colour, medium, "rm")
    for column, (name, frame) in enumerate(columns.items()):
        x, top = column * (SIDE + MARGIN), HEADER + TITLE
        ink = INK
        if frame.phase != EXECUTION:
            draw.rectangle((x, HEADER, x + SIDE - 1, top - 1), fill=DEMONSTRATION)
            ink = BACKGROUND
        draw.text((x + SIDE // 2, HEADER + TITLE // 2), name, fill=ink, font=large, anchor="mm")
        picture.paste(Image.fromarray(frame.image), (x, top))
        draw_checkpoints(draw, (x + 8, top + SIDE + 7), frame.reached)
        end, colour = ("solved", SOLVED) if frame.solved else ("wrong bowl", FAILED) if frame.drifted else ("", INK)
        draw.text((x + SIDE - 8, top + SIDE + FOOTER // 2), end, fill=colour, font=large, anchor="rm")
    return picture


def draw_checkpoints(draw: ImageDraw.ImageDraw, corner: tuple[int, int], reached: tuple[bool, ...]) -> None:
    """Draw a box with the operation of each memory checkpoint, ticked if it is reached."""
    x, y = corner
    for checkpoint, done in zip(get_task(TASK).checkpoints, reached, strict=True):
        colour = OPERATION_COLOURS[checkpoint.operation]
        draw.rounded_rectangle((x, y, x + 28, y + 28), 5, fill=colour if done else None, outline=colour, width=3)
        if done:
            draw.line([(x + 7, y + 14), (x + 13, y + 21), (x + 22, y + 8)], fill=BACKGROUND, width=4)
        else:
            draw.text((x + 14, y + 14), checkpoint.operation, colour, ImageFont.load_default(size=18), "mm")
        name = OPERATION_NAMES[checkpoint.operation].lower()
        draw.text((x + 36, y + 14), name, colour, ImageFont.load_default(size=19), "lm")
        x += 120


def write(pictures: Sequence[Image.Image], path: Path) -> None:
    """Write an animated WebP that repeats forever."""
    milliseconds = [round(1000 * STRIDE / CONTROL_HZ / SPEED)] * (len(pictures) - 1) + [round(1000 * LAST_SECONDS)]
    options = {"append_images": pictures[1:], "duration": milliseconds, "loop": 0, "quality": QUALITY, "method": 6}
    path.parent.mkdir(parents=True, exist_ok=True)
    with draft_of(path) as draft:
        pictures[0].save(draft, "WEBP", save_all=True, **options)


def main() -> None:
    """Evaluate, select a seed, replay and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/figures/memory.webp"))
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as work:
        rollouts = {name: evaluate(name, Path(work) / name.replace(" ", "_")) for name in POLICIES}
    for name, episodes in rollouts.items():
        print(name, {seed: (record["success"], record["failure"]) for seed, (record, _) in episodes.items()})
    seed = first_difference(rollouts)
    pictures = list(animation({name: replay(seed, *episodes[seed]) for name, episodes in rollouts.items()}))
    write(pictures, out)
    print(f"{out}: seed {seed}, {len(pictures)} frames, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
