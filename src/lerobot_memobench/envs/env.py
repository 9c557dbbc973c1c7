"""The gymnasium environment: an `Episode` with observations, video and a line in the log."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from numpy.typing import ArrayLike, NDArray

from lerobot_memobench.constants import ACTION_DIM, EXECUTION, PROMPT, PROMPT_HORIZON, SEALED, SPLITS, UNSEEDED
from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.envs.episode_log import EpisodeLog, episode_record, has_log, not_run_record, read_lines
from lerobot_memobench.envs.evaluation_file import UNKNOWN_POLICY, Acting, facts_of
from lerobot_memobench.envs.observations import (
    METADATA,
    REWARDS,
    SPARSE,
    Observer,
    action_space,
    blank,
    observation_space,
)
from lerobot_memobench.envs.pacing import longest
from lerobot_memobench.envs.settings import AUTO, DEFAULTS, EVERY, RESET, STEPS, EnvSettings
from lerobot_memobench.envs.video import BAND, VideoRecorder
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.io import file_name
from lerobot_memobench.tasks.assessment import scene_and_variant
from lerobot_memobench.tasks.catalogue import get_task, load_task, suite_of, task_names
from lerobot_memobench.tasks.memory_text import memory_text, with_memory
from lerobot_memobench.tasks.task import Task

logger = logging.getLogger(__name__)


class MemobenchEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """One task of the benchmark.

    Observation: ``pixels/image`` and ``pixels/wrist_image`` uint8 (H, W, 3) upright, with ``convention=libero``
    ``pixels/image`` and ``pixels/image2`` mirrored left to right, or ``environment_state`` float32 (208,): the visible
    objects (`sim.object_layout`), or both; ``agent_pos`` float32 (8,): end-effector position (3, m), axis-angle (3,
    rad), fingers (2, m); ``phase`` (1,): 0 while the demonstration prompt plays and actions have no effect, 1 in
    execution; ``step`` (1,): control steps since the phase began, in the execution of a strict task `NO_CLOCK` or
    `ENDED`; optionally ``robot_state`` (`ROBOT_STATE`), ``expert_action`` (7,) and ``blind_action`` (7,). A strict task
    is held at the start of the execution and after each event (`Pacing.hold`); observations do not show it.

    Action: float32 (7,) in [−1, 1]: end-effector displacement (±5 cm, ±0.5 rad per unit), gripper (−1 opens, 1 closes).

    An invalid action, unstable physics, and a task that the simulator or the expert cannot run raise a
    `MemobenchError`. If episodes are logged, such an episode is truncated instead; its reason is in the log and in the
    info as ``fault``. A pickled copy keeps the settings and starts with `reset`.

    Args:
        task: name in the catalogue of either suite, or a task folder.
        settings: ``suite`` follows from the task; ``prompt_in=auto`` means `STEPS`. ``changes`` replace some by name.
        log_dir: folder of the episode log; None for no log.
        acting: description of the policy; episodes of other seeds than the requested ones are not logged or recorded.
        reward: `sparse`: 1 at success. `checkpoints`: 1 / (K + 1) for each of the K memory checkpoints completed in
            order, and 1 / (K + 1) at success, so the sum is at most 1 and reaches 1 only with success.
    """

    metadata = METADATA

    def __init__(
        self,
        task: str,
        settings: EnvSettings = DEFAULTS,
        *,
        log_dir: str | None = None,
        acting: Acting = UNKNOWN_POLICY,
        reward: str = SPARSE,
        render_mode: str = "rgb_array",
        **changes: Any,
    ) -> None:
        check_choice("reward", reward, REWARDS)
        self._task = load_task(task) if suite_of(task) is None else get_task(task)
        settings = settings.changed(**{**changes, "suite": self._task.suite})
        if settings.prompt_in == AUTO:
            settings = settings.changed(prompt_in=STEPS)
        self.settings, self.render_mode = settings, render_mode
        self._task = self._task.at(settings.difficulty)
        self.task = self._task.name
        if settings.needs_prompt and self._task.prompt is None:
            raise MemobenchError(
                f"{self.task} has no demonstration prompt, and corrupt= (at step 0), reshow= and interference= act on "
                "it; choose another task, or set corrupt_step="
            )
        if log_dir is not None:  # fail before the first episode
            file_name(self.task, "the name of a task")
        self._episode: Episode | None = None
        self._describe(0)
        self._reward = reward
        self._longest = longest(settings)
        self.observation_space = observation_space(settings, self._longest)
        self.action_space = action_space()
        self._acting = acting
        self._log_dir = Path(log_dir) if log_dir is not None else None
        self._log = None if log_dir is None else EpisodeLog(log_dir, facts_of(settings, acting))
        self._video: VideoRecorder | None = None
        self._observer = Observer(settings)
        self._others: Interference | None = None
        self._began = self._closed = False
        self._not_run: str | None = None
        self._warned: set[str] = set()

    def __getstate__(self) -> dict[str, Any]:
        # everything except the running episode, with its scene and generators
        return {**vars(self), "_episode": None, "_others": None, "_video": None, "_began": False}

    @property
    def episode(self) -> Episode:
        """The running episode; the first access in a process compiles its scene."""
        if self._episode is None:
            self._episode = Episode(self._task, self.settings)
        return self._episode

    @property
    def _shown(self) -> Episode:
        """The episode that is observed: the running one, or another one (`Interference`)."""
        return self.episode if self._others is None or self._others.shown is None else self._others.shown

    @property
    def _max_episode_steps(self) -> int:
        """Upper bound of steps for LeRobot's loop: the horizon with pauses, holds and prompt."""
        task, settings = self._task, self.settings
        if settings.prompt_in == RESET:
            return self._longest
        shown = (1 + settings.reshow) * (settings.demonstration_prompt and task.prompt is not None)
        longest_prompt = PROMPT_HORIZON if task.prompt_steps is None else task.prompt_steps
        return self._longest + shown * longest_prompt + settings.longest_interference

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start the episode of a seed; without a seed, of one drawn from `np_random` outside all splits.

        With ``prompt_in=reset`` the prompt plays here, and the first observation is the first execution frame.
        """
        super().reset(seed=seed)
        repeatable = seed is not None  # a drawn seed is not used again
        self._seed = seed = int(self.np_random.integers(*UNSEEDED)) if seed is None else int(seed)
        self._started = time.monotonic()
        self._began, self._closed, self._over, self._not_run = True, False, False, None
        self._discard_video()
        settings = self.settings
        self._number = number = seed - settings.seed_base
        scene, variant = scene_and_variant(self._task, number) if settings.evidence else (number, None)
        self._scene_seed = settings.seed_base + scene
        if self._scene_seed in SPLITS[SEALED] and settings.salt is None:
            _warn_of_sealed_seeds()
        with self._ending_episode():
            self.episode.reset(self._scene_seed, variant, keep_prompt=repeatable)
            if settings.interference:
                self._others = self._others or Interference(self._task, settings)
                self._others.begin(self._scene_seed)
        if self._not_run is not None:
            return blank(self.observation_space), self._info()
        self._describe(0)
        self._observer.begin(self.episode)
        recorded = (settings.videos == EVERY or 0 <= number < settings.videos) and self._acting.counts(seed)
        if self._log_dir is not None and recorded:
            self._video = VideoRecorder(self._log_dir / "videos" / f"{self.task}.{number}.mp4")
            self._video.add(self.render())
        with self._ending_episode():
            if settings.prompt_in == RESET and self.episode.phase == PROMPT:
                self._play_prompt()
        return self._observation(), self._info()

    def _play_prompt(self) -> None:
        self._observer.needed = False  # it is rendered for a video only
        if self._video is None:
            self.episode.skip_prompt_frames()
        while self.episode.phase == PROMPT:
            self.episode.step(np.zeros(ACTION_DIM, np.float32))
            self._observe()
        self._observer.needed = True

    def step(self, action: ArrayLike) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance by one control step of 50 ms.

        An episode terminates at success, when the goal of a strict task becomes unreachable, and in the authors'
        evaluation when all checkpoints have held. The horizon truncates it. A `MemobenchError` (see the class) is
        raised again at each step until the next reset.
        """
        self._check_began("step")
        if self._log is None and self._not_run is None and (fault := self.episode.fault) is not None:
            raise MemobenchError(f"the episode has ended ({fault.why}); begin another by reset()")
        if self._not_run is None:
            # As in a dataset, checkpoints of this step count from the next frame on.
            completed = self.episode.progress.index
            with self._ending_episode():
                if self._others is None or not self._others.step(self.episode):
                    self.episode.step(action)
        if self._not_run is not None:
            self._end()
            return blank(self.observation_space), 0.0, False, True, self._info()
        episode = self.episode
        if episode.fault is not None:
            if self._log is None:
                raise MemobenchError(episode.fault.why)
            self._warn(episode.fault.why)
        self._describe(completed)
        self._observe()
        if episode.done:
            self._end()
        ended = episode.success or episode.lost or episode.checkpoints_satisfied
        reward = float(episode.success)
        if self._reward != SPARSE:
            reward = (episode.progress.index - completed + reward) / (len(episode.task.checkpoints) + 1)
        return self._observation(), reward, ended, episode.done and not ended, self._info()

    def _observe(self) -> None:
        """Observe the current frame and add it to the video, which skips pauses."""
        filmed = self._video is not None and not self.episode.rested
        self._observer.observe(self._shown, recorded=filmed)
        if self._video is not None and filmed:
            self._video.add(self.render())

    def need_observation(self, needed: bool) -> None:
        """Set whether the policy reads the following frames, until the next reset or call; see `Observer`."""
        self._observer.needed = needed

    @contextmanager
    def _ending_episode(self) -> Iterator[None]:
        """End the episode with the reason of an error if it is logged, else raise the error."""
        try:
            yield
        except MemobenchError as error:
            if self._log is None:
                raise
            self._not_run = str(error)
            self._warn(self._not_run)

    def _warn(self, why: str) -> None:
        if why not in self._warned:
            self._warned.add(why)
            logger.warning("%s, episode %d: %s", self.task, self._number, why)

    def _check_began(self, call: str) -> None:
        if self._closed:
            raise ClosedEnvironmentError(f"Trying to call `{call}` on a closed environment; `reset` opens it again")
        if not self._began:
            raise ResetNeeded(f"Cannot call env.{call}() before calling env.reset()")

    def _end(self) -> None:
        if self._over:
            return
        self._over = True
        if self._video is not None and self._not_run is None:
            self._video.finish()
            self._video = None
        self._discard_video()
        if self._log is not None and self._acting.counts(self._seed):
            self._log.append(self.record())

    def _describe(self, completed: int) -> None:
        """Set the instruction, which LeRobot reads at every step; with oracle memory it ends with the memory text."""
        task = self._task if self._episode is None else self._shown.task
        self.task_description = task.language
        if self.settings.oracle_memory:
            self.task_description = with_memory(task.language, memory_text(task, completed))

    def scene_hash(self) -> str:
        """Return the hash of the physical state: equal for equal states."""
        self._check_began("scene_hash")
        return self.episode.sim.scene_hash()

    def record(self) -> dict[str, Any]:
        """Return the episode's line for the log."""
        self._check_began("record")
        if self._not_run is None:
            return episode_record(self.episode, self._number, time.monotonic() - self._started)
        variants = len(self._task.random_variants) if self.settings.evidence else None
        return not_run_record(self._task, self._number, self._scene_seed, self._not_run, variants)

    def _observation(self) -> dict[str, Any]:
        if self._not_run is not None:
            return blank(self.observation_space)
        episode, offered = self.episode, ("expert_action", "blind_action")
        observation: dict[str, Any] = {
            **self._observer.observation(),
            "agent_pos": self._shown.sim.proprio(),
            "phase": np.array([episode.phase], dtype=np.float32),
            "step": np.array([episode.clock], dtype=np.float32),
        }
        if self.settings.robot_state:
            observation["robot_state"] = self._shown.sim.robot_state()
        for name in [name for name in offered if getattr(self.settings, name)]:
            observation[name] = np.zeros(ACTION_DIM, np.float32)  # it stays if the expert cannot do the task
            with self._ending_episode():
                observation[name] = getattr(episode, name)()
        return observation

    def _info(self) -> dict[str, Any]:
        if self._not_run is not None:
            return {**_info_without_scene(False), "fault": self._not_run}
        episode = self.episode
        return {
            "is_success": episode.success,
            "phase": episode.phase,
            "checkpoints_completed": episode.progress.index,
            **({} if episode.fault is None else {"fault": episode.fault.why}),
            **({"corrupt": True} if episode.corrupts else {}),
        }

    def render(self) -> NDArray[np.uint8]:
        """Return both cameras side by side, under instruction and checkpoints."""
        self._check_began("render")
        return self._observer.frame(self._shown) if self._not_run is None else _black(self.settings)

    def close(self) -> None:
        """Release the scene; the next `reset` opens it again. Closing twice is allowed."""
        self._discard_video()
        self._episode = self._others = None
        self._began, self._closed = False, True

    def _discard_video(self) -> None:
        if self._video is not None:
            self._video.discard()
            self._video = None


