"""Serve a LeRobot policy on openpi's websocket, to scripts that ask for π0 and to ``dialect=openpi``.

    python examples/openpi_server.py outputs/train/mine --port 8000

The server sends its metadata when a client connects. Each frame after it is an observation, each answer holds the next
chunk of actions (H, 7). ``prompt`` is the instruction; ``observation/NAME`` reaches the policy as ``observation.NAME``,
an image as ``observation.images.NAME``. A failure is answered by its traceback as text, and ends the connection.

The policy serves one client at a time, since it has one memory. A connection begins an episode. Within one,
``observation/step`` (control steps since the episode began) begins another where it goes down. A policy that remembers
needs it, and must be asked at every step that it remembers: at every eighth, by default, so with replan=8, 4, 2 or 1.

A policy of object state asks for `observation/environment_state`. Stock LIBERO observes none. A client in it sends its
simulator state instead, from which the server computes what both cameras see:

``simulator/task``
    name of the task
``simulator/state``
    (D,) ``sim.get_state().flatten()``
``simulator/fixtures``
    name -> position and quaternion (7,)
"""

from __future__ import annotations

import argparse
import threading
import traceback
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.constants import OBS_ENV_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from numpy.typing import NDArray
from websockets.sync.server import Server, ServerConnection, serve

from lerobot_memobench.policies.checkpoint import local_folder
from lerobot_memobench.policies.compatibility import trained_convention
from lerobot_memobench.policies.remote_connection import pack, unpack_message
from lerobot_memobench.sim.convention import STATED
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task

OBSERVATION, STEP, STATE = "observation/", "observation/step", "simulator/state"
FAILED = 1011
"""The websocket's code of a server that failed."""


class ServedPolicy:
    """A checkpoint that answers observations by chunks of actions.

    Args:
        checkpoint: a folder, a repository, or a policy of the package. device: torch's.

    Attributes:
        policy, before, after: the policy and its processors of LeRobot's.
    """

    def __init__(self, checkpoint: str, device: str = "cpu") -> None:
        register_third_party_plugins()
        folder = str(local_folder(checkpoint) or checkpoint)
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = device
        self.policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        override = {"device_processor": {"device": device}}
        self.before, self.after = make_pre_post_processors(config, folder, preprocessor_overrides=override)
        self._device = torch.device(device)
        self.metadata = {"policy": config.type, "checkpoint": checkpoint}
        if (convention := trained_convention(folder, config)[0]) is not None:
            self.metadata[STATED] = convention
        self.begin()

    def begin(self) -> None:
        """Forget the last episode."""
        self.policy.reset()
        self._step = -1

    def answer(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return the policy's actions (H, 7) for an observation."""
        if STEP in question:
            step = round(float(np.squeeze(question[STEP])))
            if step <= self._step:
                self.begin()
            self._step = step
        frame = {
            f"observation.{'images.' * (np.ndim(value) == 3)}{key.removeprefix(OBSERVATION)}": np.array(value)
            for key, value in question.items()
            if key.startswith(OBSERVATION)
        }
        if STATE in question:
            frame[OBS_ENV_STATE] = objects(question["simulator/task"], question[STATE], question["simulator/fixtures"])
        batch = self.before(prepare_observation_for_inference(frame, self._device, task=question["prompt"]))
        with torch.inference_mode():
            chunk = self.after(self.policy.predict_action_chunk(batch))
        return {"actions": chunk[0].float().cpu().numpy()}


def objects(task: str, state: NDArray[np.float64], fixtures: dict[str, NDArray[np.float64]]) -> NDArray[np.float32]:
    """Return the object state (208,) of a simulator state of stock LIBERO."""
    sim, slots = scene(task)
    sim.set_state(state, fixtures)
    return slots.observe()


@lru_cache(maxsize=1)
def scene(task: str) -> tuple[Simulation, ObjectSlots]:
    """Return a task's scene in the paper's world; the last one stays."""
    sim = Simulation(get_task(task))
    return sim, ObjectSlots(sim)


def make_server(policy: ServedPolicy, host: str, port: int) -> Server:
    """Return a server that listens; ``serve_forever`` answers."""
    turn = threading.Lock()

    def talk(connection: ServerConnection) -> None:
        with turn:
            policy.begin()
            connection.send(pack(policy.metadata))
            for frame in connection:
                try:
                    assert isinstance(frame, bytes), "openpi's questions are binary frames"
                    answer = pack(policy.answer(unpack_message(frame)))
                except Exception:
                    connection.send(traceback.format_exc())
                    connection.close(FAILED)
                    raise
                connection.send(answer)

    return serve(talk, host, port, compression=None, max_size=None)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="a folder, a repository, or a policy of the package")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    asked = parser.parse_args()
    make_server(ServedPolicy(asked.checkpoint, asked.device), asked.host, asked.port).serve_forever()
