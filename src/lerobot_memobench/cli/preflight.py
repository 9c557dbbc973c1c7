"""What is checked before LeRobot starts, so that a mistake costs a sentence and not a run."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_memobench import files
from lerobot_memobench.cli.arguments import Translation
from lerobot_memobench.engine.card import extended
from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.envs.protocol import PROTOCOL_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.protocol import CARD_FILE, POLICY, differences, read_card, read_protocol
from lerobot_memobench.policies.checkpoint import check_checkpoint

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
        raise MemobenchError(
            f"{folder} already holds an evaluation; choose another output_dir=, or go on with it by resume=true"
        )
    check_folder(folder)


def check_folder(folder: Path) -> None:
    """Refuse to write into what is no folder."""
    if folder.exists() and not folder.is_dir():
        raise MemobenchError(f"output_dir={folder} is a file; name a folder")


def check_resumed(folder: Path, card: dict[str, Any]) -> dict[str, Any]:
    """Return the card for an evaluation that goes on with the one in ``folder``; refuse to mix two.

    Tasks and episodes may be others: those that are there stay. A folder without an evaluation is begun.
    """
    check_folder(folder)
    path = folder / CARD_FILE
    if not has_log(folder):
        return card
    found = differences(read_protocol(folder), {**card["protocol"], POLICY: card[POLICY]}, policy=True)
    if found:
        raise MemobenchError(
            f"{folder} holds an evaluation with another protocol ({'; '.join(found)}, there and now); repeat its "
            "settings to go on with it, or choose another output_dir="
        )
    if not path.is_file():
        warn(f"{folder} has no {CARD_FILE}: whether its episodes are this policy's cannot be checked")
        return card
    earlier = read_card(path)
    edited = [name for name, value in card["task_files"].items() if earlier["task_files"].get(name, value) != value]
    if edited:
        raise MemobenchError(f"the files of {edited[0]} are not those that the episodes in {folder} were run with")
    for name in ("batch_size", "versions", "gl"):
        changed = _changed(earlier["runs"][-1][name], card["runs"][-1][name], name)
        if changed:
            warn(f"the episodes in {folder} were run otherwise ({changed}, there and now); numbers may depend on it")
    return extended(earlier, card)


def _changed(earlier: Any, now: Any, name: str) -> str:
    """Return in what two runs differ, the first thing of several."""
    if isinstance(earlier, dict):
        return next(
            (f"{key}: {earlier[key]} and {now[key]}" for key in now if earlier.get(key, now[key]) != now[key]), ""
        )
    return f"{name}: {earlier} and {now}" if earlier != now else ""


def warn(text: str) -> None:
    """Tell the user what may matter and stops nothing."""
    print(f"note: {text}", file=sys.stderr)


def remove_drafts(folder: Path) -> None:
    """Remove what a killed run was writing: whole files have names of their own. The caller holds the folder."""
    for part in (folder, folder / "videos"):
        files.remove_drafts(part)
    for pattern in (".*.part", "*.part", f".{PROTOCOL_FILE}.*", "videos/.*.part"):  # of earlier versions
        for draft in folder.glob(pattern):
            draft.unlink(missing_ok=True)


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
