"""A video per episode, encoded while it happens.

LeRobot keeps every frame of its first ten episodes in memory and leaves out the last one, in which the goal comes
true. A film is written as the episode goes and shows its end.
"""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.files import draft_of

LAST_FRAMES = 20
"""How often the final frame is repeated: a second to see how it ended."""


class _DiscardedError(Exception):
    """The film is not wanted."""


class Film:
    """Write frames to an MP4 that appears under its name only when it is whole.

    Args:
        path: the file to be.
        fps: frames per second.
    """

    def __init__(self, path: Path, fps: int = 20) -> None:
        self._path, self._fps = path, fps
        self._writing = ExitStack()
        self._container: Any = None

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame (height, width, 3); height and width must be even and stay the same."""
        import av

        if self._container is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._writing.enter_context(draft_of(self._path))), "w", format="mp4")
            # Ultrafast costs a tenth of a rendered frame, and more threads only add to it; crf 20 keeps small text
            # readable.
            options = {"preset": "ultrafast", "crf": "20", "threads": "1"}
            self._stream = self._container.add_stream("libx264", rate=self._fps, options=options)
            self._stream.height, self._stream.width = height, width = frame.shape[:2]
            self._stream.pix_fmt = "yuv420p"
            self._picture = av.VideoFrame(width, height, "rgb24")
            plane = self._picture.planes[0]  # its lines may be longer than the picture is wide
            lines = np.frombuffer(plane, np.uint8).reshape(height, plane.line_size)
            self._pixels = lines[:, : 3 * width].reshape(height, width, 3, copy=False)
        self._pixels[:] = frame
        self._encode()

    def _encode(self) -> None:
        """Append what is in the buffer; the encoder copies it, converted."""
        self._container.mux(self._stream.encode(self._picture))

    def finish(self) -> Path | None:
        """Hold the last frame, close the file and give it its name; None when nothing was filmed."""
        if self._container is None:
            return None
        for _ in range(LAST_FRAMES):
            self._encode()
        self._container.mux(self._stream.encode())
        self._container.close()
        self._container = None
        self._writing.close()
        return self._path

    def discard(self) -> None:
        """Throw an unfinished film away."""
        if self._container is not None:
            self._container.close()
            self._container = None
            with suppress(_DiscardedError), self._writing:  # an error is what makes a draft go
                raise _DiscardedError
