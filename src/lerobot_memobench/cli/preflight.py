"""What is checked before LeRobot starts, so that a mistake costs a sentence and not a run."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_memobench.cli.arguments import Translation
from lerobot_memobench.cli.checkpoint import check_checkpoint
from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.errors import MemobenchError

INFO_FILE = Path("meta") / "info.json"


@contextmanager
def quiet() -> Iterator[None]:
    """Keep LeRobot's log lines about a configuration to the run itself, which parses it again."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)


def parse_choice(translation: Translation, key: str) -> Any | None:
    """Return the configuration of ``policy`` or ``env`` as LeRobot will build it, None where it is not known
    here.

    Its own checks run here: an unknown ``policy.align`` or task is reported before anything starts.
    """
    import draccus
    from lerobot.configs import parser
    from lerobot.configs.policies import PreTrainedConfig

    if key not in translation.chosen or translation.has("config_path"):
        return None
    overrides = parser.get_cli_overrides(key, translation.flags) or []
    path = translation.get(f"{key}.path")
    with quiet():
        if path is not None:
            return PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
        return draccus.parse(translation.chosen[key], args=overrides)


def check_policy(translation: Translation) -> None:
    """Refuse a checkpoint that is not whole."""
    path = translation.get("policy.path")
    if path is not None:
        check_checkpoint(path)


def check_dataset(translation: Translation) -> None:
    """Refuse a dataset folder that is none."""
    root = translation.get("dataset.root")
    if root is None:
        return
    folder = Path(root).expanduser()
    local_only = (translation.get("dataset.repo_id") or "").startswith("local/")
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


def check_output(folder: Path) -> None:
    """Refuse to mix an evaluation with an earlier one in the same folder."""
    if has_log(folder):
        raise MemobenchError(f"{folder} already holds an evaluation; choose another output_dir= or remove the old one")
    if folder.exists() and not folder.is_dir():
        raise MemobenchError(f"output_dir={folder} is a file; name a folder")


def check_rendering() -> None:
    """Refuse to start without a GL library: every episode would fail at its first frame."""
    from lerobot_memobench.sim.rendering import gl_backend

    gl_backend()


def remove_empty(folder: Path) -> None:
    """Remove a folder and those below it, as far as they hold nothing."""
    if not folder.is_dir():
        return
    for child in sorted(folder.rglob("*"), reverse=True):
        if child.is_dir() and not any(child.iterdir()):
            child.rmdir()
    if not any(folder.iterdir()):
        folder.rmdir()
