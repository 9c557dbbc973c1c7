"""What the preprocessor of a checkpoint must agree on with the policy that goes on from it.

LeRobot loads the saved steps. Ours follow the policy (`processing.training_run`) and LeRobot hands some of its own
their new settings; the rest would keep the checkpoint's, whatever the configuration says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import Processor, read_json
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.weights import PREPROCESSOR_FILE, checkpoint_file

_ORACLE = "memobench_oracle_memory"


def require_agreement(source: str | Path, revision: str | None, config: MemobenchMemConfig, *, training: bool) -> None:
    """Check that the saved steps of a checkpoint do, or will do, what ``config`` says.

    A checkpoint without a preprocessor passes: LeRobot says what it lacks.

    Raises:
        MemobenchError: a setting would silently have no effect.
    """
    path = checkpoint_file(source, PREPROCESSOR_FILE, revision)
    if path is None:
        return
    entries = read_json(path, Processor).get("steps", [])
    steps = {entry.get("registry_name", ""): entry.get("config", {}) for entry in entries}
    for field, held in _held(steps, config, training):
        asked = getattr(config, field)
        if asked != held:
            raise MemobenchError(
                f"--policy.{field}={asked} would have no effect, because the preprocessor of '{source}' was saved with "
                f"{held} and cannot change it; leave {field} as it is there, or train from --policy.base_weights."
            )


def _held(
    steps: Mapping[str, Mapping[str, Any]], config: MemobenchMemConfig, training: bool
) -> Iterator[tuple[str, object]]:
    """Settings that the saved steps keep, with their values there."""
    if not training or _ORACLE not in steps:
        yield "oracle_memory", _ORACLE in steps and bool(steps[_ORACLE].get("enabled", True))
    if not training:
        return
    tokenizer = steps.get("memobench_tokenizer", steps.get("tokenizer_processor"))  # ours, or LeRobot's pi05
    words = "memobench_word_tokenizer" in steps
    if tokenizer is not None or words:
        yield "tokenizer_name", "words" if tokenizer is None else tokenizer.get("tokenizer_name")
    if tokenizer is not None:
        yield "tokenizer_max_length", tokenizer.get("max_length")
    if not config.use_relative_actions:  # LeRobot switches them on, and never off
        yield "use_relative_actions", bool(steps.get("relative_actions_processor", {}).get("enabled", False))
