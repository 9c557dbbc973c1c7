"""Write a view of a dataset for LeRobot's trainer: without prompt and held frames, and with columns of chosen inputs.

LeRobot trains on all frames, including those of demonstration prompts and holds, in which actions have no effect. It
uses every column that begins with ``observation`` as an input: pictures, object state, phase and step. A view is a
LeRobotDataset v3.0 with a part of the frames and columns; its videos are links to the dataset's, or mirrored copies for
another convention of pictures. Each part of an episode between two holds is an episode of the view, so that chunks of
actions and windows of inputs end at a hold.
"""

from __future__ import annotations

import copy
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_IMAGES
from lerobot.utils.feature_utils import dataset_to_policy_features
from PIL import Image, ImageOps

from lerobot_memobench.datasets.demonstration import LEVEL_COLUMNS
from lerobot_memobench.datasets.episodes import read_info, tables_of, undamaged
from lerobot_memobench.datasets.frames import FrameTable, read_frame_table
from lerobot_memobench.datasets.layout import (
    EPISODES,
    INFO_FILE,
    LANGUAGE,
    PRIVILEGED,
    STATS_FILE,
    TASKS_FILE,
    image_key,
    without_pattern,
)
from lerobot_memobench.datasets.layout import OBJECTS as OBJECTS_COLUMN
from lerobot_memobench.datasets.statistics import recorded
from lerobot_memobench.datasets.video import mirror_video, video_info
from lerobot_memobench.envs.observations import chooses_inputs, reads_prompt
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import cache_folder, explaining_disk_errors, files_below, write_file
from lerobot_memobench.policies.checkpoint import trained_names
from lerobot_memobench.policies.compatibility import keeps_sizes
from lerobot_memobench.protocol import CAMERAS, CLOCK, IMAGE_SIZE
from lerobot_memobench.sim.convention import CONVENTIONS, MIRRORED, OTHER, convention_of
from lerobot_memobench.training.configuration import check_environment, with_features
from lerobot_memobench.training.data import check_episodes, complete_statistics
from lerobot_memobench.training.features import cameras_of

SOURCE_EPISODE = "source_episode_index"
"""Column of a view's episodes: the dataset's episode of which each is a part."""


@dataclass(frozen=True)
class Choice:
    """The frames and columns of a view.

    Attributes:
        prompts: whether the view has the frames of demonstration prompts and holds, and the clock.
        obs_type: `envs.observations.OBS_TYPES`; None: all observations.
        convention: of the pictures (`sim.convention`); None: the dataset's.
    """

    prompts: bool = False
    obs_type: str | None = None
    convention: str | None = None

    def columns(self, features: Mapping[str, Any]) -> dict[str, str]:
        """Return the view's columns: name in the dataset -> name in the view.

        Raises:
            MemobenchError: the dataset lacks the observations.
        """
        cameras = cameras_of(features)
        objects = [name for name in (PRIVILEGED, OBJECTS_COLUMN) if name in features][:1]
        dropped = set() if self.prompts else {*CLOCK}
        if (self.obs_type in (OBJECTS, BOTH) and not objects) or (self.obs_type in (PIXELS, BOTH) and not cameras):
            found = ", ".join(cameras + objects) or "neither pictures nor objects"
            raise MemobenchError(
                f"found obs_type={self.obs_type}, and the dataset has {found}; choose another obs_type, or generate a "
                "dataset that has it"
            )
        if self.obs_type == OBJECTS:
            dropped |= {*cameras}
        if self.obs_type == PIXELS:
            dropped |= {OBJECTS_COLUMN}
        renamed = {PRIVILEGED: OBJECTS_COLUMN} if self.obs_type in (OBJECTS, BOTH) else {}
        if self.mirrors(features):
            old, new = (CONVENTIONS[one] for one in (OTHER[str(self.convention)], str(self.convention)))
            renamed |= {image_key(old[camera]): image_key(new[camera]) for camera in CAMERAS}
        return {name: renamed.get(name, name) for name in features if name not in dropped}

    def mirrors(self, features: Mapping[str, Any]) -> bool:
        """Return whether the view's pictures are those of the dataset, mirrored left to right.

        Raises:
            MemobenchError: the view has no pictures, or the dataset's convention is unknown.
        """
        if self.convention is None:
            return False
        cameras, found = cameras_of(features), convention_of(features)
        if not cameras or self.obs_type == OBJECTS:
            raise MemobenchError(f"found convention={self.convention}, and the view has no pictures; leave it out")
        if found is None:
            raise MemobenchError(
                f"found convention={self.convention}, and it is unknown whether {', '.join(cameras)} are upright or "
                "mirrored; name a dataset of this package, or one of LIBERO with image and image2"
            )
        return found != self.convention


