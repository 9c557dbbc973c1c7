"""Trained checkpoints on disk: where they lie, what type they are, whether they are whole."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.files import file_name
from lerobot_memobench.files.reading import read_json as read_json_file

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
ADAPTER_FILE = "adapter_model.safetensors"
PREPROCESSOR_FILE = "policy_preprocessor.json"
POSTPROCESSOR_FILE = "policy_postprocessor.json"
ADVICE = "copy or train the checkpoint again"
SHIPPED = Path(__file__).parent / "shipped"
"""Folder of the trained policies that come with the package, each in a folder of its name."""


class Feature(TypedDict, total=False):
    """A column that is normalised."""

    type: str


class StepConfig(TypedDict, total=False):
    """What is used of a normalising step's settings."""

    norm_map: dict[str, str]
    features: dict[str, Feature]


class Step(TypedDict, total=False):
    """A step of a processor, as LeRobot saves it."""

    registry_name: str
    state_file: str | None
    config: StepConfig


class Processor(TypedDict, total=False):
    """A processor's file."""

    steps: list[Step]


def looks_local(text: str) -> bool:
    """Return whether a name can only be a path of this machine, never a repository ``user/name``."""
    return text.startswith((".", "/", "~")) or text.count("/") > 1 or text.endswith("/")


def shipped_policies() -> dict[str, Path]:
    """Return name -> checkpoint folder of the trained policies that come with the package."""
    return {file.parent.name: file.parent for file in sorted(SHIPPED.glob(f"*/{CONFIG_FILE}"))}


def checkpoint_folder(text: str) -> Path | None:
    """Return the checkpoint that a text means: that of a policy that comes with the package, by its name; or a folder,
    itself or the last one of a training run; None when there is none. Of two of one name, ``./name`` is the folder.
    """
    return shipped_policies().get(text) or folder_with_checkpoint(text)


def folder_with_checkpoint(text: str) -> Path | None:
    """Return the checkpoint in a folder: itself, or the last one of a training run; None when there is none."""
    base = Path(text).expanduser()
    for folder in (base, base / "pretrained_model", base / "checkpoints" / "last" / "pretrained_model"):
        if (folder / CONFIG_FILE).is_file():
            return folder
    return None


def portable_path(path: str) -> str:
    """Return how another machine knows a checkpoint: by its name if it comes with the package, else by its path."""
    names = {str(folder): name for name, folder in shipped_policies().items()}
    return names.get(path, path)


def local_folder(path: str) -> Path | None:
    """Return the folder of a checkpoint: here, or where the hub's cache keeps a repository; None when not here."""
    here = checkpoint_folder(path)
    if here is not None or looks_local(path):
        return here
    from huggingface_hub import try_to_load_from_cache

    cached = try_to_load_from_cache(path, CONFIG_FILE)
    return Path(cached).parent if isinstance(cached, str) else None


def checkpoint_type(path: str) -> str | None:
    """Return the policy type of a checkpoint folder; None for one that is not on this machine."""
    folder = Path(path).expanduser()
    if not folder.is_dir():
        return None
    name = read_json(folder / CONFIG_FILE).get("type")
    if not isinstance(name, str):
        raise MemobenchError(f"{folder / CONFIG_FILE} names no policy type; expected a checkpoint of LeRobot")
    return name


def read_json(path: Path, schema: Any = dict[str, Any]) -> dict[str, Any]:
    """Return the object in a JSON file, or tell what is wrong with it."""
    try:
        content: dict[str, Any] = read_json_file(path, schema, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(
            f"{path} is missing; expected a whole checkpoint folder as lerobot-train saves it"
        ) from None
    return content


def check_checkpoint(path: str) -> None:
    """Refuse a checkpoint folder that cannot act as it was trained.

    A policy without the statistics of its training data would run on raw numbers and score 0 % without a
    word.

    Raises:
        MemobenchError: weights, processors or normalisation statistics are missing.
    """
    folder = Path(path).expanduser()
    if not folder.is_dir():
        if looks_local(path):
            raise MemobenchError(f"the checkpoint folder {path} does not exist")
        return  # a repository: LeRobot fetches it
    checkpoint_type(path)
    if not any((folder / name).is_file() for name in (WEIGHTS_FILE, ADAPTER_FILE)):
        raise MemobenchError(f"the checkpoint {folder} holds no weights ({WEIGHTS_FILE}); copy or train it again")
    for name in (PREPROCESSOR_FILE, POSTPROCESSOR_FILE):
        for step in read_json(folder / name, Processor).get("steps", []):
            if str(step.get("registry_name", "")).endswith("normalizer_processor"):
                _check_statistics(folder, name, step)


def _check_statistics(folder: Path, file: str, step: Mapping[str, Any]) -> None:
    config = step.get("config", {})
    modes = config.get("norm_map", {})
    needed = [
        key
        for key, feature in config.get("features", {}).items()
        if str(modes.get(feature.get("type"), "IDENTITY")).upper() != "IDENTITY"
        and _applies(file, str(feature.get("type")))
    ]
    state_file = step.get("state_file")
    present: set[str] = set()
    if isinstance(state_file, str):
        present = _tensor_names(folder / file_name(state_file, f"state_file in {folder / file}"))
    missing = [key for key in needed if not any(name.startswith(f"{key}.") for name in present)]
    if missing:
        raise MemobenchError(
            f"the checkpoint {folder} has no normalisation statistics for {', '.join(missing)} "
            f"({state_file or file}); copy it whole or train it again, since without them it would act on "
            "raw numbers"
        )


def _applies(file: str, feature_type: str) -> bool:
    """The preprocessor normalises observations (and actions in training), the postprocessor actions alone."""
    return file == PREPROCESSOR_FILE or feature_type == "ACTION"


def _tensor_names(path: Path) -> set[str]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise MemobenchError(
            f"the checkpoint {path.parent} lacks its normalisation statistics ({path.name} is missing); "
            "copy it whole or train it again"
        )
    try:
        with safe_open(path, framework="numpy") as file:
            return set(file.keys())
    except (SafetensorError, OSError) as error:
        raise MemobenchError(f"{path} cannot be read ({error}); copy or train the checkpoint again") from None
