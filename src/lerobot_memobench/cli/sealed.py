"""``memobench test-sealed``: an evaluation on the seeds that are looked at once per release."""

from __future__ import annotations

from typing import Annotated

import typer


def test_sealed(
    settings: Annotated[
        list[str],
        typer.Argument(help="As for `lerobot eval env=memobench`: policy=…, suite=…, tasks=….", metavar="policy=…"),
    ],
) -> int:
    """Evaluate on the sealed seeds, and count how often. 100007 to 100056, once per release, when all is chosen: output
    and card tell which run of this policy it is.
    """
    from lerobot_memobench.cli.lerobot import run
    from lerobot_memobench.protocol import SEALED

    return run(["eval", "env=memobench", *settings, f"split={SEALED}"])
