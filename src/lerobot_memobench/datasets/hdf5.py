"""Demonstrations in the published HDF5 layout: one file per task (paper, appendix on data collection).

::

    data                       bddl_file_name, bddl_file_content, env_info, problem_info (attributes)
    data/demo_k                num_samples, model_file, meta_data (attributes)
    data/demo_k/states         (T, D) float64
    data/demo_k/actions        (T, 7)
    data/demo_k/obs/agentview_image, robot0_eye_in_hand_image    (T, 256, 256, 3) uint8

``meta_data`` is the task's metadata as JSON, with ``key_frame`` (for each checkpoint the frame at which it was
completed in order) and ``timestep_exec_start_idx`` (the frame at which execution starts) filled in. Frame t shows
what was seen before ``actions[t]``.

What this package knows beyond the layout is in further attributes, so that every reader of the layout finds what
it expects and nothing else among the arrays: of ``data`` ``task_metadata``; of a demonstration ``seed``,
``referent``, ``variant``, ``success``, ``fixture_poses``, ``scene_hash``, ``satisfied_intervals`` and ``digest``.
Images are compressed with gzip, losslessly, a frame per chunk: a third of the published files' size.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import ACTION_DIM, FPS, Demonstration, digest, labels
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula import to_lists
from lerobot_memobench.tasks.task import BDDL_FILE, Task

if TYPE_CHECKING:
    import h5py

IMAGE_NAMES = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}
"""Camera of this package -> dataset of the published layout."""

SLICE = 32
"""Frames read at a time."""

SUFFIX = "_demo.hdf5"

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Problem:
    """Something that cannot be used: ``file``, ``group`` ("" for the file as a whole) and why."""

    file: str
    group: str
    reason: str

    def __str__(self) -> str:
        return f"{self.file}{', ' + self.group if self.group else ''}: {self.reason}"


class Unusable(MemobenchError):
    """A file or group that is not in the layout; the message is the reason alone."""


# --- writing ------------------------------------------------------------------------------------------------


class EpisodeFile:
    """A demonstration being written frame by frame: what its ``demo_k`` will hold, at the root of its own file."""

    def __init__(self, path: Path) -> None:
        import h5py

        self._file: h5py.File = h5py.File(path, "w")
        self._images: dict[str, h5py.Dataset] = {}
        self._frames = 0

    def add_images(self, images: Mapping[str, Image]) -> None:
        """Append both cameras' next frame, (H, W, 3) uint8 each."""
        if not self._images:
            obs = self._file.create_group("obs")
            for camera, name in IMAGE_NAMES.items():
                shape = images[camera].shape
                self._images[camera] = obs.create_dataset(
                    name,
                    (0, *shape),
                    np.uint8,
                    maxshape=(None, *shape),
                    chunks=(1, *shape),
                    compression="gzip",
                    compression_opts=1,
                )
        self._frames += 1
        for camera, dataset in self._images.items():
            dataset.resize(self._frames, axis=0)
            dataset[-1] = images[camera]

    def finish(self, demo: Demonstration) -> None:
        """Add arrays and attributes and close the file."""
        self._file.create_dataset("states", data=demo.states)
        self._file.create_dataset("actions", data=demo.actions)
        self._file.attrs.update(demo_attributes(demo))
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is; it is about to be deleted. After ``finish`` this does nothing."""
        self._file.close()


def demo_attributes(demo: Demonstration) -> dict[str, Any]:
    """Return the attributes of a demonstration's group."""
    return {
        "num_samples": len(demo),
        "model_file": demo.model_xml,
        "meta_data": json.dumps(demo_metadata(demo)),
        "seed": int(demo.seed),
        "referent": demo.referent,
        "variant": int(demo.variant),
        "success": bool(demo.success),
        "fixture_poses": json.dumps({name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()}),
        "scene_hash": demo.scene_hash,
        "satisfied_intervals": json.dumps([_intervals(column) for column in demo.satisfied.T]),
        "digest": digest(demo),
    }


