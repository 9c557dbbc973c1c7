"""Make README's animation: one scene with two prompts, equal pictures after both, and two right answers.

    python scripts/memory_film.py            # docs/figures/memory.webp; two minutes on one core

The expert acts in two variants of a strict task at one seed. Both episodes rest after their prompts; their pictures are
equal at the first step of the execution.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.constants import CONTROL_HZ, EXECUTION, VALIDATION_SEED
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.io import draft_of
from lerobot_memobench.sim.simulation import RenderSettings
from lerobot_memobench.tasks.catalogue import get_task

TASK, SEED = "find_the_artichoke_hidden_in_one_of_the_drawers", VALIDATION_SEED + 2
VARIANTS = (0, 1)
STRIDE, SPEED = 6, 3.0
"""Control steps per frame, and playback speed relative to real time."""
EQUAL_SECONDS, LAST_SECONDS = 2.5, 2.0
"""Duration of the frame with equal pictures, and of the last frame."""
SIDE, MARGIN = 408, 6
"""Size of a scene and margin between scenes, pixels; two scenes are as wide as a README on GitHub."""
HEADER, FOOTER = 44, 44
"""Heights of the text rows, pixels."""
FONT, SMALL = 22, 19
"""Sizes of the captions and of the instruction, which fills the width."""
BACKGROUND, INK = (24, 26, 30), (240, 240, 240)
PROMPT, EQUAL, SOLVED = (204, 121, 167), (230, 159, 0), (0, 158, 115)
QUALITY = 76
"""WebP quality; keeps the file below 2 MB without artefacts around text."""

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """Picture of one episode at a step, and its caption."""

    picture: Picture
    prompt: bool
    caption: str = ""


def frames_of(variant: int) -> tuple[list[Frame], list[Frame]]:
    """Return the frames of the prompt without the rest after it, and of the execution without holds."""
    episode = Episode(get_task(TASK), referent="random", render=RenderSettings(2 * SIDE, 2 * SIDE, "high"))
    episode.reset(SEED, variant)
    prompt, execution = [frame_of(episode)], list[Frame]()
    while not episode.done:
        rests = episode.idling
        episode.step(episode.expert_action())
        if episode.rested:
            continue
        if episode.phase == EXECUTION:
            if not execution or episode.exec_steps % STRIDE == 0 or episode.done:
                execution.append(frame_of(episode))
        elif not rests and episode.step_index % STRIDE == 0:
            prompt.append(frame_of(episode))
    if not episode.success:
        raise SystemExit(f"the expert did not solve variant {variant} at seed {SEED}; choose another seed")
    return prompt, execution


def frame_of(episode: Episode) -> Frame:
    """Render the current step."""
    picture = Image.fromarray(episode.sim.render()).resize((SIDE, SIDE), Image.Resampling.BOX)
    caption = "solved" if episode.success else ""
    return Frame(np.asarray(picture), episode.phase != EXECUTION, caption)


def composed(columns: Sequence[Frame], headline: str, colour: tuple[int, int, int]) -> Image.Image:
    """Return a frame of the animation: instruction, headline, and the scenes with their captions."""
    width = len(columns) * (SIDE + MARGIN) - MARGIN
    made = Image.new("RGB", (width, HEADER + SIDE + FOOTER), BACKGROUND)
    draw, font = ImageDraw.Draw(made), ImageFont.load_default(size=FONT)
    small = ImageFont.load_default(size=SMALL)
    draw.text((8, HEADER // 2), f"“{get_task(TASK).language}”", fill=INK, font=small, anchor="lm")
    for column, frame in enumerate(columns):
        x = column * (SIDE + MARGIN)
        made.paste(Image.fromarray(frame.picture), (x, HEADER))
        if frame.prompt:
            draw.rectangle((x, HEADER, x + SIDE - 1, HEADER + SIDE - 1), outline=PROMPT, width=4)
        draw.text((x + SIDE - 10, HEADER + SIDE + FOOTER // 2), frame.caption, fill=SOLVED, font=font, anchor="rm")
    draw.text((8, HEADER + SIDE + FOOTER // 2), headline, fill=colour, font=font, anchor="lm")
    return made


def animation() -> Iterator[tuple[Image.Image, float]]:
    """Yield the frames of the animation and their durations in seconds; a finished episode repeats its last frame."""
    prompts, executions = zip(*map(frames_of, VARIANTS), strict=True)
    step = STRIDE / CONTROL_HZ / SPEED
    for columns in _together(prompts):
        yield composed(columns, "1. Two prompts in one scene", PROMPT), step
    first = [frames[0] for frames in executions]
    if not all(np.array_equal(first[0].picture, frame.picture) for frame in first):
        raise SystemExit(f"the pictures of seed {SEED} differ after the prompts; choose another seed")
    yield composed(first, "2. Equal pictures: which drawer?", EQUAL), EQUAL_SECONDS
    *pictures, last = [composed(columns, "3. Two right answers", INK) for columns in _together(executions)]
    yield from ((picture, step) for picture in pictures)
    yield last, LAST_SECONDS


def _together(columns: Sequence[Sequence[Frame]]) -> Iterator[list[Frame]]:
    for place in range(max(map(len, columns))):
        yield [frames[min(place, len(frames) - 1)] for frames in columns]


def main() -> None:
    """Make the animation and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/figures/memory.webp"))
    out = parser.parse_args().out
    pictures, seconds = zip(*animation(), strict=True)
    options = {"append_images": pictures[1:], "loop": 0, "quality": QUALITY, "method": 6}
    out.parent.mkdir(parents=True, exist_ok=True)
    with draft_of(out) as draft:
        pictures[0].save(draft, "WEBP", save_all=True, duration=[round(1000 * one) for one in seconds], **options)
    print(f"{out}: seed {SEED}, {len(pictures)} frames, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
