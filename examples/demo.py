"""The demo: the scripted expert on one task of each memory type, then a policy with a memory and one without.

    python examples/demo.py --out outputs/demo

All runs are public commands. The second part is a strict task, under the expert and the two policies of the package,
which were trained alike except for the memory. The three act in the same scenes, of the first evaluation seeds, on
privileged object state. A policy without a memory cannot know which carton is meant. The same command resumes.

| output | |
|---|---|
| `expert` | evaluation of the expert on four tasks: report and videos |
| `memory/*` | evaluations of the second part |
| `contact_sheet.png` | frames of the four videos |
| `memory.mp4`, `memory.png` | one episode of the second part, side by side: the first that did not end alike for all |
| `memory.md` | how many episodes each solved |
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.jobs.processes import adding_resume_hint

TASKS = (
    "turn_on_the_stove_and_turn_it_off",
    "put_the_tomato_into_the_top_drawer_of_the_cabinet",
    "put_the_butter_into_the_bowl_from_the_prompt_video",
    "execute_the_assembly_procedure_demonstrated_in_the_prompt_video",
)
"""One task of each memory type, for the first part."""
STRICT_TASK = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
"""Task of the second part, with the shortest prompt; former policies differed in it on validation seeds."""
POLICIES: dict[str, tuple[str, ...]] = {
    "expert": (),
    "with memory": ("policy=memobench_strict",),
    "without memory": ("policy=memobench_strict_memoryless",),
}
"""Name in the second part -> arguments of `lerobot eval` that choose who acts."""
EPISODES, RECORDED, HORIZON = 12, 3, 400
"""Of each policy; how many of them are recorded as videos; steps of an episode. The expert takes about 150."""

TITLE = 28
"""Height of the name over a video, pixels."""
SOLVED, FAILED, TEXT, BACKGROUND = (0, 158, 115), (213, 94, 0), (240, 240, 240), (24, 26, 30)
FRAMES_PER_VIDEO = 6
COLUMN_WIDTH, STRIP_WIDTH = 320, 200
"""Width of a frame in the contact sheet and in a strip, pixels."""

Frame = NDArray[np.uint8]
"""(height, width, 3), RGB."""


class Take(NamedTuple):
    """A video and whether its episode was solved."""

    video: Path
    solved: bool


def run(*arguments: str) -> None:
    """Run a command of the environment that runs this script."""
    print(f"\n$ {shlex.join(arguments)}", flush=True)
    subprocess.run([str(Path(sys.executable).with_name(arguments[0])), *arguments[1:]], check=True)


def main() -> None:
    """Evaluate, then draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo"))
    out: Path = parser.parse_args().out
    expert = out / "expert"
    run(
        *("lerobot", "eval", "env=memobench", f"tasks={','.join(TASKS)}", "episodes=1", "videos=1"),
        *(f"output_dir={expert}", "resume=true"),
    )
    folders = {name: out / "memory" / name.replace(" ", "_") for name in POLICIES}
    for name, folder in folders.items():
        run(
            *("lerobot", "eval", "env=memobench", "suite=strict", *POLICIES[name], f"tasks={STRICT_TASK}"),
            *(f"horizon={HORIZON}", "obs_type=environment_state_agent_pos", f"episodes={EPISODES}"),
            *(f"videos={RECORDED}", f"output_dir={folder}", "resume=true"),
        )
    contact_sheet([expert / "videos" / f"{name}.0.mp4" for name in TASKS]).save(out / "contact_sheet.png")
    outcomes = {name: episodes_of(folder) for name, folder in folders.items()}
    takes = chosen_takes(folders, outcomes)
    side_by_side(takes, out / "memory.mp4")
    strip(takes).save(out / "memory.png")
    (out / "memory.md").write_text(table(outcomes))
    print(f"\n{table(outcomes)}\nvideos, report: {expert}")
    for name in ("contact_sheet.png", "memory.mp4", "memory.png"):
        print(out / name)


# --- how the second part ended ---

Episodes = list[dict[str, Any]]


def episodes_of(folder: Path) -> Episodes:
    """Return the lines of an evaluation's log by episode."""
    return sorted(read_episodes(folder), key=lambda record: record["episode"])


