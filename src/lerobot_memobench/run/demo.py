"""The demo: the scripted expert on one task of each memory type, and beside it policies that have learned one.

The expert's part is videos, a contact sheet and a report. The second part is a task that begins with a demonstration
prompt, under the expert, a policy with a memory and one without; both come with the package. All three act in the same
episodes, of the first evaluation seeds, and the table counts them all: so many that a policy without a memory, which
guesses, stands out. Their inputs are the privileged object states, so that only the few recorded episodes are drawn.
Video and strip show the first of these that did not end alike for all, or else the first.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.episode_log import MERGED_FILE, read_episodes
from lerobot_memobench.envs.settings import OBJECTS
from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import policy_inputs
from lerobot_memobench.evaluation.records import CARD_FILE
from lerobot_memobench.evaluation.report import REPORT_JSON, REPORT_MARKDOWN
from lerobot_memobench.io import write_file
from lerobot_memobench.policies.checkpoint import shipped_policies
from lerobot_memobench.run.plan import EvaluationPlan, plan_line
from lerobot_memobench.run.run import VIDEOS
from lerobot_memobench.run.run import made as made_folder
from lerobot_memobench.tasks.catalogue import BOWL
from lerobot_memobench.tasks.failures import REFERENCE_DRIFT

if TYPE_CHECKING:
    from PIL.Image import Image

TASKS = (
    "turn_on_the_stove_and_turn_it_off",
    "put_the_tomato_into_the_top_drawer_of_the_cabinet",
    BOWL,
    "execute_the_assembly_procedure_demonstrated_in_the_prompt_video",
)
"""One task of each memory type."""
CONTACT_SHEET = "contact_sheet.png"
MEMORY_VIDEO, MEMORY_STRIP, MEMORY_TABLE = "memory.mp4", "memory.png", "memory.md"
RESULTS = (MERGED_FILE, REPORT_JSON, REPORT_MARKDOWN, CARD_FILE)
"""Files that are taken over from the expert's evaluation."""
PRODUCTS = (*RESULTS, VIDEOS, CONTACT_SHEET, MEMORY_VIDEO, MEMORY_STRIP, MEMORY_TABLE)
"""All that a demo writes, and so all that a new one removes."""

