"""How many of the project's own files the everyday calls enter.

    python scripts/trace.py [--list] [CALL ...]

A file is entered when one of its functions runs; what an import runs does not count, nor what numba has compiled. Each
call is made in a process of its own, on the CPU, by public commands and LeRobot's interfaces:

words to plan      `lerobot eval env=memobench policy=memobench_small …`, from the typed words to the `EvaluationPlan`
control step       processors, `select_action` and `env.step`, of a step at which nothing is planned
planned step       processors and `select_action`, of a step at which an action chunk is planned
training step      `lerobot train`: batch, processors and update, from the end of one update to the end of the next
generated episode  `memobench generate` of one episode, all of the command
report             `memobench report` of one evaluation, all of the command
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
from types import CodeType, FrameType, TracebackType
from typing import Any

if sys.path[0] == os.path.dirname(os.path.abspath(__file__)):
    del sys.path[0]  # this file is named like a module of Python's library

SOURCE = Path(__file__).resolve().parents[1] / "src" / "lerobot_memobench"
TASK = "check_the_top_drawer_of_the_cabinet"
POLICY = "memobench_small"
SEED = 20_000
STEPS = 48
"""Control steps that are watched: with 6 actions per chunk and every 8th frame in memory, all kinds are among them."""

Functions = set[tuple[str, str]]
"""File, below the package, and qualified name of each function that ran."""


class Watch:
    """While it lasts, note which of the project's functions run, in all threads.

    Attributes:
        functions: those that ran.
    """

    _tool = sys.monitoring.PROFILER_ID

    def __init__(self) -> None:
        self.functions: Functions = set()
        self._prefix = f"{SOURCE}{os.sep}"

    def __enter__(self) -> Watch:
        self.start()
        return self

    def start(self) -> None:
        """Note from now on."""
        events = sys.monitoring.events
        sys.monitoring.use_tool_id(self._tool, "scripts/trace.py")
        sys.monitoring.restart_events()
        for event in (events.PY_START, events.PY_RESUME):
            sys.monitoring.register_callback(self._tool, event, self._note)
        sys.monitoring.set_events(self._tool, events.PY_START | events.PY_RESUME)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.stop()

    def stop(self) -> None:
        """Note no more."""
        if sys.monitoring.get_tool(self._tool) is not None:
            sys.monitoring.set_events(self._tool, sys.monitoring.events.NO_EVENTS)
            sys.monitoring.free_tool_id(self._tool)

    def _note(self, code: CodeType, offset: int) -> Any:
        if not code.co_filename.startswith(self._prefix):
            return sys.monitoring.DISABLE
        frame: FrameType | None = sys._getframe(1)
        while frame is not None:
            if frame.f_code.co_name == "<module>" and frame.f_code.co_filename.startswith(self._prefix):
                return None  # an import runs it; it may be called again
            frame = frame.f_back
        self.functions.add((code.co_filename.removeprefix(self._prefix), code.co_qualname))
        return sys.monitoring.DISABLE  # it is noted once


def lerobot(*words: object) -> None:
    """Run the command ``lerobot``.

    Raises:
        RuntimeError: it failed.
    """
    from lerobot_memobench.cli.lerobot import main

    if status := main([str(word) for word in words]):
        raise RuntimeError(f"lerobot {words[0]} ended with status {status}")


def memobench(*words: object) -> None:
    """Run the command ``memobench``.

    Raises:
        RuntimeError: it failed.
    """
    from lerobot_memobench.cli.memobench import main

    if status := main([str(word) for word in words]):
        raise RuntimeError(f"memobench {words[0]} ended with status {status}")


def words_to_plan(folder: Path) -> list[Functions]:
    """Trace ``lerobot eval`` until its plan is made, and end it there."""
    from lerobot_memobench.run.plan import EvaluationPlan

    make, watch = EvaluationPlan.__init__, Watch()

    def made(self: EvaluationPlan, *parts: Any, **fields: Any) -> None:
        make(self, *parts, **fields)
        watch.stop()
        raise SystemExit(0)

    EvaluationPlan.__init__ = made  # type: ignore[method-assign]
    with watch, contextlib.suppress(SystemExit):
        lerobot("eval", "env=memobench", f"policy={POLICY}", f"tasks={TASK}", "episodes=2", f"output_dir={folder}/eval")
    return [watch.functions]


def control_and_planned_step(folder: Path) -> list[Functions]:
    """Trace control steps of a shipped policy; return the one at which it does least and its side of the one at which
    it does most.

    The least is an action from the queue, before the environment's step. The most is a frame that is remembered and a
    chunk that is planned.
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
    scene = EnvConfig.get_choice_class("memobench")(
        tasks=TASK, obs_type="environment_state_agent_pos", log_dir=str(folder)
    )
    env = next(env for by_task in make_env(scene, n_envs=1).values() for env in by_task.values())
    env_before, env_after = make_env_pre_post_processors(scene, config)
    policy.reset()
    observation, _ = env.reset(seed=[SEED])
    policy_sides, env_sides = [], []
    for _ in range(STEPS):
        task = list(env.call("task_description"))
        with Watch() as watch, torch.inference_mode():
            batch = before(env_before(preprocess_observation(observation) | {"task": task}))
            action = env_after({ACTION: after(policy.select_action(batch))})[ACTION].numpy()
        policy_sides.append(watch.functions)
        with Watch() as watch:
            observation, *_ = env.step(action)
        env_sides.append(watch.functions)
    env.close()
    least = min(range(1, STEPS), key=lambda t: len(policy_sides[t]))
    return [policy_sides[least] | env_sides[least], max(policy_sides[1:], key=len)]


