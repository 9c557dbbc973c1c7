"""What each kind of policy server expects: one row per deployed protocol, read from its own server and client code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

IMAGE, WRIST_IMAGE, STATE, TASK = "image", "wrist_image", "state", "task"
"""Names of what can be sent: both cameras (256, 256, 3) uint8, proprioception (8,) float32, the instruction. Any other
observation of the environment goes by its own name (``phase``, ``step``)."""

OPENPI_KEYS = {
    "observation/image": IMAGE,
    "observation/wrist_image": WRIST_IMAGE,
    "observation/state": STATE,
    "prompt": TASK,
}

LIBERO, RLDS = "libero", "rlds"
GRIPPERS = (LIBERO, RLDS)
"""``libero``: −1 opens, 1 closes, as this environment has it. ``rlds``: 1 opens, 0 closes, and the client turns
whatever lies between into the nearer of both."""


@dataclass(frozen=True)
class Dialect:
    """One kind of server.

    Attributes:
        transport: ``websocket`` (openpi's), ``act`` (OpenVLA's REST) or ``process_frame`` (MemoryVLA's REST).
        port: where the server listens unless told otherwise.
        keys: the server's name of each thing that is sent -> our name of it.
        image_size: side of the images that are sent, pixels; None for as rendered, where the server resizes itself.
        gripper: meaning of the last number of an action.
        memory: the server remembers what it was sent, so that it has to see the episode again when it was restarted.
        shared: it has one memory for all its connections, so it serves one environment at a time.
        buffers: it is sent every frame, in a message of its own before each question (``add_buffer``).
    """

    transport: str = "websocket"
    port: int = 8000
    keys: Mapping[str, str] = field(default_factory=lambda: dict(OPENPI_KEYS))
    image_size: int | None = None
    gripper: str = LIBERO
    memory: bool = False
    shared: bool = False
    buffers: bool = False


DIALECTS: dict[str, Dialect] = {
    # openpi: examples/libero/main.py, src/openpi/serving/websocket_policy_server.py, openpi-client 0.1.2
    "openpi": Dialect(image_size=224),
    # RoboMME/robomme_policy_learning: examples/robomme/{eval,utils}.py, serving/websocket_policy_server.py
    "robomme": Dialect(port=8011, memory=True, shared=True, buffers=True),
    # openvla-oft: vla-scripts/deploy.py, experiments/robot/{openvla_utils,robot_utils}.py
    "openvla_oft": Dialect(
        transport="act",
        port=8777,
        keys={"full_image": IMAGE, "wrist_image": WRIST_IMAGE, "state": STATE, "instruction": TASK},
        gripper=RLDS,
    ),
    # shihao1895/MemoryVLA: deploy.py, evaluation/libero/{vla_policy,eval_libero}.py; RoboMME/MemoryVLA: deploy.py
    "memoryvla": Dialect(
        transport="process_frame",
        port=2345,
        keys={"image": IMAGE, "text": TASK},
        gripper=RLDS,
        memory=True,
        shared=True,
    ),
}
