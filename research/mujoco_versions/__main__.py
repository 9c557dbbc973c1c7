"""``python -m research.mujoco_versions``: the expert under this MuJoCo and another."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from research.command import run


def versions(
    packages: Annotated[Path, typer.Argument(help="Folder that holds the other MuJoCo.")],
    out: Annotated[Path, typer.Option(help="Folder of what both sides did; a study that was ended goes on there.")],
    seeds: Annotated[int, typer.Option(min=1, help="Episodes per task.")] = 5,
    task: Annotated[list[str] | None, typer.Option(help="Only this task; may be given again.")] = None,
) -> None:
    """Run the expert on all sixty tasks under both, and print what differs."""
    from research.mujoco_versions.study import compare, run_both, table

    run_both(packages, out, seeds, task)
    print(table(*compare(out)))


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    arguments = sys.argv[1:] if argv is None else argv
    if arguments[:1] == ["side"]:  # one side, in a process of its own
        from research.mujoco_versions.study import run_side

        run_side(Path(arguments[1]), int(arguments[2]), arguments[3:])
        return 0
    return run("mujoco_versions", versions, argv)


if __name__ == "__main__":
    sys.exit(main())
