"""Net ``logs``: files of evaluations, field by field.

`lerobot eval` with cheap policies, one command per group of settings. The facts are the fields of each episode, with
the settings that the reader of the log adds, of ``evaluation.json`` and of ``report.json``; of fields that differ from
run to run (times, paths, versions, commit) only the type. Batch sizes follow from the number of cores. About 3 CPU
minutes.
"""

import json
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

from scripts.nets.access import records_of, succeed
from scripts.nets.store import Facts, Parts, flatten

OBJECTS = "obs_type=environment_state_agent_pos"
RANDOM, BLIND = f"policy=memobench_random {OBJECTS}", f"policy=memobench_blind {OBJECTS}"
SHIPPED = "suite=strict policy=memobench_strict"
EVALUATIONS = (
    "tasks=4,7 episodes=1",
    f"{RANDOM} tasks=1,12,24,28 episodes=1 horizon=30",
    "suite=strict tasks=4,24 episodes=1",
    f"{SHIPPED} tasks=4 episodes=2 split=validation horizon=120",
    "suite=libero_object policy=memobench_random tasks=0,1 episodes=1 horizon=20 policy.seed=3",
    f"{BLIND} tasks=21,26 referent=random prompt_in=steps episodes=2 horizon=60 seed=40",
    f"{BLIND} tasks=4,7 episodes=1 pause_steps=15 speed=0.5 horizon=120",
    f"{RANDOM} suite=strict difficulty=hard tasks=4 episodes=1 horizon=20 env.delay_steps=2 replan=4",
    f"{BLIND} tasks=21 referent=random evidence=true episodes=3 horizon=60",
    f"{SHIPPED} tasks=24 episodes=1 interference=1 horizon=60",
    f"{SHIPPED} tasks=24 episodes=1 corrupt=delete horizon=60",
    f"{RANDOM} rules=upstream tasks=7 episodes=1 horizon=20",
    f"{BLIND.replace(OBJECTS, 'obs_type=both')} convention=libero observation_height=64 observation_width=64 "
    "robot_state=true tasks=7 episodes=1 horizon=20 videos=1",
)
FILES = ("evaluation.json", "report.json")
UNSTEADY = re.compile(
    r"(^|\.)(wall_s|written|git_commit|runs\.\d+\.(versions|machine|command)\.\w+)$|seconds|_s$|^versions\."
)


def parts() -> Parts:
    """Return one part per evaluation."""
    return {words: partial(evaluate, words) for words in EVALUATIONS}


def evaluate(words: str, folder: Path) -> Facts:
    """Run an evaluation; return the facts of its files."""
    out = folder / re.sub(r"\W+", "_", words)
    shutil.rmtree(out, ignore_errors=True)  # of an interrupted run
    succeed("lerobot", "eval", "env=memobench", *words.split(), f"output_dir={out}")
    files = {file: json.loads((out / file).read_text()) for file in FILES}
    names = sorted(file.relative_to(out).as_posix() for file in out.rglob("*") if file.is_file())
    found: Facts = {words: {"files": re.sub(r"\.\d+\.jsonl", ".jsonl", " ".join(names))}}
    for record in records_of(out):
        found[f"{words}: {record['task']} {record['episode']}"] = fields(record, "record", out)
    for name, content in files.items():
        found[words] |= fields(content, name, out)
    return found


def fields(content: dict[str, Any], name: str, out: Path) -> dict[str, Any]:
    """Return the fields of a file or line; of an unsteady one its type."""
    return {
        f"{name} {field}": f"some {type(value).__name__}"
        if UNSTEADY.search(field)
        else (value.replace(str(out), "<folder>") if isinstance(value, str) else value)
        for field, value in flatten(content).items()
    }
