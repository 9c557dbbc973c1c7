"""Describe a dataset without its data: pictures, the card's tables, the hash of every episode.

The pictures show the lengths of episodes beside the paper's, and a camera's frame at each checkpoint.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_memobench.datasets.lerobot_format.card import (
    CARD_FILE,
    EDITED,
    FAMILIES,
    LENGTH_BUCKETS,
    MADE_BY,
    card_from_frames,
    ordered_types,
    own_card,
)
from lerobot_memobench.datasets.lerobot_format.layout import (
    MANIFEST_FILE,
    check_whole,
    image_key,
    naming_damage,
    read_info,
    read_manifest,
    undamaged,
    without_pattern,
)
from lerobot_memobench.datasets.lerobot_format.reading import STRANGER, list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of, telling_of_the_disk, write_file
from lerobot_memobench.protocol import CAMERAS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from PIL.Image import Image as Picture

LENGTHS_FIGURE, STORYBOARD_FIGURE, TABLES_FILE = "lengths.png", "storyboard.jpg", "tables.md"
OURS, THEIRS = "#0072B2", "#E69F00"
"""Okabe and Ito's blue and orange: apart for the colour-blind, and one darker than the other in grey."""
FRAME = 160
"""Height and width of a storyboard's pictures, pixels."""
MOST_FRAMES = 6

UNCHECKED = (
    "not checked: values of tables, pictures of videos, statistics, states, hashes, HDF5 files and feature caches; "
    "`memobench validate {folder}` checks them"
)
Say = Callable[[str], None]


def describe(folder: Path, out: Path, say: Say = lambda _: None) -> list[Path]:
    """Write pictures, tables and hashes of the dataset in ``folder`` to ``out``; return the files.

    The storyboard needs images; a dataset of states and actions has none. ``say`` is told, in a sentence each, what
    other tools have taken from the dataset, and which of its episodes another program made; those are left out.

    Raises:
        MemobenchError: the folder is no dataset, one of its files is cut off (see `check_whole`), or none of its
            episodes is one of this benchmark.
    """
    rows, hashes = _known(folder, say), folder / MANIFEST_FILE
    check_whole(folder)
    with undamaged(folder), naming_damage(folder):
        card = own_card(folder, read_info(folder)["total_episodes"])
        tables = card_tables(card or card_from_frames(folder, rows))
        board = storyboard(folder, rows) if (folder / "videos").is_dir() else None
        manifest = read_manifest(folder) if hashes.is_file() else _manifest_of(rows)
    say(UNCHECKED.format(folder=folder))
    if card is None:
        say(EDITED)
        _put_card(folder, rows, say)
    with telling_of_the_disk(out):
        out.mkdir(parents=True, exist_ok=True)
        found = [draw_lengths(rows, out / LENGTHS_FIGURE)]
        if board is not None:
            found.append(out / STORYBOARD_FIGURE)
            with draft_of(found[-1]) as draft:
                board.save(draft, quality=88, optimize=True)
        found.append(write_file(out / TABLES_FILE, tables))
        found.append(write_file(out / MANIFEST_FILE, short_manifest(manifest)))
    return found


def _known(folder: Path, say: Say) -> list[dict[str, Any]]:
    """Return what the dataset says of its episodes, without those that another program made."""
    with undamaged(folder):
        places = list_episodes(folder)
    rows = [
        place.record.model_dump() | {"episode_index": place.index, "length": place.length, "start": place.start}
        for place in places
        if place.record is not None
    ]
    strangers = [str(place.index) for place in places if place.record is None]
    if not rows:
        raise MemobenchError(f"{folder} has no episode of this benchmark: of each, {STRANGER}")
    if strangers:
        listed = ", ".join(strangers[:5]) + (", …" if len(strangers) > 5 else "")
        say(f"{len(strangers)} of {len(places)} episodes ({listed}) are left out: of each, {STRANGER}")
    return rows


def _put_card(folder: Path, rows: Sequence[Mapping[str, Any]], say: Say) -> None:
    """Give a dataset without a card one, where there may be written."""
    if (folder / CARD_FILE).exists():
        return
    try:
        write_file(folder / CARD_FILE, card_from_frames(folder, rows))
    except OSError as error:
        say(f"its card could not be written to {folder} ({error.strerror})")


def _manifest_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a manifest of the episodes that are there."""
    versions = sorted({json.dumps(row["versions"], sort_keys=True) for row in rows if row["versions"]})
    return {
        "versions": [json.loads(each) for each in versions],
        "episodes": [{**row, "failure": None} for row in rows],
    }


def card_tables(card: str) -> str:
    """Return the part of a dataset card that says how it was made, what failed, and its statistics."""
    begin, end = card.find(MADE_BY), card.find("## Columns")
    if begin < 0:
        raise MemobenchError("the dataset's README.md has no section 'How it was made': this package did not write it")
    return card[begin : end if end > begin else None].rstrip() + "\n"


def short_manifest(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as JSON of one line per task: seed to the hash of its episode, or to why there is none."""
    tasks: dict[str, dict[str, str]] = {}
    for row in manifest["episodes"]:
        tasks.setdefault(row["task_name"], {})[str(row["seed"])] = (
            row["failure"] or row.get("digest") or "no hash was kept"
        )
    head = {key: value for key, value in manifest.items() if key != "episodes"}
    lines = [f"{json.dumps(name)}: {json.dumps(seeds)}" for name, seeds in sorted(tasks.items())]
    return json.dumps(head | {"tasks": None})[: -len("null}")] + "{\n" + ",\n".join(lines) + "\n}}\n"


