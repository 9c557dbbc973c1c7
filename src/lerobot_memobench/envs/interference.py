"""Episodes of other tasks between prompt and execution (``interference``), as further frames of the prompt phase.

The scripted expert acts in them; the policy observes. Its clock continues and its memory is not reset.
"""

from __future__ import annotations

import numpy as np

from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.protocol import ACTION_DIM, PROMPT, UNSEEDED
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import Task


class Interference:
    """The other episodes of one task's environment: of the tasks with a prompt that follow it in its suite.

    Args:
        task: task of the environment. settings: of the environment.
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
        """Draw the scenes of an episode, outside all splits."""
        self._seeds = generator(self._task, seed, 6).integers(*UNSEEDED, size=len(self._names))
        self._done = 0
        self.shown = None

    def step(self, main: Episode) -> bool:
        """Advance the shown episode by one control step; False if ``main`` itself has to advance."""
        if not main.waits:
            return False
        if self.shown is None:
            self._open()
        elif self._ended(self.shown):
            self._done += 1
            if self._done == len(self._names):
                self.shown = None
                main.wait(last=True)
                return True
            self._open()
        else:
            other = self.shown
            other.step(np.zeros(ACTION_DIM, np.float32) if other.phase == PROMPT else other.expert_action())
        main.wait()
        return True

    def _open(self) -> None:
        name = self._names[self._done]
        if name not in self._episodes:
            self._episodes[name] = Episode(get_task(name), self._settings)
        self.shown = self._episodes[name]
        self.shown.reset(int(self._seeds[self._done]))

    @staticmethod
    def _ended(episode: Episode) -> bool:
        return episode.done or episode.expert_done
