"""A policy in a server: observations go to the server, actions come back.

``lerobot eval env=memobench policy=memobench_remote host=… port=…``
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE, OBS_STR
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lerobot_memobench.constants import ACTION_DIM, CAMERAS, EXECUTION
from lerobot_memobench.envs.lerobot import begins_episode, is_frozen
from lerobot_memobench.envs.observations import PIXEL_INPUT, PRIVILEGED, SIMULATOR
from lerobot_memobench.errors import MemobenchError, nearest, short
from lerobot_memobench.policies.baselines import UntrainedConfig, UntrainedPolicy, make_processors
from lerobot_memobench.policies.remote_connection import (
    DIALECTS,
    IMAGE,
    STATE,
    STEP,
    TASK,
    WRIST_IMAGE,
    Connection,
    NamedValues,
)
from lerobot_memobench.sim.convention import CONVENTIONS, STATED, WRIST

logger = logging.getLogger(__name__)

LIBERO, RLDS = "libero", "rlds"
GRIPPERS = (LIBERO, RLDS)
"""``libero``: −1 opens, 1 closes, as in this environment. ``rlds``: 1 opens, 0 closes; values between are rounded."""
BY_DIALECT: Any = None
"""Default of a field that `__post_init__` fills in from the dialect."""
MOST_ACTIONS = 4096
"""Largest number of actions in an answer: more than three episodes of the paper's horizon."""
MOST_THREADS = 256
"""Largest number of servers that are asked at a time."""

Action = NDArray[np.float32]


@PreTrainedConfig.register_subclass("memobench_remote")
@dataclass
class RemoteConfig(UntrainedConfig):
    """Address and dialect of the server, and waiting times.

    Args:
        host: name or address of the server's machine, optionally with ``ws://`` or ``wss://``.
        port: its port; the dialect's default if left out.
        servers: several servers, ``host:port,host:port``; environment i of a batch asks server i modulo their number.
        dialect: protocol of the server, one of `DIALECTS`.
        n_action_steps: executed actions of each answer (``replan=``); default 5, for ``vla_eval`` 1.
        keys: observations to send, ``theirs=ours,…`` with ours one of image, wrist_image, state, task or another
            observation of the environment; replaces the dialect's.
        image_size: side of sent images, padded to a square, pixels; 0: as rendered.
        gripper: meaning of the last number of an action, one of `GRIPPERS`.
        send_prompt: send the demonstration prompt; set to false to save time with a policy without memory.
        history_every: steps between sent frames of the prompt; default ``n_action_steps``, for ``vla_eval`` 1. A
            server that buffers frames (robomme) receives all of them.
        connect_timeout: longest wait for a connection, s.
        timeout: longest wait for an answer, s; the first one may include compilation.
        label: name of the checkpoint for the result card; servers do not send one.
    """

    reads_prompt: ClassVar[bool] = True

    host: str = "127.0.0.1"
    port: int | None = None
    servers: str | None = None
    dialect: str = "openpi"
    n_action_steps: int = BY_DIALECT
    keys: str | None = None
    image_size: int | None = None
    gripper: str = LIBERO
    send_prompt: bool = True
    history_every: int | None = None
    connect_timeout: float = 60.0
    timeout: float = 300.0
    label: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, known in (("dialect", DIALECTS), ("gripper", GRIPPERS)):
            if (value := getattr(self, name)) not in known:
                raise MemobenchError(f"policy.{name} is {value!r}, {nearest(value, known)}")
        if self.n_action_steps is BY_DIALECT:
            self.n_action_steps = self.connection.n_action_steps
        for name, least in (("n_action_steps", 1), ("history_every", 1), ("image_size", 0)):
            if (number := getattr(self, name)) is not None and number < least:
                raise MemobenchError(f"policy.{name} is {number}; expected a whole number from {least} on")
        for name in ("connect_timeout", "timeout"):
            if getattr(self, name) <= 0:
                raise MemobenchError(f"policy.{name} is {getattr(self, name)}; expected seconds above 0")
        self.addresses()
        self.sent()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Inputs of its server, in the terms of `envs.observations`."""
        sent = set(self.sent().values())
        special = {"environment_state": PRIVILEGED, "expert_action": SIMULATOR, "blind_action": SIMULATOR}
        pixels = (PIXEL_INPUT,) * bool(sent & {IMAGE, WRIST_IMAGE})
        return pixels + tuple(dict.fromkeys(words for name, words in special.items() if name in sent))

    @property
    def connection(self) -> type[Connection]:
        return DIALECTS[self.dialect]

    @property
    def plans_unseen(self) -> bool:
        """Whether the server executes its plan itself, so that the number of actions is unknown here."""
        return self.connection.queues

    @property
    def prompt_stride(self) -> int:
        kind = self.connection
        return 1 if kind.buffers else self.history_every or kind.prompt_stride or self.n_action_steps

    @property
    def max_environments(self) -> int | None:
        """Largest number of environments in a batch; None: any number."""
        return len(self.addresses()) if self.connection.buffers else None

    @property
    def side(self) -> int | None:
        """Side of sent images, pixels; None: as rendered."""
        return (self.connection.image_size if self.image_size is None else self.image_size) or None

    def addresses(self) -> list[str]:
        """Return the addresses of the servers, ``scheme://host:port``, or refuse an invalid one."""
        texts = self.servers.split(",") if self.servers else [f"{self.host}:{self.port or self.connection.port}"]
        return [_address(text.strip()) for text in texts]

    def sent(self) -> dict[str, str]:
        """Return the server's name -> our name of each sent observation, or refuse ``keys`` that are no pairs."""
        if self.keys is None:
            return dict(self.connection.keys)
        pairs = [tuple(part.strip() for part in pair.split("=", 1)) for pair in self.keys.split(",")]
        if not all(len(pair) == 2 and all(pair) for pair in pairs):
            raise MemobenchError(
                f"policy.keys is {self.keys!r}; expected pairs of the server's and our names, as in "
                "'observation/image=image,observation/state=state,prompt=task'"
            )
        return {pair[0]: pair[1] for pair in pairs}


