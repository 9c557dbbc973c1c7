"""Objects that eyes find in the present pictures, in the place of those that the environment tells.

All that learns is as in `objects`, so a policy that was trained on the environment's objects acts from pictures too.
Eyes are no part of the policy: a checkpoint names them, and others may be given to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.objects import ObjectFinder
from lerobot_memobench.perception.tower import SIDE
from lerobot_memobench.perception.weights import Eyes
from lerobot_memobench.policies.memobench_mem.perception.eyes import SEEN
from lerobot_memobench.policies.memobench_mem.perception.frozen import fingerprint
from lerobot_memobench.policies.memobench_mem.perception.objects import OBS_PHASE, OBS_RAW_STATE, ObjectPerception
from lerobot_memobench.policies.memobench_mem.perception.perception import Seen
from lerobot_memobench.policies.shown import cure
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.sim.object_layout import SIZE

FOUND = f"{SEEN}objects"
"""Name in a training sample of what was found in its pictures, (B, SIZE)."""
VIEWS = {f"{OBS_IMAGES}.{name}": camera for name, camera in CAMERAS.items()}
"""Picture at the policy -> camera."""


class ObjectsInPictures:
    """Find objects in pictures by the policy's names of these."""

    def __init__(self, eyes: Eyes) -> None:
        self._eyes, self._find = eyes, ObjectFinder(eyes)

    @cached_property
    def key(self) -> str:
        """Identity of what is found: weights, and size of the pictures."""
        return f"{fingerprint({'eyes': self._eyes})}-{SIDE}x{SIDE}-objects-{SIZE}"

    def __call__(self, pictures: Mapping[str, Tensor], states: Tensor) -> Tensor:
        """Return the slots (N, SIZE) float32 of pictures (N, 3, H, H) in [0, 1] and robots' states (N, >= 6).

        Raises:
            MemobenchError: a camera is missing.
        """
        for name in VIEWS:
            if name not in pictures:
                raise MemobenchError(f"The observation has no '{name}', which eyes look at; {cure(name, pictures)}")
        device = next(self._eyes.parameters()).device
        views = {camera: pictures[name].to(device) for name, camera in VIEWS.items()}
        with torch.autocast(device.type, enabled=False):  # mixed precision would see otherwise than training did
            return self._find(views, states).to(states.device)


class FoundObjects(ObjectPerception):
    """A token per thing that is found now; what is remembered are its numbers.

    Args:
        look: no module, so that a checkpoint has no part of it.
        trained, tokens_per_frame, width: as of `ObjectPerception`.
    """

    remembers = next(iter(VIEWS))
    pictures = True

    def __init__(self, look: ObjectsInPictures, trained: Sequence[str], tokens_per_frame: int, width: int) -> None:
        super().__init__(trained, tokens_per_frame, width)
        self.look = look
        self.key = look.key

    def present(self, batch: Mapping[str, Tensor]) -> Seen:
        """Return what `ObjectPerception.present` does, of what was found in the batch's pictures, or is now."""
        return super().present(self._with_objects(batch))

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return the rows (n, 1, D') of frames; without a phase all is execution."""
        wanted = {FOUND} if FOUND in batch else {*VIEWS}
        chosen = {key: value[list(rows)] for key, value in batch.items() if key in wanted | {OBS_RAW_STATE, OBS_PHASE}}
        return super().remember(self._with_objects(chosen), range(len(rows)))

    def _with_objects(self, batch: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        found = batch[FOUND] if FOUND in batch else self.look(batch, batch[OBS_RAW_STATE])
        return {**batch, OBS_ENV_STATE: found}
