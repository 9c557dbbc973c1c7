"""One environment's session with its server."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE, OBS_STR
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import short
from lerobot_memobench.policies.remote.configuration_remote import (
    IMAGE,
    RLDS,
    STATE,
    TASK,
    VLA_EVAL,
    WRIST_IMAGE,
    RemoteConfig,
)
from lerobot_memobench.policies.remote.transports import ServerAway, Websocket
from lerobot_memobench.policies.remote.vla_eval import VlaEval, episode_start, observation, png_map
from lerobot_memobench.protocol import ACTION_DIM
from lerobot_memobench.sim.convention import CONVENTIONS, STATED, WRIST

logger = logging.getLogger(__name__)

MOST_ACTIONS = 4096
"""Largest number of actions in an answer: more than three episodes of the paper's horizon."""
PAUSE = 0.5
"""Time between two attempts to connect, s."""
RESET = {"reset": True}
HISTORY = {IMAGE: "video_history", WRIST_IMAGE: "wrist_video_history", STATE: "state_history"}
"""Our name of an observation -> vla-evaluation-harness's name of its frames in the demonstration prompt."""


class Session:
    """A connection to one server on behalf of one environment.

    An episode that loses its server is not continued, because a server that starts again has lost its memory and its
    random state: the evaluation stops, and resuming it repeats the episode.

    Args:
        config: of the policy. address: of the server.
    """

    def __init__(self, config: RemoteConfig, address: str) -> None:
        self.config, self.address = config, address
        self._dialect, self._keys = config.spoken, config.sent()
        self._speaks_vla_eval = self._dialect.protocol == VLA_EVAL
        self._transport = (VlaEval if self._speaks_vla_eval else Websocket)(address, config.timeout)
        self._connected = False
        self._trained = ""  # the convention that the server states
        self._used = False  # whether the connection has served an episode
        self._frames: list[dict[str, Any]] = []  # by our names, not sent yet
        self._seen, self._execution_starts = 0, 0

    # --- for the policy ---

    def connect(self) -> None:
        """Connect, so that a missing server is an error before any simulation.

        Raises:
            MemobenchError: the server does not answer within ``connect_timeout``.
        """
        if not self._connected:
            found = self._open()
            logger.info("connected with the policy server at %s: %s", self.address, short(found))
            self._connected, self._trained = True, str(found.get(STATED))

    def begin(self, row: Row) -> None:
        """Start an episode on a connection of its own; the server's memory is cleared.

        Raises:
            MemobenchError: the server does not answer, or states another convention of pictures.
        """
        self.connect()
        if row.convention is not None and self._trained in WRIST and self._trained != row.convention:
            raise MemobenchError(
                f"the policy server at {self.address} expects pictures of convention={self._trained}, and found "
                f"{row.convention}; give convention={self._trained}"
            )
        if self._used:
            self._open()
        self._used, self._frames, self._seen, self._execution_starts = True, [], 0, 0
        if self._dialect.buffers:
            self._ask(dict(RESET))
        elif self._speaks_vla_eval:
            self._ask(episode_start(row.get(TASK)))

    def watch(self, row: Row) -> None:
        """Keep a frame for the next question."""
        sent = self._keys.values()
        names = (IMAGE, STATE) if self._dialect.buffers else [name for name in HISTORY if name in sent]
        self._frames.append({name: self._value(row, name) for name in names})

    def execution_starts(self) -> None:
        """Note that all frames so far belong to the prompt."""
        self._execution_starts = self._seen + len(self._frames)

    def ask(self, row: Row) -> NDArray[np.float32]:
        """Return the server's actions for an observation, (H, 7).

        Raises:
            MemobenchError: the server failed, took too long, disconnected, or gave a wrong answer.
        """
        if self._dialect.buffers:
            self.watch(row)
            self._ask(self._buffer())
        return read_actions(self._ask(self._observation(row)), self.config, self.address)

    # --- messages ---

    def _observation(self, row: Row) -> dict[str, Any]:
        found = {theirs: self._value(row, ours) for theirs, ours in self._keys.items()}
        if self._speaks_vla_eval:
            if (step := row.scalar("step")) is not None:
                found["step"] = np.array([step], np.float32)
            return observation(found, self._history())
        return found

    def _history(self) -> dict[str, list[Any]]:
        """Return the frames of the demonstration prompt, once per episode."""
        frames, self._frames = self._frames, []
        return {HISTORY[name]: [frame[name] for frame in frames] for name in (frames[0] if frames else ())}

    def _value(self, row: Row, name: str) -> Any:
        value = row.get(name)
        if isinstance(value, np.ndarray) and value.ndim == 3:
            image = fit(value, self.config.side)
            return png_map(image) if self._speaks_vla_eval else image
        return value

    def _buffer(self) -> dict[str, Any]:
        frames, self._frames = self._frames, []
        self._seen += len(frames)
        return {
            "images": np.stack([frame[IMAGE] for frame in frames])[:, None],
            "state": np.stack([frame[STATE] for frame in frames]),
            "add_buffer": True,
            "exec_start_idx": self._execution_starts,
        }

    # --- the connection ---

    def _open(self) -> dict[str, Any]:
        """Connect; return the server's metadata."""
        deadline, warned = time.monotonic() + self.config.connect_timeout, False
        while True:
            try:
                return self._transport.open(max(deadline - time.monotonic(), 0.0))
            except ServerAway as error:
                if time.monotonic() >= deadline:
                    raise MemobenchError(
                        f"no policy server answered at {self.address} within {self.config.connect_timeout:g} s "
                        f"({error}); start it, or give its address by host= and port="
                    ) from error
                if not warned:
                    logger.warning("waiting for the policy server at %s (%s)", self.address, error)
                warned = True
            time.sleep(min(PAUSE, max(0.0, deadline - time.monotonic())))

    def _ask(self, content: dict[str, Any]) -> dict[str, Any]:
        try:
            return self._transport.ask(content)
        except ServerAway as error:
            raise MemobenchError(
                f"the policy server at {self.address} disconnected ({error}); its episode is not counted: start the "
                "server, and resume the evaluation by resume=true output_dir=<this run's folder>"
            ) from error


