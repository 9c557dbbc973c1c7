"""A video per episode, encoded while it happens, in a thread beside the simulation.

LeRobot keeps every frame of its first ten episodes in memory and leaves out the last one, in which the goal comes
true. A film is written as the episode goes and shows its end.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of

if TYPE_CHECKING:
    from av import VideoFrame

LAST_FRAMES = 20
"""How often the final frame is repeated: a second to see how it ended."""
AHEAD = 2
"""Frames of a film that may wait for the encoder: as many are in memory. A third one waits to be added."""
FORMAT = "yuv420p"
"""How pixels are stored."""


class _DiscardedError(Exception):
    """The film is not wanted."""


@cache
def _encoder(process: int) -> ThreadPoolExecutor:
    """Return the one thread of this process that encodes; one that was forked has none of its parent's."""
    return ThreadPoolExecutor(1, "film")


class Film:
    """Write frames to an MP4 that appears under its name only when it is whole.

    Opening, encoding and writing happen in the order of the calls, in a thread; PyAV and x264 let others compute
    meanwhile. `add` and `finish` raise a `MemobenchError` when the film cannot be written; then `discard` it.

    Args:
        path: the file to be.
        fps: frames per second.
    """

    def __init__(self, path: Path, fps: int = 20) -> None:
        self._path, self._fps = path, fps
        self._writing = ExitStack()
        self._container: Any = None
        self._size: tuple[int, int] | None = None
        self._waiting: deque[Future[VideoFrame]] = deque()
        self._error: Exception | None = None

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame (height, width, 3); height and width must be even and stay the same. It stays the caller's."""
        from av import VideoFrame

        self._size = height, width = self._size or (frame.shape[0], frame.shape[1])
        picture = self._next() if len(self._waiting) == AHEAD else VideoFrame(width, height, "rgb24")
        plane = picture.planes[0]  # its lines may be longer than the picture is wide
        lines = np.frombuffer(plane, np.uint8).reshape(height, plane.line_size)
        lines[:, : 3 * width].reshape(height, width, 3, copy=False)[:] = frame
        self._later(self._encode, picture)

    def finish(self) -> Path | None:
        """Hold the last frame, close the file and give it its name; None when nothing was filmed."""
        if not self._waiting:
            return None
        while self._waiting:
            last = self._next()
        self._later(self._end, last)
        self._next()
        return self._path

    def discard(self) -> None:
        """Throw an unfinished film away, with what still waits to be encoded."""
        self._error = _DiscardedError()
        wait(self._waiting)
        self._waiting.clear()
        with suppress(_DiscardedError), self._writing:  # an error is what makes a draft go
            if self._container is not None:
                with suppress(Exception):  # what is thrown away may end as it likes
                    self._container.close()
                self._container = None
            raise _DiscardedError

    def _later(self, work: Callable[[VideoFrame], None], picture: VideoFrame) -> None:
        """Have the thread do something to a picture."""
        self._waiting.append(_encoder(os.getpid()).submit(self._do, work, picture))

    def _next(self) -> VideoFrame:
        """Wait until the oldest of what waits is done; return its picture, which is free again."""
        picture = self._waiting.popleft().result()
        if self._error is not None:
            reason = getattr(self._error, "strerror", None)  # what the system or FFmpeg says
            if reason is None:
                raise self._error
            raise MemobenchError(
                f"the film {self._path} cannot be written ({reason}); make room there, choose another output_dir=, or "
                "film nothing with films=0"
            ) from self._error
        return picture

    # --- in the thread ---

    def _do(self, work: Callable[[VideoFrame], None], picture: VideoFrame) -> VideoFrame:
        """Do it, unless an error came before: FFmpeg ends the process when it is handed more after one."""
        if self._error is None:
            try:
                work(picture)
            except Exception as error:
                self._error = error
        return picture

    def _encode(self, picture: VideoFrame) -> None:
        """Append what is in the picture; the encoder copies it, converted."""
        if self._container is None:
            self._open(picture)
        self._container.mux(self._stream.encode(picture))

    def _open(self, picture: VideoFrame) -> None:
        import av

        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(self._writing.enter_context(draft_of(self._path))), "w", format="mp4")
        # Ultrafast costs a tenth of a rendered frame, and more threads only add to it; crf 20 keeps small text
        # readable.
        options = {"preset": "ultrafast", "crf": "20", "threads": "1"}
        self._stream = self._container.add_stream("libx264", rate=self._fps, options=options)
        self._stream.height, self._stream.width = picture.height, picture.width
        self._stream.pix_fmt = FORMAT

    def _end(self, picture: VideoFrame) -> None:
        """Repeat the last picture, which is converted once, and let the file take its name."""
        last = picture.reformat(format=FORMAT)
        for _ in range(LAST_FRAMES):
            last.pts = None  # the encoder numbers it
            self._encode(last)
        self._container.mux(self._stream.encode())
        container, self._container = self._container, None
        container.close()
        self._writing.close()