# -- for a training ----------------------------------------------------------------------------------------------------


def viewed(
    config: TrainPipelineConfig, prompt_frames: bool | None, obs_type: str | None, notify: Callable[[str], None]
) -> TrainPipelineConfig:
    """Return the configuration for LeRobot's trainer, with a view of the dataset if it is needed.

    Args:
        prompt_frames: whether to train on prompt frames; None: if the policy reads prompts.
        obs_type: kind of observation; None: pictures if the dataset has them, else objects.
        notify: called with the view's folder.

    Raises:
        MemobenchError: the dataset lacks the observations, or is streamed from the hub.
    """
    config = copy.deepcopy(config)
    given, policy = config.dataset, config.policy
    if policy is None:
        return config
    if given.root is not None:
        given.root = str(without_pattern(Path(given.root)))
    meta = LeRobotDatasetMetadata(given.repo_id, root=given.root, revision=given.revision)
    check_episodes(given.episodes, meta)
    choice = choice_for(policy, meta.features, prompt_frames, obs_type)
    kept = choice.columns(meta.features)
    features = {new: meta.features[name] for name, new in kept.items()}
    if policy.pretrained_path is not None and not config.rename_map:
        names = trained_names(policy.pretrained_path)
        config.rename_map = {old: new for old, new in names.items() if old in features}
    check_environment(config, meta, features)
    check_inputs(policy, meta, features, config.rename_map)
    sizes = [tuple(features[name]["shape"][:2]) for name in cameras_of(features)]
    if _is_ours(meta.features) and keeps_sizes(policy) and any(size != (IMAGE_SIZE, IMAGE_SIZE) for size in sizes):
        height, width = sizes[0]
        notify(
            f"note: {meta.root} has pictures of {height} x {width} pixels, and policy={policy.type} does not resize "
            f"them; evaluate it with observation_height={height} observation_width={width}"
        )
    if given.streaming and not (Path(meta.root) / "data").is_dir():
        if needs_view(meta.features, choice):
            raise MemobenchError(
                f"dataset.streaming=true reads {given.repo_id} from the hub with its prompts and all of its columns; "
                "leave dataset.streaming out"
            )
        return config
    complete_statistics(policy, meta, given)
    if choice.prompts and not policy.input_features and not chooses_inputs(policy):
        policy.input_features = {  # the view has the clock, which is not an input
            name: one
            for name, one in dataset_to_policy_features({new: meta.features[old] for old, new in kept.items()}).items()
            if one.type is not FeatureType.ACTION and name not in CLOCK
        }
    if not needs_view(meta.features, choice):
        return config
    root = Path(meta.root)
    if not (root / "data").is_dir():
        root = Path(LeRobotDataset(given.repo_id, root=given.root, revision=given.revision).root)
    folder = cache_folder() / "views" / f"{root.resolve().name}-{view_hash(root, choice)}"
    if not (folder / INFO_FILE).is_file():
        write_view(root, folder, choice)
    notify(f"LeRobot's trainer reads {folder}: {described(choice)}")
    if given.episodes is not None:
        sources = LeRobotDatasetMetadata(given.repo_id, root=folder).episodes[SOURCE_EPISODE]
        given.episodes = [number for number, source in enumerate(sources) if source in given.episodes]
    given.root = str(folder)
    return config


