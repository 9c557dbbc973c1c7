"""What is seen of an episode: pictures, objects or both, looked at only where somebody wants to know."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.annotate import annotate
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.obs_types import OBJECTS, PIXELS
from lerobot_memobench.protocol import PROMPT
from lerobot_memobench.sim.rendering import Image


class Sight:
    """The part of the observations that must be looked for: drawing pictures and finding visible objects takes time.

    Args:
        obs_type: one of `obs_types.OBS_TYPES`.
        render_every: pictures are drawn every so many execution steps, and repeated in between; objects are not.

    Attributes:
        watched: whether somebody looks at the frames that follow. What nobody looks at is as it was seen last; the
            first and the last frame of the execution always are of the present.
    """

    def __init__(self, obs_type: str, render_every: int) -> None:
        self._sees_pictures, self._sees_objects = obs_type != OBJECTS, obs_type != PIXELS
        self._render_every = render_every
        self.watched = True

    def begin(self, episode: Episode) -> None:
        """Look at the first frame of an episode."""
        self.watched = True
        self._picture_step: int | None = None
        self.look(episode, filmed=False)

    def look(self, episode: Episode, *, filmed: bool) -> None:
        """Take in the present frame, as far as anybody looks at it.

        Args:
            filmed: whether a film does.
        """
        always = episode.done or episode.step_index == episode.exec_start
        if self._sees_objects and (always or self.watched):
            self._objects = episode.objects()
        due = episode.phase == PROMPT or episode.exec_steps % self._render_every == 0
        if self._sees_pictures and (always or (due and (self.watched or filmed))):
            self._draw(episode)

    def _draw(self, episode: Episode) -> None:
        self._images: dict[str, Image] = episode.images()
        self._picture_step, self._picture_clock = episode.step_index, episode.clock

    def observed(self) -> dict[str, Any]:
        """Return the observation's pictures and objects, see `observations.observation_space`."""
        seen: dict[str, Any] = {}
        if self._sees_pictures:
            seen["pixels"] = dict(self._images)
            if self._render_every > 1:
                seen["picture_step"] = np.array([self._picture_clock], dtype=np.float32)
        if self._sees_objects:
            seen["environment_state"] = self._objects
        return seen

    def frame(self, episode: Episode) -> NDArray[np.uint8]:
        """Return both cameras annotated: as they were drawn last, or now where observations hold no pictures."""
        if not self._sees_pictures and self._picture_step != episode.step_index:
            self._draw(episode)
        return annotate(self._images, episode)
