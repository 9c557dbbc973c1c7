"""The benchmark for vla-evaluation-harness (vla-eval): ``lerobot_memobench.vla_eval:MEMOBench`` in its YAML.

It evaluates the harness's model servers with the tasks, seeds and protocol of this benchmark. Only vla-eval imports
this module.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import ACTION_DIM, CAMERAS, EVALUATION_SEED, LIBERO, PROMPT, SEALED, SPLITS, WORLD
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.evaluation_file import Acting, check_facts, facts_of
from lerobot_memobench.envs.lerobot import UNKNOWN_PLAN, MemobenchEnvConfig, check_loop
from lerobot_memobench.envs.observations import PIXEL_INPUT
from lerobot_memobench.envs.pacing import longest
from lerobot_memobench.envs.settings import RESET, STEPS, EnvSettings
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.evaluation.metrics import PROCESS_METRICS, rollout_value
from lerobot_memobench.sim.convention import CONVENTIONS, STATED
from lerobot_memobench.tasks.catalogue import NUM_STATES
from lerobot_memobench.tasks.task import LIBERO_SUITES, STRICT

try:
    from vla_eval import specs
    from vla_eval.benchmarks.base import StepBenchmark, StepResult
except ImportError as error:
    raise MemobenchError(
        f"vla-evaluation-harness is not installed here ({error}): pip install 'vla-eval>=0.8,<0.9'"
    ) from error

logger = logging.getLogger(__name__)

NAMES = {"image": ("agentview", "video_history"), "wrist_image": ("wrist", "wrist_video_history")}
"""Camera -> the harness's names of its image and of its video of the demonstration prompt."""
DECIDED = {"seed_base": "seed", "prompt_in": "send_video_history", "obs_type": "send_state and send_wrist_image"}
"""Setting of `EnvSettings` -> the argument that determines it."""