def check_inputs(policy: Any, meta: Any, features: dict[str, Any], renamed: Mapping[str, str]) -> None:
    """Refuse inputs that a policy cannot have, such as two cameras of VQ-BeT; LeRobot does after opening the data."""
    made = with_features(policy, features)
    read, there = [*made.image_features], {renamed.get(name, name): name for name in cameras_of(features)}
    missing, free = ([name for name in one if name not in other] for one, other in ((read, there), (there, read)))
    if missing and free:
        guess = json.dumps(dict(zip((there[name] for name in free), missing, strict=False)))
        raise MemobenchError(
            f"the policy {policy.pretrained_path or policy.type} reads {', '.join(read)}, and {meta.root} has "
            f"{', '.join(there.values())}; map its names, for example by rename_map='{guess}'"
        )
    try:
        made.validate_features()
    except ValueError as error:
        raise MemobenchError(
            f"policy={policy.type} cannot read {', '.join(made.input_features)} of {meta.root}: {error} Choose its "
            "inputs by policy.input_features"
        ) from None


def choice_for(policy: Any, features: Mapping[str, Any], prompt_frames: bool | None, obs_type: str | None) -> Choice:
    """Return the frames and inputs that a policy is trained on; a checkpoint keeps its inputs."""
    prompts = reads_prompt(policy) if prompt_frames is None else prompt_frames
    begun = getattr(policy, "input_features", None) or {}
    if chooses_inputs(policy):
        return Choice(prompts, None)
    if begun:
        pictures = any(one.type is FeatureType.VISUAL for one in begun.values())
        objects = OBJECTS_COLUMN in begun
        seen = {(True, True): BOTH, (True, False): PIXELS, (False, True): OBJECTS}.get((pictures, objects))
        return Choice(prompts, seen)
    if obs_type is None:
        objects = PRIVILEGED in features or OBJECTS_COLUMN in features
        obs_type = PIXELS if cameras_of(features) else OBJECTS if objects else None
    return Choice(prompts, obs_type)


def _is_ours(features: Mapping[str, Any]) -> bool:
    """Return whether a dataset is the benchmark's, by its texts too: a phase alone may have another meaning."""
    return {*CLOCK, LEVEL_COLUMNS["intermediate"]} <= {*features}


def needs_view(features: Mapping[str, Any], choice: Choice) -> bool:
    """Return whether a dataset differs from its view."""
    kept = choice.columns(features)
    shortened = _is_ours(features) and not choice.prompts
    return shortened or choice.mirrors(features) or kept != {name: name for name in features}


def described(choice: Choice) -> str:
    """Return a view's content in words."""
    frames = "all frames" if choice.prompts else "without the frames of prompts and holds"
    return f"{frames}, {choice.obs_type or 'all observations'}"


# -- files -------------------------------------------------------------------------------------------------------------