def _address(text: str) -> str:
    scheme, rest = text.split("://", 1) if "://" in text else ("ws", text)
    host, _, port = rest.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536 or set(host) & set("/ @?#"):
        raise MemobenchError(
            f"found {text!r} as the policy server's address; expected a host and a port, as in host=10.0.0.5 "
            "port=8000 or policy.servers=gpu1:8000,gpu2:8000"
        )
    if scheme not in ("ws", "wss"):
        raise MemobenchError(f"found the address {text!r}; expected ws:// or wss://")
    return f"{scheme}://{host}:{port}"


def make_memobench_remote_pre_post_processors(
    config: RemoteConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor that rename and batch only; images stay on the CPU."""
    return make_processors(replace(config, device="cpu"))


class RemotePolicy(UntrainedPolicy):
    """A policy that asks a server; see `RemoteConfig`. Each environment of a batch has a connection of its own."""

    config_class = RemoteConfig
    name = "memobench_remote"
    why_not_trained = "runs in a server and cannot be trained here"

    def __init__(self, config: RemoteConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: RemoteConfig = config
        self._clients: list[Client] = []
        self._pool = ThreadPoolExecutor(MOST_THREADS, "policy-server")  # threads start as they are needed
        self._cameras = dict(zip(CAMERAS, config.image_features, strict=False))  # LeRobot's, in the environment's order

    def reset(self) -> None:
        """Begin a rollout. Connections stay open; a missing server is an error before any simulation."""
        if not self._clients:
            self._add_client()
        self._clients[0].connect()
        for client in self._clients:
            client.forget()

    def needs_observation(self) -> bool:
        """Return whether the next observation's images are sent to a server."""
        return any(client.needs_observation() for client in self._clients)

    def _add_client(self) -> None:
        addresses = self.config.addresses()
        self._clients.append(Client(self.config, addresses[len(self._clients) % len(addresses)]))

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action (B, 7) in [-1, 1] of each environment; servers are asked in parallel."""
        count = len(next(value for value in batch.values() if isinstance(value, Tensor) and value.ndim))
        limit = self.config.max_environments
        if limit is not None and count > limit:
            raise MemobenchError(
                f"a {self.config.dialect} server has one memory for all of its connections, and {count} environments "
                f"would share {limit}; use batch_size={limit}, or name {count} servers by policy.servers=host:port,…"
            )
        while len(self._clients) < count:
            self._add_client()
        batch = _flat(batch)
        observations = [EnvObservation(batch, index, self._cameras) for index in range(count)]
        run = map if count == 1 else self._pool.map
        return torch.from_numpy(np.stack([*run(Client.act, self._clients, observations)]))


class Client:
    """One environment: its connection, its episode and its queued actions.

    Without ``phase`` and ``step`` in observations, an episode begins with the policy's reset.
    """

    def __init__(self, config: RemoteConfig, address: str) -> None:
        self._config = config
        self._connection = config.connection(address, config.timeout, config.sent())
        self._stated: str | None = None  # the convention that the server states; None: not connected
        self._used = False  # whether the connection has served an episode
        self.forget()

    def connect(self) -> None:
        """Connect within ``connect_timeout``, so that a missing server is an error before any simulation."""
        if self._stated is None:
            metadata = self._connection.open(self._config.connect_timeout)
            logger.info("connected with the policy server at %s: %s", self._connection.address, short(metadata))
            self._stated = str(metadata.get(STATED))

    def forget(self) -> None:
        """Begin a rollout: the next observation is of another episode."""
        self._clock: tuple[int, int] | None = None
        self._prompt = self._rests = False
        self._queue: deque[Action] = deque()

    def act(self, observation: EnvObservation) -> Action:
        """Return the action (7,) for the present observation, queued or of a new answer."""
        step, phase = observation.scalar(STEP), observation.scalar("phase")
        last, self._clock = self._clock, self._now(step, phase)
        begins = begins_episode(last, self._clock)
        self._rests = (not begins and is_frozen(last, self._clock)) or (step is not None and observation.blank)
        if self._rests:
            return np.zeros(ACTION_DIM, np.float32)  # the episode has ended, or is not simulated
        if begins:
            self._begin(observation)
        self._prompt = phase not in (None, EXECUTION)
        if self._prompt:  # actions have no effect
            if self._shows_prompt(self._clock[1]):
                self._connection.show(self._frame(observation))
            return np.zeros(ACTION_DIM, np.float32)
        if not self._queue:
            answer = self._connection.plan(self._frame(observation))
            actions = read_actions(answer, self._config, self._connection.address)
            self._queue.extend(actions[: self._config.n_action_steps])
        elif self._config.connection.buffers:
            self._connection.watch(self._frame(observation))
        return self._queue.popleft()

    def _now(self, step: int | None, phase: int | None) -> tuple[int, int]:
        if step is None:
            return EXECUTION, 0 if self._clock is None else self._clock[1] + 1
        return EXECUTION if phase is None else phase, step

    def _begin(self, observation: EnvObservation) -> None:
        """Start an episode on a connection of its own; the server's memory is cleared."""
        self.connect()
        shown = observation.convention
        if shown is not None and self._stated in WRIST and self._stated != shown:
            raise MemobenchError(
                f"the policy server at {self._connection.address} expects images of convention={self._stated}, and "
                f"found {shown}; give convention={self._stated}"
            )
        if self._used:
            self._connection.open(self._config.connect_timeout)
        self._used = True
        self._queue.clear()
        self._connection.begin(observation.get(TASK))

    def needs_observation(self) -> bool:
        """Return whether the next observation's images are sent. Those of the first execution step always are."""
        if self._rests or self._clock is None:
            return not self._rests
        if self._prompt:
            return self._shows_prompt(self._clock[1] + 1)
        return self._config.connection.buffers or not self._queue

    def _shows_prompt(self, step: int) -> bool:
        return self._config.send_prompt and step % self._config.prompt_stride == 0

    def _frame(self, observation: EnvObservation) -> NamedValues:
        buffered = (IMAGE, STATE) if self._config.connection.buffers else ()
        values = {name: observation.get(name) for name in (*buffered, *self._connection.keys.values())}
        if observation.scalar(STEP) is not None:
            values[STEP] = observation.get(STEP)
        return {name: fit(value, self._config.side) if np.ndim(value) == 3 else value for name, value in values.items()}


def read_actions(answer: Mapping[str, Any], config: RemoteConfig, address: str) -> NDArray[np.float32]:
    """Return the actions (H, 7) of an answer, with the environment's gripper convention; refuse too few, or others.

    Infinite actions are returned too: the environment ends that episode, and the others continue.
    """

    def wrong(problem: str) -> MemobenchError:
        return MemobenchError(
            f"the policy server at {address} answered {problem}; expected finite numbers of shape (steps, "
            f"{ACTION_DIM}), at most {MOST_ACTIONS:,} steps: six numbers of the end effector's displacement and one of "
            "the gripper"
        )

    if "actions" not in answer:
        raise wrong(f"an answer without 'actions' (it holds {short(list(answer))})")
    try:
        actions = np.array(answer["actions"], dtype=np.float32, ndmin=2)
    except (TypeError, ValueError, OverflowError) as error:
        raise wrong("actions that are no numbers") from error
    if actions.ndim != 2 or actions.shape[1] != ACTION_DIM or not 0 < len(actions) <= MOST_ACTIONS:
        raise wrong(f"actions of shape {actions.shape}")
    if len(actions) < config.n_action_steps:
        raise MemobenchError(
            f"the policy server at {address} answers {len(actions)} actions at a time, fewer than the "
            f"{config.n_action_steps} to execute; set replan={len(actions)} or less"
        )
    if config.gripper == RLDS:
        gripper = actions[:, -1]
        actions[:, -1] = np.where(np.isfinite(gripper), -np.sign(2 * gripper - 1), gripper)
    return actions


@dataclass(frozen=True)
class EnvObservation:
    """One environment's observation in a batch; values are copied on access.

    ``cameras``: our name of a camera -> name of its image in the batch, where ``camera_name_mapping`` changes it.
    """

    batch: Mapping[str, Any]
    env_index: int
    cameras: Mapping[str, str]

    def scalar(self, name: str) -> int | None:
        """Return an observation that is one integer, None if the environment has no such observation."""
        value = self.batch.get(f"{OBS_STR}.{name}")
        return None if value is None else round(float(value[self.env_index].reshape(-1)[0]))

    @property
    def convention(self) -> str | None:
        """The convention of the images by the name of the wrist camera, None if it is unknown."""
        return next((convention for convention, name in WRIST.items() if f"{OBS_IMAGES}.{name}" in self.batch), None)

    @property
    def blank(self) -> bool:
        """Whether this environment is not simulated: its episode is already in the log, and its observation is zero."""
        values = [value[self.env_index] for key, value in self.batch.items() if key == OBS_STATE or OBS_IMAGES in key]
        return bool(values) and not any(bool(value.any()) for value in values)

    def get(self, name: str) -> Any:
        """Return an observation by our name: an image (H, W, 3) uint8, a vector float32, or the instruction."""
        if name == TASK:
            return str(self.batch[TASK][self.env_index])
        images = [f"{OBS_IMAGES}.{names.get(name, name)}" for names in CONVENTIONS.values()]
        for key in (self.cameras.get(name, ""), *images, OBS_STATE if name == STATE else f"{OBS_STR}.{name}"):
            if key in self.batch:
                value = self.batch[key][self.env_index].float()
                if OBS_IMAGES not in key:
                    return value.cpu().reshape(-1).numpy()
                pixels = (value * 255).round().clamp(0, 255).to(torch.uint8)
                return pixels.permute(1, 2, 0).contiguous().cpu().numpy()
        known = [key.removeprefix(f"{OBS_IMAGES}.").removeprefix(f"{OBS_STR}.") for key in self.batch if OBS_STR in key]
        raise MemobenchError(
            f"policy.keys names {name!r}, which the environment does not observe; available: "
            f"{', '.join(sorted([*known, TASK]))}"
        )


def _flat(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return a batch whose parts of ``robot_state`` have names with dots, such as ``robot_state.joints.pos``."""
    nested = f"{OBS_STR}.robot_state"
    parts = {
        f"{nested}.{group}.{key}": value
        for group, values in batch.get(nested, {}).items()
        for key, value in values.items()
    }
    return {name: value for name, value in batch.items() if name != nested} | parts


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