def draw_lengths(rows: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Draw the distribution of episode lengths, and each memory type's mean and P95, beside the paper's."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(9, 3.2), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        _draw_buckets(left, rows)
        _draw_types(right, rows)
        with draft_of(path) as draft:
            figure.savefig(draft, dpi=130)
    return path


def _draw_buckets(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    lengths = np.array([row["length"] for row in rows])
    published = sum(LENGTH_BUCKETS.values())
    places = np.arange(len(LENGTH_BUCKETS))
    ours = [100 * ((lengths >= low) & (lengths < (high or np.inf))).mean() for low, high in LENGTH_BUCKETS]
    theirs = [100 * count / published for count in LENGTH_BUCKETS.values()]
    axes.bar(places - 0.2, ours, 0.38, color=OURS, label=f"here, {len(rows):,} episodes")
    axes.bar(places + 0.2, theirs, 0.38, color=THEIRS, hatch="//", edgecolor="white", label=f"paper, {published:,}")
    names = [f"{low}+" if high is None else f"{low}–{high - 1}" for low, high in LENGTH_BUCKETS]
    axes.set_xticks(places, names, rotation=30, ha="right")
    axes.set_ylabel("episodes, %")
    axes.set_xlabel("length, control steps of 50 ms, prompt included")
    axes.legend(frameon=False)


def _draw_types(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    types = [name for name in FAMILIES if any(row["memory_type"] == name for row in rows)]
    lengths = {name: np.array([row["length"] for row in rows if row["memory_type"] == name]) for name in types}
    ours = [(lengths[name].mean(), np.percentile(lengths[name], 95)) for name in types]
    theirs = [(FAMILIES[name]["mean"], FAMILIES[name]["p95"]) for name in types]
    for shift, colour, marker, source, spans in (
        (-0.12, OURS, "o", "here", ours),
        (0.12, THEIRS, "s", "paper", theirs),
    ):
        for place, (mean, high) in enumerate(spans):
            axes.plot([place + shift] * 2, [mean, high], color=colour, lw=2, solid_capstyle="butt")
            axes.plot(place + shift, mean, marker, color=colour, ms=6, label=source if place == 0 else None)
    axes.set_xticks(range(len(types)), types)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("steps: mean, line to P95")
    axes.legend(frameon=False)


def storyboard(folder: Path, rows: Sequence[Mapping[str, Any]]) -> Picture:
    """Draw one episode per memory type: the prompt's middle, the start, and the frame of each checkpoint."""
    from lerobot.datasets import LeRobotDataset
    from PIL import Image, ImageDraw, ImageFont

    dataset = LeRobotDataset("local/storyboard", root=without_pattern(folder))
    camera = next(key for key in map(image_key, CAMERAS) if key in dataset.meta.features)
    chosen = [next(row for row in rows if row["memory_type"] == name) for name in ordered_types(rows)]
    caption, title = 56, 26
    height = FRAME + caption + title
    sheet = Image.new("RGB", (MOST_FRAMES * (FRAME + 6), len(chosen) * height), "white")
    draw = ImageDraw.Draw(sheet)
    font, bold = ImageFont.load_default(size=13), ImageFont.load_default(size=16)
    for line, row in enumerate(chosen):
        top = line * height
        name = row["task_name"].replace("_", " ")
        draw.text((2, top + 3), f"{row['memory_type']}: {name}", fill="black", font=bold)
        for column, (frame, text) in enumerate(_key_frames(dataset, row)):
            image = dataset[row["start"] + frame][camera].numpy()
            pixels = (image.transpose(1, 2, 0) * 255).round().astype(np.uint8)
            picture = Image.fromarray(pixels).resize((FRAME, FRAME), Image.Resampling.LANCZOS)
            left = column * (FRAME + 6)
            sheet.paste(picture, (left, top + title))
            words = textwrap.fill(f"{frame}: {text}", 24, max_lines=3, placeholder=" …")
            draw.multiline_text((left + 2, top + title + FRAME + 1), words, fill="black", font=font, spacing=1)
    return sheet


def _key_frames(dataset: Any, row: Mapping[str, Any]) -> list[tuple[int, str]]:
    """Return the frames of an episode to draw, each with the text of the checkpoint just completed."""
    begin, found = int(row["exec_start_index"]), []
    if begin:
        found.append((begin // 2, "demonstration prompt"))
    found.append((begin, "execution begins"))
    last = begin
    for frame in sorted(int(frame) for frame in row["key_frames"] if frame >= 0):
        before = dataset.hf_dataset[row["start"] + max(frame - 1, last)]
        found.append((frame, before.get("simple_subgoal", "")))
        last = frame
    return found[: MOST_FRAMES - 1] + found[MOST_FRAMES - 1 :][-1:]