def demo_metadata(demo: Demonstration) -> dict[str, Any]:
    """Return ``meta_data``: the task's metadata, of the variant that was carried out, with its frames filled in."""
    task = demo.task
    metadata = dict(task.metadata)
    metadata["key_frame"] = labels(demo).key_frames.tolist()
    as_list = isinstance(metadata.get("timestep_exec_start_idx"), list)
    metadata["timestep_exec_start_idx"] = [demo.exec_start] if as_list else demo.exec_start
    if task.variant_index:
        metadata.pop("variants", None)  # they are variants of the published task, not of this one
        metadata |= {
            "memory": [list(checkpoint.language) for checkpoint in task.checkpoints],
            "subtask_goals": [to_lists(checkpoint.goal) for checkpoint in task.checkpoints],
            "demo_summary": task.demo_summary,
            "goal": to_lists(task.goal),
        }
        if task.prompt is not None:
            metadata["prompt"] = {"kind": task.prompt.kind, "target": task.prompt.target}
    return metadata


def data_attributes(task: Task) -> dict[str, Any]:
    """Return the attributes of a task's ``data`` group."""
    task = task.variant(0)
    problem = re.search(r"\(\s*problem\s+([^\s()]+)", task.bddl_text)
    domain = re.search(r"\(\s*:domain\s+([^\s()]+)", task.bddl_text)
    env_info = {
        "env_name": problem.group(1) if problem else task.name,
        "type": 1,
        "env_kwargs": {
            "robots": ["Panda"],
            "controller": "OSC_POSE",
            "control_freq": FPS,
            "camera_names": ["agentview", "robot0_eye_in_hand"],
        },
    }
    problem_info = {
        "problem_name": env_info["env_name"],
        "domain_name": domain.group(1) if domain else "robosuite",
        "language_instruction": task.language,
    }
    return {
        "bddl_file_name": f"{task.memory_type}/{task.name}/{BDDL_FILE}",
        "bddl_file_content": task.bddl_text,
        "env_info": json.dumps(env_info),
        "problem_info": json.dumps(problem_info),
        "task_metadata": json.dumps(task.metadata),
        "memory_type": task.memory_type,
        "family": task.family,
    }


def write_task_file(path: Path, attributes: Mapping[str, Any], episodes: Sequence[Path]) -> None:
    """Join demonstrations, each a file of an :class:`EpisodeFile`, to a task's file; chunks are copied as they are."""
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as target:
        data = target.create_group("data")
        data.attrs.update(attributes)
        total = 0
        for number, episode in enumerate(episodes):
            with h5py.File(episode) as source:
                group = data.create_group(f"demo_{number}")
                for name in source:
                    source.copy(name, group)
                group.attrs.update(source.attrs)
                total += int(source.attrs["num_samples"])
        data.attrs["num_demos"], data.attrs["total"] = len(episodes), total


