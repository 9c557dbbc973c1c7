"""``python -m research.clock``: is it memory, or a clock?"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.io import write_file
from lerobot_memobench.protocol import IDLE_STEPS
from research.command import run


def clock(
    dataset: Annotated[
        Path, typer.Argument(help="Demonstrations of strict tasks, without pictures; with --prompts of any.")
    ],
    idle: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Most control steps that the robot idles, 0 and as it does if left out; repeatable."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of clock.json and clock.md.")] = Path("outputs/clock"),
    prompts: Annotated[
        bool, typer.Option("--prompts", help="Print what the lengths of prompts tell instead; no file is written.")
    ] = False,
) -> None:
    """Measure how often a classifier decides rightly from the present observation and the step, beside chance."""
    if prompts:
        from research.clock.prompts import prompt_lengths, prompts_table

        print(prompts_table([*prompt_lengths(dataset)]))
        return
    from research.clock.study import markdown, study

    results = []
    for one in study(dataset, idle or [0, IDLE_STEPS]):
        results.append(one)
        print(f"{len(results)} {one['task']}", file=sys.stderr)
    table = markdown(results)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "clock.json", json.dumps(results, indent=1) + "\n")
    write_file(out / "clock.md", table + "\n")
    print(table)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("clock", clock, argv)


if __name__ == "__main__":
    sys.exit(main())
