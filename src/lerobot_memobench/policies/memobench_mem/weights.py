"""Files of a checkpoint: finding them, what they must hold, and starting from pi0.5's."""

from __future__ import annotations

from pathlib import Path

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, LocalEntryNotFoundError
from safetensors import safe_open
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import Processor, read_json

MODEL_FILE = "model.safetensors"
TRAINING_FILE = "training_weights.safetensors"
PREPROCESSOR_FILE = "policy_preprocessor.json"


def checkpoint_file(source: str | Path, name: str, revision: str | None = None) -> Path | None:
    """A file of a checkpoint folder or hub repository; None when it has no such file.

    Raises:
        MemobenchError: the repository cannot be reached.
    """
    folder = Path(source)
    if folder.is_dir():
        return folder / name if (folder / name).is_file() else None
    try:
        return Path(hf_hub_download(str(source), name, revision=revision))
    except LocalEntryNotFoundError as error:
        raise MemobenchError(f"'{source}' is neither a folder nor reachable on the hub.") from error
    except EntryNotFoundError:
        return None
    except (HfHubHTTPError, ValueError) as error:
        raise MemobenchError(f"'{source}' is neither a folder nor a repository that can be read.") from error


def weights_file(source: str | Path, revision: str | None = None, *, named: str, fix: str) -> Path:
    """The file of a checkpoint's weights.

    Raises:
        MemobenchError: it has none; the message calls it ``named`` and ends with ``fix``.
    """
    path = checkpoint_file(source, MODEL_FILE, revision)
    if path is None:
        raise MemobenchError(f"{named} has no {MODEL_FILE}; {fix}.")
    return path


def require_statistics(source: str | Path, revision: str | None = None) -> None:
    """Check that a checkpoint brings the statistics that normalise states and actions.

    LeRobot passes values through unchanged where a statistic is missing, and an evaluation then scores 0 %.

    Raises:
        MemobenchError: a file or a statistic is missing.
    """
    fix = "copy the preprocessor files of its training run into it, or train again"
    path = checkpoint_file(source, PREPROCESSOR_FILE, revision)
    if path is None:
        raise MemobenchError(f"The checkpoint '{source}' has no {PREPROCESSOR_FILE}, so it cannot be evaluated; {fix}.")
    steps = read_json(path, Processor).get("steps", [])
    step = next((step for step in steps if step.get("registry_name") == "normalizer_processor"), None)
    state = None if step is None or not step.get("state_file") else step["state_file"]
    file = None if state is None else checkpoint_file(source, state, revision)
    present: set[str] = set()
    if file is not None:
        with safe_open(file, framework="pt") as tensors:
            present = {name.rsplit(".", 1)[0] for name in tensors.keys()}  # noqa: SIM118 (not a dict)
    missing = sorted({"observation.state", "action"} - present)
    if missing:
        raise MemobenchError(
            f"The checkpoint '{source}' has no dataset statistics for {' and '.join(missing)}, so states and actions "
            f"could not be normalised; {fix}."
        )


def read_weights(source: str | Path, prefix: str = "") -> dict[str, Tensor]:
    """Weights of a checkpoint whose names start with ``prefix``, without a leading ``model.`` and the prefix.

    Raises:
        MemobenchError: no weights there.
    """
    path = weights_file(source, named=f"'{source}'", fix="give the folder or repository of a pi0.5 checkpoint")
    with safe_open(path, framework="pt") as tensors:
        found = {}
        for name in tensors.keys():  # noqa: SIM118 (not a dict)
            short = name.removeprefix("model.")
            if short.startswith(prefix):
                found[short.removeprefix(prefix)] = tensors.get_tensor(name)
    return found


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
