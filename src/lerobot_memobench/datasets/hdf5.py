"""Read demonstrations in the published HDF5 layout: one file per task (paper, appendix on data collection).

::

    data                       bddl_file_name, bddl_file_content, env_info, problem_info (attributes)
    data/demo_k                num_samples, model_file, meta_data (attributes)
    data/demo_k/states         (T, D) float64
    data/demo_k/actions        (T, 7)
    data/demo_k/obs/agentview_image, robot0_eye_in_hand_image    (T, 256, 256, 3) uint8

``meta_data`` is the task's metadata as JSON, with ``key_frame`` (for each checkpoint the frame at which it was
completed in order) and ``timestep_exec_start_idx`` (the frame at which execution starts) filled in. Frame t shows
the observation before ``actions[t]``.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired, TypedDict

import numpy as np
from annotated_types import MinLen
from numpy.typing import NDArray

from lerobot_memobench.constants import ACTION_DIM
from lerobot_memobench.errors import MemobenchError, short
from lerobot_memobench.io import check_regular
from lerobot_memobench.untrusted import Malformed, check_fetched, checked, parsed, refusing

if TYPE_CHECKING:
    import h5py

IMAGE_NAMES = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}
"""Camera of this package -> array of the published layout."""
LIBERO_NAMES = {"image": "agentview_rgb", "wrist_image": "eye_in_hand_rgb"}
"""Camera of this package -> array of LIBERO's own files, whose names are also accepted."""
FILE_OBJECT = re.compile(r"<(_io\.\w+|open file) .*>")
NO_SEED = -1  # the layout does not hold seeds
SUFFIX = "_demo.hdf5"
FRAMES_PER_READ = 32  # in memory at a time
LARGEST = 1e10  # MuJoCo treats a state with a larger number as unstable and replaces it by the initial state


@dataclass(frozen=True, eq=False)
class PublishedDemo:
    """A checked group without its images: states (T, D), actions (T, 7), ``meta_data``, MJCF ("" if it is missing)."""

    group: str
    states: NDArray[np.float64]
    actions: NDArray[np.float32]
    metadata: dict[str, Any]
    model_file: str
    image_size: tuple[int, int]


class PublishedFile:
    """A file in the published layout; a context. Errors name the first difference to the layout, without the file."""

    def __init__(self, path: Path) -> None:
        import h5py

        self.path = path
        try:
            check_regular(path)
            self._file: h5py.File = h5py.File(path, "r")
        except OSError as error:
            raise MemobenchError(_open_error(path, error)) from None
        try:
            # HDF5 would read any file of this machine that external links and arrays name.
            if name := self._file.visititems_links(_outside) or self._file.visititems(_outside):
                raise MemobenchError(
                    f"{short(name)} is read from another file (a link, external storage or a virtual array); copy it in"
                )
            data = self._file.get("data")
            if not isinstance(data, h5py.Group):
                raise MemobenchError(f"it has no group 'data' (found {', '.join(self._file) or 'none'})")
            self._data: h5py.Group = data
            announced = data.attrs.get("num_demos")
            self.announced = int(announced) if isinstance(announced, int | np.integer) else None
            self.bddl_name = _text_attribute(data, "bddl_file_name", required=True)
            self.bddl_text = _text_attribute(data, "bddl_file_content", required=True)
            self.lacks_its_text = _is_file_object(self.bddl_text)
        except Exception as error:
            self._file.close()
            if isinstance(error, MemobenchError):
                raise
            raise MemobenchError(f"it is damaged ({first_line(error)})") from None

    def __enter__(self) -> PublishedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def attribute(self, name: str) -> str | None:
        """Return a text attribute of the group ``data``, or None."""
        return _text_attribute(self._data, name)

    def groups(self) -> list[str]:
        """Return the names of the demonstrations, demo_2 before demo_10."""
        return sorted(self._data, key=lambda name: (demo_number(name) is None, demo_number(name) or 0, name))

    @refusing(lambda why: MemobenchError(f"it cannot be read ({why})"))
    def read(self, name: str) -> PublishedDemo:
        """Read and check the group of one demonstration, except its pixels."""
        import h5py

        group = self._data.get(name)
        if demo_number(name) is None or not isinstance(group, h5py.Group):
            raise MemobenchError("it is no group demo_<number>")
        states = _array(group, "states", (None, None), np.float64)
        actions = _array(group, "actions", (None, ACTION_DIM), np.float32, np.float64)
        images = {
            image: _array(group, f"obs/{image}", (None, None, None, 3), np.uint8)
            for image in _image_names(group.get("obs", ())).values()
        }
        _check_length(group, {"states": states, "actions": actions, **images})
        sizes = {image.shape[1:3] for image in images.values()}
        if len(sizes) > 1:
            raise MemobenchError(f"its cameras have different sizes: {', '.join(map(str, sorted(sizes)))}")
        return PublishedDemo(
            group=name,
            states=_finite("states", states[:]),
            actions=_finite("actions", actions[:]).astype(np.float32),
            metadata=_metadata(_text_attribute(group, "meta_data", required=True)),
            model_file=_text_attribute(group, "model_file") or "",
            image_size=sizes.pop(),
        )

    def images(self, group: str, rows: int = 1, columns: int = 1) -> Iterator[dict[str, NDArray[np.uint8]]]:
        """Yield both cameras' frames, (H, W, 3) uint8; -1 as ``rows`` turns them upside down, ``columns`` mirrors."""
        obs = self._data[group]["obs"]
        names = _image_names(obs)
        for start in range(0, len(obs[names["image"]]), FRAMES_PER_READ):
            try:
                block = {camera: obs[name][start : start + FRAMES_PER_READ] for camera, name in names.items()}
            except Exception as error:  # h5py raises OSError, KeyError, RuntimeError or ValueError for damage
                raise MemobenchError(f"its images cannot be read from frame {start} on ({first_line(error)})") from None
            for offset in range(len(block["image"])):
                frame = {camera: frames[offset] for camera, frames in block.items()}
                yield {c: np.ascontiguousarray(image[::rows, ::columns]) for c, image in frame.items()}


