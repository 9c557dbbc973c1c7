"""Find, check and identify trained policies: their checkpoints and their configurations.

LeRobot imports and calls any ``class`` that a checkpoint's processor names, so its steps are checked before it builds
them. Each check raises `MemobenchError`. A source is a checkpoint folder, or a repository, whose files are fetched when
they are read.
"""

from __future__ import annotations

import copy
import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict

from lerobot_memobench.constants import CLOCK
from lerobot_memobench.envs.evaluation_file import Acting
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError, short
from lerobot_memobench.io import LONGEST_NAME, file_hash, file_name
from lerobot_memobench.untrusted import Count, check_fetched, read_json, refusing

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

# LeRobot's names of the files in a checkpoint.
CONFIG_FILE, TRAIN_CONFIG = "config.json", "train_config.json"
WEIGHTS_FILE, ADAPTER_FILE = "model.safetensors", "adapter_model.safetensors"
PREPROCESSOR_FILE, POSTPROCESSOR_FILE = "policy_preprocessor.json", "policy_postprocessor.json"
CHECKPOINTS, LAST = "checkpoints", "last"
"""LeRobot's folder of a training run's checkpoints, and its link to the last one."""
RENAMING = "rename_observations_processor"
"""LeRobot's processor step that gives observations the names of a policy."""
RANDOM_IF_MISSING = ("pi0", "pi05", "pi0_fast")
"""LeRobot's policies that act with random weights if there are none."""
PACKAGES = ("lerobot", "lerobot_memobench")
PLUGIN = "lerobot_policy_"
"""Prefix of the packages that LeRobot imports as plugins."""
NAMES_CODE = ("class", "registry_name", "_target_")
"""Keys of nested mappings that would build an object."""
REMOTE_CODE = {
    "action_tokenizer_name": "lerobot/fast-action-tokenizer",
    "paligemma_tokenizer_name": "google/paligemma-3b-pt-224",
    "model_name": "nvidia/Cosmos-Reason2-2B",
}
"""Settings of LeRobot's steps that run the Python code of a repository -> LeRobot's values."""
ADVICE = "copy or train the checkpoint again"
NOT_THE_CHECKPOINT = (
    *("train_config.json", "README.md", "training_weights.safetensors", ".gitattributes"),
    *("training_curve.png", "training_curve.json"),
)
"""Files of a checkpoint folder that do not affect the policy's actions."""
ELSEWHERE = (
    *("device", "pretrained_path", "repo_id", "private", "tags", "license", "push_to_hub", "use_peft"),
    *("host", "port", "servers", "connect_timeout", "timeout"),
)
"""Settings of where a policy runs or is published; its actions do not depend on them."""
LONGEST, LARGEST = 100_000, 10_000_000
"""Largest number of control steps or tokens of a policy, and largest other number of its configuration."""
LENGTHS = ("chunk_size", "horizon", "memory_settings.frames", "n_action_steps", "n_obs_steps", "tokenizer_max_length")
SHIPPED = Path(__file__).parent / "shipped"
"""Folder of the trained policies that come with the package, each in a folder of its name."""


# --- the parts of LeRobot's files that are read ---


class _StepConfig(TypedDict, total=False):
    norm_map: dict[str, str]
    features: dict[str, dict[str, Any]]
    rename_map: dict[str, str]


class SavedStep(TypedDict, total=False):
    """A step of a processor; ``config`` of those that normalise or rename."""

    registry_name: str
    state_file: str | None
    config: _StepConfig


class _Processor(TypedDict, total=False):
    steps: list[SavedStep]


class _TrainedOn(TypedDict, total=False):
    repo_id: str | None
    revision: str | None
    root: str | None
    episodes: list[int] | None


class TrainConfig(TypedDict):
    """A checkpoint's ``train_config.json``."""

    dataset: _TrainedOn
    steps: NotRequired[Count | None]
    rename_map: NotRequired[dict[str, str] | None]


# --- finding checkpoints ---


def looks_local(text: str) -> bool:
    """Return whether a name is a path of this machine and not a repository ``user/name``."""
    # A folder of that name does not make lerobot/act a path: many users have a copy of LeRobot in the current folder.
    return text.startswith((".", "/", "~", "outputs/")) or text.count("/") > 1 or text.endswith("/")


