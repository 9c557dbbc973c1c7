"""Configuration of a policy in a server: ``lerobot eval env=memobench policy=memobench_remote host=… port=…``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_memobench.envs.observations import PIXEL_INPUT, PRIVILEGED, SIMULATOR
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.baselines.configuration_baselines import UntrainedConfig

IMAGE, WRIST_IMAGE, STATE, TASK = "image", "wrist_image", "state", "task"
"""Names of observations to send: both cameras (256, 256, 3) uint8, proprioception (8,) float32, the instruction. Other
observations have the environment's names (``phase``, ``step``)."""

OPENPI_KEYS = {
    "observation/image": IMAGE,
    "observation/wrist_image": WRIST_IMAGE,
    "observation/state": STATE,
    "prompt": TASK,
}

VLA_EVAL_KEYS = {"images.agentview": IMAGE, "images.wrist": WRIST_IMAGE, "states": STATE, "task_description": TASK}
"""Keys of vla-evaluation-harness's model servers; a dot separates levels."""

LIBERO, RLDS = "libero", "rlds"
GRIPPERS = (LIBERO, RLDS)
"""``libero``: −1 opens, 1 closes, as in this environment. ``rlds``: 1 opens, 0 closes; values between are rounded."""


OPENPI, VLA_EVAL = "openpi", "vla_eval"


@dataclass(frozen=True)
class Dialect:
    """One kind of server.

    Attributes:
        protocol: ``openpi`` or ``vla_eval`` (vla-evaluation-harness), both over a websocket.
        port: default port of the server.
        keys: the server's name of each observation -> our name.
        image_size: side of sent images, pixels; None: as rendered, and the server resizes them.
        n_action_steps: default number of executed actions of each answer.
        shared: all connections share one memory, so the server serves one environment at a time.
        buffers: the server receives every frame, in a message before each question (``add_buffer``).
        history: the server receives the whole demonstration prompt with the first question of the execution.
        queues: the server answers one action and queues the rest of its plan.
    """

    protocol: str = OPENPI
    port: int = 8000
    keys: Mapping[str, str] = field(default_factory=lambda: dict(OPENPI_KEYS))
    image_size: int | None = None
    n_action_steps: int = 5
    shared: bool = False
    buffers: bool = False
    history: bool = False
    queues: bool = False


DIALECTS: dict[str, Dialect] = {
    # openpi: examples/libero/main.py, src/openpi/serving/websocket_policy_server.py, openpi-client 0.1.2
    "openpi": Dialect(image_size=224),
    # RoboMME/robomme_policy_learning: examples/robomme/{eval,utils}.py, serving/websocket_policy_server.py
    "robomme": Dialect(port=8011, shared=True, buffers=True),
    # vla-eval 0.8: protocol/{messages,numpy_codec,image_codec}.py, connection.py, model_servers/{serve,predict}.py
    "vla_eval": Dialect(protocol=VLA_EVAL, keys=VLA_EVAL_KEYS, n_action_steps=1, history=True, queues=True),
}

BY_DIALECT: Any = None
"""Default of a field that `__post_init__` fills in from the dialect."""


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
        mirror: replaced by the environment's ``convention=libero``, and refused.
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
    mirror: bool = False
    gripper: str = LIBERO
    send_prompt: bool = True
    history_every: int | None = None
    connect_timeout: float = 60.0
    timeout: float = 300.0
    label: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dialect not in DIALECTS:
            raise MemobenchError(f"policy.dialect is {self.dialect!r}, {nearest(self.dialect, DIALECTS)}")
        if self.mirror:
            raise MemobenchError("policy.mirror is now a setting of the environment: give convention=libero")
        if self.gripper not in GRIPPERS:
            raise MemobenchError(f"policy.gripper is {self.gripper!r}, {nearest(self.gripper, GRIPPERS)}")
        if self.n_action_steps is BY_DIALECT:
            self.n_action_steps = self.spoken.n_action_steps
        for name in ("n_action_steps", "history_every"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise MemobenchError(f"policy.{name} is {number}; expected a whole number from 1 on")
        for name in ("connect_timeout", "timeout"):
            if getattr(self, name) <= 0:
                raise MemobenchError(f"policy.{name} is {getattr(self, name)}; expected seconds above 0")
        if self.image_size is not None and self.image_size < 0:
            raise MemobenchError(f"policy.image_size is {self.image_size}; expected pixels, or 0 as rendered")
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
    def spoken(self) -> Dialect:
        """The server's dialect."""
        return DIALECTS[self.dialect]

    @property
    def plans_unseen(self) -> bool:
        """Whether the server executes its plan itself, so that the number of actions is unknown here."""
        return self.spoken.queues

    @property
    def prompt_stride(self) -> int:
        """Steps between sent frames of the prompt."""
        return 1 if self.spoken.buffers else self.history_every or (1 if self.spoken.history else self.n_action_steps)

    @property
    def max_environments(self) -> int | None:
        """Largest number of environments in a batch; None: any number."""
        return len(self.addresses()) if self.spoken.shared else None

    @property
    def side(self) -> int | None:
        """Side of sent images, pixels; None: as rendered."""
        return (self.spoken.image_size if self.image_size is None else self.image_size) or None

    def addresses(self) -> list[str]:
        """Return the addresses of the servers, ``scheme://host:port``.

        Raises:
            MemobenchError: an address is invalid.
        """
        given = self.servers.split(",") if self.servers else [f"{self.host}:{self.port or self.spoken.port}"]
        return [self._address(text.strip()) for text in given]

    def _address(self, text: str) -> str:
        scheme, rest = text.split("://", 1) if "://" in text else ("", text)
        host, _, port = rest.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536 or set(host) & set("/ @?#"):
            raise MemobenchError(
                f"found {text!r} as the policy server's address; expected a host and a port, as in host=10.0.0.5 "
                "port=8000 or policy.servers=gpu1:8000,gpu2:8000"
            )
        if scheme not in ("", "ws", "wss"):
            raise MemobenchError(f"found the address {text!r}; expected ws:// or wss://")
        return f"{scheme or 'ws'}://{host}:{port}"

    def sent(self) -> dict[str, str]:
        """Return the server's name -> our name of each sent observation.

        Raises:
            MemobenchError: ``keys`` is not a list of pairs.
        """
        if self.keys is None:
            return dict(self.spoken.keys)
        pairs = [tuple(part.strip() for part in pair.split("=", 1)) for pair in self.keys.split(",")]
        if not all(len(pair) == 2 and all(pair) for pair in pairs):
            raise MemobenchError(
                f"policy.keys is {self.keys!r}; expected pairs of the server's and our names, as in "
                "'observation/image=image,observation/state=state,prompt=task'"
            )
        return {pair[0]: pair[1] for pair in pairs}
