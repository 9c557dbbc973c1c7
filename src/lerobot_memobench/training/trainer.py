"""LeRobot's own trainer, for other policies: the view of a dataset that it reads, and its samples.

LeRobot trains on all frames, also on those of prompts and holds, in which actions have no effect, and uses every column
that begins with ``observation`` as an input: images, object state, phase and step. A view is a LeRobotDataset v3.0 with
a part of the frames and columns; its videos are links to the dataset's, or mirrored copies for another convention of
images. Each part of an episode between two holds is an episode of the view, so that chunks of actions and windows of
inputs end at a hold.

LeRobot decodes all videos of a sample, and reads a table for each time of each column of a history. For policies
without images, samples come from main memory, bit-identical to LeRobot's: numbers are tensors, images are left out.
"""

from __future__ import annotations

import copy
import hashlib
import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.utils.constants import OBS_IMAGES
from lerobot.utils.feature_utils import dataset_to_policy_features
from PIL import Image, ImageOps
from torch import Tensor

from lerobot_memobench.commands.command_line import without
from lerobot_memobench.constants import CAMERAS, CLOCK, IMAGE_SIZE
from lerobot_memobench.datasets.demonstration import LEVEL_COLUMNS
from lerobot_memobench.datasets.episodes import read_info, tables_of, undamaged
from lerobot_memobench.datasets.frames import FrameTable, SamplesInMemory, read_frame_table
from lerobot_memobench.datasets.layout import (
    EPISODES,
    INFO_FILE,
    LANGUAGE,
    PRIVILEGED,
    STATS_FILE,
    TASKS_FILE,
    image_key,
)
from lerobot_memobench.datasets.layout import OBJECTS as OBJECTS_COLUMN
from lerobot_memobench.datasets.statistics import recorded
from lerobot_memobench.datasets.video import mirror_video, video_info
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.observations import chooses_inputs, reads_prompt
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import cache_folder, explaining_disk_errors, files_below, write_file
from lerobot_memobench.policies.checkpoint import trained_names
from lerobot_memobench.policies.compatibility import keeps_sizes
from lerobot_memobench.sim.convention import CONVENTIONS, MIRRORED, OTHER, convention_of
from lerobot_memobench.training.data import (
    check_environment,
    complete_statistics,
    downloaded,
    open_metadata,
    with_features,
)
from lerobot_memobench.training.features import cameras_of

logger = logging.getLogger(__name__)

SOURCE_EPISODE = "source_episode_index"
"""Column of a view's episodes: the dataset's episode that each is a part of."""


def prepare(
    config: TrainPipelineConfig, prompt_frames: bool | None, obs_type: str | None, notify: Callable[[str], None]
) -> TrainPipelineConfig:
    """Return the configuration for LeRobot's trainer, with a view of the dataset if it is needed.

    Without ``prompt_frames``, prompts are trained on if the policy reads them; without ``obs_type``, images are if the
    dataset has them, else objects.
    """
    config = copy.deepcopy(config)
    dataset, policy = config.dataset, config.policy
    if policy is None:
        return config
    meta = open_metadata(dataset)
    options = view_options(policy, meta.features, prompt_frames, obs_type)
    features = {new: meta.features[name] for name, new in options.columns(meta.features).items()}
    if policy.pretrained_path is not None and not config.rename_map:
        names = trained_names(policy.pretrained_path)
        config.rename_map = {old: new for old, new in names.items() if old in features}
    check_environment(config, meta, features)
    check_inputs(policy, meta, features, config.rename_map)
    sizes = [tuple(features[name]["shape"][:2]) for name in cameras_of(features)]
    other = any(size != (IMAGE_SIZE, IMAGE_SIZE) for size in sizes)
    if other and has_benchmark_columns(meta.features) and keeps_sizes(policy):
        height, width = sizes[0]
        notify(
            f"note: {meta.root} has images of {height} x {width} pixels, and policy={policy.type} does not resize "
            f"them; evaluate it with observation_height={height} observation_width={width}"
        )
    changed = needs_view(meta.features, options) and not config.resume  # it reads what the training was begun with
    if dataset.streaming and not (Path(meta.root) / "data").is_dir():
        if changed:
            raise MemobenchError(
                f"dataset.streaming=true reads {dataset.repo_id} from the hub with its prompts and all of its columns; "
                "leave dataset.streaming out"
            )
        return config
    complete_statistics(policy, meta, dataset)
    if options.prompts and not policy.input_features and not chooses_inputs(policy):
        policy.input_features = {  # the view has the clock, which is not an input
            name: feature
            for name, feature in dataset_to_policy_features(features).items()
            if feature.type is not FeatureType.ACTION and name not in CLOCK
        }
    if not changed:
        return config
    folder = cached_view(downloaded(dataset, meta), options)
    frames = "all frames" if options.prompts else "without the frames of prompts and holds"
    notify(f"LeRobot's trainer reads {folder}: {frames}, {options.obs_type or 'all observations'}")
    if dataset.episodes is not None:
        sources = LeRobotDatasetMetadata(dataset.repo_id, root=folder).episodes[SOURCE_EPISODE]
        dataset.episodes = [number for number, source in enumerate(sources) if source in dataset.episodes]
    dataset.root = str(folder)
    return config


