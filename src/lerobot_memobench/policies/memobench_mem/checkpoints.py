"""Load the weights of a checkpoint, and check that its processor steps agree with the configuration.

The model file holds the averaged weights; `training.loop` saves the trained weights next to it.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, cast

from lerobot.configs import PreTrainedConfig
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from lerobot_memobench.constants import MEMORY_POLICY
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import (
    CONFIG_FILE,
    PREPROCESSOR_FILE,
    WEIGHTS_FILE,
    check_processors,
    checkpoint_file,
    differing,
    processor_steps,
    read_checkpoint_json,
    undamaged_tensors,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05

logger = logging.getLogger(__name__)

_HEAD = "paligemma_with_expert.paligemma.lm_head.weight"
_EMBEDDING = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"


def read_config(source: str | Path, config: PreTrainedConfig | None, revision: str | None) -> MemobenchMemConfig:
    """Return the configuration to load a checkpoint with: ``config``, or the checkpoint's own."""
    check_processors(source, revision)
    loaded = PreTrainedConfig.from_pretrained(source, revision=revision) if config is None else config
    if not isinstance(loaded, MemobenchMemConfig):
        raise MemobenchError(
            f"'{source}' is a '{loaded.type}' checkpoint and not memobench_mem; to start from pi0.5's weights "
            "pass --policy.type=memobench_mem --policy.base_weights=<checkpoint>."
        )
    return loaded


def has_another_memory(config: MemobenchMemConfig, trained: MemobenchMemConfig) -> bool:
    """Return whether a policy's memory differs from its checkpoint's in more than the number of frames read."""

    def memory(policy: MemobenchMemConfig) -> tuple[Any, ...]:
        settings = {name: value for name, value in policy.memory_settings.items() if name != "frames"}
        return policy.memory, settings, policy.memory_fusion, policy.subgoals

    return memory(config) != memory(trained)


def restarted(policy: nn.Module, trained: MemobenchMemConfig) -> set[str]:
    """Return the names of the policy's tensors that keep their initial weights instead of a checkpoint's.

    These are the memory and its fusion if the memory differs from that of ``trained``, the checkpoint's configuration,
    and the alignment head if the memory, the objective or the text encoder differs.
    """
    config, model = cast(MemobenchMemConfig, policy.config), cast(MemoryPI05, policy.model)
    head = {name for name in policy.state_dict() if name.startswith("alignment.")}
    if has_another_memory(config, trained):
        return head | {f"model.{name}" for name in model.memory_names()}
    return set() if (config.align, config.text_encoder) == (trained.align, trained.text_encoder) else head


def load_weights(policy: nn.Module, path: Path, source: str | Path, trained: MemobenchMemConfig) -> None:
    """Load the weights of checkpoint ``source``; `restarted` parts keep their initial weights, with a warning."""
    config, new = cast(MemobenchMemConfig, policy.config), restarted(policy, trained)
    for name, value, earlier in differing(config, trained, ("base_weights", "visual_encoder")):
        raise MemobenchError(
            f"--policy.{name}={value} has no effect: it sets initial weights, and the weights of '{source}' "
            f"({name}={earlier}) replace them; leave {name} out, or train from scratch."
        )
    if has_another_memory(config, trained):
        logger.warning(
            "'%s' was trained with memory=%s, and this is memory=%s%s: %d tensors of the memory and its fusion keep "
            "their initial weights. A frame is written every %d control steps.",
            source,
            trained.memory,
            config.memory,
            "" if config.memory != trained.memory else " with other settings",
            sum(not name.startswith("alignment.") for name in new),
            config.memory_stride,
        )
    weights = {name: tensor for name, tensor in read_tensors(path).items() if name not in new}
    load_exactly(policy, weights, source, optional=new)


def load_base_weights(model: MemoryPI05, weights: dict[str, Tensor], source: str) -> None:
    """Load pi0.5's weights; the memory's parameters keep their initial values."""
    # As LeRobot's pi0.5: openpi's checkpoints have older names, and store the embedding as the language head only.
    placed = {
        name.removeprefix("model.").replace("action_time_mlp", "time_mlp"): tensor for name, tensor in weights.items()
    }
    if _HEAD in placed:
        placed.setdefault(_EMBEDDING, placed[_HEAD])
    load_exactly(model, placed, source, optional=set(model.memory_parameters()))


def learned_from_answer(source: str) -> bool:
    """Return whether weights are those of a `memobench_mem` that was supervised with the answer."""
    file = checkpoint_file(source, CONFIG_FILE)
    if file is None or read_checkpoint_json(file).get("type") != MEMORY_POLICY:
        return False
    return read_config(source, None, None).supervised_with_answer


# -- files ------------------------------------------------------------------------------------------------------------


def weights_file(source: str | Path, revision: str | None = None) -> Path:
    """Return the file of a checkpoint's weights, or raise `MemobenchError`."""
    path = checkpoint_file(source, WEIGHTS_FILE, revision)
    if path is None:
        raise MemobenchError(f"The checkpoint '{source}' has no {WEIGHTS_FILE}; give a pretrained_model folder.")
    return path


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Return all tensors of a file; a `MemobenchError` if it is truncated or damaged."""
    with undamaged_tensors(path):
        return load_file(path)


def read_weights(source: str | Path, prefix: str = "") -> dict[str, Tensor]:
    """Return the weights whose names start with ``prefix``, without a leading ``model.`` and the prefix."""
    path = weights_file(source)
    with undamaged_tensors(path), safe_open(path, framework="pt") as tensors:
        names = {name.removeprefix("model."): name for name in tensors.keys()}  # noqa: SIM118 (not a dict)
        return {
            short.removeprefix(prefix): tensors.get_tensor(name)
            for short, name in names.items()
            if short.startswith(prefix)
        }


def load_exactly(module: nn.Module, weights: dict[str, Tensor], source: str | Path, optional: set[str]) -> None:
    """Load ``weights``; a `MemobenchError` if names not in ``optional`` are missing, or shapes differ."""
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


def require_agreement(source: str | Path, revision: str | None, config: MemobenchMemConfig, *, training: bool) -> None:
    """Raise `MemobenchError` if the saved processor steps of a checkpoint disagree with ``config``.

    Training updates most steps (`follow_training`); a pretrained tokenizer keeps the checkpoint's settings.
    """
    path = checkpoint_file(source, PREPROCESSOR_FILE, revision)
    if path is None:  # LeRobot reports it
        return
    steps: dict[str, Any] = {step.get("registry_name", ""): step.get("config", {}) for step in processor_steps(path)}
    tokenizer, saved = steps.get("memobench_tokenizer"), dict[str, Any]()
    if not training:
        saved["oracle_memory"] = steps.get("memobench_oracle_memory", {}).get("enabled", False)
    elif tokenizer is None:
        saved["tokenizer_name"] = "words"
    else:
        saved["tokenizer_name"] = tokenizer.get("tokenizer_name")
        saved["tokenizer_max_length"] = tokenizer.get("max_length")
    for field, value in saved.items():
        if getattr(config, field) != value:
            raise MemobenchError(
                f"--policy.{field}={getattr(config, field)} has no effect: the preprocessor of '{source}' was saved "
                f"with {value}, which cannot be changed; leave {field} out, or train from --policy.base_weights."
            )
