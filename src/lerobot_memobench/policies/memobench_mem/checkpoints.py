"""Model checkpoints of the policy: its configuration, weights, statistics and saved processor steps, each checked.

The model file holds the averaged weights; `training.average` keeps the trained ones beside it.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from lerobot.configs import PreTrainedConfig
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import (
    CONFIG_FILE,
    PREPROCESSOR_FILE,
    WEIGHTS_FILE,
    Processor,
    check_processors,
    checkpoint_file,
    differing,
    read_json,
    statistics_shapes,
    undamaged,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.fusion import plain_name
from lerobot_memobench.policies.memobench_mem.memory import NONE
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05

logger = logging.getLogger(__name__)


def read_config(source: str | Path, config: PreTrainedConfig | None, revision: str | None) -> MemobenchMemConfig:
    """Return the configuration that a checkpoint is loaded with: ``config``, or its own.

    Raises:
        MemobenchError: it is another policy's, was trained with another visual encoder, or its processors name code.
    """
    check_processors(source, revision)
    found = PreTrainedConfig.from_pretrained(source, revision=revision) if config is None else config
    if not isinstance(found, MemobenchMemConfig):
        raise MemobenchError(
            f"'{source}' is a '{found.type}' checkpoint and not memobench_mem; to start from pi0.5's weights "
            "pass --policy.type=memobench_mem --policy.base_weights=<checkpoint>."
        )
    path = checkpoint_file(source, CONFIG_FILE, revision)
    held = None if path is None else read_json(path).get("visual_encoder")
    if held and found.visual_encoder and found.visual_encoder != held:
        raise MemobenchError(
            f"--policy.visual_encoder={found.visual_encoder} cannot be followed: '{source}' was trained with that of "
            f"'{held}' and holds it; leave visual_encoder out, or train anew."
        )
    return found


def remembers_otherwise(config: MemobenchMemConfig, trained: MemobenchMemConfig) -> bool:
    """Return whether a policy's memory is another one than that of the checkpoint that it begins with."""
    makes = ("memory", "memory_settings", "memory_fusion", "tokens_per_frame", "subgoals")
    return any(getattr(config, name) != getattr(trained, name) for name in makes)


def restarted(policy: nn.Module, trained: MemobenchMemConfig) -> set[str]:
    """Return the names of the policy's tensors that a checkpoint does not decide, because they have another meaning.

    These are the memory with its fusion where the memory is another one, and the alignment head where the memory, the
    objective or the text encoder is.

    Args:
        trained: the checkpoint's configuration.
    """
    config, model = cast(MemobenchMemConfig, policy.config), cast(MemoryPI05, policy.model)
    if remembers_otherwise(config, trained):
        return _head(policy) | {f"model.{name}" for name in model.memory_names()}
    return set() if (config.align, config.text_encoder) == (trained.align, trained.text_encoder) else _head(policy)


def _head(policy: nn.Module) -> set[str]:
    return {name for name in policy.state_dict() if name.startswith("alignment.")}


def name_here(policy: nn.Module, name: str, trained: MemobenchMemConfig) -> str:
    """Return the name in a policy of a tensor of a checkpoint: another fusion nests pi0.5's modules differently."""
    begins = ("model.memory.position.", "model.memory.project.")
    if trained.memory == "frames" and name.startswith(begins):  # without a pool, its encoder was the memory itself
        name = name.replace("model.memory.", "model.memory.encoder.")
    if name.startswith("model.") and remembers_otherwise(cast(MemobenchMemConfig, policy.config), trained):
        name = f"model.{cast(MemoryPI05, policy.model).place_of(plain_name(name.removeprefix('model.')))}"
    return name


def load_weights(policy: nn.Module, path: Path, source: str | Path, trained: MemobenchMemConfig) -> None:
    """Load the weights of checkpoint ``source`` into a policy of this kind; its alignment heads may be missing.

    Args:
        trained: the checkpoint's configuration. `restarted` parts keep their initial weights, and a warning names them.

    Raises:
        MemobenchError: they cannot be read, do not fit, or bring no memory to a policy of the same.
    """
    config, new = cast(MemobenchMemConfig, policy.config), restarted(policy, trained)
    begins = ["base_weights"] if remembers_otherwise(config, trained) else ["base_weights", "open_gate"]
    for name, asked, held in differing(config, trained, begins):
        raise MemobenchError(
            f"--policy.{name}={asked} would do nothing: it decides how weights begin, and those of '{source}' "
            f"({name}={held}) go on; leave {name} out, or train from scratch."
        )
    weights = {name_here(policy, name, trained): tensor for name, tensor in read_tensors(path).items()}
    if remembers_otherwise(config, trained):
        logger.warning(
            "'%s' was trained with memory=%s, and this is memory=%s%s: of the latter and of how actions read it, %d "
            "tensors begin anew; all others go on. A frame is written every %d control steps.",
            source,
            trained.memory,
            config.memory,
            "" if config.memory != trained.memory else " with other settings",
            len(new - _head(policy)),
            config.memory_stride,
        )
    elif config.memory != NONE and not any(name.startswith("model.memory.") for name in weights):
        raise MemobenchError(
            f"'{source}' holds weights without a memory; to start from pi0.5's weights pass "
            "--policy.base_weights=<checkpoint> instead of a pretrained path."
        )
    else:
        require_phase(weights, policy.state_dict(), source)
    weights = {name: tensor for name, tensor in weights.items() if name not in new}
    load_exactly(policy, weights, source, optional=new | _head(policy))


