"""Net ``commands``: forty-three command lines, conformance of seven memories, and the recomputed results.

The facts are the exit status, whether the output names the wrong key and the nearest known name, whether there is a
traceback, and written files; the outcome of each check of `memobench conformance`; each row of
`scripts/recompute.py`. Sentences are not compared. About 2 CPU minutes.
"""

import json
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

from lerobot_memobench.policies.memobench_mem.memory import OURS
from scripts.nets.access import run, shipped_policy
from scripts.nets.store import ROOT, Facts, Parts

SHORT = {
    "EVAL": "lerobot eval env=memobench",
    "CHEAP": "lerobot eval env=memobench obs_type=environment_state_agent_pos tasks=4 horizon=3 episodes=1",
    "TRAIN": "lerobot train policy=memobench_mem size=small perception=objects",
    "LEROBOTS": "lerobot-eval --env.type=memobench --policy.path=usable",
}
LINES = """
lerobot --help
lerobot eval --help
lerobot train --help
memobench --help
memobench tasks --suite strict
memobench objects --json
CHEAP policy=memobench_random output_dir=out/eval
memobench report out/eval
CHEAP policy=memobench_random output_dir=out/eval resume=true
CHEAP policy=memobench_random output_dir=./out/eval -> out/eval -> resume=true
CHEAP policy=memobench_random output_dir=out/eval resume=true speed=0.5 -> speed
CHEAP policy=memobench_blind output_dir=out/eval resume=true -> policy
lerobot evl env=memobench -> evl -> eval
lerobot eval env=memobensh -> memobensh -> memobench
EVAL episode=3 -> episode -> episodes
EVAL env.horizn=3 -> env.horizn -> env.horizon
EVAL policy=memobench_stric -> memobench_stric -> memobench_strict
EVAL policy=memobench_mem policy.memroy=bank -> policy.memroy -> policy.memory
EVAL tasks=temporl -> temporl -> temporal
EVAL tasks=check_the_top_drawer_of_the_cabine -> tasks -> check_the_top_drawer_of_the_cabinet
EVAL tasks=31 -> 31
EVAL policy=memobench_random task=libero_object task_ids=[10] -> 10
TRAIN policy.memory=bnk dataset=out/none -> bnk -> bank
lerobot train config=train_papr dataset=out/none -> train_papr -> train_paper
memobench generate --tsks all --out out/x -> --tsks -> --tasks
memobench tasks --suite publishd -> publishd -> published
EVAL episodes=many -> episodes
CHEAP policy=memobench_random speed=0.7 -> speed
EVAL observation_height=255 -> observation_height
LEROBOTS --env.suite=strict --env.tasks=4 --env.replan_steps=7 -> env.replan_steps -> replan
CHEAP policy=memobench_random difficulty=hard -> difficulty -> strict
CHEAP policy=memobench_random corrupt_step=4 -> corrupt_step -> corrupt
memobench generate --suite libero_object --out out/x -> libero_object -> lerobot/libero
EVAL policy=./nothing -> nothing
EVAL policy=./empty -> empty -> config.json
EVAL policy=./unweighted suite=strict -> model.safetensors
EVAL policy=./untyped -> unknown_policy -> policy type
EVAL policy=memobench_strict suite=strict policy.memory=none -> memory
EVAL config_path=nothing.yaml -> nothing.yaml
TRAIN dataset=./nothing output_dir=out/train -> nothing
memobench rerun nothing --out out/again -> nothing
memobench merge out/merged nothing -> nothing
LEROBOTS --env.horizn=3 -> horizn
"""
"""Command -> wrong key or value, which the error names -> suggested name. Lines use files of earlier ones."""

SMALL = ("policy=memobench_mem", "policy.size=small", "policy.perception=objects", "policy.num_inference_steps=1")
ROW = re.compile(r"^[│|]\s*([^│|\s][^│|]*?)\s*[│|]\s*([^│|]+?)\s*[│|]", re.MULTILINE)


def parts() -> Parts:
    """Return one part per command line, in their order, one per memory, and one of the results."""
    lines = {line: partial(outcome, *line.split(" -> ")) for line in LINES.strip().splitlines()}
    return {
        **lines,
        **{f"conformance {memory}": partial(conform, memory) for memory in OURS},
        "recompute": recompute,
    }


def outcome(words: str, *names: str, folder: Path) -> Facts:
    """Run a command line in a folder with good and bad checkpoints; return its facts."""
    place = folder / "place"
    if not place.exists():
        (place / "empty").mkdir(parents=True)
        for name in ("usable", "unweighted", "untyped"):
            shutil.copytree(shipped_policy("memobench_strict"), place / name)
        (place / "unweighted" / "model.safetensors").unlink()
        config = place / "untyped" / "config.json"
        config.write_text(json.dumps(json.loads(config.read_text()) | {"type": "unknown_policy"}))
    before = set(place.rglob("*"))
    first, *others = words.split()
    program, *line = [*SHORT.get(first, first).split(), *others]
    status, output = run(program, *line, folder=place)
    found = {"exit status": status, "traceback": "traceback:" in output}
    for field, name in zip(("names the key", "names the nearest"), names, strict=False):
        found[field] = re.search(rf"(?<!\w){re.escape(name)}(?!\w)", " ".join(output.split())) is not None
    written = (file.relative_to(place).as_posix() for file in set(place.rglob("*")) - before if file.is_file())
    dated = re.compile(r"\.\d+(?=\.jsonl)|\d{4}-\d\d-\d\d/\d\d-\d\d-\d\d")
    return {words: {**found, "writes": " ".join(sorted(dated.sub("", name) for name in written))}}


def conform(memory: str, folder: Path) -> Facts:
    """Check the conformance of a memory; return the outcome of each check."""
    status, output = run("memobench", "conformance", *SMALL, f"policy.memory={memory}")
    return {f"conformance {memory}": {"exit status": status, **dict(ROW.findall(output))}}


def recompute(folder: Path) -> Facts:
    """Recompute the published figures; return the facts of the rows."""
    command = [sys.executable, "scripts/recompute.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return {"recompute": {"exit status": done.returncode, **dict.fromkeys(done.stdout.splitlines(), True)}}
