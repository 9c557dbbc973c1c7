"""A policy that runs in a server, what LeRobot hands it, and answers by which it can be followed."""

from __future__ import annotations

import socket
from typing import Any

import numpy as np
import torch

from lerobot_memobench.policies.remote import RemoteConfig, RemotePolicy
from tests.support.policy_server import PolicyServer, robomme

TASK = "turn_on_the_stove_and_turn_it_off"
SIDE = 32
PATIENT = {"connect_timeout": 5.0, "timeout": 5.0}
IMPATIENT = {"connect_timeout": 0.3, "timeout": 0.3}


def numbered_image(step: int, row: int = 0) -> np.ndarray:
    """(SIDE, SIDE, 3) uint8 with step and row in their first pixel."""
    array = np.full((SIDE, SIDE, 3), 90, np.uint8)
    array[0, 0] = step, row, 255
    return array


def batch(*steps: int | None, phase: int = 1, task: str = "do it") -> dict[str, Any]:
    """What LeRobot hands a policy for environments at these steps; None is one that is not simulated."""
    images = np.stack([numbered_image(step or 0, row) for row, step in enumerate(steps)])
    images[[step is None for step in steps]] = 0
    tensor = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
    state = torch.arange(8.0).repeat(len(steps), 1) + 1
    state[[step is None for step in steps]] = 0
    return {
        "observation.images.image": tensor,
        "observation.images.wrist_image": tensor.flip(-1),
        "observation.state": state,
        "observation.step": torch.tensor([float(step or 0) for step in steps]),
        "observation.phase": torch.full((len(steps),), float(phase)),
        "task": [task] * len(steps),
    }


def make(server: PolicyServer | int, **settings: Any) -> RemotePolicy:
    port = server if isinstance(server, int) else server.port
    policy = RemotePolicy(RemoteConfig(port=port, **{**PATIENT, **settings}))
    policy.reset()
    return policy


def counting(question: dict[str, Any]) -> dict[str, Any]:
    """Ten actions whose first number is their place and whose second the step that was asked about, over 100."""
    if "observation/image" not in question:
        return robomme(question)
    actions = np.zeros((10, 7), np.float32)
    actions[:, 0] = np.arange(10) / 10
    actions[:, 1:3] = question["observation/image"][0, 0, :2] / 100
    return {"actions": actions}


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def frames_of(question: dict[str, Any]) -> list[int]:
    """Steps of the frames in a message to a buffer."""
    assert question["images"].shape[1:] == (1, SIDE, SIDE, 3)
    assert question["state"].shape == (len(question["images"]), 8)
    assert question["state"].dtype == np.float32
    return [int(step) for step in question["images"][:, 0, 0, 0, 0]]
