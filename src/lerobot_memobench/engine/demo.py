"""``memobench demo``: the scripted expert on one task of each memory type, in videos, a contact sheet and a
report.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.cli.console import console
from lerobot_memobench.engine.card import CARD_MARKDOWN
from lerobot_memobench.envs.episode_log import MERGED_FILE
from lerobot_memobench.envs.protocol import PROTOCOL_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.report import REPORT_JSON, REPORT_MARKDOWN
from lerobot_memobench.evaluation.records.protocol import CARD_FILE

#: One task of each memory type.
TASKS = (
    "turn_on_the_stove_and_turn_it_off",
    "put_the_tomato_into_the_top_drawer_of_the_cabinet",
    "put_the_butter_into_the_bowl_from_the_prompt_video",
    "execute_the_assembly_procedure_demonstrated_in_the_prompt_video",
)
VIDEOS = "videos"
CONTACT_SHEET = "contact_sheet.png"
FRAMES_PER_VIDEO = 6
COLUMN_WIDTH = 320
"""Width of a frame in the contact sheet, pixels."""

#: What is taken over from the evaluation.
RESULTS = (MERGED_FILE, REPORT_JSON, REPORT_MARKDOWN, PROTOCOL_FILE, CARD_FILE, CARD_MARKDOWN)

#: All that a demo writes, and so all that a new one removes.
PRODUCTS = (*RESULTS, VIDEOS, CONTACT_SHEET)

Frame = NDArray[np.uint8]


def run_demo(out: Path) -> int:
    """Evaluate, then put the results into ``out``; return the exit status.

    The evaluation works in a folder of its own, so a demo that fails leaves an earlier one as it was.
    """
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"{out} is a file; name a folder")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".demo-", dir=out) as scratch:
        work = Path(scratch) / "eval"
        status = run_expert(work)
        if status:
            return status
        videos = collect_videos(work, Path(scratch) / VIDEOS)
        contact_sheet(list(videos.values())).save(Path(scratch) / CONTACT_SHEET, optimize=True)
        for name in PRODUCTS:
            _remove(out / name)
        for name in RESULTS:
            shutil.move(work / name, out / name)
        shutil.move(Path(scratch) / VIDEOS, out / VIDEOS)
        shutil.move(Path(scratch) / CONTACT_SHEET, out / CONTACT_SHEET)
    screen = console()
    screen.print(f"report:  {out / REPORT_MARKDOWN}", soft_wrap=True)
    screen.print(f"videos:  {out / VIDEOS}", soft_wrap=True)
    screen.print(f"picture: {out / CONTACT_SHEET}", soft_wrap=True)
    return 0


def run_expert(output: Path) -> int:
    """Run ``lerobot eval env=memobench`` on the four tasks, one episode each, filmed."""
    from lerobot_memobench.cli.lerobot import run

    words = ["eval", "env=memobench", f"tasks={','.join(TASKS)}", "episodes=1", "env.videos=true"]
    return run([*words, f"output_dir={output}"], say_where=False)


def collect_videos(evaluation: Path, folder: Path) -> dict[str, Path]:
    """Move the film of each task's episode into ``folder`` under the task's name; return them."""
    folder.mkdir(parents=True)
    found = {}
    for name in TASKS:
        film = evaluation / VIDEOS / f"{name}.0.mp4"
        if not film.is_file():
            raise MemobenchError(f"the evaluation left no film of {name}; see its messages above")
        found[name] = Path(shutil.move(film, folder / f"{name}.mp4"))
    return found


def contact_sheet(videos: list[Path]):  # type: ignore[no-untyped-def] # PIL's Image, imported late
    """Return a picture with one row per video: frames at even distances, the last one included."""
    from PIL import Image

    rows = []
    for video in videos:
        frames = evenly(read_video(video), FRAMES_PER_VIDEO)
        small = [_resized(frame) for frame in frames]
        rows.append(np.concatenate(small, axis=1))
    return Image.fromarray(np.concatenate(rows, axis=0))


def evenly(frames: list[Frame], count: int) -> list[Frame]:
    """Return ``count`` frames at even distances, the first and the last included."""
    return [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]


def _resized(frame: Frame) -> Frame:
    from PIL import Image

    height = round(frame.shape[0] * COLUMN_WIDTH / frame.shape[1])
    return np.asarray(Image.fromarray(frame).resize((COLUMN_WIDTH, height), Image.Resampling.LANCZOS))


def read_video(path: Path) -> list[Frame]:
    """Return every frame of a video, (height, width, 3) uint8 each."""
    import av

    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
