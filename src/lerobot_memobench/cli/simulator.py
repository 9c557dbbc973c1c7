"""``memobench gallery``: how the simulated world looks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.suite import Suite, WhichSuite


def gallery(
    out: Annotated[Path, typer.Option(help="Folder of the pictures; those of the same name are replaced.")] = Path(
        "outputs/gallery"
    ),
    suite: WhichSuite = Suite.PUBLISHED,
) -> None:
    """Draw every task's initial scene, every object and fixture. Objects from all sides, fixtures open and closed."""
    from lerobot_memobench.sim.gallery import write_gallery

    for picture in write_gallery(out, suite):
        console().print(str(picture), soft_wrap=True)
