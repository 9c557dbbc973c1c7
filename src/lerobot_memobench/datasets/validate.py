"""Validate a dataset: replay every episode, read every file, and report the first difference of each.

Replay resets the scene to the episode's seed and applies the recorded actions, in the prompt too; neither expert nor
environment is used. Everything is compared bit for bit, except images: some frames of each camera are drawn again, and
must be near to the decoded ones.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import CAMERAS, CONTROL_HZ, IMAGE_SIZE
from lerobot_memobench.datasets.demonstration import HELD_COLUMN, Demonstration, labels, persistent_rows
from lerobot_memobench.datasets.episodes import (
    Columns,
    DemonstrationRecord,
    FileHash,
    RecordedEpisode,
    check_whole,
    expect,
    list_episodes,
    read_episode,
    read_info,
    read_manifest,
    read_to_end,
)
from lerobot_memobench.datasets.layout import (
    ADVICE,
    EXECUTED_ACTION,
    INFO_FILE,
    LANGUAGE,
    MANIFEST_FILE,
    STATS_FILE,
    dataset_files,
    image_key,
    is_dataset,
    objects_column,
)
from lerobot_memobench.datasets.statistics import check_statistics, measured
from lerobot_memobench.datasets.video import frame_reader
from lerobot_memobench.errors import MemobenchError, cut, short
from lerobot_memobench.experts.expert import highlights_at
from lerobot_memobench.io import file_hash, files_below
from lerobot_memobench.jobs.processes import process_pool
from lerobot_memobench.sim.convention import CONVENTIONS, MIRRORED, UPRIGHT, convention_of
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import RenderSettings, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import STRICT, Task
from lerobot_memobench.untrusted import check_fetched, refusing

COMPARED = ("task_name", "seed", "referent", "variant", "success", "scene_hash", "digest")
"""Fields of an episode in the manifest that its record has too."""
NO_HASHES = (
    "it has no hashes of files, as after LeRobot's dataset tools: damage to a frame that can still be decoded and is "
    "not drawn again cannot be found"
)


@dataclass(frozen=True)
class CheckResult:
    """First disagreement of an episode or a file, None if everything agrees, and a note on a file that agrees."""

    subject: str
    disagreement: str | None
    note: str | None = None
    of_file: bool = False


def _run(check: Callable[[], str | None], path: Path, subject: str, of_file: bool = False) -> CheckResult:
    """Run a check, which returns a disagreement of an episode, or a note on a file, and raises for damage."""
    try:
        with refusing(lambda why: MemobenchError(f"it cannot be read ({why}); {ADVICE}"), path):
            message = check()
    except MemobenchError as error:  # the other checks still run
        return CheckResult(subject, str(error), of_file=of_file)
    return CheckResult(subject, None, message, of_file) if of_file else CheckResult(subject, message)


def validate(
    folder: Path | str, *, workers: int = 1, progress: Callable[[int, int, CheckResult], None] = lambda *_: None
) -> list[CheckResult]:
    """Replay the episodes of a dataset and check its files (`replay`, `check_file`, `check_statistics`, …).

    Return the result of each episode, in order, then of each file with a disagreement or a note. ``progress`` is called
    after each check with the number of finished checks, their total, and the latest result.
    """
    folder = Path(folder).absolute()
    if workers < 1:
        raise MemobenchError(f"{workers} workers were asked for; it must be at least 1")
    if not is_dataset(folder):
        raise MemobenchError(
            f"{folder} holds no dataset (meta/info.json); name the folder of a generated one. HDF5 files are checked "
            "by `memobench convert`"
        )
    numbers = range(read_info(folder)["total_episodes"])
    checks = [partial(_run, partial(_replay_episode, folder, k), folder, f"episode {k}") for k in numbers]
    checks += _file_checks(folder)
    results: dict[int, CheckResult] = {}

    def add(number: int, result: CheckResult) -> None:
        results[number] = result
        progress(len(results), len(checks), result)

    if workers == 1:
        for number, check in enumerate(checks):
            add(number, check())
    else:
        with process_pool(min(workers, len(checks))) as pool:
            futures = {pool.submit(check): number for number, check in enumerate(checks)}
            for future in as_completed(futures):
                add(futures[future], future.result())
    in_order = [results[number] for number in range(len(checks))]
    return [result for result in in_order if not result.of_file or result.disagreement or result.note]


def images_of(folder: Path, episode: int) -> Images | None:
    """Return the reader of an episode's images, upright; None if the dataset has none of our cameras."""
    features = read_info(folder)["features"]
    convention = convention_of(features) or UPRIGHT
    step = -1 if convention == MIRRORED else 1
    cameras = {camera: key for camera, name in CONVENTIONS[convention].items() if (key := image_key(name)) in features}

    def read(frames: Sequence[int]) -> dict[str, NDArray[np.uint8]]:
        decoded = {camera: _reader(folder, key)(episode, list(frames)) for camera, key in cameras.items()}
        return {
            camera: (images * 255).round().clamp(0, 255).byte().permute(0, 2, 3, 1).numpy()[:, :, ::step]
            for camera, images in decoded.items()
        }

    return read if cameras else None


