"""``lerobot train policy=…``: the defaults and checks before LeRobot's training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lerobot_memobench.datasets.lerobot_format import DEFAULT_REPO_ID
from lerobot_memobench.envs.obs_types import OBS_TYPES
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.settings.configurations import check_sight, env_config, policy_config
from lerobot_memobench.settings.fields import checked_value
from lerobot_memobench.settings.short_forms import TRAINING_WORDS
from lerobot_memobench.settings.translation import LerobotSettings
from lerobot_memobench.settings.words import Words

INFO_FILE = Path("meta") / "info.json"
OBJECT_BATCH = 72
"""Frames per update of a policy that sees objects, or through eyes: a dozen episodes, six moments of each. They lie in
main memory, where no loader would be quicker."""
TRAINED = ("policy.type", "policy.path", "reward_model.type", "reward_model.path")
"""What may say what is trained."""


def take_training_words(words: Words) -> tuple[bool | None, str | None, Words]:
    """Return whether prompt frames are trained on, and what a policy is to see, each None where it is not said; and the
    words without these.

    Raises:
        MemobenchError: the first is neither true nor false, or the second no kind of observation.
    """
    given = dict(item for item in words.settings if item[0] in TRAINING_WORDS)
    of_env = {"obs_type"} if any(key == "env" for key, _ in words.settings) else set()  # it is a setting of it, too
    rest = [item for item in words.settings if item[0] in of_env or item[0] not in TRAINING_WORDS]
    known = {"true": True, "false": False}
    prompt_frames, obs_type = given.get("prompt_frames"), given.get("obs_type")
    if obs_type is not None and obs_type not in OBS_TYPES:
        raise MemobenchError(f"found obs_type={obs_type}, {nearest(obs_type, OBS_TYPES)}")
    wanted = None if prompt_frames is None else known.get(checked_value("prompt_frames", bool, prompt_frames))
    return wanted, obs_type, replace(words, settings=rest)


def complete_training(settings: LerobotSettings) -> LerobotSettings:
    """Return a training run's settings with the benchmark's defaults; what is wrong with them is told here.

    Raises:
        MemobenchError: no policy is named, or the dataset or the checkpoint is none.
    """
    from_file = settings.has("config_path")
    if not from_file:
        if not any(settings.has(key) for key in TRAINED):
            raise MemobenchError("name a policy: policy=memobench_mem")
        settings = with_places(settings)
    check_dataset(settings)
    policy = policy_config(settings)
    check_sight(policy, env_config(settings))
    settings = with_logging(settings)
    if not from_file and getattr(policy, "decodes_nothing", False):
        settings = settings.default("batch_size", OBJECT_BATCH).default("num_workers", 0)
    if cores() < 4 and not from_file:  # LeRobot's default of 4 loaders would only wait for one another
        settings = settings.default("num_workers", cores())
    return settings


def with_places(settings: LerobotSettings) -> LerobotSettings:
    """Return settings that name the dataset; without a repository to push to, which LeRobot would ask for."""
    settings = settings.default("dataset.repo_id", DEFAULT_REPO_ID)
    if not settings.has("policy.repo_id") and (settings.has("policy.type") or settings.has("policy.path")):
        settings = settings.default("policy.push_to_hub", False)
    return settings


def check_dataset(settings: LerobotSettings) -> None:
    """Refuse a dataset folder that is none."""
    root = settings.get("dataset.root")
    if root is None:
        return
    folder = Path(root).expanduser()
    local_only = (settings.get("dataset.repo_id") or "").startswith("local/")
    if not folder.exists() and not local_only:
        return  # LeRobot downloads the repository into it
    if not folder.is_dir():
        raise MemobenchError(
            f"the dataset folder {root} does not exist; make one with `memobench generate --out {root}`"
        )
    if not (folder / INFO_FILE).is_file():
        raise MemobenchError(
            f"the folder {root} is not a LeRobot dataset ({INFO_FILE} is missing); make one with "
            "`memobench generate --out <folder>`"
        )


def with_logging(settings: LerobotSettings) -> LerobotSettings:
    """Return settings that log a short run often enough to see its loss: LeRobot's default is every 200 steps."""
    steps = settings.get("steps")
    if steps is not None and steps.isdigit() and int(steps) < 2000:
        return settings.default("log_freq", max(1, int(steps) // 10))
    return settings
