"""Let a policy act in stock LIBERO by the authors' protocol, and compare its episodes with those here, pair by pair.

    python examples/openpi_server.py POLICY --port 8000 &
    PYTHONPATH=src:. LIBERO/bin/python scripts/libero_bridge.py stock FOLDER --replan 8
    lerobot eval env=memobench world=libero protocol=upstream policy=POLICY replan=8 episodes=10 output_dir=HERE …
    python scripts/libero_bridge.py compare HERE FOLDER

`stock` runs in the environment of `libero_records.py`, with httpx, msgpack, pydantic and websockets in addition. It
makes each episode's environment as the authors' script does (seed 7 + k, ten stabilisation steps, 990 steps, the end
when each checkpoint has held once) and asks a policy server for a chunk every `--replan` steps. Physics, contacts,
controller, placement, observations and atoms of predicates are LIBERO's. `tasks.progress` follows the goal over time,
since stock LIBERO does not know `Then` and `Was…`. No picture is drawn: the server computes object state from LIBERO's
simulator state. Given again, it goes on with the episodes that are missing.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.episode_log import MERGED_FILE, has_log, read_log
from lerobot_memobench.evaluation.statistics import mcnemar
from lerobot_memobench.policies.remote.transports import Websocket
from lerobot_memobench.protocol import EVALUATION_SEED, UPSTREAM, UPSTREAM_EVALUATIONS, UPSTREAM_HORIZON
from lerobot_memobench.sim.libero.classes import SCANS
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task
from scripts.libero_records import NO_OP, STABILISATION_STEPS, holds, make, prepare, task_files

PATIENCE = 60.0
"""How long the server is waited for, and each of its answers, s."""

Record = dict[str, Any]
Pair = tuple[Record, Record]


def tasks_without_scans() -> list[str]:
    """Return the published tasks that LIBERO's own assets suffice for."""
    return [name for name in task_files() if not set(get_task(name).objects.values()) & set(SCANS)]


# --- stock LIBERO ---


def stock(folder: Path, tasks: list[str], episodes: int, server: Websocket, replan: int) -> None:
    """Log the episodes of some tasks that a folder lacks."""
    prepare()
    folder.mkdir(parents=True, exist_ok=True)
    done = {(one["task"], one["episode"]) for one in read(folder)}
    for name in tasks:
        for episode in range(episodes):
            if (name, episode) in done:
                continue
            record = play(get_task(name), episode, server, replan)
            with (folder / MERGED_FILE).open("a") as log:
                log.write(json.dumps(record) + "\n")
            print(name, record["seed"], "success" if record["success"] else "-", record["steps"], flush=True)


def play(task: Task, episode: int, server: Websocket, replan: int) -> Record:
    """Return the record of one episode, in the fields of `envs.episode_log`."""
    began, seed, env = time.monotonic(), EVALUATION_SEED + episode, make(task.name)
    progress, queue = Progress(task, UPSTREAM_EVALUATIONS), deque[NDArray[np.float32]]()
    server.open(PATIENCE)
    env.seed(seed)
    env.reset()

    def asked(atom: Atom) -> bool:
        return holds(env, " ".join((atom.predicate, *atom.args)))

    for _ in range(STABILISATION_STEPS):
        observed, *_ = env.step(NO_OP)
        progress.settle(asked)
    while progress.steps < UPSTREAM_HORIZON and not progress.success and None in progress.first_step:
        if not queue:
            queue.extend(server.ask(question(env, task, observed, progress.steps))["actions"][:replan])
        observed, *_ = env.step(list(map(float, queue.popleft())))
        progress.step(asked)
    server.close()
    env.close()
    steps = zip(task.checkpoints, progress.first_step, progress.ordered_step, strict=True)
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": episode,
        "seed": seed,
        "referent": "fixed",
        "variant": 0,
        "replan_steps": replan,
        "prompt_steps": 0,
        "steps": progress.steps,
        "success": progress.success,
        "checkpoints": [
            {"operation": one.operation, "first_step": first, "ordered_step": ordered} for one, first, ordered in steps
        ],
        "world": "libero",
        "protocol": UPSTREAM,
        "wall_s": round(time.monotonic() - began, 3),
    }