POLICIES: dict[str, tuple[str, ...]] = {
    "expert": (),
    "with memory": ("policy=memobench_small",),
    "without memory": ("policy=memobench_small_memoryless",),
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


def demo_plan(folder: Path) -> EvaluationPlan:
    """Return the plan of the demo's evaluation: one recorded episode of each task."""
    words = ["env=memobench", f"tasks={','.join(TASKS)}", "episodes=1", "videos=1"]
    return plan_line([*words, f"output_dir={folder}"])


def make_demo(out: Path, evaluate: Callable[[Path], object], compare: Callable[[Path, Path], object] | None) -> None:
    """Evaluate and compare, then put the results into ``out``.

    The evaluation works in a folder of its own, so a demo that fails leaves an earlier one as it was.

    Args:
        evaluate: runs the demo's evaluation in a folder.
        compare: works in one folder and writes into another what `compare_memories` does; None where the package
            brings no trained policies.
    """
    there = [name for name in PRODUCTS if (out / name).exists()]
    if there and CONTACT_SHEET not in there:
        raise MemobenchError(f"{out} holds {there[0]}, and no earlier demo; name a new or an empty folder")
    with made_folder(out), tempfile.TemporaryDirectory(prefix=".demo-", dir=out) as scratch:
        work = Path(scratch) / "eval"
        evaluate(work)
        made = Path(scratch) / "made"
        if compare is not None:
            compare(Path(scratch) / "memory", made)
        videos = collect_videos(work, made / VIDEOS)
        contact_sheet(videos).save(made / CONTACT_SHEET, optimize=True)
        for name in RESULTS:
            shutil.move(work / name, made / name)
        for name in PRODUCTS:
            if (out / name).is_dir():
                shutil.rmtree(out / name)
            else:
                (out / name).unlink(missing_ok=True)
            if (made / name).exists():
                shutil.move(made / name, out / name)


def collect_videos(evaluation: Path, folder: Path) -> list[Path]:
    """Move the video of each task's episode into ``folder``, under its name, by which the HTML report finds it."""
    folder.mkdir(parents=True)
    found = []
    for name in TASKS:
        video = evaluation / VIDEOS / f"{name}.0.mp4"
        if not video.is_file():
            raise MemobenchError(f"the evaluation left no video of {name}; see its messages above")
        found.append(Path(shutil.move(video, folder / video.name)))
    return found


@dataclass(frozen=True)
class Outcome:
    """How a policy's episodes ended: whether each was solved, how many failed at a wrong referent; and its inputs."""

    solved: tuple[bool, ...]
    wrong: int
    inputs: str


def has_policies() -> bool:
    """Return whether the package brings the trained policies that are compared."""
    return {word.partition("=")[2] for words in POLICIES.values() for word in words} <= set(shipped_policies())


def memory_plan(
    name: str, folder: Path, *more: str, episodes: int = EPISODES, videos: int = RECORDED
) -> EvaluationPlan:
    """Return the plan of the evaluation of one of `POLICIES`, with ``more`` arguments of `lerobot eval`."""
    words = ["env=memobench", *POLICIES[name], f"tasks={BOWL}", "referent=random", f"horizon={HORIZON}"]
    words += [f"obs_type={OBJECTS}", f"episodes={episodes}", f"videos={videos}", f"output_dir={folder}"]
    return plan_line([*words, *more])


def compare_memories(work: Path, out: Path, evaluate: Callable[[str, Path], object]) -> dict[str, Outcome]:
    """Evaluate all `POLICIES`, each in a folder of its own in ``work``; write video, strip and table into ``out``.

    Args:
        evaluate: runs the evaluation of a name in a folder.
    """
    outcomes: dict[str, Outcome] = {}
    folders = {name: work / name.replace(" ", "_") for name in POLICIES}
    for name, folder in folders.items():
        evaluate(name, folder)
        outcomes[name] = _outcome(folder)
    ends = enumerate(zip(*(one.solved[:RECORDED] for one in outcomes.values()), strict=True))
    chosen = next((episode for episode, solved in ends if len({*solved}) > 1), 0)
    videos = {
        name: (folder / VIDEOS / f"{BOWL}.{chosen}.mp4", outcomes[name].solved[chosen])
        for name, folder in folders.items()
    }
    out.mkdir(parents=True, exist_ok=True)
    side_by_side(videos, out / MEMORY_VIDEO)
    strip(videos).save(out / MEMORY_STRIP, optimize=True)
    write_file(out / MEMORY_TABLE, table(outcomes))
    return outcomes


def _outcome(folder: Path) -> Outcome:
    records = read_episodes(folder)
    return Outcome(
        solved=tuple(bool(record["success"]) for record in sorted(records, key=itemgetter("episode"))),
        wrong=sum(not record["success"] and record.get("failure") == REFERENCE_DRIFT for record in records),
        inputs=policy_inputs(records),
    )


def table(outcomes: dict[str, Outcome]) -> str:
    """Return who solved how many of the episodes, and how many failed at a wrong bowl, as Markdown."""
    rows = [
        f"| {name} | {sum(one.solved)}/{len(one.solved)} | {one.wrong} | {one.inputs} |"
        for name, one in outcomes.items()
    ]
    head = "| butter into the bowl that the prompt showed, of three | solved | wrong bowl | inputs |"
    return "\n".join([head, "|---|---|---|---|", *rows]) + "\n"


def contact_sheet(videos: Sequence[Path]) -> Image:
    """Return a picture with one row per video: frames at even distances, the last one included."""
    from PIL import Image

    return Image.fromarray(np.concatenate([_row(video, COLUMN_WIDTH) for video in videos], axis=0))


def strip(videos: Mapping[str, tuple[Path, bool]]) -> Image:
    """Return a picture with a row per video, as in `contact_sheet`, under its name and how the episode ended."""
    from PIL import Image

    rows = []
    for name, (path, solved) in videos.items():
        row = _row(path, STRIP_WIDTH)
        rows.append(np.concatenate([title(name, row.shape[1], solved), row]))
    return Image.fromarray(np.concatenate(rows))


def side_by_side(videos: Mapping[str, tuple[Path, bool]], out: Path) -> Path:
    """Write one video of several; a shorter one waits at its last frame. Return its path.

    Args:
        videos: name -> file and whether the episode was solved. All are of the same height.
    """
    movie = VideoRecorder(out)
    try:
        for frame in joined(videos):
            movie.add(frame)
        movie.finish()
    finally:
        movie.discard()
    return out


def joined(videos: Mapping[str, tuple[Path, bool]]) -> Iterator[Frame]:
    """Yield the frames of the whole, (TITLE + height, sum of widths, 3) uint8."""
    read = {name: (read_video(path), solved) for name, (path, solved) in videos.items()}
    for step in range(max(len(frames) for frames, _ in read.values())):
        parts = []
        for name, (frames, solved) in read.items():
            over = step >= len(frames) - 1
            frame = frames[min(step, len(frames) - 1)]
            parts.append(np.concatenate([title(name, frame.shape[1], solved if over else None), frame]))
        yield np.concatenate(parts, axis=1)


def title(name: str, width: int, solved: bool | None) -> Frame:
    """Return the line over a video, (TITLE, width, 3): a name, and how it ended once it has (None before)."""
    from PIL import Image, ImageDraw, ImageFont

    band = Image.new("RGB", (width, TITLE), BACKGROUND)
    draw, font = ImageDraw.Draw(band), ImageFont.load_default(size=16)
    draw.text((8, TITLE // 2), name, fill=TEXT, font=font, anchor="lm")
    if solved is not None:
        words, colour = ("solved", SOLVED) if solved else ("failed", FAILED)
        draw.text((width - 8, TITLE // 2), words, fill=colour, font=font, anchor="rm")
    return np.asarray(band)


def _row(video: Path, width: int) -> Frame:
    """Return frames of a video at even distances, the first and the last included, each ``width`` wide."""
    from PIL import Image

    frames = read_video(video)
    chosen = [frames[k] for k in np.linspace(0, len(frames) - 1, FRAMES_PER_VIDEO).round().astype(int)]
    height = round(frames[0].shape[0] * width / frames[0].shape[1])
    resized = [Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS) for frame in chosen]
    return np.concatenate([np.asarray(frame) for frame in resized], axis=1)


def read_video(path: Path) -> list[Frame]:
    """Return every frame of a video."""
    import av

    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