def check_inputs(policy: Any, meta: Any, features: dict[str, Any], renamed: Mapping[str, str]) -> None:
    """Refuse inputs that a policy cannot have, such as two cameras of VQ-BeT; LeRobot does after opening the data."""
    config = with_features(policy, features)
    read, cameras = [*config.image_features], {renamed.get(name, name): name for name in cameras_of(features)}
    missing = [name for name in read if name not in cameras]
    free = [name for name in cameras if name not in read]
    if missing and free:
        guess = json.dumps(dict(zip((cameras[name] for name in free), missing, strict=False)))
        raise MemobenchError(
            f"the policy {policy.pretrained_path or policy.type} reads {', '.join(read)}, and {meta.root} has "
            f"{', '.join(cameras.values())}; map its names, for example by rename_map='{guess}'"
        )
    try:
        config.validate_features()
    except ValueError as error:
        raise MemobenchError(
            f"policy={policy.type} cannot read {', '.join(config.input_features)} of {meta.root}: {error} Choose its "
            "inputs by policy.input_features"
        ) from None


# -- the trainer -------------------------------------------------------------------------------------------------------


def run_lerobot(config: TrainPipelineConfig) -> None:
    """Run LeRobot's trainer, with samples in memory."""
    from lerobot.scripts import lerobot_train

    line, theirs = sys.argv, lerobot_train.make_train_eval_datasets
    # LeRobot reads the checkpoint of a resumed training in the arguments.
    path = config.checkpoint_path
    sys.argv = [line[0], *([] if path is None else [f"--config_path={path / 'pretrained_model'}"])]
    lerobot_train.make_train_eval_datasets = open_trainer_datasets
    try:
        lerobot_train.train(config)
    finally:
        sys.argv, lerobot_train.make_train_eval_datasets = line, theirs


def open_trainer_datasets(config: TrainPipelineConfig) -> tuple[Any, Any]:
    """Open LeRobot's datasets of a training and of its held-out episodes; keep them in memory without images.

    LeRobot opens environments without the policy, so those of the benchmark receive its plans here.
    """
    if isinstance(config.env, MemobenchEnvConfig):
        config.env.declare_plans(config.policy)
    datasets: tuple[Any, Any] = make_train_eval_datasets(config)
    inputs = getattr(config.policy, "input_features", None) or {}
    images = [name for name, feature in inputs.items() if feature.type is FeatureType.VISUAL]
    reads_images = bool(images if inputs else datasets[0].meta.camera_keys)
    if config.policy is not None and not config.dataset.streaming and not reads_images:
        for dataset in datasets:
            if dataset is not None:
                keep_in_memory(dataset)
        config.num_workers = 0  # each would hold a copy
        logger.info("samples are read from main memory, num_workers=0")
    return datasets