def read_actions(answer: Mapping[str, Any], config: RemoteConfig, address: str) -> NDArray[np.float32]:
    """Return the actions (H, 7) of an answer, with the environment's gripper convention.

    Infinite actions are returned too: the environment ends that episode, and the others continue.

    Raises:
        MemobenchError: there are no actions, too few, or values of another shape.
    """
    actions = _numbers(answer, address)
    if len(actions) < config.n_action_steps:
        raise MemobenchError(
            f"the policy server at {address} answers {len(actions)} actions at a time, fewer than the "
            f"{config.n_action_steps} to execute; set replan={len(actions)} or less"
        )
    if config.gripper == RLDS:
        gripper = actions[:, -1]
        actions[:, -1] = np.where(np.isfinite(gripper), -np.sign(2 * gripper - 1), gripper)
    return actions


def _numbers(answer: Mapping[str, Any], address: str) -> NDArray[np.float32]:
    if "actions" not in answer:
        raise _wrong(address, f"an answer without 'actions' (it holds {short(list(answer))})")
    try:
        actions = np.array(answer["actions"], dtype=np.float32, ndmin=2)
    except (TypeError, ValueError, OverflowError) as error:
        raise _wrong(address, "actions that are no numbers") from error
    if actions.ndim != 2 or actions.shape[1] != ACTION_DIM or not 0 < len(actions) <= MOST_ACTIONS:
        raise _wrong(address, f"actions of shape {actions.shape}")
    return actions


def _wrong(address: str, found: str) -> MemobenchError:
    return MemobenchError(
        f"the policy server at {address} answered {found}; expected finite numbers of shape (steps, {ACTION_DIM}), at "
        f"most {MOST_ACTIONS:,} steps: six numbers of the end effector's displacement and one of the gripper"
    )


@dataclass(frozen=True)
class Row:
    """One environment's row of a batch; values are copied on access.

    ``cameras``: our name of a camera -> name of its picture in the batch, where ``camera_name_mapping`` changes it.
    """

    batch: Mapping[str, Any]
    number: int
    cameras: Mapping[str, str] = field(default_factory=dict)

    def scalar(self, name: str) -> int | None:
        """Return an observation that is one integer, None if the environment has no such observation."""
        value = self.batch.get(f"{OBS_STR}.{name}")
        return None if value is None else round(float(value[self.number].reshape(-1)[0]))

    @property
    def convention(self) -> str | None:
        """The convention of the pictures by the name of the wrist camera, None if it is unknown."""
        return next((one for one, name in WRIST.items() if f"{OBS_IMAGES}.{name}" in self.batch), None)

    @property
    def blank(self) -> bool:
        """Whether this row is not simulated: observations of an episode that is already in the log are zeros."""
        found = [value[self.number] for key, value in self.batch.items() if key == OBS_STATE or OBS_IMAGES in key]
        return bool(found) and not any(bool(value.any()) for value in found)

    def get(self, name: str) -> Any:
        """Return an observation by our name: an image (H, W, 3) uint8, a vector float32, or the instruction."""
        if name == TASK:
            return str(self.batch[TASK][self.number])
        pictures = [f"{OBS_IMAGES}.{names.get(name, name)}" for names in CONVENTIONS.values()]
        for key in (self.cameras.get(name, ""), *pictures, OBS_STATE if name == STATE else f"{OBS_STR}.{name}"):
            if key in self.batch:
                value = self.batch[key][self.number]
                return to_image(value) if OBS_IMAGES in key else value.float().cpu().reshape(-1).numpy()
        known = [key.removeprefix(f"{OBS_IMAGES}.").removeprefix(f"{OBS_STR}.") for key in self.batch if OBS_STR in key]
        raise MemobenchError(
            f"policy.keys names {name!r}, which the environment does not observe; available: "
            f"{', '.join(sorted([*known, TASK]))}"
        )


def to_image(value: Tensor) -> NDArray[np.uint8]:
    """Convert LeRobot's image (3, H, W) in [0, 1] to the rendered one, (H, W, 3) uint8."""
    pixels = (value.float() * 255).round().clamp(0, 255).to(torch.uint8)
    array: NDArray[np.uint8] = pixels.permute(1, 2, 0).contiguous().cpu().numpy()
    return array


def fit(image: NDArray[np.uint8], side: int | None) -> NDArray[np.uint8]:
    """Resize an image bilinearly to (side, side, 3), padded with black; unchanged if side is None.

    Equal to openpi-client's ``resize_with_pad``, pixel for pixel.
    """
    height, width = image.shape[:2]
    if side is None or (height, width) == (side, side):
        return image
    ratio = max(width, height) / side
    size = int(width / ratio), int(height / ratio)
    padded = Image.new("RGB", (side, side))
    padded.paste(
        Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), ((side - size[0]) // 2, (side - size[1]) // 2)
    )
    return np.asarray(padded)
