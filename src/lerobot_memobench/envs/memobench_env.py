"""The gym environment that LeRobot steps: an `Episode`, its observations, its line in the log."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import HORIZON, PROMPT_LIMIT, Episode
from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.envs.episode_record import episode_record
from lerobot_memobench.envs.film import Film
from lerobot_memobench.envs.obs_types import PIXELS
from lerobot_memobench.envs.observations import (
    ACTION_DIM,
    IMAGE_SIZE,
    METADATA,
    PROMPT,
    action_space,
    observation_space,
)
from lerobot_memobench.envs.prompting import RESET, STEPS
from lerobot_memobench.envs.protocol import SEED_BASE
from lerobot_memobench.envs.sight import Sight
from lerobot_memobench.files import file_name
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.tasks.loading import load_task
from lerobot_memobench.tasks.memory_text import memory_text, with_memory
from lerobot_memobench.tasks.task import PUBLISHED, referent_told


class MemobenchEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """One task of the benchmark.

    Observation: ``pixels/image`` and ``pixels/wrist_image`` uint8 (256, 256, 3) upright, or ``environment_state``
    float32 (208,): the visible objects (`sim.object_layout`), or both; ``agent_pos`` float32 (8,): end-effector
    position (3, m), axis-angle (3, rad), fingers (2, m); ``phase`` (1,): 0 while the prompt video plays and actions
    have no effect, 1 in execution; ``step`` (1,): control steps since the phase began; on request ``expert_action``
    (7,), ``blind_action`` (7,).

    Action: float32 (7,) in [−1, 1]: end-effector displacement (±5 cm, ±0.5 rad per unit), gripper (−1 opens, 1 closes).

    Args:
        folder: the task's folder.
        log_dir: where finished episodes are logged; nowhere when None.
        others: see `MemobenchEnvConfig`.
    """

    metadata = METADATA

    def __init__(
        self,
        folder: str,
        *,
        log_dir: str | None = None,
        obs_type: str = PIXELS,
        suite: str = PUBLISHED,
        referent: str = "fixed",
        prompt_video: bool = True,
        prompt_in: str = STEPS,
        horizon: int = HORIZON,
        render: str = "default",
        render_every: int = 1,
        replan_steps: int | None = None,
        expert_action: bool = False,
        blind_action: bool = False,
        oracle_memory: bool = False,
        films: int | None = None,
        videos: bool = False,
        seed_base: int = SEED_BASE,
    ) -> None:
        self.render_mode = "rgb_array"
        self._task = load_task(folder)
        self.task = self._task.name
        if log_dir is not None:  # now, not when the first episode has been simulated
            file_name(self.task, "the name of a task")
        self._episode: Episode | None = None
        self._oracle_memory = oracle_memory
        self._describe(0)
        self.observation_space = observation_space(expert_action, render_every, obs_type, blind_action)
        self.action_space = action_space()
        protocol = {
            "suite": suite,
            "seed_base": seed_base,
            "obs_type": obs_type,
            "referent": referent_told(referent, self._task.drawn),
            "prompt_video": prompt_video,
            "prompt_in": prompt_in,
            "horizon": horizon,
            "replan_steps": replan_steps,
            "render": render,
            "render_every": render_every,
            "oracle_memory": oracle_memory,
        }
        self._log = EpisodeLog(log_dir, protocol) if log_dir is not None else None
        self._videos = Path(log_dir) / "videos" if log_dir is not None else None
        self._filmed = range(films or 0)
        self._films_all = videos
        self._film: Film | None = None
        self._sight = Sight(obs_type, render_every)
        self._settings: dict[str, Any] = {
            "referent": referent,
            "prompt_video": prompt_video,
            "horizon": horizon,
            "render": RenderSettings(IMAGE_SIZE, IMAGE_SIZE, render),
        }
        self._prompt_in = prompt_in
        self._replan_steps = replan_steps
        self._expert_action, self._blind_action, self._seed_base = expert_action, blind_action, seed_base
        self._next_seed = seed_base

    @property
    def episode(self) -> Episode:
        """The running episode; its scene is compiled and its GL context opened in the process that first asks."""
        if self._episode is None:
            self._episode = Episode(self._task, **self._settings)
        return self._episode

    @property
    def _max_episode_steps(self) -> int:
        """Upper bound for LeRobot's loop: what it steps through. The horizon itself counts execution steps."""
        prompt = self._settings["prompt_video"] and self._task.prompt is not None and self._prompt_in == STEPS
        return int(self._settings["horizon"]) + (PROMPT_LIMIT if prompt else 0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start the episode of a seed; without one, of the seed after the last.

        With the prompt played in here (`prompt_in`), the first observation is that of the first execution frame.
        """
        super().reset(seed=seed)
        seed = self._next_seed if seed is None else int(seed)
        self._next_seed = seed + 1
        self._started = time.monotonic()
        self._over = False
        self.episode.reset(seed)
        self._describe(0)
        self._sight.begin(self.episode)
        self._discard_film()
        number = seed - self._seed_base
        if self._videos is not None and (self._films_all or number in self._filmed):
            self._film = Film(self._videos / f"{self.task}.{number}.mp4", METADATA["render_fps"])
            self._film.add(self.render())
        if self._prompt_in == RESET and self.episode.phase == PROMPT:
            self._play_prompt()
        return self._observation(), self._info()

    def _play_prompt(self) -> None:
        """Let the prompt run to its end, where the scene is restored; only a film watches it."""
        self._sight.watched = False
        while self.episode.phase == PROMPT:
            self.episode.step(np.zeros(ACTION_DIM, np.float32))
            self._see()
        self._sight.watched = True

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance by one control step of 50 ms. The reward is 1 at success, else 0.

        An episode terminates by success and, of a strict task, by the loss of its goal; the horizon truncates it.
        """
        episode = self.episode
        # A dataset's labels count what was completed before a frame; what this step completes is told one frame later.
        completed = episode.progress.index
        episode.step(np.asarray(action, dtype=np.float32))
        self._describe(completed)
        self._see()
        if episode.done and not self._over:
            self._end()
        success, ended = episode.success, episode.success or episode.lost
        return self._observation(), float(success), ended, episode.done and not ended, self._info()

    def _see(self) -> None:
        """Look at the present frame, and film it where the episode is filmed."""
        self._sight.look(self.episode, filmed=self._film is not None)
        if self._film is not None:
            self._film.add(self.render())

    def watch(self, watched: bool) -> None:
        """Say whether somebody looks at the frames that follow, until the next reset or another word; see `Sight`."""
        self._sight.watched = watched

    def _end(self) -> None:
        """Close the books of an episode that has just ended."""
        self._over = True
        if self._film is not None:
            self._film.finish()
            self._film = None
        if self._log is not None:
            self._log.append(self.record())

    def _describe(self, completed: int) -> None:
        """Set the instruction, which LeRobot asks for at every step; the oracle's has the memory text behind it."""
        task = self._task if self._episode is None else self._episode.task
        self.task_description = task.language
        if self._oracle_memory:
            self.task_description = with_memory(task.language, memory_text(task, completed))

    def scene_hash(self) -> str:
        """Return the hash of the present scene: equal in two environments when all of their physics is."""
        return self.episode.sim.scene_hash()

    def record(self) -> dict[str, Any]:
        """Return the episode's line for the log."""
        return episode_record(
            self.episode,
            seed_base=self._seed_base,
            replan_steps=self._replan_steps,
            wall_s=time.monotonic() - self._started,
        )

    def _observation(self) -> dict[str, Any]:
        episode = self.episode
        observation: dict[str, Any] = {
            **self._sight.observed(),
            "agent_pos": episode.sim.proprio(),
            "phase": np.array([episode.phase], dtype=np.float32),
            "step": np.array([episode.clock], dtype=np.float32),
        }
        if self._expert_action:
            observation["expert_action"] = episode.expert_action()
        if self._blind_action:
            observation["blind_action"] = episode.blind_action()
        return observation

    def _info(self) -> dict[str, Any]:
        episode = self.episode
        return {
            "is_success": episode.success,
            "phase": episode.phase,
            "checkpoints_completed": episode.progress.index,
        }

    def render(self) -> NDArray[np.uint8]:
        """Return both cameras side by side under what is being remembered and done; see `Sight.frame`."""
        return self._sight.frame(self.episode)

    def close(self) -> None:
        """Let the scene go; the next reset compiles or fetches it anew."""
        self._discard_film()
        self._episode = None

    def _discard_film(self) -> None:
        if self._film is not None:
            self._film.discard()
            self._film = None
