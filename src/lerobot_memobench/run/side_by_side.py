"""Films of the same episode under several policies, as one film: side by side, each with its name and how it ended."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.envs.video import Film
from lerobot_memobench.run.contact_sheet import Frame, evenly, read_video

TITLE = 28
"""Height of the name over a film, pixels."""
SOLVED, FAILED, TEXT, BACKGROUND = (0, 158, 115), (213, 94, 0), (240, 240, 240), (24, 26, 30)
STRIP_FRAMES = 6
STRIP_WIDTH = 200
"""Width of a frame in a strip, pixels."""


def side_by_side(films: Mapping[str, tuple[Path, bool]], out: Path) -> Path:
    """Write one film of several; a shorter one waits at its last frame. Return its path.

    Args:
        films: name -> file and whether the episode was solved. All are of the same height.
    """
    movie = Film(out)
    try:
        for frame in joined(films):
            movie.add(frame)
        movie.finish()
    finally:
        movie.discard()
    return out


def joined(films: Mapping[str, tuple[Path, bool]]) -> Iterator[Frame]:
    """Yield the frames of the whole, (TITLE + height, sum of widths, 3) uint8."""
    told = {name: (read_video(path), solved) for name, (path, solved) in films.items()}
    for step in range(max(len(frames) for frames, _ in told.values())):
        parts = []
        for name, (frames, solved) in told.items():
            over = step >= len(frames) - 1
            frame = frames[min(step, len(frames) - 1)]
            parts.append(np.concatenate([title(name, frame.shape[1], solved if over else None), frame]))
        yield np.concatenate(parts, axis=1)


def title(name: str, width: int, solved: bool | None) -> NDArray[np.uint8]:
    """Return the line over a film, (TITLE, width, 3): a name, and how it ended once it has (None before)."""
    band = Image.new("RGB", (width, TITLE), BACKGROUND)
    draw = ImageDraw.Draw(band)
    draw.text((8, TITLE // 2), name, fill=TEXT, font=ImageFont.load_default(size=16), anchor="lm")
    if solved is not None:
        words, colour = ("solved", SOLVED) if solved else ("failed", FAILED)
        draw.text((width - 8, TITLE // 2), words, fill=colour, font=ImageFont.load_default(size=16), anchor="rm")
    return np.asarray(band)


def strip(films: Mapping[str, tuple[Path, bool]]) -> Image.Image:
    """Return a picture with a row per film: frames at even distances of its own length, the last one included."""
    rows = []
    for name, (path, solved) in films.items():
        frames = [_small(frame) for frame in evenly(read_video(path), STRIP_FRAMES)]
        row = np.concatenate(frames, axis=1)
        rows.append(np.concatenate([title(name, row.shape[1], solved), row]))
    return Image.fromarray(np.concatenate(rows))


def _small(frame: Frame) -> Frame:
    height = round(frame.shape[0] * STRIP_WIDTH / frame.shape[1])
    return np.asarray(Image.fromarray(frame).resize((STRIP_WIDTH, height), Image.Resampling.LANCZOS))