_reader = lru_cache(maxsize=len(CAMERAS))(frame_reader)


def _file_checks(folder: Path) -> Iterator[partial[CheckResult]]:
    def of(name: Path | str, check: Callable[[], str | None]) -> partial[CheckResult]:
        return partial(_run, check, folder / name, Path(name).as_posix(), of_file=True)

    hashes = None
    with contextlib.suppress(MemobenchError, FileNotFoundError):  # `check_manifest` reports its damage
        hashes = read_manifest(folder).get("files")
    for name in sorted({*dataset_files(folder), *(hashes or {})}):
        yield of(name, partial(check_file, folder / name, (hashes or {}).get(name)))
    if hashes is None:
        yield of(MANIFEST_FILE, partial(str, NO_HASHES))
    yield of(INFO_FILE, partial(check_whole, folder))
    yield of(INFO_FILE, partial(check_description, folder))
    names = measured(read_info(folder)["features"])
    cameras = [name for name in names if name.startswith(image_key(""))]
    for chosen in ([name for name in names if name not in cameras], *([camera] for camera in cameras)):
        yield of(STATS_FILE, partial(check_statistics, folder, chosen))
    if (folder / MANIFEST_FILE).exists():
        yield of(MANIFEST_FILE, partial(check_manifest, folder))


def _replay_episode(folder: Path, index: int) -> str | None:
    episode = read_episode(folder, index)
    if episode.record.seed < 0:
        return "it has no seed, so its scene cannot be made again"
    difference = replay(episode, images_of(folder, index))
    return None if difference is None else str(difference)


# --- files ---


def check_file(path: Path, recorded: FileHash | None) -> str | None:
    """Read a file to its end and compare it with its recorded hash; return a note if it was written again.

    Other bytes in a file of equal size are damage; tools that encode or write a file again change its size.
    """
    if not path.is_file():
        raise MemobenchError(f"the file is missing; {ADVICE}")
    check_fetched(path)
    if path.suffix in (".parquet", ".mp4"):
        read_to_end(path)
    if recorded is None or file_hash(path) == recorded["sha256"]:
        return None
    if path.stat().st_size == recorded["bytes"]:
        raise MemobenchError(
            f"its size is as in {MANIFEST_FILE}, but its content differs: it was damaged or edited; take the dataset "
            "from its source again, or generate it"
        )
    return f"encoded or written again after {MANIFEST_FILE}: its content was checked, its hash was not"


def check_description(folder: Path) -> None:
    """Compare features, frame rate and splits of ``meta/info.json`` with columns and videos; raise at a difference."""
    import av
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    info = read_info(folder)
    features = {name: {**feature, "shape": tuple(feature["shape"])} for name, feature in info["features"].items()}
    wanted = {field.name: field.type for field in get_hf_features_from_features(features).arrow_schema}
    splits = {"train": f"0:{info['total_episodes']}"}
    expect(INFO_FILE, "splits", [info.get("splits", splits)], [splits])
    for path in files_below(folder / "data", ".parquet"):
        types = {field.name: field.type for field in pq.read_schema(path)}
        for name, kind in {**dict.fromkeys(types), **wanted}.items():
            stored = types.get(name)
            if name == LANGUAGE and stored is not None:
                continue  # LeRobot's tools write the fields of its rows in several types
            if isinstance(stored, pa.ListType) and isinstance(kind, pa.FixedSizeListType):  # by LeRobot's tools
                (size,) = pc.list_value_length(pq.read_table(path, columns=[name])[name]).unique().to_pylist()
                stored = pa.list_(stored.value_type, size)
            expect(path.relative_to(folder), f"type of the column {name}", [stored], [kind])
    for name, feature in features.items():
        is_video, names = feature["dtype"] == "video", feature.get("names")
        if isinstance(names, list):
            expect(INFO_FILE, f"number of names of {name}", [len(names)], [3] if is_video else feature["shape"])
        for path in files_below(folder / "videos" / name, ".mp4") if is_video else ():
            with av.open(str(path)) as container:
                video = container.streams.video[0]
                sizes = [video.height, video.width, 3, float(video.average_rate or 0)]
            stated = [feature.get("info", {}).get(f"video.{key}") for key in ("height", "width", "channels", "fps")]
            for values in ([*feature["shape"], info["fps"]], stated):
                expect(INFO_FILE, f"size and rate of {name}", values, sizes)


