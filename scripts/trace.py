"""Count the package's files that common operations execute.

    python scripts/trace.py [--list] [OPERATION ...]

A file counts when one of its functions runs; code run by an import and code compiled by numba do not count. Each
operation runs in a process of its own, on the CPU, through public commands and LeRobot's interfaces:

words to plan      `lerobot eval env=memobench policy=memobench_strict …`, from the command line to the `EvaluationPlan`
control step       processors, `select_action` and `env.step`, at a step without planning
planned step       processors and `select_action`, at a step that plans an action chunk
training step      `lerobot train`: batch, processors and update, from the end of one update to the end of the next
generated episode  the whole command `memobench generate`, for one episode
report             the whole command `memobench report`, for one evaluation
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

if sys.path[0] == os.path.dirname(os.path.abspath(__file__)):
    del sys.path[0]  # this file has the name of a module of the standard library

SOURCE = Path(__file__).resolve().parents[1] / "src" / "lerobot_memobench"
TASK = "check_the_top_drawer_of_the_cabinet"
POLICY = "memobench_strict"
SEED = 20_000
STEPS = 48
"""Traced control steps; with 6 actions per chunk and a memory stride of 8, they include every kind of step."""

Functions = set[tuple[str, str]]
"""File (relative to the package) and qualified name of each executed function."""


class Trace:
    """Context manager that records in ``functions`` the package's functions executed by any thread."""

    _tool = sys.monitoring.PROFILER_ID
    _prefix = f"{SOURCE}{os.sep}"

    def __init__(self) -> None:
        self.functions: Functions = set()

    def __enter__(self) -> Trace:
        events = sys.monitoring.events
        sys.monitoring.use_tool_id(self._tool, "scripts/trace.py")
        sys.monitoring.restart_events()
        for event in (events.PY_START, events.PY_RESUME):
            sys.monitoring.register_callback(self._tool, event, self._record)
        sys.monitoring.set_events(self._tool, events.PY_START | events.PY_RESUME)
        return self

    def __exit__(self, *_: object) -> None:
        if sys.monitoring.get_tool(self._tool) is not None:
            sys.monitoring.set_events(self._tool, sys.monitoring.events.NO_EVENTS)
            sys.monitoring.free_tool_id(self._tool)

    def _record(self, code: CodeType, offset: int) -> Any:
        if not code.co_filename.startswith(self._prefix):
            return sys.monitoring.DISABLE
        frame: FrameType | None = sys._getframe(1)
        while frame is not None:
            if frame.f_code.co_name == "<module>" and frame.f_code.co_filename.startswith(self._prefix):
                return None  # executed by an import; keep watching the function
            frame = frame.f_back
        self.functions.add((code.co_filename.removeprefix(self._prefix), code.co_qualname))
        return sys.monitoring.DISABLE


def command(program: str, *words: object) -> None:
    """Run ``lerobot`` or ``memobench``."""
    from lerobot_memobench.cli import lerobot, memobench

    if status := {"lerobot": lerobot, "memobench": memobench}[program].main(list(map(str, words))):
        raise RuntimeError(f"{program} {words[0]} ended with status {status}")


def words_to_plan(folder: Path) -> list[Functions]:
    """Trace ``lerobot eval`` until the plan is complete, and stop the command there."""
    from lerobot_memobench.rollouts.plan import EvaluationPlan

    create, trace = EvaluationPlan.__init__, Trace()

    def create_and_stop(self: EvaluationPlan, *args: Any, **fields: Any) -> None:
        create(self, *args, **fields)
        trace.__exit__()
        raise SystemExit(0)

    EvaluationPlan.__init__ = create_and_stop  # type: ignore[method-assign]
    words = ("env=memobench", f"policy={POLICY}", f"tasks={TASK}", "episodes=2", f"output_dir={folder}/eval")
    with trace, contextlib.suppress(SystemExit):
        command("lerobot", "eval", *words)
    return [trace.functions]


