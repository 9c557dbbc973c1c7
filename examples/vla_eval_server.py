"""Serve a LeRobot policy with a memory to vla-evaluation-harness, and to ``dialect=vla_eval``.

    python examples/vla_eval_server.py memobench_strict --detector package --port 8000

The harness's own LeRobot server knows no demonstration prompts. This one hands them to the policy frame by frame, as
``lerobot-eval`` does: `observation.phase` is 0 in the prompt and 1 in the execution, `observation.step` counts the
control steps of each. In strict tasks the scene may rest in between: these frames look like the execution's first, and
are not sent.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.import_utils import register_third_party_plugins
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.lerobot import LeRobotModelServer
from vla_eval.model_servers.serve import serve
from vla_eval.specs import (
    GRIPPER_CLOSE_POS,
    IMAGE_RGB,
    LANGUAGE,
    POSITION_DELTA,
    ROTATION_AA,
    STATE_EEF_POS_AA_GRIP,
    DimSpec,
)

from lerobot_memobench.constants import EXECUTION, PROMPT
from lerobot_memobench.policies.checkpoint import local_folder
from lerobot_memobench.policies.compatibility import trained_convention
from lerobot_memobench.sim.convention import CONVENTIONS, STATED, UPRIGHT

CAMERAS = {"agentview": "image", "wrist": "wrist_image"}


class MemoryPolicyServer(LeRobotModelServer):
    """A policy that is offered every control step, of one episode at a time: it has one memory.

    Args:
        checkpoint: the policy's folder or repository. policy_type: of it.
        device, policy_kwargs: as of `LeRobotModelServer`.
    """

    def __init__(self, checkpoint: str, policy_type: str = "memobench_mem", **settings: Any) -> None:
        register_third_party_plugins()
        self._convention = trained_convention(checkpoint, PreTrainedConfig.from_pretrained(checkpoint))[0]
        names = CONVENTIONS[self._convention or UPRIGHT]
        self._keys = {theirs: f"observation.images.{names[ours]}" for theirs, ours in CAMERAS.items()}
        super().__init__(policy_type, checkpoint, self._keys, use_select_action=True, **settings)
        self._episode = ""

    def get_observation_params(self) -> dict[str, Any]:
        """Return the inputs that it needs, and the convention of images that its policy was trained on, if known."""
        stated = {} if self._convention is None else {STATED: self._convention}
        return {**super().get_observation_params(), **stated}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Return the conventions of an action, which are those of our demonstrations."""
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Return the conventions of the inputs."""
        return {**dict.fromkeys(CAMERAS, IMAGE_RGB), "state": STATE_EEF_POS_AA_GRIP, "language": LANGUAGE}

    def predict(self, obs: dict[str, Any], ctx: SessionContext) -> dict[str, Any]:
        """Return the action (7,) for an observation; the first one of an episode may hold its prompt."""
        now = int(obs["step"][0]) if "step" in obs else ctx.step
        if ctx.is_first:
            self._episode = ctx.episode_id
            self._policy.reset()
            frames = list(zip(obs.get("video_history", ()), obs.get("wrist_video_history", ()), strict=True))
            for step, (image, wrist) in enumerate(frames):
                images = {"agentview": image, "wrist": wrist}
                self._act({**obs, "images": images, "states": obs["state_history"][step]}, PROMPT, step)
        if ctx.episode_id != self._episode:
            raise RuntimeError("this server has one memory, and another episode has begun; use one environment")
        return {"actions": self._act(obs, EXECUTION, now)}

    def _act(self, obs: dict[str, Any], phase: int, step: int) -> np.ndarray:
        frame = {key: np.asarray(obs["images"][name]) for name, key in self._keys.items()}
        frame["observation.state"] = np.asarray(obs["states"], np.float32)
        frame |= {f"observation.{key}": np.array([now], np.float32) for key, now in (("phase", phase), ("step", step))}
        frame = self._preprocess(prepare_observation_for_inference(frame, self._device, task=obs["task_description"]))
        with torch.inference_mode():
            action = self._postprocess(self._policy.select_action(frame))
        return action.squeeze(0).cpu().numpy()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="a folder, a repository, or a policy of the package")
    parser.add_argument("--detector", help="with a policy that reads objects: package, or a detector's file")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    asked = parser.parse_args()
    folder = str(local_folder(asked.checkpoint) or asked.checkpoint)
    changed = {} if asked.detector is None else {"detector": asked.detector}
    serve(MemoryPolicyServer(folder, device=asked.device, policy_kwargs=changed), asked.host, asked.port)