def check_manifest(folder: Path) -> None:
    """Compare seeds, hashes and lengths in the manifest with the dataset's episodes; raise at the first difference."""
    rows = {row["episode_index"]: row for row in read_manifest(folder)["episodes"] if row["failure"] is None}
    for episode in list_episodes(folder):
        row, record = rows.pop(episode.index, {}), episode.record
        facts = {"frames": episode.length} | ({} if record is None else record.model_dump(include={*COMPARED}))
        for key, value in facts.items():
            if row.get(key) != value:
                listed = short(row.get(key))
                raise MemobenchError(f"episode {episode.index} has {key}={short(value)}, {MANIFEST_FILE} {listed}")
    if rows:
        raise MemobenchError(f"it names episode {next(iter(rows))}, which is not in the dataset")


# --- replay ---

FRAMES_DRAWN = 8
"""Frames of each camera that are drawn again: evenly spaced, with the first, the last and the start of execution."""
MIN_PSNR, MAX_BLOCK_DIFFERENCE, BLOCKS = 26.0, 40.0, 8
"""A recorded image agrees with a drawn one if its PSNR, dB, is large enough, and no channel of any of 8 × 8 blocks
differs by too many of 255 levels. Worst values measured at 32 to 256 pixels: H.264 as recorded 28.8 dB and 28 levels,
AV1 as encoded by LeRobot's tools 28.1 and 33; images of five frames later have a median of 15.8 to 24.8 dB, those of
the other camera 12."""

Images = Callable[[Sequence[int]], dict[str, NDArray[np.uint8]]]
"""Frame numbers (n,) to the images of each camera, (n, H, W, 3)."""


DETERMINED = {"memory_type", "family", "operations", "success", "key_frames", "scene_hash", "fixture_poses", "digest"}
"""Fields of an episode's record that task, seed and actions determine."""


@dataclass(frozen=True)
class Disagreement:
    """The first difference; ``frame`` is None for a field of the whole episode."""

    column: str
    frame: int | None
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        where = "" if self.frame is None else f" at frame {self.frame}"
        return f"{self.column}{where}: recorded {_text(self.recorded)}, replayed {_text(self.replayed)}"


def replay(recorded: RecordedEpisode, images: Images | None = None) -> Disagreement | None:
    """Replay an episode and return the first disagreement, or None.

    Compared are states (if recorded), proprioception, visible objects, instruction, numbering, every label column,
    language rows, success, key frames, the hashes of scene and episode, and some of the recorded ``images``. The
    episode's hash covers the states, which LeRobot's dataset tools remove.
    """
    record, columns = recorded.record, recorded.columns
    task = get_task(record.task_name).variant(record.variant)
    if "action" not in columns:
        raise MemobenchError("its frames have no column 'action' (a tool removed it), so it cannot be replayed")
    actions = columns["action"]
    executed, held = columns[EXECUTED_ACTION if EXECUTED_ACTION in columns else "action"], columns.get(HELD_COLUMN)
    even = np.linspace(0, len(actions) - 1, FRAMES_DRAWN).round().astype(int).tolist()
    drawn = sorted({*even, min(max(record.exec_start_index, 0), len(actions) - 1)})
    recorded_images = {} if images is None else images(drawn)
    height, width = next((frames.shape[1:3] for frames in recorded_images.values()), (IMAGE_SIZE, IMAGE_SIZE))
    of_images: list[Disagreement] = []

    def compare(sim: Simulation, frame: int) -> None:
        for camera, frames in recorded_images.items() if frame in drawn and not of_images else ():
            if difference := _unlike(sim.render(CAMERAS[camera]), frames[drawn.index(frame)]):
                of_images.append(Disagreement(image_key(camera), frame, difference, "the simulator's image"))

    render = RenderSettings(height=height, width=width)
    again = resimulate(task, record.seed, executed, record.exec_start_index, held, render, compare)
    again = replace(again, referent=record.referent, variant=record.variant)
    if not np.array_equal(actions, executed):
        again = replace(again, actions=actions, executed=again.actions)
    columns_again = labels(again)
    facts = {key: value for key, value in record.model_dump(include=DETERMINED).items() if value != ""}
    facts |= {LANGUAGE: columns[LANGUAGE][0]} if LANGUAGE in columns else {}
    facts_again = DemonstrationRecord.of(again).model_dump() | {LANGUAGE: persistent_rows(columns_again)}
    of_episode = next(
        (Disagreement(key, None, old, facts_again[key]) for key, old in facts.items() if old != facts_again[key]), None
    )
    if of_episode is not None and of_episode.column == "digest" and again.executed is not None:
        of_episode = replace(
            of_episode, column="action or held (they alone are in the episode's hash and not in its states)"
        )
    frames = np.arange(len(actions))
    replayed = {
        "task": [task.language] * len(actions),
        "frame_index": frames,
        "index": recorded.start + frames,
        "timestamp": (frames / CONTROL_HZ).astype(np.float32),
        "states": again.states,
        "observation.state": again.proprio,
        objects_column(columns): again.objects,
        **columns_again,
    }
    return _first_difference(columns, replayed) or next(iter(of_images), None) or of_episode