def _intervals(column: NDArray[np.bool_]) -> list[list[int]]:
    """Return where a (T,) truth is true, as [start, stop) pairs."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], column, [False]]).astype(np.int8)))
    return [[int(start), int(stop)] for start, stop in edges.reshape(-1, 2)]


def truth_from_intervals(intervals: Sequence[Sequence[Sequence[int]]], length: int) -> NDArray[np.bool_]:
    """Undo ``_intervals`` for K checkpoints: (T, K)."""
    truth = np.zeros((length, len(intervals)), dtype=np.bool_)
    for k, pairs in enumerate(intervals):
        for start, stop in pairs:
            truth[start:stop, k] = True
    return truth


# --- reading ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PublishedDemo:
    """A group that was checked, without its images.

    Attributes:
        states: (T, D) float64.
        actions: (T, 7) float32.
        metadata: ``meta_data``.
        model_file: MJCF, or "" where there is none.
        extras: the attributes that only this package writes; empty for files of others.
        image_size: (height, width).
    """

    group: str
    states: NDArray[np.float64]
    actions: NDArray[np.float32]
    metadata: dict[str, Any]
    model_file: str
    extras: dict[str, Any]
    image_size: tuple[int, int]


EXTRAS = ("seed", "referent", "variant", "success", "fixture_poses", "scene_hash", "satisfied_intervals", "digest")


class PublishedFile:
    """A file in the published layout, being read; a context.

    Every check names what was found. ``Unusable`` raised on opening concerns the file, by ``read`` a group.
    """

    def __init__(self, path: Path) -> None:
        import h5py

        self.path = path
        try:
            self._file: h5py.File = h5py.File(path, "r")
        except FileNotFoundError:
            raise Unusable("there is no such file") from None
        except OSError as error:
            raise Unusable(f"it is no HDF5 file, or was cut off ({_first_line(error)})") from None
        try:
            data = self._file.get("data")
            if not isinstance(data, h5py.Group):
                raise Unusable(f"it has no group 'data' (found {', '.join(self._file) or 'nothing'})")
            self._data: h5py.Group = data
            self.bddl_name = _text(data, "bddl_file_name", required=True)
            self.bddl_text = _text(data, "bddl_file_content", required=True)
        except Unusable:
            self._file.close()
            raise
        except Exception as error:
            self._file.close()
            raise Unusable(f"it is damaged ({_first_line(error)})") from None

    def __enter__(self) -> PublishedFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    @cached_property
    def task_metadata(self) -> dict[str, Any] | None:
        """The task's metadata as this package stores it; None in files of others."""
        text = _text(self._data, "task_metadata")
        return None if text is None else _json_object(text, "task_metadata")

    def attribute(self, name: str) -> str | None:
        """Return a text attribute of ``data``, or None."""
        return _text(self._data, name)

    def groups(self) -> list[str]:
        """Return the names of the demonstrations, demo_2 before demo_10."""
        return sorted(self._data, key=lambda name: (_number(name) is None, _number(name) or 0, name))

    def announced(self) -> int | None:
        """Return how many demonstrations the file says it has, where it does."""
        value = self._data.attrs.get("num_demos")
        return int(value) if isinstance(value, int | np.integer) else None

    def read(self, group: str) -> PublishedDemo:
        """Read and check one demonstration, all but its pixels.

        Raises:
            Unusable: with the first thing that is not as the layout says.
        """
        try:
            return self._read(group)
        except Unusable:
            raise
        except Exception as error:  # h5py raises OSError, KeyError, RuntimeError, ValueError on damaged files
            raise Unusable(f"it cannot be read ({_first_line(error)})") from None

    def _read(self, name: str) -> PublishedDemo:
        import h5py

        group = self._data[name]
        if _number(name) is None or not isinstance(group, h5py.Group):
            raise Unusable("it is no group demo_<number>")
        states = _array(group, "states", (None, None), np.float64)
        actions = _array(group, "actions", (None, ACTION_DIM), np.float32, np.float64)
        if not isinstance(group.get("obs"), h5py.Group):
            raise Unusable("the group 'obs' is missing")
        images = [_array(group, f"obs/{image}", (None, None, None, 3), np.uint8) for image in IMAGE_NAMES.values()]
        lengths = {"states": len(states), "actions": len(actions)}
        lengths |= {image: len(found) for image, found in zip(IMAGE_NAMES.values(), images, strict=True)}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{key} {length}" for key, length in lengths.items())
            raise Unusable(f"its arrays have different lengths: {told}")
        length = len(states)
        if not length:
            raise Unusable("it has no frames")
        count = group.attrs.get("num_samples")
        if count is None:
            raise Unusable("the attribute 'num_samples' is missing")
        if not isinstance(count, int | np.integer) or int(count) != length:
            raise Unusable(f"num_samples is {count}, but its arrays have {length} frames")
        sizes = {image.shape[1:3] for image in images}
        if len(sizes) > 1:
            raise Unusable(f"its cameras have different sizes: {', '.join(map(str, sorted(sizes)))}")
        values = {"states": states[:], "actions": actions[:]}
        for key, value in values.items():
            if not np.isfinite(value).all():
                raise Unusable(f"{key} holds a value that is not finite at frame {_first_bad(value)}")
        metadata = _json_object(_text(group, "meta_data", required=True), "meta_data")
        return PublishedDemo(
            group=name,
            states=values["states"],
            actions=values["actions"].astype(np.float32),
            metadata=metadata,
            model_file=_text(group, "model_file") or "",
            extras={key: group.attrs[key] for key in EXTRAS if key in group.attrs},
            image_size=next(iter(sizes)),
        )

    def images(self, group: str, *, upside_down: bool = False) -> Iterator[dict[str, Image]]:
        """Yield both cameras' frames, (H, W, 3) uint8, one after the other; ``SLICE`` of them are in memory.

        Args:
            group: a name of ``groups()``.
            upside_down: the file's images are stored as robosuite's renderer gives them: turn them up.
        """
        obs = self._data[group]["obs"]
        length = len(obs[IMAGE_NAMES["image"]])
        for start in range(0, length, SLICE):
            try:
                block = {camera: obs[name][start : start + SLICE] for camera, name in IMAGE_NAMES.items()}
            except Exception as error:
                raise Unusable(f"its images cannot be read from frame {start} on ({_first_line(error)})") from None
            for offset in range(len(block["image"])):
                frame = {camera: frames[offset] for camera, frames in block.items()}
                if upside_down:
                    frame = {camera: np.ascontiguousarray(picture[::-1]) for camera, picture in frame.items()}
                yield frame