def training_step(folder: Path) -> list[Functions]:
    """Trace ``lerobot train`` from the end of its second update to that of its third, and end it there."""
    from lerobot_memobench.training.loop import Run

    memobench("generate", "--tasks", TASK, "--episodes", 1, "--no-images", "--out", folder / "dataset")
    update, watch, count = Run.update, Watch(), 0

    def updated(run: Run, batch: dict[str, Any]) -> dict[str, Any]:
        nonlocal count
        if count == 3:  # the third has been made
            raise SystemExit(0)
        result = update(run, batch)
        count += 1
        if count == 2:
            watch.start()
        elif count == 3:
            watch.stop()
        return result

    Run.update = updated  # type: ignore[method-assign]
    with contextlib.suppress(SystemExit):
        policy = ("policy=memobench_mem", "size=small", "perception=objects", "align=semantic", "device=cpu")
        run = (f"dataset={folder}/dataset", "steps=9", "batch_size=12", "num_workers=0", f"output_dir={folder}/train")
        lerobot("train", *policy, *run)
    return [watch.functions]


def generated_episode(folder: Path) -> list[Functions]:
    """Trace ``memobench generate``."""
    with Watch() as watch:
        memobench("generate", "--tasks", TASK, "--episodes", 1, "--no-images", "--out", folder / "dataset")
    return [watch.functions]


def report(folder: Path) -> list[Functions]:
    """Trace ``memobench report`` of an evaluation that another process makes, so that nothing of it is warm here."""
    in_other_process(partial(evaluate, folder=folder / "eval"))
    with Watch() as watch:
        memobench("report", folder / "eval")
    return [watch.functions]


def evaluate(_: Path, folder: Path) -> list[Functions]:
    """Write the log of one short episode."""
    policy = ("policy=memobench_random", "horizon=5", "obs_type=environment_state_agent_pos")
    lerobot("eval", "env=memobench", *policy, f"tasks={TASK}", "episodes=1", f"output_dir={folder}")
    return []


CALLS: dict[tuple[str, ...], Callable[[Path], list[Functions]]] = {
    ("words to plan",): words_to_plan,
    ("control step", "planned step"): control_and_planned_step,
    ("training step",): training_step,
    ("generated episode",): generated_episode,
    ("report",): report,
}


def in_other_process(call: Callable[[Path], list[Functions]]) -> list[Functions]:
    """Make a call where nothing has run before."""
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return process.submit(quietly, call).result()


def quietly(call: Callable[[Path], list[Functions]]) -> list[Functions]:
    """Make a call in a folder that is gone afterwards; what it prints is shown only when it fails."""
    said = io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                return call(Path(folder))
        except BaseException:
            print(said.getvalue(), file=sys.stderr)
            raise


def main() -> None:
    """Trace the calls that are asked for and print a table."""
    known = [name for names in CALLS for name in names]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("call", nargs="*", metavar="CALL", help=f"one of: {', '.join(known)}; all when left out")
    parser.add_argument("--list", action="store_true", help="print the files, with the functions in each")
    asked = parser.parse_args()
    if unknown := [name for name in asked.call if name not in known]:
        parser.error(f"there is no call {unknown[0]!r}; expected one of: {', '.join(known)}")
    os.environ |= {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    wanted = asked.call or known
    print("| call | files | functions |\n|---|---|---|")
    for names, call in CALLS.items():
        if not set(names) & set(wanted):
            continue
        traced = dict(zip(names, in_other_process(call), strict=True))
        for name in (name for name in names if name in wanted):
            functions = traced[name]
            files = sorted({file for file, _ in functions})
            print(f"| {name} | {len(files)} | {len(functions)} |", flush=True)
            for file in files if asked.list else ():
                print(f"    {file}: {', '.join(sorted(called for where, called in functions if where == file))}")


if __name__ == "__main__":
    main()