def keep_in_memory(dataset: Any) -> None:
    """Let an opened dataset return its samples from main memory, without images."""
    reader: Any = dataset.reader
    names = [name for name in reader.hf_dataset.column_names if name not in dataset.meta.camera_keys]
    table = reader.hf_dataset.select_columns(names)
    arrow = table.with_format("arrow")[:]
    columns: dict[str, Tensor] = {}
    texts: dict[str, pa.Array] = {}
    for name, like in table[0].items():  # LeRobot's first row has the types and shapes
        column = arrow.column(name).combine_chunks()
        if not isinstance(like, Tensor):
            texts[name] = column.dictionary_encode() if pa.types.is_string(column.type) else column
            continue
        while isinstance(column, pa.ExtensionArray | pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
            column = column.storage if isinstance(column, pa.ExtensionArray) else column.flatten()
        numbers = torch.from_numpy(column.to_numpy(zero_copy_only=False).copy())
        columns[name] = numbers.to(like.dtype).reshape(len(table), *like.shape)
    # A reader may have some episodes only.
    starts = np.flatnonzero(np.diff(columns["episode_index"].numpy(), prepend=-1))
    bounds = np.append(starts, len(table))
    samples = SamplesInMemory(columns, bounds, reader.delta_indices or {}, dataset.meta.tasks.index.tolist(), texts)
    reader.get_item = samples.__getitem__
    dataset.__getitems__ = samples.__getitems__  # torch's loader asks for a batch at once


# -- the view of a dataset ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ViewOptions:
    """The frames and columns of a view."""

    prompts: bool = False  # whether it has the frames of demonstration prompts and holds, and the clock
    obs_type: str | None = None  # None: all observations
    convention: str | None = None  # of the images; None: the dataset's

    def columns(self, features: Mapping[str, Any]) -> dict[str, str]:
        """Return name in the dataset -> name in the view; refuse a dataset that lacks the observations."""
        cameras = cameras_of(features)
        objects = [name for name in (PRIVILEGED, OBJECTS_COLUMN) if name in features][:1]
        dropped = set() if self.prompts else {*CLOCK}
        needed = {OBJECTS: [objects], PIXELS: [cameras], BOTH: [objects, cameras]}.get(self.obs_type or "", [])
        if not all(needed):
            inputs = ", ".join(cameras + objects) or "neither images nor objects"
            raise MemobenchError(
                f"found obs_type={self.obs_type}, and the dataset has {inputs}; choose another obs_type, or generate a "
                "dataset that has it"
            )
        dropped |= {OBJECTS: {*cameras}, PIXELS: {OBJECTS_COLUMN}}.get(self.obs_type or "", set())
        renamed = {PRIVILEGED: OBJECTS_COLUMN} if self.obs_type in (OBJECTS, BOTH) else {}
        if self.mirrors(features):
            old, new = (CONVENTIONS[convention] for convention in (OTHER[str(self.convention)], str(self.convention)))
            renamed |= {image_key(old[camera]): image_key(new[camera]) for camera in CAMERAS}
        return {name: renamed.get(name, name) for name in features if name not in dropped}

    def mirrors(self, features: Mapping[str, Any]) -> bool:
        """Return whether the view mirrors images left to right; refuse a view without, or an unknown convention."""
        if self.convention is None:
            return False
        cameras, convention = cameras_of(features), convention_of(features)
        if not cameras or self.obs_type == OBJECTS:
            raise MemobenchError(f"found convention={self.convention}, and the view has no images; leave it out")
        if convention is None:
            raise MemobenchError(
                f"found convention={self.convention}, and it is unknown whether {', '.join(cameras)} are upright or "
                "mirrored; name a dataset of this package, or one of LIBERO with image and image2"
            )
        return convention != self.convention


def view_options(
    policy: Any, features: Mapping[str, Any], prompt_frames: bool | None, obs_type: str | None
) -> ViewOptions:
    """Return the frames and inputs that a policy is trained on; a checkpoint keeps its inputs."""
    prompts = reads_prompt(policy) if prompt_frames is None else prompt_frames
    if chooses_inputs(policy):
        return ViewOptions(prompts, None)
    if begun := getattr(policy, "input_features", None):
        images = any(feature.type is FeatureType.VISUAL for feature in begun.values())
        objects = OBJECTS_COLUMN in begun
    elif obs_type is not None:
        return ViewOptions(prompts, obs_type)
    else:
        images = bool(cameras_of(features))
        objects = not images and (PRIVILEGED in features or OBJECTS_COLUMN in features)
    seen = {(True, True): BOTH, (True, False): PIXELS, (False, True): OBJECTS}.get((images, objects))
    return ViewOptions(prompts, seen)


def has_benchmark_columns(features: Mapping[str, Any]) -> bool:
    """Return whether a dataset is the benchmark's, by its texts too: a phase alone may have another meaning."""
    return {*CLOCK, LEVEL_COLUMNS["intermediate"]} <= {*features}


def needs_view(features: Mapping[str, Any], options: ViewOptions) -> bool:
    """Return whether a dataset differs from its view, in the convention of the dataset."""
    shortened = has_benchmark_columns(features) and not options.prompts
    return shortened or options.columns(features) != {name: name for name in features}


def cached_view(root: Path, options: ViewOptions) -> Path:
    """Return the view of a dataset in the cache folder; write it first if it is not there."""
    digest = hashlib.blake2b(f"{root.resolve()} {options} {SOURCE_EPISODE}".encode(), digest_size=8)
    for path in (*files_below(root / "meta"), *files_below(root / "data", ".parquet")):
        digest.update(path.read_bytes())
    folder = cache_folder() / "views" / f"{root.resolve().name}-{digest.hexdigest()}"
    if not (folder / INFO_FILE).is_file():
        write_view(root, folder, options)
    return folder


def write_view(root: Path, out: Path, options: ViewOptions) -> None:
    """Write a view of the dataset in ``root``; ``out`` must not exist."""
    if out.exists():
        raise MemobenchError(f"{out} exists already; name another folder, or delete it")
    info, table = read_info(root), read_frame_table(root)
    features, fps = info["features"], info["fps"]
    columns, mirrors, is_ours = options.columns(features), options.mirrors(features), has_benchmark_columns(features)
    stretches = Stretches.of(table, is_ours and not options.prompts)
    if not stretches.starts.size:
        raise MemobenchError(f"{root} has no frame whose action has an effect; name a dataset of `memobench generate`")
    build = out.with_name(f".{out.name}.{os.getpid()}")
    with explaining_disk_errors(out):
        shutil.rmtree(build, ignore_errors=True)
        for path, rows in tables_of(root / "data"):
            with undamaged(path):
                frames = _frames_of(rows, columns, stretches, fps)
                frames = _mirrored(frames) if mirrors else frames
            _write_table(frames, build / path.relative_to(root))
        for path, rows in tables_of(root / EPISODES):
            _write_table(_episodes_of(rows, columns, stretches, fps), build / path.relative_to(root))
        described = {new: features[name] for name, new in columns.items()}
        stated = options.convention if options.convention == MIRRORED or not is_ours else None
        for name in cameras_of(features):
            if name in columns:
                videos = build / "videos" / columns[name]
                _write_videos(root / "videos" / name, videos, fps if mirrors else None)
                if mirrors:
                    new = without(features[name], "convention", "info") | ({"convention": stated} if stated else {})
                    new |= {"info": video_info(files[0])} if (files := files_below(videos, ".mp4")) else {}
                    described[columns[name]] = new
        count = len(stretches.starts)
        info |= {"features": described, "total_episodes": count, "total_frames": int(stretches.lengths.sum())}
        info |= {"splits": {"train": f"0:{count}"}}
        write_file(build / INFO_FILE, json.dumps(info, indent=4))
        stats = {columns[name]: values for name, values in recorded(root).items() if name in columns}
        write_file(build / STATS_FILE, json.dumps(stats))
        shutil.copyfile(root / TASKS_FILE, build / TASKS_FILE)
        build.rename(out)  # complete at once: `cached_view` uses a view that exists


class Stretches(NamedTuple):
    """The S stretches of a dataset's episodes that are the episodes of a view; each array is (S,)."""

    starts: np.ndarray  # first frame in the dataset
    lengths: np.ndarray  # number of frames
    firsts: np.ndarray  # first frame in the view
    sources: np.ndarray  # episode in the dataset
    offsets: np.ndarray  # frames of that episode before the stretch

    @classmethod
    def of(cls, table: FrameTable, shortened: bool) -> Stretches:
        """Return all episodes, or if ``shortened`` the stretches of frames whose action has an effect."""
        acts = table.acts if shortened else np.ones(len(table.phase), np.bool_)
        edges = table.runs(acts)
        starts, lengths = edges[:-1], np.diff(edges)
        starts, lengths = starts[acts[starts]], lengths[acts[starts]]
        sources = np.searchsorted(table.episodes, starts, "right") - 1
        return cls(starts, lengths, np.cumsum(lengths) - lengths, sources, starts - table.episodes[sources])


def _frames_of(rows: pa.Table, columns: Mapping[str, str], stretches: Stretches, fps: float) -> pa.Table:
    """Return the view's rows and columns of a data file, with new numbers."""
    index = rows.column("index").to_numpy()
    number = np.searchsorted(stretches.starts, index, "right") - 1
    wanted = (number >= 0) & (index < (stretches.starts + stretches.lengths)[number])
    rows, index, number = rows.filter(pa.array(wanted)).replace_schema_metadata(None), index[wanted], number[wanted]
    within = index - stretches.starts[number]
    changed = {"index": stretches.firsts[number] + within, "episode_index": number, "frame_index": within}
    rows = _with_values(rows, {**changed, "timestamp": (within / fps).astype(np.float32)})
    if LANGUAGE in rows.column_names:
        texts = _earlier(rows.column(LANGUAGE).combine_chunks(), stretches.offsets[number] / fps)
        rows = rows.set_column(rows.column_names.index(LANGUAGE), LANGUAGE, texts)
    present = [name for name in rows.column_names if name in columns]
    return rows.select(present).rename_columns([columns[name] for name in present])


def _with_values(rows: pa.Table, changed: Mapping[str, np.ndarray]) -> pa.Table:
    """Return rows with other values of columns, in the columns' types."""
    for name, values in changed.items():
        rows = rows.set_column(rows.column_names.index(name), name, pa.array(values, rows.schema.field(name).type))
    return rows


def _earlier(texts: pa.ListArray, seconds: np.ndarray) -> pa.ListArray:
    """Return LeRobot's language rows (N,) with timestamps reduced by seconds (N,)."""
    lengths, rows = pc.list_value_length(texts).fill_null(0).to_numpy(zero_copy_only=False), texts.flatten()
    columns = {field.name: rows.field(number) for number, field in enumerate(rows.type)}
    kind = columns["timestamp"].type
    columns["timestamp"] = pc.subtract(columns["timestamp"], pa.array(np.repeat(seconds, lengths), kind))
    offsets = pa.array(np.concatenate([[0], np.cumsum(lengths)]), pa.int32())
    return pa.ListArray.from_arrays(offsets, pa.StructArray.from_arrays(list(columns.values()), fields=list(rows.type)))


def _mirrored(frames: pa.Table) -> pa.Table:
    """Return frames with LeRobot's images mirrored left to right, as PNG."""
    for number, field in enumerate(frames.schema):
        if field.name.startswith(OBS_IMAGES) and pa.types.is_struct(field.type):
            rows = frames.column(number).to_pylist()
            for row in rows:
                with Image.open(BytesIO(row["bytes"])) as image, BytesIO() as file:
                    ImageOps.mirror(image).save(file, "PNG")
                    row["bytes"] = file.getvalue()
            frames = frames.set_column(number, field, pa.array(rows, field.type))
    return frames


def _write_videos(source: Path, out: Path, mirrored_at: int | None) -> None:
    """Write a camera's videos: mirrored ones (frames/s), or links to the dataset's."""
    for path in files_below(source, ".mp4"):
        target = out / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        if mirrored_at is not None:
            with undamaged(path):
                mirror_video(path, target, mirrored_at)
            continue
        try:
            target.symlink_to(path.resolve())
        except OSError:  # a disk without links
            shutil.copyfile(path, target)


def _episodes_of(rows: pa.Table, columns: Mapping[str, str], stretches: Stretches, fps: float) -> pa.Table:
    """Return the view's rows of a file of the episodes' table: numbers, bounds of frames, and times in the videos."""
    numbers = rows.column("episode_index").to_numpy()
    chosen = np.flatnonzero(np.isin(stretches.sources, numbers))
    rows = rows.take(pa.array(np.searchsorted(numbers, stretches.sources[chosen])))  # they are in the order of numbers
    firsts, lengths = stretches.firsts[chosen], stretches.lengths[chosen]
    changed = {"episode_index": chosen, "length": lengths}
    changed |= {"dataset_from_index": firsts, "dataset_to_index": firsts + lengths}
    for name in rows.column_names:
        if name.endswith("/from_timestamp"):
            changed[name] = rows.column(name).to_numpy() + stretches.offsets[chosen] / fps
            changed[name.replace("/from_", "/to_")] = changed[name] + lengths / fps
    # A view of a view has the column of source episodes already.
    kept = [name for name in rows.column_names if not name.startswith("stats/") and name != SOURCE_EPISODE]
    rows = rows.select(kept).append_column(SOURCE_EPISODE, rows.column("episode_index"))
    names = []
    for name in rows.column_names:  # videos/<camera>/<place>
        section, *rest = name.split("/", 2)
        names.append("/".join([section, columns.get(rest[0], rest[0]), *rest[1:]]) if rest else name)
    return _with_values(rows, changed).rename_columns(names).replace_schema_metadata(None)


def _write_table(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)