def load_base_weights(model: MemoryPI05, weights: dict[str, Tensor], source: str) -> None:
    """Start from pi0.5's weights; only the memory's own parameters stay at their initial values."""
    placed = {model.place_of(plain_name(name.removeprefix("model."))): tensor for name, tensor in weights.items()}
    load_exactly(model, placed, source, optional=set(model.memory_parameters()))


# -- files ------------------------------------------------------------------------------------------------------------


def weights_file(source: str | Path, revision: str | None = None, *, named: str, fix: str) -> Path:
    """The file of a checkpoint's weights.

    Raises:
        MemobenchError: it has none; the message calls it ``named`` and ends with ``fix``.
    """
    path = checkpoint_file(source, WEIGHTS_FILE, revision)
    if path is None:
        raise MemobenchError(f"{named} has no {WEIGHTS_FILE}; {fix}.")
    return path


def require_statistics(source: str | Path, revision: str | None = None) -> None:
    """Check that a checkpoint brings the statistics that normalise states and actions.

    LeRobot passes values through unchanged where a statistic is missing, and an evaluation then scores 0 %.

    Raises:
        MemobenchError: a file or a statistic is missing.
    """
    fix = "copy the preprocessor files of its training run into it, or train again"
    if checkpoint_file(source, PREPROCESSOR_FILE, revision) is None:
        raise MemobenchError(f"The checkpoint '{source}' has no {PREPROCESSOR_FILE}, so it cannot be evaluated; {fix}.")
    missing = sorted({"observation.state", "action"} - set(statistics_shapes(source, revision)))
    if missing:
        raise MemobenchError(
            f"The checkpoint '{source}' has no dataset statistics for {' and '.join(missing)}, so states and actions "
            f"could not be normalised; {fix}."
        )


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Return all tensors of a file.

    Raises:
        MemobenchError: it is cut off or damaged.
    """
    with undamaged(path):
        return load_file(path)


def read_weights(source: str | Path, prefix: str = "") -> dict[str, Tensor]:
    """Weights of a checkpoint whose names start with ``prefix``, without a leading ``model.`` and the prefix.

    Raises:
        MemobenchError: no weights there, or they cannot be read.
    """
    path = weights_file(source, named=f"'{source}'", fix="give the folder or repository of a pi0.5 checkpoint")
    with undamaged(path), safe_open(path, framework="pt") as tensors:
        found = {}
        for name in tensors.keys():  # noqa: SIM118 (not a dict)
            short = name.removeprefix("model.")
            if short.startswith(prefix):
                found[short.removeprefix(prefix)] = tensors.get_tensor(name)
    return found


PHASE_WEIGHT = "model.memory.pool.phase.weight"


def require_phase(weights: Mapping[str, Tensor], own: Collection[str], source: str | Path) -> None:
    """Refuse weights of a memory that told the phase, for a policy whose configuration does not say so.

    Raises:
        MemobenchError: an earlier version trained them, which had no such setting and always told it.
    """
    if PHASE_WEIGHT in weights and PHASE_WEIGHT not in own:
        raise MemobenchError(
            f"'{source}' was trained with a memory that tells the phase of its frames, and its {CONFIG_FILE} does not "
            'say so, because an earlier version wrote it; add "memory_phase": true to that file.'
        )


def load_exactly(module: nn.Module, weights: dict[str, Tensor], source: str | Path, optional: set[str]) -> None:
    """Load ``weights`` into ``module``, whose names in ``optional`` may be absent.

    Raises:
        MemobenchError: names or shapes differ.
    """
    own = module.state_dict()
    missing = sorted(set(own) - set(weights) - optional)
    wrong = sorted(name for name in set(own) & set(weights) if own[name].shape != weights[name].shape)
    if missing or wrong:
        name = (missing + wrong)[0]
        raise MemobenchError(
            f"The weights of '{source}' do not fit this policy: {len(missing)} are missing and {len(wrong)} have "
            f"another shape, the first being '{name}'; give weights of the same size (--policy.size) and "
            "perception (--policy.perception)."
        )
    module.load_state_dict({name: weights[name] for name in own if name in weights}, strict=False)


# -- saved processor steps --------------------------------------------------------------------------------------------


_ORACLE = "memobench_oracle_memory"


def require_agreement(source: str | Path, revision: str | None, config: MemobenchMemConfig, *, training: bool) -> None:
    """Check that the saved steps of a checkpoint do, or will do, what ``config`` says.

    LeRobot loads them. Ours follow the training (`follow_training`), and LeRobot gives some of its own their new
    settings; the rest would keep the checkpoint's.

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