def chosen_takes(folders: Mapping[str, Path], outcomes: Mapping[str, Episodes]) -> dict[str, Take]:
    """Return name -> its take of the first recorded episode that did not end alike for all, else of the first."""
    ends = [[bool(record["success"]) for record in episodes[:RECORDED]] for episodes in outcomes.values()]
    alike = [len(set(each)) == 1 for each in zip(*ends, strict=True)]
    chosen = alike.index(False) if False in alike else 0
    return {
        name: Take(folder / "videos" / f"{STRICT_TASK}.{chosen}.mp4", solved[chosen])
        for (name, folder), solved in zip(folders.items(), ends, strict=True)
    }


def table(outcomes: Mapping[str, Episodes]) -> str:
    """Return how many of the episodes each solved, as Markdown."""
    rows = [
        f"| {name} | {sum(record['success'] for record in episodes)}/{len(episodes)} |"
        for name, episodes in outcomes.items()
    ]
    head = [f"`{STRICT_TASK}`", "", "| policy | solved |", "|---|---|"]
    return "\n".join([*head, *rows, "", "Inputs: privileged object state and the prompt."]) + "\n"


# --- images ---


def contact_sheet(videos: Sequence[Path]) -> Image.Image:
    """Return an image with one row per video: frames at even distances, the first and the last included."""
    return Image.fromarray(np.concatenate([frames_row(video, COLUMN_WIDTH) for video in videos]))


def strip(takes: Mapping[str, Take]) -> Image.Image:
    """Return an image with a row per video, as in `contact_sheet`, under its name and how the episode ended."""
    rows = []
    for name, take in takes.items():
        row = frames_row(take.video, STRIP_WIDTH)
        rows += [title(name, row.shape[1], take.solved), row]
    return Image.fromarray(np.concatenate(rows))


def side_by_side(takes: Mapping[str, Take], out: Path) -> None:
    """Write one video of several; a shorter one stays at its last frame."""
    movie = VideoRecorder(out)
    for frame in joined(takes):
        movie.add(frame)
    movie.finish()


def joined(takes: Mapping[str, Take]) -> Iterator[Frame]:
    """Yield the frames of the whole, (TITLE + height, sum of widths, 3) uint8; all videos are of one height."""
    videos = {name: read_video(take.video) for name, take in takes.items()}
    for step in range(max(map(len, videos.values()))):
        parts = []
        for name, frames in videos.items():
            solved = takes[name].solved if step >= len(frames) - 1 else None
            frame = frames[min(step, len(frames) - 1)]
            parts.append(np.concatenate([title(name, frame.shape[1], solved), frame]))
        yield np.concatenate(parts, axis=1)


def title(name: str, width: int, solved: bool | None) -> Frame:
    """Return the line over a video, (TITLE, width, 3): a name, and how it ended once it has (None before)."""
    band = Image.new("RGB", (width, TITLE), BACKGROUND)
    draw, font = ImageDraw.Draw(band), ImageFont.load_default(size=16)
    draw.text((8, TITLE // 2), name, fill=TEXT, font=font, anchor="lm")
    if solved is not None:
        words, colour = ("solved", SOLVED) if solved else ("failed", FAILED)
        draw.text((width - 8, TITLE // 2), words, fill=colour, font=font, anchor="rm")
    return np.asarray(band)


def frames_row(video: Path, width: int) -> Frame:
    """Return frames of a video at even distances, the first and the last included, each ``width`` wide."""
    frames = read_video(video)
    chosen = [frames[k] for k in np.linspace(0, len(frames) - 1, FRAMES_PER_VIDEO).round().astype(int)]
    size = (width, round(frames[0].shape[0] * width / frames[0].shape[1]))
    resized = [Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS) for frame in chosen]
    return np.concatenate([np.asarray(frame) for frame in resized], axis=1)


def read_video(path: Path) -> list[Frame]:
    """Return every frame of a video."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


if __name__ == "__main__":
    with adding_resume_hint("demo", lambda: "the same command resumes"):  # SIGTERM ends the children
        main()
