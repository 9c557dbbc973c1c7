"""Everything that the nets read behind the outer interface. A redesign may edit this file, and no other one here."""

import contextlib
import io
import os
import sys
import tomllib
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from scripts.nets.store import ROOT


def simulation(env: Any) -> tuple[Any, Any]:
    """Return MuJoCo's model and data of a gymnasium environment that has been reset."""
    sim = env.unwrapped.episode.sim
    return sim.model, sim.data


def shipped_policy(name: str) -> Path:
    """Return the folder of a shipped policy."""
    (file,) = (ROOT / "src").rglob(f"{name}/config.json")
    return file.parent


def records_of(folder: Path) -> list[dict[str, Any]]:
    """Return the episodes of an evaluation, with its settings."""
    from lerobot_memobench.envs.episode_log import read_log

    return read_log(folder)


def run(program: str, *words: object, folder: Path | None = None) -> tuple[int, str]:
    """Run a command of `pyproject.toml`, or another, in this process and in a folder; return exit status and output."""
    output, before, line = io.StringIO(), Path.cwd(), [str(word) for word in words]
    ours = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    argv, sys.argv = sys.argv, [program, *line]
    os.chdir(folder or before)
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            if program in ours:
                module, _, name = ours[program].partition(":")
                status: Any = getattr(import_module(module), name)(line)
            else:
                (entry,) = entry_points(group="console_scripts", name=program)
                status = entry.load()()
    except SystemExit as end:
        status = end.code
    except Exception as error:
        status = f"traceback: {error!r}"
    finally:
        os.chdir(before)
        sys.argv = argv
    return (1, f"{output.getvalue()}{status}") if isinstance(status, str) else (status or 0, output.getvalue())


def succeed(program: str, *words: object) -> None:
    """Run a command; raise a ``RuntimeError`` if its exit status is not 0."""
    status, output = run(program, *words)
    if status:
        raise RuntimeError(f"{program} {words[0]} ended with status {status}:\n{output[-3000:]}")
