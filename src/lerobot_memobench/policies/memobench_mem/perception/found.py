"""Objects that eyes find in the present pictures, in the place of those that the environment tells.

All that learns is as in `objects`, so a policy that was trained on the environment's objects acts from pictures too.
Eyes are no part of the policy: a checkpoint names them, and others may be given to it. To know what a failure is from,
the environment may tell some of it all the same.
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
from lerobot_memobench.policies.memobench_mem.perception.sight_errors import TOLD, SightErrors
from lerobot_memobench.policies.memobench_mem.perception.slots import in_order
from lerobot_memobench.policies.shown import cure
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.sim.object_slots import SIZE, SLOTS, WIDTH, field

FOUND = f"{SEEN}objects"
"""Name in a training sample of what was found in its pictures, (B, SIZE)."""
AT_HAND = 0.15
"""How near to the hand ``told_objects=hand`` tells, m."""
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
        told: what rollouts are told by the environment instead, as of `told_objects`.
        errors: with which a training batch's are seen; they are told ones then.
    """

    remembers = next(iter(VIEWS))
    pictures = True

    def __init__(
        self,
        look: ObjectsInPictures,
        trained: Sequence[str],
        tokens_per_frame: int,
        width: int,
        told: str = "nothing",
        errors: SightErrors = TOLD,
    ) -> None:
        super().__init__(trained, tokens_per_frame, width, errors)
        self.look, self.told = look, told
        self.key = look.key

    def present(self, batch: Mapping[str, Tensor]) -> Seen:
        """Return what `ObjectPerception.present` does, of what was found in the batch's pictures, or is now."""
        return super().present(self._with_objects(batch, "present"))

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return the rows (n, 1, D') of frames; without a phase all is execution."""
        wanted = {FOUND} if FOUND in batch else {*VIEWS, OBS_ENV_STATE}
        chosen = {key: value[list(rows)] for key, value in batch.items() if key in wanted | {OBS_RAW_STATE, OBS_PHASE}}
        return super().remember(self._with_objects(chosen, "memory"), range(len(rows)))

    def _with_objects(self, batch: Mapping[str, Tensor], use: str) -> Mapping[str, Tensor]:
        """Return a batch with its objects, for the ``present`` or for ``memory``."""
        if FOUND in batch:
            return {**batch, OBS_ENV_STATE: batch[FOUND]}
        near = self.told == "hand" and use == "present"
        if (self.told == use or near) and OBS_ENV_STATE not in batch:
            raise MemobenchError(
                f"The observation has no '{OBS_ENV_STATE}', of which told_objects={self.told} tells; evaluate with "
                "--env.obs_type=both."
            )
        if self.told == use:
            return batch
        found = self.look(batch, batch[OBS_RAW_STATE])
        if near:
            found = _told_near(found, batch[OBS_ENV_STATE].to(found), batch[OBS_RAW_STATE].to(found))
        return {**batch, OBS_ENV_STATE: found}


def _told_near(found: Tensor, told: Tensor, hand: Tensor) -> Tensor:
    """Return slots (N, SIZE): what is found, but near the hand (N, >= 3) what is told."""
    both = torch.cat([found, told], dim=1).unflatten(1, (2 * SLOTS, WIDTH))
    near = (field(both, "position") - hand[:, None, :3]).norm(dim=-1) < AT_HAND
    kept = torch.cat([~near[:, :SLOTS], near[:, SLOTS:]], dim=1)
    return in_order(both * kept[..., None])[:, :SLOTS].flatten(1)
