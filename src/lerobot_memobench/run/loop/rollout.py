"""LeRobot's loop over control steps, in which pictures are drawn and converted only for a policy that looks at them.

It takes the same steps in the same order as ``lerobot_eval.rollout`` and returns the same tensors, and records what a
dataset is asked for of (`recording`). Between two looks a
policy is handed the pictures and objects that it saw last, which it has said it will not read; everything else of an
observation is of the present.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.envs import check_env_attributes_and_types, preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION, OBS_IMAGES
from numpy.typing import NDArray
from tqdm import trange

from lerobot_memobench.jobs.threads import limit_torch
from lerobot_memobench.run.loop.looking import looking
from lerobot_memobench.run.loop.recording import Recorder

PIXELS, PHASE = "pixels", "phase"
"""Of an observation: what is left out when nobody looks; 0 while the prompt plays, 1 in execution."""
KEEPS_FRAMES = ("return_observations", "render_callback", "predicted_latents_callback")
"""Settings of LeRobot's rollout that make use of every frame, or of what only its own loop does."""
RECORDS = ("recording_dir", "env_features", "recording_repo_id", "recording_private")
"""Settings by which a rollout is recorded as a dataset; see `recording`."""

Processor = Callable[[Any], Any]


class Eyes:
    """The observations of a rollout as its policy gets them.

    Args:
        env: the vector environment, told by ``watch`` whether its next frames are seen.
        looks: tells, after an action, whether the policy looks at the next observation.
    """

    def __init__(self, env: Any, looks: Callable[[], bool]) -> None:
        self._env, self._looks = env, looks
        self._watched = True  # since the environment's reset
        self._pictures: dict[str, torch.Tensor] = {}
        self._phase: NDArray[np.float32] | None = None

    def announce(self) -> None:
        """Tell the environment, before its step, whether anybody looks at what comes of it."""
        looks = self._looks()
        if looks != self._watched:
            self._env.call("watch", looks)
            self._watched = looks

    def see(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return LeRobot's form of an observation, with the pictures seen last where nobody looks."""
        begins = self._phase is None or bool((observation[PHASE] != self._phase).any())
        self._phase = np.array(observation[PHASE])
        if begins or self._watched:  # the first frame of an execution is seen by all: none can know when it comes
            seen = preprocess_observation(observation)
            self._pictures = {key: value for key, value in seen.items() if key.startswith(OBS_IMAGES)}
            return seen
        seen = preprocess_observation({key: value for key, value in observation.items() if key != PIXELS})
        return {**self._pictures, **seen}


def sparing(
    rollout: Callable[..., dict[str, Any]], hides_progress: Callable[[], bool]
) -> Callable[..., dict[str, Any]]:
    """Wrap LeRobot's rollout: where nothing but the policy sees the frames, only those that it looks at are drawn.

    Args:
        hides_progress: whether the bar over a rollout's steps is left out.
    """

    @functools.wraps(rollout)
    def run(env: Any, policy: Any, *args: Any, **settings: Any) -> dict[str, Any]:
        limit_torch(sum(parameter.numel() for parameter in getattr(policy, "parameters", tuple)()))
        if args or any(settings.get(name) for name in KEEPS_FRAMES):
            return rollout(env, policy, *args, **settings)
        return _roll(env, policy, settings, quiet=hides_progress())

    return run


def _roll(env: Any, policy: Any, settings: dict[str, Any], quiet: bool) -> dict[str, Any]:
    """Run one episode in each environment of a batch; see LeRobot's rollout for what is returned."""
    policy.reset()
    observation, _ = env.reset(seed=settings.get("seeds"), options={NEW_ROLLOUT_OPTION: True})
    limit = env.call("_max_episode_steps")[0]
    check_env_attributes_and_types(env)
    done = ever = np.zeros(env.num_envs, bool)
    steps: list[tuple[NDArray[Any], ...]] = []
    bar = trange(limit, desc=f"Running rollout with at most {limit} steps", disable=quiet, leave=False)
    with bar, _recorder(env, settings) as recorder:
        eyes = Eyes(env, looking(policy) if recorder is None else lambda: True)
        while not done.all() and len(steps) < limit:
            before, seen = observation, eyes.see(observation)
            action = _act(env, policy, settings, seen)
            eyes.announce()
            observation, reward, terminated, truncated, info = env.step(action)
            success = _successes(info, env.num_envs)
            done = terminated | truncated | done | (len(steps) + 1 == limit)
            ever = ever | success
            if recorder is not None:
                broken = np.broadcast_to(info.get("_fault", False), done.shape)  # gymnasium's mark of rows that tell it
                recorder.add(before, action, reward, success, done, seen["task"], broken)
            steps.append((action, reward, success, done))
            bar.set_postfix({"running_success_rate": f"{ever.mean() * 100:.1f}%"}, refresh=False)
            bar.update()
    if hasattr(policy, "use_original_modules"):
        policy.use_original_modules()
    stacked = (torch.from_numpy(np.stack(parts, axis=1)) for parts in zip(*steps, strict=True))
    return dict(zip((ACTION, "reward", "success", "done"), stacked, strict=True))


@contextmanager
def _recorder(env: Any, settings: Mapping[str, Any]) -> Iterator[Recorder | None]:
    """Yield what records the batch, None where nothing does; what it has recorded is whole when this ends."""
    folder, features, repository, private = (settings.get(name) for name in RECORDS)
    if folder is None or features is None:
        yield None
        return
    fps = env.unwrapped.metadata["render_fps"]
    recorder = Recorder(Path(folder), features, env.num_envs, fps, repository, bool(private))
    try:
        yield recorder
    finally:
        recorder.close()


def _act(env: Any, policy: Any, through: Mapping[str, Processor], seen: dict[str, Any]) -> NDArray[np.float32]:
    """Return the actions (batch, A) of a policy for an observation, both ``through`` the processors of each."""
    seen["task"] = list(env.call("task_description"))
    batch = through["preprocessor"](through["env_preprocessor"](seen))
    with torch.inference_mode():
        action = policy.select_action(batch)
    action = through["env_postprocessor"]({ACTION: through["postprocessor"](action)})[ACTION]
    found: NDArray[np.float32] = action.to("cpu").numpy()
    return found


def _successes(info: dict[str, Any], rows: int) -> NDArray[np.bool_]:
    """Return which rows' goals hold (rows,)."""
    told = info.get("final_info", info).get("is_success", False)
    return np.broadcast_to(np.asarray(told, bool), rows)