def control_and_planned_step(folder: Path) -> list[Functions]:
    """Trace control steps of a shipped policy; return the smallest control step and the largest policy call.

    The smallest takes an action from the queue. The largest writes a frame to the memory and plans a chunk.
    """
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import make_env, make_env_pre_post_processors, preprocess_observation
    from lerobot.envs.configs import EnvConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.constants import ACTION
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_memobench.policies.checkpoint import shipped_policies

    register_third_party_plugins()
    source = shipped_policies()[POLICY]
    config = PreTrainedConfig.from_pretrained(source, cli_overrides=["--device=cpu"])
    policy = get_policy_class(config.type).from_pretrained(source, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(source))
    env_config = EnvConfig.get_choice_class("memobench")(
        tasks=TASK, obs_type="environment_state_agent_pos", log_dir=str(folder)
    )
    env = next(env for by_task in make_env(env_config, n_envs=1).values() for env in by_task.values())
    env_before, env_after = make_env_pre_post_processors(env_config, config)
    policy.reset()
    observation, _ = env.reset(seed=[SEED])
    policy_calls, env_calls = [], []
    for _ in range(STEPS):
        task = list(env.call("task_description"))
        with Trace() as trace, torch.inference_mode():
            batch = before(env_before(preprocess_observation(observation) | {"task": task}))
            action = env_after({ACTION: after(policy.select_action(batch))})[ACTION].numpy()
        policy_calls.append(trace.functions)
        with Trace() as trace:
            observation, *_ = env.step(action)
        env_calls.append(trace.functions)
    env.close()
    smallest = min(range(1, STEPS), key=lambda t: len(policy_calls[t]))
    return [policy_calls[smallest] | env_calls[smallest], max(policy_calls[1:], key=len)]


def training_step(folder: Path) -> list[Functions]:
    """Trace ``lerobot train`` from the end of its second update to the end of its third, and stop it there."""
    from lerobot_memobench.training.loop import TrainingState

    generate(folder)
    update, trace, count = TrainingState.update, Trace(), 0

    def count_update(state: TrainingState, batch: dict[str, Any]) -> dict[str, Any]:
        nonlocal count
        result = update(state, batch)
        count += 1
        if count == 2:
            trace.__enter__()
        elif count == 3:
            trace.__exit__()
            raise SystemExit(0)
        return result

    TrainingState.update = count_update  # type: ignore[assignment,method-assign]
    policy = ("policy=memobench_mem", "size=small", "perception=objects", "align=semantic", "device=cpu")
    run = (f"dataset={folder}/dataset", "steps=9", "batch_size=12", "num_workers=0", f"output_dir={folder}/train")
    with contextlib.suppress(SystemExit):
        command("lerobot", "train", *policy, *run)
    return [trace.functions]


def generate(folder: Path) -> None:
    """Generate a dataset of one episode."""
    command("memobench", "generate", "--tasks", TASK, "--episodes", 1, "--no-images", "--out", folder / "dataset")


def generated_episode(folder: Path) -> list[Functions]:
    """Trace ``memobench generate``."""
    with Trace() as trace:
        generate(folder)
    return [trace.functions]


def report(folder: Path) -> list[Functions]:
    """Trace ``memobench report``, of an evaluation that another process runs so that all caches here are cold."""
    run_in_process(partial(evaluate, folder=folder / "eval"))
    with Trace() as trace:
        command("memobench", "report", folder / "eval")
    return [trace.functions]


def evaluate(_: Path, folder: Path) -> list[Functions]:
    """Evaluate one short episode."""
    policy = ("policy=memobench_random", "horizon=5", "obs_type=environment_state_agent_pos")
    command("lerobot", "eval", "env=memobench", *policy, f"tasks={TASK}", "episodes=1", f"output_dir={folder}")
    return []


OPERATIONS: dict[tuple[str, ...], Callable[[Path], list[Functions]]] = {
    ("words to plan",): words_to_plan,
    ("control step", "planned step"): control_and_planned_step,
    ("training step",): training_step,
    ("generated episode",): generated_episode,
    ("report",): report,
}


def run_in_process(operation: Callable[[Path], list[Functions]]) -> list[Functions]:
    """Run an operation in a new process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return process.submit(run_quietly, operation).result()


def run_quietly(operation: Callable[[Path], list[Functions]]) -> list[Functions]:
    """Run an operation in a temporary folder; print its output only if it fails."""
    output = io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        try:
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                return operation(Path(folder))
        except BaseException:
            print(output.getvalue(), file=sys.stderr)
            raise


def main() -> None:
    """Trace the given operations and print a table."""
    names = [name for group in OPERATIONS for name in group]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("operation", nargs="*", metavar="OPERATION", help=f"{', '.join(names)}; default: all")
    parser.add_argument("--list", action="store_true", help="print the files and their executed functions")
    args = parser.parse_args()
    if unknown := [name for name in args.operation if name not in names]:
        parser.error(f"unknown operation {unknown[0]!r}; available: {', '.join(names)}")
    os.environ |= {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    selected = args.operation or names
    print("| operation | files | functions |\n|---|---|---|")
    for group, operation in OPERATIONS.items():
        if not set(group) & set(selected):
            continue
        for name, functions in zip(group, run_in_process(operation), strict=True):
            if name not in selected:
                continue
            files = sorted({file for file, _ in functions})
            print(f"| {name} | {len(files)} | {len(functions)} |", flush=True)
            for file in files if args.list else ():
                print(f"    {file}: {', '.join(sorted(function for where, function in functions if where == file))}")


if __name__ == "__main__":
    main()
