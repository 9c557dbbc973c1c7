"""Evaluate a policy in stock LIBERO with the authors' protocol, and compare the episodes with this package's in pairs.

    python examples/openpi_server.py POLICY --port 8000 &
    PYTHONPATH=src:. LIBERO/bin/python scripts/libero_bridge.py stock FOLDER --replan 8
    lerobot eval env=memobench protocol=upstream policy=POLICY replan=8 episodes=10 output_dir=HERE …
    python scripts/libero_bridge.py compare HERE FOLDER

`stock` runs in the environment of `libero_records.py`, plus httpx, msgpack, pydantic and websockets. It follows the
authors' script (seed 7 + k, ten stabilisation steps, 990 steps, end when each checkpoint has been true once) and
requests a chunk from a policy server every `--replan` steps. Physics, contacts, controller, placement, observations and
predicates are LIBERO's. `tasks.progress` evaluates the goal over time, because stock LIBERO has no `Then` and `Was…`.
No image is rendered: the server computes object state from LIBERO's simulator state. Repeat the command to run missing
episodes.
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

from lerobot_memobench.envs.episode_log import MERGED_FILE, has_log, read_lines
from lerobot_memobench.envs.evaluation_file import FORMAT, write_facts
from lerobot_memobench.evaluation.statistics import mcnemar
from lerobot_memobench.policies.remote.transports import Websocket
from lerobot_memobench.protocol import EVALUATION_SEED, UPSTREAM, UPSTREAM_EVALUATIONS, UPSTREAM_HORIZON
from lerobot_memobench.sim.libero.classes import CLASSES
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task
from scripts.libero_records import NO_OP, STABILISATION_STEPS, holds, make, prepare, task_files

TIMEOUT = 60.0
"""Timeout of the connection and of each answer, s."""

Record = dict[str, Any]
Pair = tuple[Record, Record]


def tasks_without_scans() -> list[str]:
    """Return the published tasks that need only LIBERO's assets."""
    return [name for name in task_files() if set(get_task(name).objects.values()) <= set(CLASSES)]


# --- stock LIBERO ---


def stock(folder: Path, tasks: list[str], episodes: int, server: Websocket, replan: int) -> None:
    """Run the missing episodes of some tasks and append them to the log in ``folder``."""
    prepare()
    protocol = {"suite": "published", "protocol": UPSTREAM, "seed_base": EVALUATION_SEED, "referent": "fixed"}
    protocol |= {"demonstration_prompt": False, "horizon": UPSTREAM_HORIZON, "replan_steps": replan}
    write_facts(folder, {"format": FORMAT, "protocol": protocol, "policy": {}})
    done = {(record["task"], record["episode"]) for record in read(folder)}
    for name in tasks:
        for episode in range(episodes):
            if (name, episode) in done:
                continue
            record = play(get_task(name), episode, server, replan)
            with (folder / MERGED_FILE).open("a") as log:
                log.write(json.dumps(record) + "\n")
            print(name, record["seed"], "success" if record["success"] else "-", record["steps"], flush=True)


def play(task: Task, episode: int, server: Websocket, replan: int) -> Record:
    """Run one episode and return its log record (`envs.episode_log`)."""
    start, seed, env = time.monotonic(), EVALUATION_SEED + episode, make(task.name)
    progress, queue = Progress(task, UPSTREAM_EVALUATIONS), deque[NDArray[np.float32]]()
    server.open(TIMEOUT)
    env.seed(seed)
    env.reset()

    def is_true(atom: Atom) -> bool:
        return holds(env, " ".join((atom.predicate, *atom.args)))

    for _ in range(STABILISATION_STEPS):
        observation, *_ = env.step(NO_OP)
        progress.settle(is_true)
    while progress.steps < UPSTREAM_HORIZON and not progress.success and None in progress.first_step:
        if not queue:
            queue.extend(server.ask(request(env, task, observation, progress.steps))["actions"][:replan])
        observation, *_ = env.step(list(map(float, queue.popleft())))
        progress.step(is_true)
    server.close()
    env.close()
    steps = zip(task.checkpoints, progress.first_step, progress.ordered_step, strict=True)
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": episode,
        "seed": seed,
        "variant": 0,
        "prompt_steps": 0,
        "steps": progress.steps,
        "success": progress.success,
        "checkpoints": [
            {"operation": checkpoint.operation, "first_step": first, "ordered_step": ordered}
            for checkpoint, first, ordered in steps
        ],
        "wall_s": round(time.monotonic() - start, 3),
    }


