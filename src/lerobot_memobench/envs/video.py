"""Videos of evaluations: frames annotated with task and checkpoints.

LeRobot's own videos keep all frames of ten episodes in memory and omit the last frame, in which the goal becomes true.
"""

from __future__ import annotations

from contextlib import ExitStack, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.constants import CONTROL_HZ, PROMPT
from lerobot_memobench.io import draft_of, explaining_disk_errors

if TYPE_CHECKING:
    from av import VideoFrame

    from lerobot_memobench.envs.episode import Episode

BAND, MARGIN = 64, 8  # height of the text above the images, and margin at its sides, pixels
CLOCK, CLOCK_BOTTOM = 96, 24  # width reserved for the clock, and its lower edge from the top, pixels
_BACKGROUND, _TEXT, _FAINT = (24, 26, 30), (240, 240, 240), (150, 155, 165)
OPERATION_COLOURS = {"S": (86, 180, 233), "U": (230, 159, 0), "C": (0, 158, 115)}
"""Storage, Update, Compression in Okabe and Ito's palette, which colour-blind readers can distinguish."""
_PROMPT_COLOUR = (204, 121, 167)

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


@lru_cache(maxsize=4)
def _font(size: int) -> Font:
    return ImageFont.load_default(size=size)


def _fit(draw: ImageDraw.ImageDraw, text: str, size: int, width: int) -> tuple[str, Font]:
    # Shrink the text until it fits; truncate it at the smallest size.
    for points in range(size, 8, -1):
        if draw.textlength(text, font=_font(points)) <= width:
            return text, _font(points)
    while text and draw.textlength(text + "…", font=_font(9)) > width:
        text = text[:-1]
    return text + "…", _font(9)


def annotate(images: dict[str, NDArray[np.uint8]], episode: Episode) -> NDArray[np.uint8]:
    """Return a frame (BAND + height, 2 · width, 3) uint8 of the current step.

    It shows both cameras, the instruction, the next checkpoint, and a tick for each completed one. The text is cached
    between checkpoints, the clock's word and digits for the whole process.
    """
    views = list(images.values())
    height, width = views[0].shape[0], sum(view.shape[1] for view in views)
    frame = np.empty((BAND + height, width, 3), np.uint8)
    prompt = episode.phase == PROMPT
    operations = tuple(checkpoint.operation for checkpoint in episode.task.checkpoints)
    done = 0 if prompt else episode.progress.index
    following = f"next: {episode.subgoal()}" if operations else ""
    now = "watch the prompt" if prompt else "done" if episode.success else following
    frame[:BAND] = _band(width, episode.task.language, operations, done, now, prompt)
    pieces = ("prompt ", *str(episode.step_index)) if prompt else ("step ", *str(episode.exec_steps))
    clock = np.concatenate([_piece(piece, prompt) for piece in pieces], axis=1)[:, : width - 2 * MARGIN]
    frame[:CLOCK_BOTTOM, width - MARGIN - clock.shape[1] : width - MARGIN] = clock
    np.concatenate(views, axis=1, out=frame[BAND:])
    return frame


@lru_cache(maxsize=64)
def _band(
    width: int, language: str, operations: tuple[str, ...], done: int, now: str, prompt: bool
) -> NDArray[np.uint8]:
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


@lru_cache(maxsize=64)
def _piece(text: str, prompt: bool) -> NDArray[np.uint8]:
    piece = Image.new("RGB", (round(_font(13).getlength(text)), CLOCK_BOTTOM), _BACKGROUND)
    ImageDraw.Draw(piece).text((0, 5), text, fill=_PROMPT_COLOUR if prompt else _FAINT, font=_font(13))
    return np.asarray(piece)


def _draw_checkpoint(draw: ImageDraw.ImageDraw, x: int, operation: str, *, done: bool) -> None:
    colour = OPERATION_COLOURS[operation]
    box = (x, 34, x + 20, 54)
    draw.rounded_rectangle(box, 4, fill=colour if done else None, outline=colour, width=2)
    if done:
        draw.line([(x + 5, 44), (x + 9, 49), (x + 16, 39)], fill=_BACKGROUND, width=3)
    else:
        draw.text((x + 10, 44), operation, fill=colour, font=_font(12), anchor="mm")


# --- writing ---

LAST_FRAMES = 20  # repetitions of the final frame: one second


class _DiscardedError(Exception):
    """Make `draft_of` remove the draft."""


class VideoRecorder:
    """Write frames to an MP4 file that appears under its name only when it is complete.

    `add` and `finish` raise a `MemobenchError` if the video cannot be written; call `discard` then.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writing = ExitStack()
        self._container: Any = None
        self._last: VideoFrame | None = None

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a copy of a frame (height, width, 3); height and width must be even and constant."""
        from av import VideoFrame

        if self._last is not None and frame.shape[:2] != (self._last.height, self._last.width):
            raise ValueError(f"a frame of shape {frame.shape} follows one of {self._last.height} × {self._last.width}")
        self._last = VideoFrame.from_ndarray(frame, format="rgb24")
        with explaining_disk_errors(self._path, "or set videos=0"):
            if self._container is None:
                self._open(*frame.shape[:2])
            self._encode(self._last)

    def finish(self) -> Path | None:
        """Repeat the last frame and complete the file; return its path, None without frames."""
        if self._last is None:
            return None
        with explaining_disk_errors(self._path, "or set videos=0"):
            for _ in range(LAST_FRAMES):
                self._last.pts = None  # the encoder numbers it
                self._encode(self._last)
            self._container.mux(self._stream.encode())
            container, self._container = self._container, None
            container.close()
            self._writing.close()
        return self._path

    def discard(self) -> None:
        """Delete an unfinished video."""
        with suppress(_DiscardedError), self._writing:
            if self._container is not None:
                with suppress(Exception):  # the file is removed anyway
                    self._container.close()
                self._container = None
            raise _DiscardedError

    def _open(self, height: int, width: int) -> None:
        import av

        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(self._writing.enter_context(draft_of(self._path.absolute()))), "w", format="mp4")
        # Ultrafast takes a tenth of the time of rendering; more threads are slower. crf 20 keeps small text readable.
        options = {"preset": "ultrafast", "crf": "20", "threads": "1"}
        self._stream = self._container.add_stream("libx264", rate=CONTROL_HZ, options=options)
        self._stream.height, self._stream.width, self._stream.pix_fmt = height, width, "yuv420p"

    def _encode(self, image: VideoFrame) -> None:
        self._container.mux(self._stream.encode(image))