def question(env: Any, task: Task, observed: dict[str, NDArray[np.float64]], step: int) -> dict[str, Any]:
    """Return the request to the server: the authors' keys without images, the step, and the simulator's state."""
    from robosuite.utils.transform_utils import quat2axisangle

    turned = quat2axisangle(observed["robot0_eef_quat"])
    state = np.concatenate([observed["robot0_eef_pos"], turned, observed["robot0_gripper_qpos"]])
    model = env.sim.model
    bodies = {name: env.obj_body_id[name] for name in env.fixtures_dict}
    return {
        "observation/state": state.astype(np.float32),
        "observation/step": np.array([step], np.float32),
        "prompt": task.language,
        "simulator/task": task.name,
        "simulator/state": env.sim.get_state().flatten(),
        "simulator/fixtures": {
            name: np.concatenate([model.body_pos[body], model.body_quat[body]]) for name, body in bodies.items()
        },
    }


# --- comparison ---


def read(folder: Path) -> list[Record]:
    """Return the episodes of a folder's log, none where there is none."""
    return read_log(folder, []) if has_log(folder) else []


def pairs_of(here: Path, there: Path) -> list[Pair]:
    """Return the episodes that both folders hold, by task and number."""
    others = {(one["task"], one["episode"]): one for one in read(there)}
    found = [(one, others.get((one["task"], one["episode"]))) for one in read(here)]
    return [(one, other) for one, other in found if other is not None]


def complete(record: Record) -> bool:
    """Return whether each checkpoint has held once."""
    return all(one["first_step"] is not None for one in record["checkpoints"])


def row(name: str, pairs: list[Pair]) -> str:
    """Return a line of the table: success and complete checkpoints on both sides, discordant pairs, exact p."""
    cells = [name, str(len(pairs))]
    for value in (lambda one: bool(one["success"]), complete):
        mine, other = (np.array([value(pair[side]) for pair in pairs]) for side in (0, 1))
        alone = int((mine & ~other).sum()), int((other & ~mine).sum())
        cells += [f"{100 * side.mean():.0f}" for side in (mine, other)]
        cells += [f"{alone[0]}, {alone[1]}", f"{mcnemar(*alone):.2f}"]
    return f"| {' | '.join(cells)} |"


def different(pairs: Iterable[Pair]) -> Iterator[str]:
    """Yield a line for each pair that differs in its checkpoints: at which steps they held on both sides."""
    for here, there in pairs:
        if (here["success"], complete(here)) != (there["success"], complete(there)):
            held = [[one["first_step"] for one in side["checkpoints"]] for side in (here, there)]
            yield f"| {here['task']} | {here['seed']} | {held[0]} | {held[1]} |".replace("None", "–")


def compare(here: Path, there: Path) -> None:
    """Print rates of both sides by task, and the pairs that differ."""
    pairs = pairs_of(here, there)
    print("| task | pairs | SR here | SR stock | one alone | p | complete here | stock | one alone | p |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in dict.fromkeys(one["task"] for one, _ in pairs):
        print(row(name, [pair for pair in pairs if pair[0]["task"] == name]))
    print(row("all", pairs))
    print("\n| task | seed | checkpoints here | stock |\n|---|---:|---|---|", *different(pairs), sep="\n")


def main() -> None:
    """Run the requested command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    acting = commands.add_parser("stock", help="let a policy act in stock LIBERO")
    acting.add_argument("folder", type=Path)
    acting.add_argument("--tasks", nargs="+", default=tasks_without_scans())
    acting.add_argument("--episodes", type=int, default=10)
    acting.add_argument("--replan", type=int, default=8)
    acting.add_argument("--server", default="ws://127.0.0.1:8000")
    comparing = commands.add_parser("compare", help="compare episodes here with those in stock LIBERO")
    comparing.add_argument("here", type=Path)
    comparing.add_argument("there", type=Path)
    asked = parser.parse_args()
    if asked.command == "compare":
        compare(asked.here, asked.there)
    else:
        stock(asked.folder, asked.tasks, asked.episodes, Websocket(asked.server, PATIENCE), asked.replan)


if __name__ == "__main__":
    main()