def request(env: Any, task: Task, observation: dict[str, NDArray[np.float64]], step: int) -> dict[str, Any]:
    """Return a request to the server: the authors' keys without images, the step, and the simulator state."""
    from robosuite.utils.transform_utils import quat2axisangle

    rotation = quat2axisangle(observation["robot0_eef_quat"])
    state = np.concatenate([observation["robot0_eef_pos"], rotation, observation["robot0_gripper_qpos"]])
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
    """Return the episodes of a folder's log, [] without a log."""
    return read_lines(folder, []) if has_log(folder) else []


def pairs_of(here: Path, there: Path) -> list[Pair]:
    """Return the episodes in both folders, matched by task and number."""
    others = {(record["task"], record["episode"]): record for record in read(there)}
    keyed = {(record["task"], record["episode"]): record for record in read(here)}
    return [(record, others[key]) for key, record in keyed.items() if key in others]


def complete(record: Record) -> bool:
    """Return whether each checkpoint has been true once."""
    return all(checkpoint["first_step"] is not None for checkpoint in record["checkpoints"])


def row(name: str, pairs: list[Pair]) -> str:
    """Return a table row: success and complete checkpoints of both sides, discordant pairs, exact p."""
    cells = [name, str(len(pairs))]
    for value in (lambda record: bool(record["success"]), complete):
        here, there = (np.array([value(pair[side]) for pair in pairs]) for side in (0, 1))
        discordant = int((here & ~there).sum()), int((there & ~here).sum())
        cells += [f"{100 * side.mean():.0f}" for side in (here, there)]
        cells += [f"{discordant[0]}, {discordant[1]}", f"{mcnemar(*discordant):.2f}"]
    return f"| {' | '.join(cells)} |"


def different(pairs: Iterable[Pair]) -> Iterator[str]:
    """Yield a row for each pair with different outcomes: the steps at which its checkpoints became true."""
    for here, there in pairs:
        if (here["success"], complete(here)) != (there["success"], complete(there)):
            steps = [[checkpoint["first_step"] for checkpoint in side["checkpoints"]] for side in (here, there)]
            yield f"| {here['task']} | {here['seed']} | {steps[0]} | {steps[1]} |".replace("None", "–")


def compare(here: Path, there: Path) -> None:
    """Print rates of both sides by task, and the pairs with different outcomes."""
    pairs = pairs_of(here, there)
    print("| task | pairs | SR here | SR stock | one alone | p | complete here | stock | one alone | p |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in dict.fromkeys(record["task"] for record, _ in pairs):
        print(row(name, [pair for pair in pairs if pair[0]["task"] == name]))
    print(row("all", pairs))
    print("\n| task | seed | checkpoints here | stock |\n|---|---:|---|---|", *different(pairs), sep="\n")


def main() -> None:
    """Run a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    acting = commands.add_parser("stock", help="evaluate a policy in stock LIBERO")
    acting.add_argument("folder", type=Path)
    acting.add_argument("--tasks", nargs="+", default=tasks_without_scans())
    acting.add_argument("--episodes", type=int, default=10)
    acting.add_argument("--replan", type=int, default=8)
    acting.add_argument("--server", default="ws://127.0.0.1:8000")
    comparing = commands.add_parser("compare", help="compare this package's episodes with those of stock LIBERO")
    comparing.add_argument("here", type=Path)
    comparing.add_argument("there", type=Path)
    args = parser.parse_args()
    if args.command == "compare":
        compare(args.here, args.there)
    else:
        stock(args.folder, args.tasks, args.episodes, Websocket(args.server, TIMEOUT), args.replan)


if __name__ == "__main__":
    main()