class Interference:
    """Episodes of other tasks between prompt and execution, as further frames of the prompt phase.

    They are of the tasks with a prompt that follow the environment's task in its suite. The scripted expert acts in
    them; the policy observes. Its clock continues and its memory is not reset.
    """

    def __init__(self, task: Task, settings: EnvSettings) -> None:
        names = [name for name in task_names(suite=task.suite) if get_task(name).prompt is not None]
        first = names.index(task.name) + 1 if task.name in names else 0
        order = [name for name in (*names[first:], *names[:first]) if name != task.name]
        self._task = task
        self._names = [order[k % len(order)] for k in range(settings.interference)]
        self._settings = settings.changed(interference=0, evidence=False, pause_steps=0, speed=1.0)
        self._episodes: dict[str, Episode] = {}  # compiled scenes
        self.shown: Episode | None = None

    def begin(self, seed: int) -> None:
        """Begin with the episodes that follow the prompt of a seed's episode."""
        self._frames = self._play(seed)
        self.shown = None

    def step(self, main: Episode) -> bool:
        """Advance the shown episode by one control step; False if ``main`` itself has to advance."""
        if not main.waits:
            return False
        self.shown = next(self._frames, None)
        main.wait(last=self.shown is None)
        return True

    def _play(self, seed: int) -> Iterator[Episode]:
        # Scenes outside all splits.
        seeds = generator(self._task, seed, 6).integers(*UNSEEDED, size=len(self._names))
        for name, own_seed in zip(self._names, seeds.tolist(), strict=True):
            if name not in self._episodes:
                self._episodes[name] = Episode(get_task(name), self._settings)
            shown = self._episodes[name]
            shown.reset(own_seed)
            yield shown
            while not (shown.done or shown.expert_done):
                shown.step(np.zeros(ACTION_DIM, np.float32) if shown.phase == PROMPT else shown.expert_action())
                yield shown


