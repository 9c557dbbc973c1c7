"""What evaluation videos show: both cameras, the task, the checkpoint being worked on, a tick for each one done."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.protocol import PROMPT

BAND = 64
"""Height of the text over the pictures, pixels."""
CLOCK = 96
"""Width that is left to the clock, pixels."""
CLOCK_BOTTOM = 24
"""Height from the upper edge to under the clock, pixels."""
MARGIN = 8
"""Left free on both sides, pixels."""
_BACKGROUND, _TEXT, _FAINT = (24, 26, 30), (240, 240, 240), (150, 155, 165)
OPERATION_COLOURS = {"S": (86, 180, 233), "U": (230, 159, 0), "C": (0, 158, 115)}
"""Storage, Update, Compression: Okabe and Ito's palette, apart for the colour-blind too."""
_PROMPT_COLOUR = (204, 121, 167)

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


@lru_cache(maxsize=4)
def _font(size: int) -> Font:
    return ImageFont.load_default(size=size)


def _fit(draw: ImageDraw.ImageDraw, text: str, size: int, width: int) -> tuple[str, Font]:
    """Shrink a text until it fits, then cut it."""
    for points in range(size, 8, -1):
        if draw.textlength(text, font=_font(points)) <= width:
            return text, _font(points)
    while text and draw.textlength(text + "…", font=_font(9)) > width:
        text = text[:-1]
    return text + "…", _font(9)


def annotate(images: dict[str, NDArray[np.uint8]], episode: Episode) -> NDArray[np.uint8]:
    """Return a frame (BAND + height, 2 · width, 3) uint8 of the present step.

    What does not change is not drawn again: the band until a checkpoint is done, the clock's word and digits never.
    """
    pictures = list(images.values())
    height, width = pictures[0].shape[0], sum(picture.shape[1] for picture in pictures)
    frame = np.empty((BAND + height, width, 3), np.uint8)
    prompt = episode.phase == PROMPT
    operations = tuple(checkpoint.operation for checkpoint in episode.task.checkpoints)
    done = 0 if prompt else episode.progress.index
    frame[:BAND] = _band(width, episode.task.language, operations, done, _now(episode), prompt)
    clock = _clock("prompt", episode.step_index, prompt) if prompt else _clock("step", episode.exec_steps, prompt)
    frame[:CLOCK_BOTTOM, width - MARGIN - clock.shape[1] : width - MARGIN] = clock
    np.concatenate(pictures, axis=1, out=frame[BAND:])
    return frame


@lru_cache(maxsize=64)
def _band(
    width: int, language: str, operations: tuple[str, ...], done: int, now: str, prompt: bool
) -> NDArray[np.uint8]:
    """All of the text but the clock, (BAND, width, 3)."""
    band = Image.new("RGB", (width, BAND), _BACKGROUND)
    draw = ImageDraw.Draw(band)
    text, font = _fit(draw, language, 14, width - CLOCK)
    draw.text((MARGIN, 5), text, fill=_TEXT, font=font)
    x = MARGIN
    for index, operation in enumerate(operations):
        _draw_checkpoint(draw, x, operation, done=index < done)
        x += 26
    text, font = _fit(draw, now, 14, width - x - 14)
    draw.text((x + 6, 44), text, fill=_PROMPT_COLOUR if prompt else _TEXT, font=font, anchor="lm")
    return np.asarray(band)


def _clock(word: str, number: int, prompt: bool) -> NDArray[np.uint8]:
    """The upper right corner, (height, width, 3): only as wide as the clock is, so that it covers nothing."""
    return np.concatenate([_piece(piece, prompt) for piece in (f"{word} ", *str(number))], axis=1)


@lru_cache(maxsize=64)
def _piece(text: str, prompt: bool) -> NDArray[np.uint8]:
    """The clock's word or a digit, (height, width, 3)."""
    piece = Image.new("RGB", (round(_font(13).getlength(text)), CLOCK_BOTTOM), _BACKGROUND)
    ImageDraw.Draw(piece).text((0, 5), text, fill=_PROMPT_COLOUR if prompt else _FAINT, font=_font(13))
    return np.asarray(piece)


def _draw_checkpoint(draw: ImageDraw.ImageDraw, x: int, operation: str, *, done: bool) -> None:
    """A box at ``x`` pixels: ticked, or with the letter of what memory has to do."""
    colour = OPERATION_COLOURS[operation]
    box = (x, 34, x + 20, 54)
    draw.rounded_rectangle(box, 4, fill=colour if done else None, outline=colour, width=2)
    if done:
        draw.line([(x + 5, 44), (x + 9, 49), (x + 16, 39)], fill=_BACKGROUND, width=3)
    else:
        draw.text((x + 10, 44), operation, fill=colour, font=_font(12), anchor="mm")


def _now(episode: Episode) -> str:
    """What is going on, in words."""
    if episode.phase == PROMPT:
        return "watch the prompt"
    return "done" if episode.success else episode.subgoal()
