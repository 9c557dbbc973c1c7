"""The demo: the scripted expert on one task of each memory type, and beside it policies that have learned one.

In videos, a contact sheet and a report; one film shows expert, memory and no memory side by side (`memory_demo`).
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from lerobot_memobench.envs.episode_log import MERGED_FILE, PROTOCOL_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.report import REPORT_JSON, REPORT_MARKDOWN
from lerobot_memobench.evaluation.records.protocol import CARD_FILE
from lerobot_memobench.run.card import CARD_MARKDOWN
from lerobot_memobench.run.contact_sheet import contact_sheet
from lerobot_memobench.run.folder import VIDEOS
from lerobot_memobench.run.memory_demo import MEMORY_FILM, MEMORY_STRIP, MEMORY_TABLE
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.run.planning import plan_line
from lerobot_memobench.tasks.catalogue import BOWL

#: One task of each memory type.
TASKS = (
    "turn_on_the_stove_and_turn_it_off",
    "put_the_tomato_into_the_top_drawer_of_the_cabinet",
    BOWL,
    "execute_the_assembly_procedure_demonstrated_in_the_prompt_video",
)
CONTACT_SHEET = "contact_sheet.png"

#: What is taken over from the evaluation.
RESULTS = (MERGED_FILE, REPORT_JSON, REPORT_MARKDOWN, PROTOCOL_FILE, CARD_FILE, CARD_MARKDOWN)

#: All that a demo writes, and so all that a new one removes.
PRODUCTS = (*RESULTS, VIDEOS, CONTACT_SHEET, MEMORY_FILM, MEMORY_STRIP, MEMORY_TABLE)


def demo_plan(folder: Path) -> EvaluationPlan:
    """Return the plan of the demo's evaluation: one filmed episode of each task."""
    words = ["env=memobench", f"tasks={','.join(TASKS)}", "episodes=1", "env.videos=true"]
    return plan_line([*words, f"output_dir={folder}"])


def make_demo(out: Path, evaluate: Callable[[Path], int], compare: Callable[[Path, Path], object] | None) -> int:
    """Evaluate and compare, then put the results into ``out``; return the exit status.

    The evaluation works in a folder of its own, so a demo that fails leaves an earlier one as it was.

    Args:
        evaluate: runs the demo's evaluation in a folder and returns its exit status.
        compare: works in one folder and writes into another what `memory_demo.compare_memories` does; None where the
            package brings no trained policies.
    """
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"{out} is a file; name a folder")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".demo-", dir=out) as scratch:
        work = Path(scratch) / "eval"
        status = evaluate(work)
        if status:
            return status
        made = Path(scratch) / "made"
        if compare is not None:
            compare(Path(scratch) / "memory", made)
        videos = collect_videos(work, made / VIDEOS)
        contact_sheet(videos).save(made / CONTACT_SHEET, optimize=True)
        for name in RESULTS:
            shutil.move(work / name, made / name)
        for name in PRODUCTS:
            _remove(out / name)
            if (made / name).exists():
                shutil.move(made / name, out / name)
    return 0


def collect_videos(evaluation: Path, folder: Path) -> list[Path]:
    """Move the film of each task's episode into ``folder``, under its name, by which the HTML report finds it."""
    folder.mkdir(parents=True)
    found = []
    for name in TASKS:
        film = evaluation / VIDEOS / f"{name}.0.mp4"
        if not film.is_file():
            raise MemobenchError(f"the evaluation left no film of {name}; see its messages above")
        found.append(Path(shutil.move(film, folder / film.name)))
    return found


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