def shipped_policies() -> dict[str, Path]:
    """Return name -> checkpoint folder of the trained policies that come with the package."""
    return {file.parent.name: file.parent for file in sorted(SHIPPED.glob(f"*/{CONFIG_FILE}"))}


def checkpoint_folder(text: str) -> Path | None:
    """Return the folder of a shipped policy, of a checkpoint, or of the last one of a training run; None without one.

    If a shipped policy and a folder have the same name, ``./name`` is the folder.
    """
    if text in (shipped := shipped_policies()):
        return shipped[text]
    base = Path(text).expanduser()
    for last in (base, base.parent):  # of a copy that lost the link
        if (last.parent.name, last.name) == (CHECKPOINTS, LAST) and not last.is_dir():
            named = checkpoints_of(last.parent.parent)[:1]
            base = named[0] / base.relative_to(last) if named else base
            break
    folders = (base, *(checkpoint / "pretrained_model" for checkpoint in (base, *checkpoints_of(base))))
    return next((folder for folder in folders if (folder / CONFIG_FILE).is_file()), None)


def checkpoints_of(run: Path) -> list[Path]:
    """Return a run's checkpoint folders, complete or not: the one that ``last`` names, then the newest first.

    ``last`` is a link. In a copy it may be missing, a folder, or a file with the link's text.
    """
    last = run / CHECKPOINTS / LAST
    numbered = [path for path in last.parent.iterdir() if path.name.isdecimal()] if last.parent.is_dir() else []
    numbered.sort(key=lambda path: int(path.name), reverse=True)
    latest = [last] if last.is_dir() else [path for path in numbered if path.name == text_of_link(last)]
    return [*latest, *numbered]


def text_of_link(path: Path) -> str | None:
    """Return the text of a small file that a copy made of a link, None if there is no such file."""
    if not path.is_file() or path.stat().st_size > LONGEST_NAME:
        return None
    return path.read_text(errors="replace").strip()


def portable_path(path: str) -> str:
    """Return the name of a checkpoint that comes with the package, which other machines know, else its path."""
    names = {str(folder): name for name, folder in shipped_policies().items()}
    return names.get(path, path)


def local_folder(path: str) -> Path | None:
    """Return the folder of a checkpoint, also of a repository in the hub's cache; None if it is not on this machine."""
    here = checkpoint_folder(path)
    return here if here is not None or looks_local(path) else cached_folder(path)


def cached_folder(repository: str) -> Path | None:
    """Return the folder of a repository in the hub's cache, None without one."""
    from huggingface_hub import try_to_load_from_cache

    cached = try_to_load_from_cache(repository, CONFIG_FILE)
    return Path(cached).parent if isinstance(cached, str) else None


# --- reading checkpoints ---


def checkpoint_settings(path: str) -> dict[str, Any]:
    """Return the settings in the configuration of a source, or raise `MemobenchError`."""
    if not Path(path).expanduser().is_dir() and looks_local(path):
        raise MemobenchError(f"the checkpoint folder {path} does not exist")
    if (file := checkpoint_file(path, CONFIG_FILE)) is None:
        raise MemobenchError(f"{path} holds no {CONFIG_FILE}; expected a complete checkpoint as lerobot-train saves it")
    return read_checkpoint_json(file)


def checkpoint_type(path: str) -> str:
    """Return the policy type of a source, or raise `MemobenchError`."""
    name = checkpoint_settings(path).get("type")
    if not isinstance(name, str):
        raise MemobenchError(
            f"{Path(path) / CONFIG_FILE} names no policy type; LeRobot cannot read checkpoints of its first year: "
            "train the policy again"
        )
    return name


