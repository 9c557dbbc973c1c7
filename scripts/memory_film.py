"""Make the README's moving picture: the expert and two policies in one scene, in step.

    python scripts/memory_film.py            # docs/figures/memory.webp; some minutes on one core

Each is evaluated on the first evaluation seeds, with a demonstration prompt whose referent the seed draws. Shown is the
first seed at which they do not end alike. Its actions are then played again in a scene that is drawn at quality high.
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

POLICIES = {
    "expert": (),
    "with memory": ("policy=memobench_small",),
    "without memory": ("policy=memobench_small_memoryless",),
}
"""Name in the picture -> arguments of `lerobot eval` that choose who acts."""
EPISODES, HORIZON = 6, 400
"""Evaluation seeds that are tried; steps of an episode."""
STRIDE, SPEED = 4, 2.0
"""Control steps from picture to picture, and how much faster than real they are shown."""
SIDE, GAP = 272, 6
"""Of a scene, pixels: three of them are as wide as GitHub shows a README."""
HEADER, TITLE, FOOTER = 48, 40, 42
"""Heights of the texts, pixels."""
LAST = 2.0
"""Seconds that the last picture stays."""
LARGE, MEDIUM = 25, 21
"""Sizes of letters: still read where a phone shows the film at half its width."""
BACKGROUND, INK, FAINT = (24, 26, 30), (240, 240, 240), (165, 170, 180)
DEMONSTRATION, SOLVED, FAILED = (204, 121, 167), (0, 158, 115), (213, 94, 0)
QUALITY = 78
"""Of WebP: what is written in colour keeps its edges, and the file stays below 2 MB."""

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Shot:
    """One picture of an episode, and what had happened by then."""

    picture: Frame
    phase: int
    clock: int
    done: tuple[bool, ...]
    drifted: bool
    solved: bool

    @property
    def ended(self) -> bool:
        """Whether there is nothing more to wait for: it is solved, or the wrong thing was done."""
        return self.solved or self.drifted


@contextmanager
def recorded_actions() -> Iterator[dict[int, list[NDArray[np.float32]]]]:
    """Collect the actions of every execution in this process meanwhile, by seed."""
    taken: dict[int, list[NDArray[np.float32]]] = defaultdict(list)
    step = Episode.step

    def recording(episode: Episode, action: ArrayLike) -> None:
        executing = episode.phase == EXECUTION
        step(episode, action)
        if executing:
            taken[episode.seed].append(episode.applied_action)

    with mock.patch.object(Episode, "step", recording):
        yield taken


Rollout = tuple[dict[str, Any], list[NDArray[np.float32]]]
"""Line of the log and actions of an episode."""


def evaluate(name: str, folder: Path) -> dict[int, Rollout]:
    """Evaluate one of `POLICIES` in this process; return line of the log and actions by seed."""
    from lerobot_memobench.run.plan import plan_line
    from lerobot_memobench.run.run import run_evaluation

    words = ["env=memobench", *POLICIES[name], f"tasks={DEMO_TASK}", "referent=random", f"horizon={HORIZON}"]
    words += [f"obs_type={OBJECTS}", f"episodes={EPISODES}", "videos=0", f"output_dir={folder}"]
    plan = plan_line([*words, "batch_size=1", "eval.use_async_envs=false"])
    with recorded_actions() as taken:
        run_evaluation(plan, print, print)
    return {record["seed"]: (record, taken[record["seed"]]) for record in read_episodes(folder)}


def first_difference(found: dict[str, dict[int, Rollout]]) -> int:
    """Return the first seed at which the rollouts do not end alike."""
    seeds = sorted(next(iter(found.values())))
    for seed in seeds:
        if len({episodes[seed][0]["success"] for episodes in found.values()}) > 1:
            return seed
    raise SystemExit(f"all end alike on seeds {seeds[0]} to {seeds[-1]}; look through more (EPISODES)")


def play(seed: int, record: dict[str, Any], actions: Sequence[NDArray[np.float32]]) -> list[Shot]:
    """Go through a recorded episode again and draw it; it must end as the evaluation's did."""
    episode = Episode(
        get_task(DEMO_TASK), referent="random", horizon=HORIZON, render=RenderSettings(2 * SIDE, 2 * SIDE, "high")
    )
    episode.reset(seed)
    shots = [shot(episode)]
    left = iter(actions)
    while not (episode.done or shots[-1].ended):
        began = episode.exec_start
        episode.step(next(left) if began is not None else np.zeros(7, np.float32))
        if episode.step_index % STRIDE == 0 or episode.done or began != episode.exec_start:
            shots.append(shot(episode))
    if episode.scene_hash != record["scene_hash"] or (episode.done and episode.success != record["success"]):
        raise SystemExit(f"seed {seed} does not end as in its evaluation")
    return shots


