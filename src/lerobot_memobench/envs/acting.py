"""The policy that acts, its inputs, and the episodes that were asked for, as the episode log names them.

The environment writes the log and does not know the policy; `lerobot eval` passes this to it. LeRobot's own commands do
not: their logs name no policy.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import logging
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.command_line import quiet
from lerobot_memobench.envs.episode_log import INPUTS, POLICY
from lerobot_memobench.envs.evaluation_file import read_evaluation
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.io import file_hash
from lerobot_memobench.protocol import SEALED, SPLITS

logger = logging.getLogger(__name__)

SEALED_LEDGER = "sealed_tests.jsonl"
"""File of `run.sealed`: the count of a policy's runs on the sealed seeds."""
NOT_THE_CHECKPOINT = (
    *("train_config.json", "README.md", "training_weights.safetensors", ".gitattributes", SEALED_LEDGER),
    *("training_curve.png", "training_curve.json"),
)
"""Files of a checkpoint folder on which what the policy does at evaluation does not depend."""

ELSEWHERE = (
    *("device", "pretrained_path", "repo_id", "private", "tags", "license", "push_to_hub", "use_peft"),
    *("host", "port", "servers", "connect_timeout", "timeout"),
)
"""Settings of where a policy runs or is published; its actions do not depend on them."""

DIGITS = 12
"""Digits of the hash that identifies a policy."""


@dataclass(frozen=True)
class Acting:
    """Whose episodes are being run.

    Attributes:
        policy: ``type``, ``identity`` and, of a checkpoint in a folder, ``sha256``; {} where not known.
        inputs: of the policy, in words; None where not known.
        run: names this run of LeRobot's evaluation; a log may hold several, of one policy.
        seeds: of the episodes that were asked for; None where not known. LeRobot runs whole batches, and what it
            runs beyond these is no part of the evaluation.
    """

    policy: Mapping[str, Any] = field(default_factory=dict)
    inputs: str | None = None
    run: str | None = None
    seeds: range | None = None

    def counts(self, seed: int) -> bool:
        """Return whether the episode of a seed was asked for."""
        return self.seeds is None or seed in self.seeds

    @property
    def protocol(self) -> dict[str, Any]:
        """The part of the protocol that names inputs and policy, where known."""
        return _known({INPUTS: self.inputs, POLICY: dict(self.policy) or None})

    @property
    def line(self) -> dict[str, Any]:
        """The fields of every line of the log, where known."""
        return _known({POLICY: self.policy.get("identity"), "run": self.run, INPUTS: self.inputs})


NOBODY = Acting()
"""Nothing is known of who acts."""


def _known(facts: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in facts.items() if value is not None}


def acting(policy: Any, path: str | None, seeds: range | None, settings: EnvSettings) -> Acting:
    """Return the policy that acts in environments of these settings.

    Args:
        policy: its configuration.
        path: of its checkpoint, None for a policy without one.
        seeds: see `Acting`.
    """
    run = f"{dt.datetime.now():%Y%m%dT%H%M%S}-{secrets.token_hex(3)}"
    inputs = policy_inputs(policy, settings.obs_type, settings.oracle_memory)
    return Acting(_identity(policy, path), inputs, run, seeds)


# --- identity ---


def _identity(policy: Any, path: str | None) -> dict[str, Any]:
    """Return the type of a policy and one hash of its checkpoint and of the settings that differ from it."""
    weights = None if path is None else checkpoint_hash(path)
    with quiet():
        plain = _unchanged(policy, path)
    facts = json.dumps([policy.type, weights, _changes(policy, plain)], sort_keys=True, default=str)
    found = {"type": policy.type, "identity": f"{policy.type} {hashlib.sha256(facts.encode()).hexdigest()[:DIGITS]}"}
    return found | ({"sha256": weights} if path is not None and Path(path).is_dir() else {})


def _unchanged(policy: Any, path: str | None) -> Any:
    """Return the configuration that a policy would have by default."""
    from lerobot.configs import PreTrainedConfig

    if path is not None:
        return PreTrainedConfig.from_pretrained(path)
    try:
        return type(policy)()
    except TypeError:  # a plugin's that requires a setting
        return policy


def _changes(policy: Any, plain: Any) -> dict[str, Any]:
    """Return the settings of a policy that differ from its default; a file counts by its content."""
    before, now = encoded(plain), encoded(policy)
    return {k: _content(v) for k, v in now.items() if k not in (*ELSEWHERE, "type") and before.get(k) != v}


def _content(value: Any) -> Any:
    return file_hash(Path(value)) if isinstance(value, str) and Path(value).is_file() else value


def encoded(policy: Any) -> dict[str, Any]:
    """Return a policy's configuration as plain JSON values."""
    import draccus

    found = json.loads(json.dumps(draccus.encode(policy), default=str))
    assert isinstance(found, dict)
    return {**found, "type": policy.type}


def checkpoint_hash(path: str) -> str:
    """Return one hash for a checkpoint's folder; of a repository, its name and the commit that is here."""
    if Path(path).is_dir():
        return tree_hash(checkpoint_files(Path(path)))
    from huggingface_hub import try_to_load_from_cache

    found = try_to_load_from_cache(path, "config.json")
    return f"{path}@{Path(found).parent.name}" if isinstance(found, str) else path


def parameters_of(path: str) -> int | None:
    """Return about how many parameters a checkpoint's policy has, by the size of its weights, four bytes each.

    Args:
        path: its folder, or a repository. None is returned for one that is not on this machine.
    """
    from huggingface_hub import try_to_load_from_cache

    folder = Path(path).expanduser()
    if not folder.is_dir():
        cached = try_to_load_from_cache(path, "config.json")
        if not isinstance(cached, str):
            return None
        folder = Path(cached).parent
    sizes = [file.stat().st_size for file in folder.glob("*model*.safetensors")]
    return sum(sizes) // 4 if sizes else None


def checkpoint_files(folder: Path) -> dict[str, str]:
    """Return name -> sha256 of the files that a checkpoint consists of."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and path.name not in NOT_THE_CHECKPOINT)
    return {path.name: file_hash(path) for path in files}


def tree_hash(files: Mapping[str, str]) -> str:
    """Return one sha256 for many: of the lines ``<sha256>  <name>`` in the order of names, as sha256sum prints them."""
    lines = "".join(f"{files[name]}  {name}\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


def note_sealed(seed: int, log_dir: Path | None) -> None:
    """Log, once per process, that a scene of the sealed test is used outside of a counted run of it.

    Args:
        seed: of the scene.
        log_dir: folder of the episode log; the evaluation's file holds the number of a counted run (`run.sealed`).
    """
    if seed not in SPLITS[SEALED]:
        return
    if log_dir is None or "sealed" not in read_evaluation(log_dir):
        _log_sealed(SPLITS[SEALED])


@cache
def _log_sealed(split: range) -> None:
    logger.warning(
        "sealed scenes, not counted: seeds %d to %d are of the sealed test, whose runs `memobench test-sealed` counts",
        split[0],
        split[-1],
    )