def read_checkpoint_json(path: Path, schema: Any = dict[str, Any]) -> dict[str, Any]:
    """Return the object in a JSON file of a checkpoint; raise `MemobenchError` if it is missing, or not of a schema."""
    try:
        return read_json(path, schema, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(
            f"{path} is missing; expected a complete checkpoint folder as lerobot-train saves it"
        ) from None


def check_checkpoint(path: str) -> None:
    """Refuse a source without weights, trusted processors or normalisation statistics."""
    folder = Path(path).expanduser()
    if folder.is_dir() or looks_local(path):  # else a repository: LeRobot fetches these files
        checkpoint_type(path)
        if not any((folder / name).is_file() for name in (WEIGHTS_FILE, ADAPTER_FILE)):
            raise MemobenchError(f"the checkpoint {folder} holds no weights ({WEIGHTS_FILE}); copy or train it again")
        for weights in folder.glob("*.safetensors"):
            check_fetched(weights)
        check_processor_statistics(folder)
    check_processors(path)


def check_processor_statistics(source: str | Path, revision: str | None = None) -> None:
    """Refuse processors without the statistics of the training data, which would run on raw numbers and score 0 %."""
    for name in (PREPROCESSOR_FILE, POSTPROCESSOR_FILE):
        file = checkpoint_file(source, name, revision)
        if file is None:
            raise MemobenchError(
                f"{Path(source) / name} is missing; copy the checkpoint, or migrate one of an earlier LeRobot: "
                f"python -m lerobot.processor.migrate_policy_normalization --pretrained-path {source}"
            )
        for step in filter(_normalises, processor_steps(file)):
            state = step.get("state_file")
            named = None if state is None else file_name(state, f"state_file in {file}")
            path = None if named is None else checkpoint_file(source, named, revision)
            known = () if path is None else _shapes(path)
            missing = [
                key for key in _normalised(step, name) if not any(saved.startswith(f"{key}.") for saved in known)
            ]
            if missing or (state is not None and path is None):
                raise MemobenchError(
                    f"the checkpoint {source} has no normalisation statistics for {', '.join(missing)} "
                    f"({state or name}), and would act on raw numbers; copy the whole checkpoint or train it again"
                )


def _normalised(step: SavedStep, processor: str) -> Iterator[str]:
    config = step.get("config", {})
    modes = config.get("norm_map", {})
    for key, feature in config.get("features", {}).items():
        raw = str(modes.get(str(feature.get("type")), "IDENTITY")).upper() == "IDENTITY"
        # The preprocessor normalises observations (and actions in training), the postprocessor actions alone.
        unread = processor == POSTPROCESSOR_FILE and feature.get("type") != "ACTION"
        # Datasets have no statistics of the clock, which stays raw, but `lerobot-train` lists it as an input.
        if not raw and not unread and key not in CLOCK:
            yield key


# --- code in checkpoints ---


def check_processors(path: str | Path, revision: str | None = None) -> None:
    """Refuse processor steps that neither LeRobot nor this package nor an installed plugin registers; build none."""
    config = _file_of(path, CONFIG_FILE, revision)
    kind = None if config is None else read_checkpoint_json(config).get("type")
    for name in (PREPROCESSOR_FILE, POSTPROCESSOR_FILE):
        file = _file_of(path, name, revision)
        for step in processor_steps(file):
            for reason in _reasons(step, kind):
                raise MemobenchError(
                    f"{file} {reason}; expected steps with plain settings that LeRobot, this package or an installed "
                    f"{PLUGIN}* package registers: install the policy's package, or use a checkpoint that you trust"
                )


def _reasons(step: Mapping[str, Any], kind: str | None) -> Iterator[str]:
    name, config = step.get("registry_name"), step.get("config") or {}
    if not isinstance(name, str) or "class" in step:
        yield f"names the class {short(step.get('class'))}, which LeRobot would import and call"
        return
    registered = _registered(name, kind)
    if registered is None or not _trusted(registered.__module__.partition(".")[0]):
        package = "no package" if registered is None else registered.__module__
        yield f"names the step {short(name)}, which {package} registers"
    yield from (
        f"holds {short(key)} in the settings of the step {short(name)}, which would name code"
        for key in _naming(config)
    )
    if config.get("trust_remote_code") is not False:
        for setting, known in REMOTE_CODE.items():
            if config.get(setting, known) != known:
                value = short(config[setting])
                yield f"sets {setting}={value} in the step {short(name)}, which runs code of that repository"


def _registered(name: str, kind: str | None) -> type | None:
    from lerobot.policies.factory import get_policy_class
    from lerobot.processor import ProcessorStepRegistry

    with suppress(Exception):  # packages of the policy may be missing
        get_policy_class(str(kind))  # registers its steps
    with suppress(KeyError):
        return ProcessorStepRegistry.get(name)
    return None


def _trusted(package: str) -> bool:
    from lerobot.configs import PreTrainedConfig

    policies = {config.__module__.partition(".")[0] for config in PreTrainedConfig.get_known_choices().values()}
    return package in {*PACKAGES, *policies} or package.startswith(PLUGIN)


def _naming(value: Any) -> Iterator[str]:
    """Yield the keys, at any depth, that would name code."""
    if isinstance(value, Mapping):
        yield from (key for key in NAMES_CODE if key in value)
        value = list(value.values())
    for nested in value if isinstance(value, list) else []:
        yield from _naming(nested)


# --- weights and settings ---


def check_weights(path: str | Path, policy: PreTrainedConfig, revision: str | None = None) -> None:
    """Refuse weights that are incomplete, or of other shapes than the configuration sets.

    LeRobot continues with random numbers if weights are missing. The weights are compared with a policy on the meta
    device. A policy that cannot be built there (its parts come from the hub) is not checked.
    """
    if policy.use_peft:
        return
    file = _file_of(path, WEIGHTS_FILE, revision)
    if file is None:
        if policy.type in RANDOM_IF_MISSING:
            raise MemobenchError(
                f"the checkpoint {path} holds no weights ({WEIGHTS_FILE}), or they cannot be downloaded, and LeRobot's "
                f"{policy.type} would act with random ones; copy or train it again"
            )
        return
    built = _built_empty(policy)
    if built is None:
        return
    tensors, wanted = _as_loaded(built, _shapes(file)), built.state_dict(keep_vars=True)
    names: dict[int, list[str]] = {}  # a tensor with several names is saved by one of them
    for name, tensor in wanted.items():
        names.setdefault(id(tensor), []).append(name)
    missing = [same[0] for same in names.values() if not any(name in tensors for name in same)]
    wrong = [name for name, tensor in wanted.items() if name in tensors and tensors[name] != tuple(tensor.shape)]
    if missing or wrong:
        raise MemobenchError(
            f"the weights of the checkpoint {path} do not fit its policy ({policy.type}): {len(missing)} of "
            f"{len(names)} are missing and {len(wrong)} have another shape, the first being {(missing + wrong)[0]}; "
            "copy the whole checkpoint or train it again"
        )


def check_as_trained(source: str | Path, policy: PreTrainedConfig, revision: str | None = None) -> None:
    """Refuse other values of the settings ``fixed_by_training`` (an attribute of the configuration's class)."""
    fixed = getattr(policy, "fixed_by_training", ())
    for name, value, trained in differing(policy, as_trained(source, policy, revision), fixed) if fixed else ():
        raise MemobenchError(
            f"--policy.{name}={value} cannot be used: '{source}' was trained with {trained}, and its weights depend on "
            f"it; leave {name} out, or train with it"
        )


def check_as_begun(checkpoint: str | Path, requested: PreTrainedConfig, begun: PreTrainedConfig) -> None:
    """Refuse to resume a training with other settings."""
    for name, value, earlier in differing(requested, begun, getattr(begun, "fixed_by_training", ())):
        raise MemobenchError(
            f"this training was begun with {name}={earlier} and cannot change it; found {value}; "
            f"leave {name} out, or train a new run from the checkpoint: policy={checkpoint} policy.{name}={value} "
            "output_dir=<new folder>"
        )


def as_trained(source: str | Path, policy: PreTrainedConfig, revision: str | None = None) -> PreTrainedConfig:
    """Return the configuration that a source was trained with, on a policy's device."""
    device = [f"--device={policy.device}"]  # LeRobot logs a warning if the device of the training is not available
    return type(policy).from_pretrained(source, revision=revision, cli_overrides=device)


def differing(
    policy: PreTrainedConfig, trained: PreTrainedConfig, names: Iterable[str]
) -> Iterator[tuple[str, object, object]]:
    """Yield name, value and earlier value of the settings that differ."""
    for name in names:
        value, earlier = getattr(policy, name), getattr(trained, name)
        if value != earlier:
            yield name, value, earlier


def _shapes(file: Path) -> dict[str, tuple[int, ...]]:
    from safetensors import safe_open

    with undamaged_tensors(file), safe_open(file, framework="numpy") as tensors:
        return {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118


def undamaged_tensors(file: Path) -> AbstractContextManager[None]:
    """As `refusing`, for reading the tensors of a checkpoint's file."""
    return refusing(lambda why: MemobenchError(f"{file} cannot be read ({why}); {ADVICE}"), file)


def _built_empty(policy: PreTrainedConfig) -> Any | None:
    import torch
    from lerobot.policies.factory import get_policy_class

    config = copy.deepcopy(policy)
    config.device = "meta"
    # Weights that the checkpoint replaces, and a detector, which the checkpoint does not hold.
    for loads in ("pretrained_backbone_weights", "load_vlm_weights", "base_weights", "detector"):
        if hasattr(config, loads):
            setattr(config, loads, None)
    try:
        with torch.device("meta"):
            return get_policy_class(policy.type)(config)
    except Exception:  # any policy may raise anything; LeRobot raises it again
        return None


def _as_loaded(policy: Any, shapes: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Return shapes by the names under which the policy loads them: pi0 and its relatives rename tensors."""
    import torch

    rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if rename is None:
        return shapes
    tensors = rename({name: torch.empty(shape, device="meta") for name, shape in shapes.items()}, policy.config)
    return {f"model.{name.removeprefix('model.')}": tuple(tensor.shape) for name, tensor in tensors.items()}


def statistics_shapes(source: str | Path) -> dict[str, tuple[int, ...]]:
    """Return name -> shape of the observations and actions that a policy was trained on; {} without statistics."""
    file = _file_of(source, PREPROCESSOR_FILE)
    names = [step.get("state_file") for step in filter(_normalises, processor_steps(file))]
    states = [_file_of(source, file_name(name, f"state_file in {file}")) for name in names if name]
    shapes = {key: shape for state in states if state is not None for key, shape in _shapes(state).items()}
    columns = {key.rpartition(".")[0]: shape for key, shape in shapes.items() if not key.endswith(".count")}
    renamed = trained_names(source)  # LeRobot saves statistics by the names of the data
    return {renamed.get(name, name): shape for name, shape in columns.items()}


def training_of(source: str | Path) -> dict[str, Any]:
    """Return the settings of a source's training (`TrainConfig`); {} if they are missing or not readable."""
    with suppress(MemobenchError):
        if (file := checkpoint_file(source, TRAIN_CONFIG)) is not None:
            return read_checkpoint_json(file, TrainConfig)
    return {}


def trained_names(source: str | Path) -> dict[str, str]:
    """Return the ``rename_map`` of a source's training: names in its data -> names of the policy."""
    if rename_map := training_of(source).get("rename_map"):
        return dict(rename_map)
    file = _file_of(source, PREPROCESSOR_FILE)
    configs = [step.get("config", {}) for step in processor_steps(file) if step.get("registry_name") == RENAMING]
    return {old: new for config in configs for old, new in config.get("rename_map", {}).items()}


def processor_steps(file: Path | None) -> list[SavedStep]:
    """Return the steps in the file of a processor; none without a file."""
    return [] if file is None else read_checkpoint_json(file, _Processor).get("steps", [])


def _normalises(step: SavedStep) -> bool:
    return str(step.get("registry_name", "")).endswith("normalizer_processor")


def checkpoint_file(source: str | Path, name: str, revision: str | None = None) -> Path | None:
    """Return a file of a source; None if there is no such file. Raise `MemobenchError` if it cannot be downloaded."""
    folder = Path(source).expanduser()
    if folder.is_dir():
        return folder / name if (folder / name).is_file() else None
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, LocalEntryNotFoundError

    try:
        return Path(hf_hub_download(str(source), name, revision=revision))
    except LocalEntryNotFoundError as error:
        raise MemobenchError(f"'{source}' is neither a folder nor reachable on the hub.") from error
    except EntryNotFoundError:
        return None
    except (HfHubHTTPError, OSError, ValueError) as error:
        raise MemobenchError(f"'{source}' is neither a folder nor a repository that can be read.") from error


def _file_of(path: str | Path, name: str, revision: str | None = None) -> Path | None:
    with suppress(MemobenchError):  # LeRobot reports that it cannot be downloaded
        return checkpoint_file(path, name, revision)
    return None


# --- configurations ---


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress LeRobot's log lines about plugins and configurations; the run logs them again."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)


def encoded_config(policy: Any) -> dict[str, Any]:
    """Return a policy's configuration as plain JSON values."""
    import draccus

    return {**json.loads(json.dumps(draccus.encode(policy), default=str)), "type": policy.type}


def check_sizes(policy: Any) -> None:
    """Refuse a policy whose configuration has a length or a size that no machine can allocate."""
    for name, value in _integers(encoded_config(policy)):
        most = LONGEST if name in LENGTHS else None if name.startswith("scheduler_") or "seed" in name else LARGEST
        if most is not None and value > most:
            raise MemobenchError(f"found policy.{name}={value}; expected at most {most}")


def _integers(value: Any, name: str = "") -> Iterator[tuple[str, int]]:
    """Yield dotted name and value of the whole numbers in an encoded configuration."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _integers(item, f"{name}.{key}".lstrip("."))
    elif isinstance(value, int):
        yield name, value


def has_device(device: str) -> bool:
    """Return whether this machine has a device of torch, such as ``cuda:1``."""
    import torch
    from lerobot.utils.device_utils import is_torch_device_available

    try:
        torch_device = torch.device(device)
        available = is_torch_device_available(torch_device.type)
    except (RuntimeError, ValueError):  # there is no such type
        return False
    return available and (torch_device.type != "cuda" or (torch_device.index or 0) < torch.cuda.device_count())


def check_device(device: str | None) -> None:
    """Refuse a device that the user names and the machine lacks; LeRobot would run on another one."""
    if device is not None and device not in ("", "null", "~") and not has_device(device):
        raise MemobenchError(
            f"this machine has no device {device!r} that torch can use; leave the device out to use the best one, or "
            "name cpu"
        )


# --- identity ---


def acting(policy: Any, path: str | None, settings: EnvSettings) -> Acting:
    """Return the description of a policy (its configuration, and its checkpoint or None) for the evaluation's file."""
    inputs = policy_inputs(policy, settings.obs_type, settings.oracle_memory)
    weights, hashed = path, dict[str, str]()
    if path is not None and Path(path).is_dir():
        weights = hashed["sha256"] = tree_hash(checkpoint_files(Path(path)))
    elif path is not None and (folder := cached_folder(path)) is not None:
        weights = f"{path}@{folder.name}"  # the commit in the hub's cache
    return Acting({"type": policy.type, "identity": identity_of(policy, path, weights), **hashed}, inputs)


def identity_of(policy: Any, path: str | None, weights: str | None) -> str:
    """Return a policy's type and one hash over its checkpoint's hash and the settings that differ from it."""
    from lerobot.configs import PreTrainedConfig

    default = policy
    with quiet():
        if path is not None:
            default = PreTrainedConfig.from_pretrained(path)
        else:
            with suppress(TypeError):  # a plugin with a required setting
                default = type(policy)()
    before = encoded_config(default)
    changes = {
        key: file_hash(Path(value)) if isinstance(value, str) and Path(value).is_file() else value
        for key, value in encoded_config(policy).items()
        if key not in (*ELSEWHERE, "type") and before.get(key) != value
    }
    facts = json.dumps([policy.type, weights, changes], sort_keys=True, default=str)
    return f"{policy.type} {hashlib.sha256(facts.encode()).hexdigest()[:12]}"


def checkpoint_files(folder: Path) -> dict[str, str]:
    """Return name -> SHA-256 of the files of a checkpoint."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and path.name not in NOT_THE_CHECKPOINT)
    return {path.name: file_hash(path) for path in files}


def tree_hash(files: Mapping[str, str]) -> str:
    """Return one SHA-256 over the lines ``<sha256>  <name>`` in the order of names, as sha256sum prints them."""
    lines = "".join(f"{files[name]}  {name}\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()