def _unlike(drawn: NDArray[np.uint8], recorded: NDArray[np.uint8]) -> str:
    # "" if the encoding explains the difference
    if drawn.shape != recorded.shape:
        return f"an image of {recorded.shape[0]}×{recorded.shape[1]} pixels"
    off = drawn.astype(np.float32) - recorded
    psnr = 10 * np.log10(255**2 / max(float((off**2).mean()), 1e-9))
    rows, columns = (np.linspace(0, size, BLOCKS + 1).astype(int)[:-1] for size in off.shape[:2])
    sums = np.add.reduceat(np.add.reduceat(off, rows, axis=0), columns, axis=1)
    areas = np.outer(np.diff([*rows, off.shape[0]]), np.diff([*columns, off.shape[1]]))
    levels = float(np.abs(sums / areas[..., None]).max())
    agrees = psnr >= MIN_PSNR and levels <= MAX_BLOCK_DIFFERENCE
    return "" if agrees else f"an image with a PSNR of {psnr:.0f} dB and {levels:.0f} levels off"


def resimulate(
    task: Task,
    seed: int,
    actions: NDArray[np.float32],
    exec_start: int,
    held: NDArray[np.bool_] | None = None,
    render: RenderSettings | None = None,
    show: Callable[[Simulation, int], None] = lambda sim, frame: None,
) -> Demonstration:
    """Apply (T, 7) float32 actions in the scene of ``seed``; return the resulting demonstration without images.

    ``held`` (T,) are the frames after which nothing is simulated; ``show`` is called before each step.
    """
    sim = Simulation(task, render)
    sim.reset(seed)
    start, scene_hash, fixture_poses = sim.snapshot(), sim.scene_hash(), sim.fixture_poses()
    progress = Progress(task)
    look = ObjectSlots(sim)
    frames: list[tuple[Any, ...]] = []
    success = rests = False
    strict = task.suite == STRICT
    for frame, action in enumerate(actions):
        rested, rests = rests, strict and frame < exec_start and not action.any()
        rests = rests or (held is not None and bool(held[frame]))
        # The scene returns to its start, except for hidden objects, at the end of the prompt: the start of execution,
        # or of the rest before it, whose actions are zeros.
        if 0 < frame <= exec_start and not rested and (rests or frame == exec_start):
            sim.end_prompt(start, () if task.prompt is None else task.prompt.places)
        if frame > 0 and frame == exec_start:
            sim.begin_execution()
        if frame == exec_start and strict:
            progress.settle(sim.holds)
        sim.highlights = highlights_at(task, sim, frame) if frame < exec_start else ()
        show(sim, frame)
        seen = frames[-1][2] if rests and rested else look.observe()
        frames.append((sim.state(), sim.proprio(), seen, progress.satisfied))
        success = success or progress.success
        if not rests:
            sim.step(action)
            if frame >= exec_start:
                progress.step(sim.holds)
    states, proprio, objects, satisfied = map(np.array, zip(*frames, strict=True))
    return Demonstration(
        task=task,
        seed=seed,
        referent="fixed",
        variant=task.variant_index,
        states=states,
        actions=np.asarray(actions, dtype=np.float32),
        proprio=proprio.astype(np.float32),
        images=None,
        exec_start=exec_start,
        satisfied=satisfied.astype(np.bool_),
        success=success,
        fixture_poses=fixture_poses,
        scene_hash=scene_hash,
        objects=objects,
        held=held,
    )


def _first_difference(recorded: Columns, replayed: Columns) -> Disagreement | None:
    # By frame, then by order of the columns.
    first: Disagreement | None = None
    for column, new in replayed.items():
        if column not in recorded:
            continue
        old = recorded[column]
        if np.shape(old) != np.shape(new):
            return Disagreement(f"shape of {column}", None, np.shape(old), np.shape(new))
        differs = [
            frame
            for frame, (a, b) in enumerate(zip(old, new, strict=True))
            if not np.array_equal(np.asarray(a), np.asarray(b))
        ]
        if differs and (first is None or first.frame is None or differs[0] < first.frame):
            first = Disagreement(column, differs[0], old[differs[0]], new[differs[0]])
    return first


def _text(value: Any) -> str:
    return cut(np.array2string(value, threshold=12) if isinstance(value, np.ndarray) else repr(value), 200)