def find_files(source: Path) -> list[Path]:
    """Return the HDF5 files of a path: itself, or all below it, sorted.

    Raises:
        MemobenchError: there is none.
    """
    if source.is_file():
        return [source]
    found = sorted(path for path in source.rglob("*") if path.suffix in (".hdf5", ".h5") and path.is_file())
    if not found:
        raise MemobenchError(f"found no HDF5 file (.hdf5, .h5) at {source}; name a file or a folder of them")
    return found


def _number(name: str) -> int | None:
    found = re.fullmatch(r"demo_(\d+)", name)
    return int(found.group(1)) if found else None


def _text(group: h5py.Group, key: str, required: bool = False) -> Any:
    value = group.attrs.get(key)
    if value is None:
        if required:
            raise Unusable(f"the attribute {key!r} is missing")
        return None
    if isinstance(value, np.ndarray) and value.shape == (1,):
        value = value[0]
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    if not isinstance(value, str):
        raise Unusable(f"the attribute {key!r} is of type {type(value).__name__}, expected text")
    return value


def _json_object(text: str, what: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Unusable(f"{what} is no valid JSON ({error})") from None
    if not isinstance(value, dict):
        raise Unusable(f"{what} holds a {type(value).__name__}, expected a JSON object")
    return value


def _array(group: h5py.Group, name: str, shape: tuple[int | None, ...], *dtypes: Any) -> h5py.Dataset:
    import h5py

    found = group.get(name)
    if not isinstance(found, h5py.Dataset):
        raise Unusable(f"the array {name!r} is missing")
    if found.dtype not in [np.dtype(dtype) for dtype in dtypes]:
        expected = " or ".join(str(np.dtype(dtype)) for dtype in dtypes)
        raise Unusable(f"{name} has type {found.dtype}, expected {expected}")
    matches = len(found.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(found.shape, shape, strict=True)
    )
    if not matches:
        want = ", ".join("any" if n is None else str(n) for n in shape)
        raise Unusable(f"{name} has shape {found.shape}, expected ({want})")
    return found


def _first_bad(value: NDArray) -> int:
    return int(np.flatnonzero(~np.isfinite(value).all(axis=1))[0])


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
