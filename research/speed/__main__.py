"""``python -m research.speed``: steps, resets and workers, timed against stock robosuite."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from research.command import run


def speed(
    names: Annotated[list[str] | None, typer.Argument(help="Which benchmarks; all when left out.")] = None,
) -> None:
    """Time steps, resets and workers against stock robosuite. All in one run; the table belongs in a bug report."""
    from research.speed.claims import measure
    from research.speed.sides import table

    lines = []
    for line in measure(names):
        print(line.json(), flush=True)
        lines.append(line)
    print(f"\n{table(lines)}")


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("speed", speed, argv)


if __name__ == "__main__":
    sys.exit(main())