def shot(episode: Episode) -> Shot:
    """Draw the present step."""
    done = tuple(k < episode.progress.index for k in range(len(episode.task.checkpoints)))
    picture = Image.fromarray(episode.sim.render()).resize((SIDE, SIDE), Image.Resampling.BOX)
    return Shot(np.asarray(picture), episode.phase, episode.clock, done, episode.drifted, episode.success)


def frames(takes: dict[str, list[Shot]]) -> Iterator[Image.Image]:
    """Yield the film: all takes in step, each waiting at its last picture for the others."""
    for k in range(max(len(shots) for shots in takes.values())):
        now = {name: shots[min(k, len(shots) - 1)] for name, shots in takes.items()}
        yield compose(now)


def compose(now: dict[str, Shot]) -> Image.Image:
    """Return a picture of the film: instruction and phase, and each take between its name and its checkpoints."""
    task = get_task(DEMO_TASK)
    film = Image.new("RGB", (len(now) * (SIDE + GAP) - GAP, HEADER + TITLE + SIDE + FOOTER), BACKGROUND)
    draw = ImageDraw.Draw(film)
    large, medium = (ImageFont.load_default(size=size) for size in (LARGE, MEDIUM))
    phase = max(one.phase for one in now.values())
    clock = max(one.clock for one in now.values() if one.phase == phase)
    words, colour = ("demonstration", DEMONSTRATION) if phase != EXECUTION else ("execution", FAINT)
    draw.text((8, HEADER // 2), f"“{task.language}”", fill=INK, font=medium, anchor="lm")
    draw.text((film.width - 8, HEADER // 2), f"{words}  {clock / CONTROL_HZ:4.1f} s", colour, medium, "rm")
    for column, (name, one) in enumerate(now.items()):
        x, top = column * (SIDE + GAP), HEADER + TITLE
        shown = one.phase != EXECUTION
        if shown:
            draw.rectangle((x, HEADER, x + SIDE - 1, top - 1), fill=DEMONSTRATION)
        ink = BACKGROUND if shown else INK
        draw.text((x + SIDE // 2, HEADER + TITLE // 2), name, fill=ink, font=large, anchor="mm")
        film.paste(Image.fromarray(one.picture), (x, top))
        checkpoints(draw, (x + 8, top + SIDE + 7), one)
        end, colour = ("solved", SOLVED) if one.solved else ("wrong bowl", FAILED) if one.drifted else ("", INK)
        draw.text((x + SIDE - 8, top + SIDE + FOOTER // 2), end, fill=colour, font=large, anchor="rm")
    return film


def checkpoints(draw: ImageDraw.ImageDraw, corner: tuple[int, int], one: Shot) -> None:
    """Draw a box per memory checkpoint, with the letter and name of its operation; a tick once it is reached."""
    x, y = corner
    for checkpoint, done in zip(get_task(DEMO_TASK).checkpoints, one.done, strict=True):
        colour = OPERATION_COLOURS[checkpoint.operation]
        draw.rounded_rectangle((x, y, x + 28, y + 28), 5, fill=colour if done else None, outline=colour, width=3)
        if done:
            draw.line([(x + 7, y + 14), (x + 13, y + 21), (x + 22, y + 8)], fill=BACKGROUND, width=4)
        else:
            draw.text((x + 14, y + 14), checkpoint.operation, colour, ImageFont.load_default(size=18), "mm")
        name = OPERATION_NAMES[checkpoint.operation].lower()
        draw.text((x + 36, y + 14), name, colour, ImageFont.load_default(size=19), "lm")
        x += 120


def write(film: Sequence[Image.Image], path: Path) -> None:
    """Write an animated WebP that begins anew at its end."""
    duration = round(1000 * STRIDE / CONTROL_HZ / SPEED)
    times = [duration] * (len(film) - 1) + [round(1000 * LAST)]
    path.parent.mkdir(parents=True, exist_ok=True)
    with draft_of(path) as draft:
        film[0].save(
            draft, "WEBP", save_all=True, append_images=film[1:], duration=times, loop=0, quality=QUALITY, method=6
        )


def main() -> None:
    """Evaluate, choose, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/figures/memory.webp"))
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as work:
        found = {name: evaluate(name, Path(work) / name.replace(" ", "_")) for name in POLICIES}
    for name, episodes in found.items():
        print(name, {seed: (record["success"], record["failure"]) for seed, (record, _) in episodes.items()})
    seed = first_difference(found)
    takes = {name: play(seed, *episodes[seed]) for name, episodes in found.items()}
    film = list(frames(takes))
    write(film, out)
    print(f"{out}: seed {seed}, {len(film)} pictures, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