class SkipLogged(gym.Wrapper[Any, Any, Any, Any]):
    """End logged episodes at their first step with the logged outcome, without simulation.

    Batch size and rows stay the same, so the policy acts in the other rows as in an uninterrupted evaluation.
    Observations of a skipped episode are blank.
    """

    def __init__(self, make: Callable[[], gym.Env[Any, Any]], log_dir: Path, settings: EnvSettings) -> None:
        super().__init__(make())
        self._log_dir, self._settings = log_dir, settings
        self._skipped: bool | None = None

    @cached_property
    def _successes(self) -> dict[int, bool]:
        # Read at the first reset: each process of a vector environment opens its own.
        lines, name = read_lines(self._log_dir) if has_log(self._log_dir) else [], self.get_wrapper_attr("task")
        return {line["episode"]: line["success"] for line in lines if line["task"] == name and "not_run" not in line}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the episode of a seed, or skip it."""
        self._skipped = None if seed is None else self._successes.get(seed - self._settings.seed_base)
        if self._skipped is None:
            return self.env.reset(seed=seed, options=options)
        return blank(self.observation_space), _info_without_scene(False)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance, or end with the logged outcome."""
        success = self._skipped
        if success is None:
            return self.env.step(action)
        return blank(self.observation_space), float(success), success, not success, _info_without_scene(success)

    def render(self) -> Any:
        """Return the environment's image; black for a skipped episode."""
        return self.env.render() if self._skipped is None else _black(self._settings)


def _info_without_scene(success: bool) -> dict[str, Any]:
    return {"is_success": success, "phase": EXECUTION, "checkpoints_completed": 0}


def _black(settings: EnvSettings) -> NDArray[np.uint8]:
    return np.zeros((BAND + settings.observation_height, 2 * settings.observation_width, 3), np.uint8)


@cache
def _warn_of_sealed_seeds() -> None:
    seeds = SPLITS[SEALED]
    logger.warning(
        "seeds %d to %d are sealed: run them once per release, by `memobench test-sealed`", seeds[0], seeds[-1]
    )
