"""The plan of an evaluation: what its command line asks for, complete and typed. It is made once and never changed."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_memobench.run.flags import joined_flags, without_flag
from lerobot_memobench.run.grid import Grid
from lerobot_memobench.run.orders import Orders
from lerobot_memobench.run.translation import LerobotSettings

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig

OUTPUT = "output_dir"
LOG = "env.log_dir"
GOES_ON = ("resume=", f"{OUTPUT}=")
"""Beginnings of words that say whether, and with what, an evaluation goes on."""
PATHS = ("policy.path", "env.task_dir", "config_path")
"""Settings that name what is read."""


@dataclass(frozen=True)
class EvaluationPlan:
    """What is evaluated and how.

    Attributes:
        settings: LeRobot's, complete but for the folders that are written.
        policy, environment: their configurations; None when a configuration file (``config_path``) holds them.
        grid: the episodes it consists of; None when the environment is.
        output: folder of LeRobot's own files.
        log: folder of the episode log, the report and the card.
        seed: of the run; that of the first episode of each task too.
        batch: environments at once.
        orders: how it is run.
        command: the command line as it was given, for the card.
    """

    settings: LerobotSettings
    policy: PreTrainedConfig | None
    environment: MemobenchEnvConfig | None
    grid: Grid | None
    output: Path
    log: Path
    seed: int | None
    batch: int
    orders: Orders
    command: tuple[str, ...]

    @property
    def policy_path(self) -> str | None:
        """The checkpoint or repository that is evaluated, None for a policy that is not loaded."""
        return self.settings.get("policy.path")

    @property
    def draws(self) -> bool:
        """Whether pictures are drawn, as far as is known."""
        return self.environment is None or self.environment.draws

    @property
    def going_on(self) -> str:
        """The command line that goes on with it, ready to be typed."""
        folder = self.output if self.orders.shard is None else self.output.parent
        words = without_flag([word for word in self.command if not word.startswith(GOES_ON)], OUTPUT)
        return shlex.join([*words, "resume=true", f"{OUTPUT}={folder}"])

    @property
    def lerobot_flags(self) -> list[str]:
        """What ``lerobot-eval`` is called with."""
        return [*self.settings.flags, f"--{OUTPUT}={self.output}", f"--{LOG}={self.log}"]

    @property
    def portable_flags(self) -> list[str]:
        """LeRobot's flags without the folders that are written, those that are read absolute: for cards and parts."""
        settings = self.settings
        for key in PATHS:
            path = Path(settings.get(key) or "").expanduser()
            if settings.has(key) and path.exists():
                settings = settings.changed(key, path.absolute())
        return joined_flags(settings.flags)