def view_hash(root: Path, choice: Choice) -> str:
    """Return a hash of a dataset's path, tables and metadata, of the choice, and of the layout of views."""
    digest = hashlib.blake2b(f"{root.resolve()} {choice} {SOURCE_EPISODE}".encode(), digest_size=8)
    for path in (*files_below(root / "meta"), *files_below(root / "data", ".parquet")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def write_view(root: Path, out: Path, choice: Choice) -> None:
    """Write a view of the dataset in ``root``.

    Raises:
        MemobenchError: ``out`` exists, the dataset lacks the observations or is damaged, or the disk is full.
    """
    if out.exists():
        raise MemobenchError(f"{out} exists already; name another folder, or delete it")
    info, table = read_info(root), read_frame_table(root)
    kept, mirrors = choice.columns(info["features"]), choice.mirrors(info["features"])
    part = Part.of(table, _is_ours(info["features"]) and not choice.prompts)
    if not part.starts.size:
        raise MemobenchError(f"{root} has no frame whose action has an effect; name a dataset of `memobench generate`")
    build = out.with_name(f".{out.name}.{os.getpid()}")
    with explaining_disk_errors(out):
        shutil.rmtree(build, ignore_errors=True)
        for path, rows in tables_of(root / "data"):
            with undamaged(path):
                frames = _frames_of(rows, kept, part, info["fps"])
                frames = _mirrored(frames) if mirrors else frames
            _write_table(frames, build / path.relative_to(root))
        for path, rows in tables_of(root / EPISODES):
            _write_table(_episodes_of(rows, kept, part, info["fps"]), build / path.relative_to(root))
        features = {new: info["features"][name] for name, new in kept.items()}
        for name in cameras_of(info["features"]):
            if name in kept:
                _write_videos(root, build, name, kept[name], info["fps"] if mirrors else None)
        for name in cameras_of(features) if mirrors else ():
            stated = choice.convention if choice.convention == MIRRORED or not _is_ours(info["features"]) else None
            features[name] = _described(features[name], build / "videos" / name, stated)
        count = len(part.starts)
        info |= {"features": features, "total_episodes": count, "total_frames": int(part.lengths.sum())}
        info["splits"] = {"train": f"0:{count}"}
        write_file(build / INFO_FILE, json.dumps(info, indent=4))
        stats = recorded(root)
        write_file(build / STATS_FILE, json.dumps({kept[name]: one for name, one in stats.items() if name in kept}))
        shutil.copyfile(root / TASKS_FILE, build / TASKS_FILE)
        build.rename(out)


class Part(NamedTuple):
    """The frames of a view: S stretches of a dataset's E episodes, each of which is an episode of the view.

    Attributes:
        starts: (S,) first frame of each stretch in the dataset. lengths: (S,) number of its frames.
        firsts: (S,) first frame in the view.
        sources: (S,) its episode in the dataset. offsets: (S,) frames of that episode before it.
    """

    starts: np.ndarray
    lengths: np.ndarray
    firsts: np.ndarray
    sources: np.ndarray
    offsets: np.ndarray

    @classmethod
    def of(cls, table: FrameTable, shortened: bool) -> Part:
        """Return all episodes, or if ``shortened`` the stretches of frames whose action has an effect."""
        acts = table.acts if shortened else np.ones(len(table.phase), np.bool_)
        edges = table.runs(acts)
        starts, lengths = edges[:-1], np.diff(edges)
        starts, lengths = starts[acts[starts]], lengths[acts[starts]]
        sources = np.searchsorted(table.episodes, starts, "right") - 1
        return cls(starts, lengths, np.cumsum(lengths) - lengths, sources, starts - table.episodes[sources])


def _frames_of(rows: pa.Table, kept: Mapping[str, str], part: Part, fps: float) -> pa.Table:
    """Return the view's rows and columns of a data file, with new numbers."""
    index = rows.column("index").to_numpy()
    stretch = np.searchsorted(part.starts, index, "right") - 1
    wanted = (stretch >= 0) & (index < (part.starts + part.lengths)[stretch])
    rows, index, stretch = rows.filter(pa.array(wanted)).replace_schema_metadata(None), index[wanted], stretch[wanted]
    within = index - part.starts[stretch]
    numbers = {"index": part.firsts[stretch] + within, "episode_index": stretch, "frame_index": within}
    numbers["timestamp"] = (within / fps).astype(np.float32)
    for name, values in numbers.items():
        place = rows.column_names.index(name)
        rows = rows.set_column(place, name, pa.array(values, rows.schema.field(name).type))
    if LANGUAGE in rows.column_names:
        place, seconds = rows.column_names.index(LANGUAGE), part.offsets[stretch] / fps
        rows = rows.set_column(place, LANGUAGE, _earlier(rows.column(LANGUAGE).combine_chunks(), seconds))
    there = [name for name in rows.column_names if name in kept]
    return rows.select(there).rename_columns([kept[name] for name in there])


def _earlier(texts: pa.ListArray, seconds: np.ndarray) -> pa.ListArray:
    """Return LeRobot's language rows (N,) with timestamps reduced by seconds (N,)."""
    lengths, rows = pc.list_value_length(texts).fill_null(0).to_numpy(zero_copy_only=False), texts.flatten()
    columns = {field.name: rows.field(place) for place, field in enumerate(rows.type)}
    kind = columns["timestamp"].type
    columns["timestamp"] = pc.subtract(columns["timestamp"], pa.array(np.repeat(seconds, lengths), kind))
    offsets = pa.array(np.concatenate([[0], np.cumsum(lengths)]), pa.int32())
    return pa.ListArray.from_arrays(offsets, pa.StructArray.from_arrays(list(columns.values()), fields=list(rows.type)))


def _mirrored(frames: pa.Table) -> pa.Table:
    """Return frames with LeRobot's images in them mirrored left to right, as PNG."""
    for place, field in enumerate(frames.schema):
        if field.name.startswith(OBS_IMAGES) and pa.types.is_struct(field.type):
            rows = [{**row, "bytes": _mirrored_image(row["bytes"])} for row in frames.column(place).to_pylist()]
            frames = frames.set_column(place, field, pa.array(rows, field.type))
    return frames


def _mirrored_image(content: bytes) -> bytes:
    with Image.open(BytesIO(content)) as image, BytesIO() as file:
        ImageOps.mirror(image).save(file, "PNG")
        return file.getvalue()


def _write_videos(root: Path, build: Path, name: str, new: str, mirrored_at: int | None) -> None:
    """Write a camera's videos: links to the dataset's, or mirrored at so many frames/s."""
    for path in files_below(root / "videos" / name, ".mp4"):
        place = build / "videos" / new / path.relative_to(root / "videos" / name)
        if mirrored_at is None:
            _link(path.resolve(), place)
        else:
            place.parent.mkdir(parents=True, exist_ok=True)
            with undamaged(path):
                mirror_video(path, place, mirrored_at)


def _described(feature: dict[str, Any], videos: Path, stated: str | None) -> dict[str, Any]:
    """Return LeRobot's description of a camera's mirrored pictures, which states their convention where needed."""
    found = {key: one for key, one in feature.items() if key not in ("convention", "info")}
    files = files_below(videos, ".mp4")
    return found | ({"convention": stated} if stated else {}) | ({"info": video_info(files[0])} if files else {})


def _episodes_of(rows: pa.Table, kept: Mapping[str, str], part: Part, fps: float) -> pa.Table:
    """Return the view's rows of a file of the episodes' table: numbers, bounds of frames, and times in the videos."""
    numbers = rows.column("episode_index").to_numpy()
    stretches = np.flatnonzero(np.isin(part.sources, numbers))
    rows = rows.take(pa.array(np.searchsorted(numbers, part.sources[stretches])))  # they are in the order of numbers
    firsts, lengths = part.firsts[stretches], part.lengths[stretches]
    changed = {
        "episode_index": stretches,
        "dataset_from_index": firsts,
        "dataset_to_index": firsts + lengths,
        "length": lengths,
    }
    for name in rows.column_names:
        if name.endswith("/from_timestamp"):
            changed[name] = rows.column(name).to_numpy() + part.offsets[stretches] / fps
            changed[name.replace("/from_", "/to_")] = changed[name] + lengths / fps
    rows = rows.select([name for name in rows.column_names if name != SOURCE_EPISODE])  # a view of a view has it
    rows = rows.append_column(SOURCE_EPISODE, rows.column("episode_index"))
    for name, values in changed.items():
        rows = rows.set_column(rows.column_names.index(name), name, pa.array(values, rows.schema.field(name).type))
    rows = rows.select([name for name in rows.column_names if not name.startswith("stats/")])
    parts = [name.split("/") for name in rows.column_names]  # videos/<camera>/<place>
    names = ["/".join(kept.get(one, one) if at == 1 else one for at, one in enumerate(each)) for each in parts]
    return rows.rename_columns(names).replace_schema_metadata(None)


def _write_table(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _link(path: Path, place: Path) -> None:
    """Link to a file, or copy it if links are not supported."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        place.symlink_to(path)
    except OSError:
        shutil.copyfile(path, place)
