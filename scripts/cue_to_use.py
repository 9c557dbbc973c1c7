"""Measure the control steps from the cue of each checkpoint to its use, in episodes of the scripted expert.

    python scripts/cue_to_use.py --episodes 3 --log outputs/cue_to_use.jsonl

runs the expert on all tasks without rendering, appends one line per episode to the log (the same command continues an
interrupted run) and writes ``src/lerobot_memobench/tasks/cue_to_use.json``. ``docs/benchmark/gap.md`` defines them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from lerobot_memobench.constants import DEMONSTRATION_SEED, PROMPT
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.io import write_file
from lerobot_memobench.tasks.catalogue import CUE_TO_USE_FILE, cue_in_prompt, get_task, task_names
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task

VISIBLE = 0.002
"""Smallest visible displacement of a joint or an object, m or rad."""
HOME = Atom("handhome", ())


def cue_to_use_of(task: Task, seed: int) -> tuple[bool, list[int | None]]:
    """Return success and the cue-to-use times of checkpoints without held steps; None: not reached, or no cue."""
    episode = Episode(task, referent="random")
    episode.reset(seed)
    cues = _prompt_cues(episode)
    start = episode.exec_start or 0
    scenes, homes = [_scene(episode)], [True]
    while not episode.done:
        episode.step(episode.expert_action())
        if episode.rested:
            continue
        scenes.append(_scene(episode))
        homes.append(episode.sim.holds(HOME))
    steps: list[int | None] = []
    before = 0
    for k, reached in enumerate(episode.progress.ordered_step):
        if reached is None:
            steps.append(None)
            continue
        use = max([before, *(step for step in range(before, reached) if homes[step])])
        if cue_in_prompt(episode.task, k):
            steps.append(start + use - cues[k])
        else:  # at first the instruction is enough, even where LIBERO's scene still moves by itself
            steps.append(_since_change(scenes[: use + 1]) if k else None)
        before = reached
    return episode.success, steps


def _prompt_cues(episode: Episode) -> list[int]:
    """Play the prompt; return for each checkpoint its last step that shows the answer."""
    task, sim = episode.task, episode.sim
    shown, last, closed = Progress(task), 0, 0
    places = dict(task.prompt.places) if task.prompt else {}
    goals = [atom.args[0] for atom in atoms(task.goal) if atom.predicate == "on"]
    asked = next((places[name] for name in goals if name in places), None)
    while episode.phase == PROMPT:
        rests = episode.idling
        episode.step(np.zeros(7, np.float32))
        if rests or episode.phase != PROMPT:
            continue
        last = episode.step_index
        if asked is not None:
            closed = closed if sim.holds(Atom("close", (asked,))) else last
        elif task.prompt is not None and task.prompt.kind == "routine":
            shown.step(sim.holds)
    return [step or closed or last for step in shown.ordered_step]


def _scene(episode: Episode) -> NDArray[np.float64]:
    sim = episode.sim
    joints = [sim.world.articulation(name)[1] for name in sorted(sim.world.joints)]
    return np.array([*joints, *(x for name in episode.task.objects for x in sim.body_pose(name)[0])])


def _since_change(scenes: list[NDArray[np.float64]]) -> int | None:
    """Return the number of steps since the scene last differed visibly from the last one; None if it never did."""
    differs = np.abs(np.array(scenes) - scenes[-1]).max(axis=1) > VISIBLE
    return int(len(scenes) - 1 - np.flatnonzero(differs)[-1]) if differs.any() else None


def summary(lines: list[dict[str, Any]]) -> dict[str, list[list[int] | None]]:
    """Return task -> for each checkpoint the least, median and largest number of steps; None for one without a cue."""
    found: dict[str, list[list[int] | None]] = {}
    for name in task_names(suite=None):
        episodes = [line["cue_to_use"] for line in lines if line["task"] == name and line["success"]]
        columns = [[steps for steps in column if steps is not None] for column in zip(*episodes, strict=True)]
        found[name] = [[min(c), int(np.median(c)), max(c)] if c else None for c in columns]
    return found


def main(
    log: Annotated[Path, typer.Option(help="Log of the episodes; the same command continues it.")] = Path(
        "outputs/cue_to_use.jsonl"
    ),
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each task.")] = 3,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = DEMONSTRATION_SEED,
) -> None:
    """Measure all tasks and write the shipped file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    done = {(line["task"], line["seed"]) for line in lines}
    for number in range(seed, seed + episodes):
        for name in task_names(suite=None):
            if (name, number) in done:
                continue
            success, steps = cue_to_use_of(get_task(name), number)
            lines.append({"task": name, "seed": number, "success": success, "cue_to_use": steps})
            with log.open("a") as file:
                file.write(json.dumps(lines[-1]) + "\n")
    rows = [f"{json.dumps(name)}: {json.dumps(row)}" for name, row in summary(lines).items()]
    write_file(CUE_TO_USE_FILE, "{\n" + ",\n".join(rows) + "\n}\n")


if __name__ == "__main__":
    typer.run(main)