# --- parts of a file, each checked ---


def _open_error(path: Path, error: OSError) -> str:
    # HDF5 reports locks and Git LFS pointers like damage.
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    try:
        check_fetched(path)
    except (MemobenchError, OSError) as reason:
        return str(reason)
    if error.errno in (errno.EAGAIN, errno.EACCES) or "unable to lock" in str(error):
        return f"it is locked or may not be read ({first_line(error)}); end the program that writes it, then go on"
    return f"it is no HDF5 file, or was cut off ({first_line(error)})"


def _outside(name: str, member: Any) -> str | None:
    import h5py

    is_array = isinstance(member, h5py.Dataset) and (member.external or member.is_virtual)
    return name if is_array or isinstance(member, h5py.ExternalLink) else None


def _check_length(group: h5py.Group, arrays: Mapping[str, h5py.Dataset]) -> None:
    lengths = {key: len(array) for key, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{key} {length}" for key, length in lengths.items())
        raise MemobenchError(f"its arrays have different lengths: {listed}")
    length = lengths["states"]
    if not length:
        raise MemobenchError("it has no frames")
    count = group.attrs.get("num_samples")
    if not isinstance(count, int | np.integer) or int(count) != length:
        raise MemobenchError(f"num_samples is {count}, but its arrays have {length} frames")


def _is_file_object(text: str) -> bool:
    # LIBERO's script stores Python's representation of an open file by mistake.
    return FILE_OBJECT.fullmatch(text.strip()) is not None


def _image_names(obs: Collection[str]) -> dict[str, str]:
    published = any(name in obs for name in IMAGE_NAMES.values())
    return LIBERO_NAMES if not published and any(name in obs for name in LIBERO_NAMES.values()) else IMAGE_NAMES


def demo_number(name: str) -> int | None:
    """Return k of a group demo_k, None for other names."""
    match = re.fullmatch(r"demo_(\d+)", name)
    return int(match.group(1)) if match else None


def _text_attribute(group: h5py.Group, key: str, required: bool = False) -> Any:
    value = group.attrs.get(key)
    if isinstance(value, np.ndarray) and value.shape == (1,):
        value = value[0]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bytes):  # HDF5 has texts of several types
        value = value.decode("utf-8", errors="replace")
    if value is None and required:
        raise MemobenchError(
            f"the attribute {key!r} is missing; files of LIBERO or robomimic have no checkpoints: train on them with "
            "LeRobot's own datasets"
        )
    if value is not None and not isinstance(value, str):
        raise MemobenchError(f"the attribute {key!r} is of type {type(group.attrs[key]).__name__}, expected text")
    return value


class EmbeddedMetadata(TypedDict):
    """Frames in ``meta_data``, -1 where unknown."""

    key_frame: NotRequired[list[int]]
    timestep_exec_start_idx: NotRequired[int | Annotated[list[int], MinLen(1)]]


def _metadata(text: str) -> dict[str, Any]:
    if _is_file_object(text):
        raise MemobenchError(f"meta_data holds {text[:60]!r}, the name of a Python object instead of its text")
    try:
        return dict(checked(parsed(text), EmbeddedMetadata))
    except Malformed as error:
        raise MemobenchError(f"meta_data is no valid JSON of a task: {error}") from None


def _array(group: h5py.Group, name: str, shape: tuple[int | None, ...], *dtypes: Any) -> h5py.Dataset:
    import h5py

    array = group.get(name)
    if not isinstance(array, h5py.Dataset):
        raise MemobenchError(f"the array {name!r} is missing")
    if array.dtype not in [np.dtype(dtype) for dtype in dtypes]:
        expected = " or ".join(str(np.dtype(dtype)) for dtype in dtypes)
        raise MemobenchError(f"{name} has type {array.dtype}, expected {expected}")
    if len(array.shape) != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        raise MemobenchError(f"{name} has shape {array.shape}, expected ({expected})")
    stored = array.id.get_create_plist()
    for number, _, _, label in (stored.get_filter(k) for k in range(stored.get_nfilters())):
        if not h5py.h5z.filter_avail(number):
            raise MemobenchError(
                f"{name} is compressed by the HDF5 filter {number} {label.decode(errors='replace')!r}, which is not "
                "installed; set HDF5_PLUGIN_PATH to the folder of its plugin, or rewrite it with `h5repack -f NONE`"
            )
    return array


def _finite(name: str, values: NDArray) -> NDArray:
    bad = np.flatnonzero(~(np.abs(values) <= LARGEST).all(axis=1))
    if bad.size:
        raise MemobenchError(f"{name} holds a value at frame {bad[0]} that is not finite or beyond {LARGEST:g}")
    return values


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its name."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