class MEMOBench(StepBenchmark):
    """The tasks of one suite; episode i of each task has the scene of seed ``seed`` + i.

    Observation: ``images`` with ``agentview`` and ``wrist`` uint8 (H, W, 3); ``states`` float32 (8,): end-effector
    position (3, m), axis-angle (3, rad), fingers (2, m); ``task_description``; ``step`` float32 (1,) and, with
    ``robot_state=True``, ``robot_state`` of `MemobenchEnv`. The first observation of an episode with a demonstration
    prompt also contains ``video_history`` and ``wrist_video_history``, lists of images, ``state_history``, a list of
    states, and ``episode_restart``. Frames of the rest between prompt and execution equal it and are omitted.

    Action: ``actions`` float (7,) or (steps, 7) in [−1, 1], as of `MemobenchEnv`.

    Result: ``success``, and ``MSR``, ``MUR``, ``MCR``: the share of satisfied memory checkpoints of each operation. A
    task without checkpoints of an operation omits the metric, and the harness averages over the other tasks.

    Args:
        tasks: `all`, memory types, task names or numbers, separated by commas or as a list.
        seed: seed of episode 0.
        history_every: interval of the sent frames of the prompt, control steps.
        n_action_steps: actions executed per answer, open-loop.
        replan_steps: actions per plan of the server, which may answer one action and queue the rest (its
            ``chunk_size``); default ``n_action_steps``. Strict tasks need it, because holds are longer than a plan.
        send_wrist_image: whether the wrist camera is sent. The harness sets this, the next two and
            ``trained_convention`` from the hello message of a model server.
        send_state: whether the arm's state is sent.
        send_video_history: whether the demonstration prompt is sent.
        log_dir: folder of the episode log for ``memobench report``; None for no log.
        label: name of the model server's policy in the log.
        trained_convention: of the images that the server's policy was trained on: the ``convention``, or refused.
        settings: other fields of `EnvSettings`, such as ``suite``, ``referent``, ``horizon``, ``evidence`` or
            ``convention`` (``libero``: mirrored as the harness does for LIBERO). If the harness's ``max_steps`` is
            lower than the horizon, it ends episodes without a log line.
    """

    _ALL_RECORD_FIELDS = frozenset({"reward", "success", "checkpoints_completed", "action", "state"})
    render_backends = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Return no variables: the CPU renders in each mode."""
        return {}

    def __init__(
        self,
        tasks: str | int | Sequence[str | int] = "all",
        *,
        seed: int = EVALUATION_SEED,
        history_every: int = 1,
        n_action_steps: int = 1,
        replan_steps: int | None = None,
        send_wrist_image: bool = True,
        send_state: bool = True,
        send_video_history: bool = True,
        log_dir: str | None = None,
        label: str | None = None,
        trained_convention: str | None = None,
        **settings: Any,
    ) -> None:
        super().__init__()
        for name, number in {"seed": seed, "history_every": history_every, "n_action_steps": n_action_steps}.items():
            least = int(name != "seed")
            if type(number) is not int or number < least:
                raise MemobenchError(f"{name} is {number!r}; expected a whole number from {least} on")
        if seed in SPLITS[SEALED]:
            raise MemobenchError(
                f"seed {seed} belongs to the sealed test; run it by `memobench test-sealed policy=memobench_remote "
                "dialect=vla_eval`"
            )
        if trained_convention is not None:
            check_choice(STATED, trained_convention, [*CONVENTIONS])
            if (convention := settings.setdefault("convention", trained_convention)) != trained_convention:
                raise MemobenchError(
                    f"the model server expects images of convention={trained_convention}, and found convention="
                    f"{convention}; leave it out"
                )
        planned, prompt_in = replan_steps or n_action_steps, STEPS if send_video_history else RESET
        for name in DECIDED.keys() & settings.keys():
            raise MemobenchError(f"{name} is {settings[name]!r}, but follows from other arguments; set {DECIDED[name]}")
        self._settings = EnvSettings().changed(**settings, seed_base=seed, replan_steps=planned, prompt_in=prompt_in)
        if self._settings.suite == STRICT and replan_steps is None and n_action_steps == 1:
            raise MemobenchError(UNKNOWN_PLAN.format("replan_steps"))
        if planned % n_action_steps:
            raise MemobenchError(f"replan_steps is {planned}; expected a multiple of n_action_steps={n_action_steps}")
        check_loop(self._settings)
        chosen = str(tasks) if isinstance(tasks, str | int) else ",".join(map(str, tasks))
        selected = MemobenchEnvConfig(tasks=chosen, **asdict(self._settings)).selected()
        self._tasks = {folder.name: (memory_type, folder) for memory_type, _, folder in selected}
        self._cameras = [name for name in CAMERAS if send_wrist_image or name != "wrist_image"]
        self._send_state = send_state
        self._history_every, self._n_action_steps = history_every, n_action_steps
        self._log_dir = log_dir
        policy = {} if label is None else {"type": "vla_eval", "identity": f"vla_eval {label}"}
        self._acting = Acting(policy, PIXEL_INPUT)
        if log_dir is not None:  # fail before the first episode
            check_facts(Path(log_dir), facts_of(self._settings, self._acting))
        self._env: MemobenchEnv | None = None
        self._history: dict[str, list[NDArray[Any]]] = {}

    def get_tasks(self) -> list[dict[str, Any]]:
        """Return the chosen tasks; a suite of the harness is a memory type, or one of LIBERO's, as in LeRobot."""
        return [{"name": name, "suite": memory_type} for name, (memory_type, _) in self._tasks.items()]

    def reset(self, task: dict[str, Any]) -> dict[str, Any]:
        """Start the episode ``task["episode_idx"]``, play its prompt and return the first execution frame."""
        if self._env is None or self._env.task != task["name"]:
            self.cleanup()
            folder = str(self._tasks[task["name"]][1])
            self._env = MemobenchEnv(folder, self._settings, log_dir=self._log_dir, acting=self._acting)
        number = int(task.get("episode_idx", 0))
        if self._settings.suite in LIBERO_SUITES and number >= NUM_STATES:
            raise MemobenchError(
                f"{task['name']} has no initial state {number}; set episodes_per_task to {NUM_STATES} or less"
            )
        observation, info = self._env.reset(seed=self._settings.seed_base + number)
        self._history = {}
        while "fault" not in info and observation["phase"][0] == PROMPT:
            step, shows = int(observation["step"][0]), not self._env.episode.idling
            if shows and step % self._history_every == 0:
                for name in self._cameras:
                    self._history.setdefault(NAMES[name][1], []).append(self._image(observation, name))
                if self._send_state:
                    self._history.setdefault("state_history", []).append(observation["agent_pos"])
            self._env.need_observation(shows and (step + 1) % self._history_every == 0)
            observation, *_, info = self._env.step(np.zeros(ACTION_DIM, np.float32))
        if "fault" in info:
            self._env.step(np.zeros(ACTION_DIM, np.float32))  # writes the log line
            raise MemobenchError(info["fault"])
        self._env.need_observation(True)
        self._recorder.record_video(_video_frame(observation))
        return observation

    def step(self, action: dict[str, Any]) -> StepResult:
        """Execute the first actions of an answer, or fewer if the episode ends."""
        env, actions = self._running(), _actions(action)
        if len(actions) < self._n_action_steps:
            raise MemobenchError(
                f"the model server returned {len(actions)} actions, fewer than n_action_steps={self._n_action_steps}; "
                f"set n_action_steps to {len(actions)} or less"
            )
        for command in actions[: self._n_action_steps]:
            observation, reward, terminated, truncated, info = env.step(command)
            done = terminated or truncated
            self._recorder.record_video(_video_frame(observation))
            self._recorder.record_step(
                reward=reward,
                success=info["is_success"],
                checkpoints_completed=info["checkpoints_completed"],
                action=command,
                state=observation["agent_pos"],
            )
            if done:
                break
        return StepResult(obs=observation, reward=reward, done=done, info=info)

    def make_obs(self, raw_obs: dict[str, Any], task: dict[str, Any]) -> dict[str, Any]:
        """Return the observation to send; the first one contains the prompt."""
        sent: dict[str, Any] = {
            "images": {NAMES[name][0]: self._image(raw_obs, name) for name in self._cameras},
            "task_description": self._running().task_description,
            "step": raw_obs["step"],
        }
        if self._send_state:
            sent["states"] = raw_obs["agent_pos"]
        if self._settings.robot_state:
            sent["robot_state"] = raw_obs["robot_state"]
        if self._history:
            sent |= {**self._history, "episode_restart": True}
            self._history = {}
        return sent

    def _image(self, observation: dict[str, Any], name: str) -> NDArray[np.uint8]:
        image: NDArray[np.uint8] = observation["pixels"][self._settings.images[name]]
        return image

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Return success and the episode's MSR, MUR and MCR; see the class."""
        env = self._running()
        if not step_result.done:
            logger.warning("%s: max_steps ended an episode, which is not logged; set horizon instead", env.task)
        record = env.record()
        values = {metric: rollout_value(record, metric) for metric in PROCESS_METRICS}
        measured = {metric: value for metric, value in values.items() if value is not None}
        return {"success": record["success"], **measured, "failure": record["failure"]}

    def get_metric_keys(self) -> dict[str, str]:
        """Return the metrics that the harness averages over episodes."""
        process = () if self._settings.suite in LIBERO_SUITES else PROCESS_METRICS
        return dict.fromkeys(("success", *process), "mean")

    def get_metadata(self) -> dict[str, Any]:
        """Return the maximum number of steps (horizon and pauses), suite, source of the scenes, and rules."""
        own = self._settings
        return {"max_steps": longest(own), "suite": own.suite, WORLD: LIBERO, "rules": own.rules}

    def get_action_spec(self) -> dict[str, specs.DimSpec]:
        """Return the conventions of an action."""
        return {"position": specs.POSITION_DELTA, "rotation": specs.ROTATION_AA, "gripper": specs.GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, specs.DimSpec]:
        """Return the conventions of the observation."""
        spec = {NAMES[name][0]: specs.IMAGE_RGB for name in self._cameras} | {"language": specs.LANGUAGE}
        return spec | ({"state": specs.STATE_EEF_POS_AA_GRIP} if self._send_state else {})

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """Return the action of a real-time tick without an answer: no motion, and the last gripper command."""
        hold = np.zeros(ACTION_DIM, np.float32)
        # At first the gripper opens.
        hold[-1] = -1.0 if last_action is None else _actions(last_action)[-1, -1]
        return {"actions": hold}

    def _running(self) -> MemobenchEnv:
        if self._env is None:
            raise MemobenchError("no episode is running; call start_episode with one of get_tasks()")
        return self._env

    def cleanup(self) -> None:
        """Release the scene."""
        if self._env is not None:
            self._env.close()
            self._env = None


def _actions(answer: dict[str, Any]) -> NDArray[np.float32]:
    """Return the actions of a model server's answer, (steps, 7)."""
    values: Any = answer.get("actions", answer.get("action"))
    try:
        actions = np.array(values, dtype=np.float32, ndmin=2)
    except (TypeError, ValueError):
        actions = np.empty((0, 0), np.float32)
    if actions.ndim != 2 or actions.shape[1] != ACTION_DIM or not len(actions):
        raise MemobenchError(
            f"the model server returned actions of shape {np.shape(values)}; expected numbers of shape ({ACTION_DIM},) "
            f"or (steps, {ACTION_DIM}): end-effector displacement (6) and gripper (1)"
        )
    return actions


def _video_frame(observation: dict[str, Any]) -> NDArray[np.uint8]:
    return np.concatenate([*observation["pixels"].values()], axis=1)
